"""`elastic iterate`: learn offsets from trial to trial, and write them as a policy."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import model_validator
from rich.console import Console
from rich.table import Table

from baselines.adaptation.iterative import IterativeLearner, Trial, Trials
from baselines.adaptation.learned_signals import LearningGains, learned_signals
from baselines.adaptation.offset_folder import TableDescription, motion_of, save_table
from baselines.catalogue import learned_base
from baselines.policy_options import PolicyOptions
from elastic_env.core.config import Model, Title, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.world.robot_model import WalkerModel
from train.commands.options import DEFAULT_SCENARIO, MotionOrDefault
from train.evaluate.conditions import Condition, PolicySpec, Seed, cell_of
from train.evaluate.rollout import make_policy, make_vector_env
from train.evaluate.scores import over_cells
from train.figures import plots
from train.figures.score_charts import trials_chart
from train.report.tables import number_interval
from train.runs.console import make_table
from train.runs.escaping import write_records
from train.runs.folders import provenance, run_folder
from train.runs.progress import show_progress

_MOST_ROBOTS = 64


class Iterate(Model):
    """Learn on the robot itself, from walk to walk: iterative learning control.

    No training in simulation is needed.

    After each trial the measurements of IMU and foot sensors correct the offsets of the next trial
    at the same time of the motion. On the testbed these are the measurements of the link's IMU.
    Prints a table of the trials; trial 0 is the base, the last one has all learned offsets. Writes
    the learned offsets as a policy iterative:FOLDER, trials.csv and a picture.

    Example: elastic iterate --scenario soft --trials 10

    Example, one joint: elastic iterate --env testbed --reference sine --scenario soft
    """

    env: str = "walker"
    """Environment: walker, testbed, robot, ROBOT.yaml (a file of any robot, see docs/robots.md),
    or "FILE.py:ROBOT", a JointRobot."""
    scenario: Title = DEFAULT_SCENARIO
    """Scenario, see elastic evaluate --help."""
    reference: MotionOrDefault = None
    """Motion, as in elastic evaluate; it must be the same in every trial."""
    trials: int = quantity("1", 10, ge=1, le=1000)
    """Number of trials to learn from."""
    base: Title | None = None
    """Policy to which offsets are learned; default adaptive_posture, on the testbed input."""
    seed: Seed = 0
    """Seed of the robot, where the scenario draws one."""
    robots: int = quantity("1", 1, ge=1, le=_MOST_ROBOTS)
    """Number of robots, each of which learns alone; their seeds follow --seed."""
    output: Path | None = None
    """Folder for the run, new or empty; default runs/iterate, numbered if taken."""
    figure_format: plots.FigureFormat = "png"
    """Format of the figures: pdf and svg have no resolution, and png has 300 dpi."""

    @model_validator(mode="after")
    def _motion_repeats(self) -> "Iterate":
        condition = self.condition
        if condition.environment.draws(condition.reference):
            raise ConfigurationError(
                f"the reference {condition.reference!r} draws another motion for every seed, and"
                " what is learned for one is wrong for another; name one that repeats, such as"
                " sine or hold"
            )
        return self

    @property
    def gains(self) -> LearningGains:
        """Gains of the learning."""
        return LearningGains(trials=self.trials)

    @property
    def condition(self) -> Condition:
        """Robot, scenario and motion of the trials."""
        options: dict[str, Any] = {"learning": self.gains}
        if self.base is not None:
            options["learned_base"] = self.base
        return cell_of(self, PolicySpec(name="iterative", options=options))

    def run(self, console: Console) -> list[Trial]:
        """Learn, play a last trial with the learned offsets, write the run, and print the trials.

        Returns:
            The trials; the first has no offsets, the last has all learned ones.

        Raises:
            ConfigurationError: A name or a parameter does not exist.
            ResultsExistError: The output folder contains results.
        """
        plots.require_matplotlib()
        condition = self.condition
        recorded = self.model_dump(mode="json", exclude={"output", "figure_format"})
        with closing(make_vector_env(condition, self.robots)) as env:
            policy: IterativeLearner = make_policy(condition.policy, env)
            with run_folder("iterate", recorded, self.seed, self.output) as folder:
                trials = self._play(env, policy, console)
                title = f"Learned on the robot, {self.scenario}"
                chart = trials_chart(trials, condition.environment.judged, title)
                files = [
                    self._write(trials, policy.names, folder / "trials.csv"),
                    plots.draw_chart(chart, folder / f"trials.{self.figure_format}"),
                ]
                policies = self._save(env, policy, folder)
        console.print(trials_table(trials, condition))
        for path in files:
            console.print(f"wrote {path}")
        for path in policies:
            console.print(f"play it as iterative:{path}")
        return trials

    def _play(self, env: Any, policy: IterativeLearner, console: Console) -> list[Trial]:
        """Play all trials, the last one with all learned offsets."""
        trials: list[Trial] = []
        totals = {"trials": policy.trials + 1}
        with show_progress(console, totals, transient=True) as show:

            def add(trial: Trial) -> None:
                trials.append(trial)
                show(0, len(trials))

            policy.rehearse(env, self.seed, add)
            signals = learned_signals(env.unwrapped.assumed_model, self.gains)
            add(Trials(env, self.seed).play(policy, signals, policy.trials))
        return trials

    def _write(self, trials: Sequence[Trial], names: Sequence[str], path: Path) -> Path:
        """Write a row per robot and trial: measured errors and metrics."""
        columns = [f"measured_{name}" for name in names]
        rows = []
        for trial in trials:
            for robot, metrics in enumerate(trial.metrics):
                row: dict[str, Any] = {"trial": trial.number, "seed": self.seed + robot}
                row["failed"] = bool(trial.failed[robot])
                measured = zip(columns, trial.error_rms[robot].tolist(), strict=True)
                rows.append({**row, **dict(measured), **metrics})
        return write_records(rows, path)

    def _save(self, env: Any, policy: IterativeLearner, folder: Path) -> list[Path]:
        """Write the offsets of a single robot into the folder, of several into folders by seed."""
        model = env.unwrapped.assumed_model
        options = PolicyOptions(learned_base=self.base)
        base = learned_base(options, isinstance(model, WalkerModel))
        folders = []
        for robot, table in enumerate(policy.tables):
            seed = self.seed + robot
            description = TableDescription(
                robot=env.unwrapped.task.name,
                base=base,
                learning=self.gains,
                signals=list(policy.names),
                motion=motion_of(env),
                control_period_s=model.control_period_s,
                scenario=self.scenario,
                training=provenance(seed),
            )
            is_one = len(policy.tables) == 1
            folders.append(folder if is_one else folder / f"robot_{seed}")
            save_table(folders[-1], description, table)
        return folders


def trials_table(trials: Sequence[Trial], condition: Condition) -> Table:
    """Metrics of every trial, means over the robots that did not fail, and failures."""
    env = condition.environment
    title = f"{env.title(condition.reference_name)}, {condition.scenario}"
    head = ["trial", *(column.label for column in env.judged), env.failures]
    rows = []
    for trial in trials:
        robots = pd.DataFrame(trial.metrics).loc[~trial.failed]
        means = [over_cells([np.array([robots[c.metric]])]) for c in env.judged]
        scores = map(number_interval, means, env.judged)
        failed = f"{int(trial.failed.sum())} of {len(trial.failed)}"
        rows.append([str(trial.number), *scores, failed])
    return make_table(title, head, rows, left=0)
