"""`elastic train`: the training seeds of configurations, in turn or side by side, resumable."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from math import isfinite, nan
from pathlib import Path

from rich.console import Console
from rich.table import Table

from train.evaluate.environments import environment
from train.evaluate.episodes import Progress
from train.evaluate.progress import read_progress
from train.learn.algorithm_options import CONSTANTS
from train.learn.train_config import TrainConfig
from train.learn.trainer import Trainer
from train.runs.console import make_table
from train.runs.folders import lock_part, lock_run, require_name, run_folder
from train.runs.progress import Show, show_progress
from train.runs.user_code import recorded_config
from train.workers.calls import Watch, run_calls
from train.workers.executors import Executors
from train.workers.pool import Outcome

ONE_BY_ONE = Executors(jobs=1)
"""Seeds in turn, in this process, with all cores for the physics of each."""
_PATIENCE_S = 60.0
"""How long the program that works on a training seed is waited for."""


@dataclass(frozen=True)
class Run:
    """A configuration and the folder of its training."""

    config: TrainConfig
    folder: Path

    @property
    def is_complete(self) -> bool:
        """True if all training seeds have come to their end."""
        seeds = self.config.seeds
        return all(_is_complete(self.folder / f"seed_{seed}") for seed in seeds)


def start(
    configs: Sequence[TrainConfig],
    console: Console,
    output: Path | None = None,
    executors: Executors = ONE_BY_ONE,
) -> list[Path]:
    """Train all seeds of some configurations, each in a new run.

    Args:
        configs: What is trained.
        console: Where progress and results go.
        output: Folder, new or empty; of several configurations each has a folder in it by its name.
            Default runs/<name>, numbered if taken.
        executors: Where seeds are trained, and how many at a time; the weights do not depend on it.

    Returns:
        The runs' folders; there is none where nothing could begin.

    Raises:
        ConfigurationError: Names or options that do not exist.
        ResultsExistError: The output folder holds results.
    """
    runs = list[Run]()
    with ExitStack() as held:
        for config in configs:
            own = output
            if output is not None and len(configs) > 1:
                own = output / require_name(config.name)
            recorded = config.model_dump(mode="json")
            made = run_folder(config.name, recorded, config.seeds[0], own)
            runs.append(Run(config, held.enter_context(made)))
            held.enter_context(lock_run(runs[-1].folder))
        _train(runs, console, executors)
    return [run.folder for run in runs]


def resume(
    folders: Sequence[Path],
    console: Console,
    executors: Executors = ONE_BY_ONE,
    trust_code: bool = False,
) -> list[Path]:
    """Go on with runs that were interrupted or killed; seeds that are complete stay as they are.

    Args:
        folders: Of the runs.
        console: Where progress and results go.
        executors: Where seeds are trained, and how many at a time.
        trust_code: Whether an algorithm of one's own, "module:Class", may be imported: its code may
            lie in a folder.

    Raises:
        ConfigurationError: A folder is no training run, another program works on it, or its
            algorithm is not trusted.
    """
    configs = [recorded_config(own, TrainConfig, trust_code) for own in folders]
    runs = list(map(Run, configs, folders))
    with ExitStack() as held:
        for run in runs:
            held.enter_context(lock_run(run.folder))
        _train(runs, console, executors)
    return [run.folder for run in runs]


def _train(runs: Sequence[Run], console: Console, executors: Executors) -> None:
    for run in runs:
        text = f"training in {run.folder}; if it stops: elastic train --resume {run.folder}"
        if run.is_complete:
            cure = "to learn for longer, start a new run with --decisions"
            text = f"{run.folder} is complete; {cure}"
        console.print(text, soft_wrap=True)
    calls = [(run, seed) for run in runs for seed in run.config.seeds]
    names = [f"seed {seed}" for _, seed in calls]
    if len(runs) > 1:
        names = [f"{run.folder}, seed {seed}" for run, seed in calls]
    decisions = [run.config.decisions for run, _ in calls]
    totals = dict(zip(names, decisions, strict=True))
    with show_progress(console, totals, unit="decisions") as show:
        if executors == ONE_BY_ONE:
            for number, (run, seed) in enumerate(calls):
                _train_seed(run, seed, 0, partial(show, number))
        else:
            threads = executors.threads_per_call(len(calls))
            given = [(Run(r.config, r.folder.resolve()), seed, threads) for r, seed in calls]
            watch = _watch(names, console, show)
            with executors.open_pool(len(given), runs[0].folder) as pool:
                # Ctrl-C ends at once: a seed may take hours, and goes on from its checkpoint
                outcomes = run_calls(_train_seed, given, pool, watch, finishes=False)
            _raise_first(names, outcomes)
    for run in runs:
        console.print(_table(run.config, run.folder))


def _watch(names: Sequence[str], console: Console, show: Show) -> Watch:
    """Show the progress of seeds that are trained side by side."""
    done = [0] * len(names)

    def report(number: int, decisions: int) -> None:
        done[number] = max(done[number], decisions)
        show(number, done[number], watch.tally.summary("seeds"))

    def move(number: int) -> None:
        text = f"a worker was lost; {names[number]} goes on from its checkpoint"
        console.print(text, soft_wrap=True)

    watch = Watch(on_report=report, on_move=move)
    return watch


def _raise_first(names: Sequence[str], outcomes: Sequence[Outcome | None]) -> None:
    """The first error of a seed, when the others have ended."""
    for name, outcome in zip(names, outcomes, strict=True):
        if outcome is not None and (error := outcome.error) is not None:
            error.add_note(f"in the training of {name}; the other seeds have ended")
            raise error


def _train_seed(run: Run, seed: int, threads: int, report: Progress) -> None:
    """Train a seed, or go on with it.

    A worker that has lost its scheduler ends within some seconds. Another one, which takes its seed
    over, waits for it.
    """
    config = run.config
    own = run.folder / f"seed_{seed}"
    report(0)
    with lock_part(own, _PATIENCE_S):
        if not _is_complete(own):
            training = _trainer(config)(config, seed, own, threads)
            report(training.done)
            training.run(lambda done: report(min(done, config.decisions)))
    report(config.decisions)


def _is_complete(own: Path) -> bool:
    """True if a seed's training has come to its end."""
    return (own / "last").is_dir()


def _trainer(config: TrainConfig) -> type[Trainer]:
    if config.algorithm == CONSTANTS:
        from train.learn.constant_search import ConstantSearch

        return ConstantSearch
    from train.learn.training import Training

    return Training


def _table(config: TrainConfig, folder: Path) -> Table:
    """Scores of the last policies against their base, on the episodes of the evaluations."""
    columns = environment(config.env).judged
    metrics = [column.metric for column in columns]
    head = ["seed", "scenario", *(column.label for column in columns), "failed"]
    table = []
    for seed in config.seeds:
        rows = read_progress(folder / f"seed_{seed}", metrics, ["failed"])
        for row in (row for row in rows if row["decisions"] == rows[-1]["decisions"]):
            both = [(row[f"base_{c.metric}"], row[c.metric], c.scale) for c in columns]
            changes = [_change(*own) for own in both]
            table.append([str(seed), row["scenario"], *changes, f"{row['failed']:.0f}"])
    title = f"last policies on {config.base}, on episodes that training never sees"
    return make_table(title, head, table, left=2)


def _change(base: float, mine: float, scale: float) -> str:
    """Two scores and the change between them; - for one of which all episodes failed."""
    scores = [scale * score for score in (base, mine)]
    both = " → ".join(f"{score:.2f}" if isfinite(score) else "-" for score in scores)
    change = mine / base - 1.0 if base else nan
    return f"{both} ({100.0 * change:+.0f} %)" if isfinite(change) else both
