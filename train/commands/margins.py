"""`elastic margins`: the largest push, slope and load, and the softest joints, without a fall."""

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from rich.console import Console

from elastic_env.core.config import LARGEST_SEED, Entries, Locator, Model, Once, Title, quantity
from elastic_env.core.files import write_whole
from train.commands.comparison import try_out
from train.commands.options import MotionOrDefault
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.margin_search import (
    QUANTITIES,
    Causes,
    failure_causes,
    find_margins,
    margin_table,
)
from train.evaluate.rollout import num_steps
from train.runs.console import make_table, print_files
from train.runs.escaping import write_records
from train.runs.folders import run_folder
from train.runs.progress import show_progress

_MAX_ROBOTS = 64

Field = Literal["push_n", "stiffness", "slope_rad", "load_kg", "floor_friction"]


class Margins(Model):
    """Find how far a walk is from a fall: by bisection, for each of several robots.

    It searches the largest push, slope and load, the softest joints and the least friction of the
    floor. It prints the edge of the robot that fails first, and the median over robots. A star
    means: beyond its edge that robot does not stand even before a policy acts.

    Survival need not be monotone, and bisection finds one edge. So all robots walk once more at 0.9
    of the way to the first robot's edge.

    Example, one policy: elastic margins --policies input_output --robots 4 --quantities push_n
    """

    policies: Annotated[Entries[Locator], Once] = [
        "input_output",
        "adaptive_posture",
        "foothold",
        "thormang",
    ]
    """Baselines, residual:PATH, "FILE.py:function" or "module:function"."""
    quantities: Entries[Field] = list(get_args(Field))
    """Fields of the scenario that are varied, one at a time."""
    scenario: Title = "spread"
    """Scenario of the robots; not one with ranges, such as drawn."""
    reference: MotionOrDefault = 3
    """Walk, as in elastic evaluate."""
    robots: int = quantity("1", 8, ge=1, le=_MAX_ROBOTS)
    """Robots; their seeds follow --seed."""
    halvings: int = quantity("1", 7, ge=1, le=30)
    """Halvings of each interval; each is a walk of all robots."""
    seed: int = quantity("1", 0, ge=0, le=LARGEST_SEED - _MAX_ROBOTS)
    """Seed of the first robot."""
    threads: int = quantity("1", 0, ge=0, le=1024)
    """Threads of the physics, 0 for all cores."""
    output: Path | None = None
    """Folder for margins.csv and margins.json, new or empty; default runs/margins, numbered if
    taken."""

    def run(self, console: Console) -> None:
        """Bisect for each policy, and write the margins after each."""
        chosen = [q for q in QUANTITIES if q.field in self.quantities]
        conditions = [
            Condition(
                env="walker",
                policy=PolicySpec(name=name),
                scenario=self.scenario,
                reference=self.reference,
                seed=self.seed,
            )
            for name in self.policies
        ]
        try_out(conditions)
        steps = num_steps(conditions)
        walks = self.halvings + 1
        totals = {name: walks * n for name, n in zip(self.policies, steps, strict=True)}
        recorded = self.model_dump(mode="json", exclude={"output", "threads"})
        records: list[dict[str, Any]] = []
        with run_folder("margins", recorded, self.seed, self.output) as folder:
            files = [folder / "margins.csv", folder / "margins.json"]
            with show_progress(console, totals, unit="control steps") as show:
                for number, condition in enumerate(conditions):
                    starts = itertools.count(0, steps[number])
                    play = partial(self._play, starts, partial(show, number))
                    records += find_margins(condition, chosen, self.robots, self.halvings, play)
                    rows = [{k: r[k] for k in r if k != "edges"} for r in records]
                    write_records(rows, files[0])
                    write_whole(files[1], json.dumps(records, indent=2) + "\n")
        title = f"worst / median edge of {self.robots} robots, {conditions[0].reference_name}"
        console.print(make_table(title, *margin_table(records)))
        print_files(folder, files, console)

    def _play(
        self, starts: Iterator[int], show: Callable[[int], None], conditions: Sequence[Condition]
    ) -> Causes:
        """Play a walk of all robots, whose progress begins at the next of the starts."""
        start = next(starts)
        return failure_causes(conditions, self.threads, lambda done: show(start + done))
