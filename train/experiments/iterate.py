"""`elastic iterate`: learn offsets on a robot from trial to trial, and write what was learned as a policy."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import model_validator
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from baselines.adaptation.iterative import IterativeLearner, Stage, Trial
from baselines.adaptation.learned_signals import LearningGains, learned_signals
from baselines.adaptation.offset_table import TableDescription, motion_of, save_table
from baselines.catalogue import learned_base
from baselines.options import PolicyOptions
from elastic_env.core.config import LARGEST_SEED, Model, Title, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.runtime.robot_model import WalkerModel
from train.evaluate.conditions import Condition, GivenReference, PolicySpec
from train.evaluate.environments import Column, environment
from train.evaluate.rollout import make_policy, make_vector_env
from train.figures import plots
from train.figures.chart import trials_chart
from train.runs.escaping import write_records
from train.runs.folders import provenance, run_folder
from train.runs.progress import show_progress

_MOST_ROBOTS = 64


class IterateConfig(Model):
    """What `elastic iterate` does."""

    env: str = "walker"
    scenario: Title = "nominal"
    reference: GivenReference = 3
    """The motion, see `Condition.reference`."""
    base: Title | None = None
    """The policy whose offsets are learned; None for `adaptive_posture` on the walker, else `input`."""
    learning: LearningGains = LearningGains()
    seed: int = quantity("1", 0, ge=0, le=LARGEST_SEED - _MOST_ROBOTS, description="seed of the first robot")
    robots: int = quantity("1", 1, ge=1, le=_MOST_ROBOTS, description="robots, each of which learns by itself")
    env_options: dict[str, Any] = {}
    """Further arguments of the environment."""

    @model_validator(mode="after")
    def _motion_repeats(self) -> "IterateConfig":
        if environment(self.env).draws(self.reference):
            raise ConfigurationError(
                f"the reference {self.reference!r} draws another motion for every seed, and what is learned for one is "
                "wrong for another; name one that repeats, such as sine or hold"
            )
        return self

    @property
    def condition(self) -> Condition:
        """Where it is learned."""
        options = {"learned_base": self.base, "learning": self.learning}
        given = {name: value for name, value in options.items() if value is not None}
        return Condition(
            env=self.env, policy=PolicySpec(name="iterative", options=given), reference=self.reference,
            scenario=self.scenario, seed=self.seed, env_options=self.env_options,
        )  # fmt: skip


def iterate(config: IterateConfig, console: Console, output: Path | None = None) -> list[Trial]:
    """Learn, play a last trial with what was learned, write the run, and print a table of the trials.

    Args:
        config: What to do.
        console: Where progress and table go.
        output: Folder for the results; default runs/iterate, numbered if taken.

    Returns:
        The trials; the first has no offsets, the last has what was learned.

    Raises:
        ConfigurationError: A name or a parameter does not exist.
        ResultsExistError: The output folder holds results.
    """
    plots.require_matplotlib()
    with closing(make_vector_env(config.condition, config.robots)) as env:
        policy: IterativeLearner = make_policy(config.condition.policy, env)
        with run_folder("iterate", config.model_dump(mode="json"), config.seed, output) as folder:
            trials = _trials(config, env, policy, console)
            columns = config.condition.environment.judged
            chart = trials_chart(trials, columns, f"Learned on the robot, {config.scenario}")
            files = [
                _write_trials(trials, policy, config, folder / "trials.csv"),
                plots.draw_chart(chart, folder / "trials.png"),
            ]
            policies = _save(config, env, policy, folder)
    console.print(trials_table(trials, columns, config))
    for path in files:
        console.print(f"wrote {path}", soft_wrap=True)
    for path in policies:
        console.print(f"play it as iterative:{path}", soft_wrap=True)
    return trials


def _trials(config: IterateConfig, env: Any, policy: IterativeLearner, console: Console) -> list[Trial]:
    trials: list[Trial] = []
    with show_progress(console, {"trials": policy.trials + 1}, transient=True) as show:

        def told(trial: Trial) -> None:
            trials.append(trial)
            show(0, len(trials))

        policy.rehearse(env, config.seed, told)
        signals = learned_signals(env.unwrapped.assumed_model, config.learning)
        told(Stage(env, config.seed).trial(policy, signals, policy.trials))
    return trials


def trials_table(trials: Sequence[Trial], columns: Sequence[Column], config: IterateConfig) -> Table:
    """The judged metrics and the failures of every trial, the mean over the robots that did not fail."""
    condition = config.condition
    table = Table(title=f"{condition.environment.title(condition.reference_name)}, {config.scenario}")
    table.add_column("trial", justify="right")
    for column in columns:
        table.add_column(escape(column.label), justify="right")
    table.add_column(condition.environment.failures, justify="right")
    for trial in trials:
        values = [f"{column.scale * trial_mean(trial, column.metric):.{column.decimals}f}" for column in columns]
        table.add_row(str(trial.number), *values, f"{int(trial.failed.sum())} of {len(trial.failed)}")
    return table


def trial_mean(trial: Trial, metric: str) -> float:
    """A metric of a trial, the mean over the robots that did not fail; nan where all did."""
    found = [metrics[metric] for metrics, failed in zip(trial.metrics, trial.failed, strict=True) if not failed]
    return float(np.mean(found)) if found else float("nan")


def _write_trials(trials: Sequence[Trial], policy: IterativeLearner, config: IterateConfig, path: Path) -> Path:
    """One row per robot and trial: what the sensors showed, and the metrics."""
    rows = [
        {
            "trial": trial.number,
            "seed": config.seed + robot,
            "failed": bool(trial.failed[robot]),
            **{
                f"measured_{name}": rms for name, rms in zip(policy.names, trial.error_rms[robot].tolist(), strict=True)
            },
            **metrics,
        }
        for trial in trials
        for robot, metrics in enumerate(trial.metrics)
    ]
    return write_records(rows, path)


def _save(config: IterateConfig, env: Any, policy: IterativeLearner, folder: Path) -> list[Path]:
    """What every robot has learned: in the folder itself for one, else in folders by their seeds."""
    task, model = env.unwrapped.task, env.unwrapped.assumed_model
    options = PolicyOptions(learned_base=config.base)
    base, saved = learned_base(options, isinstance(model, WalkerModel)), []
    for robot, table in enumerate(policy.tables):
        seed = config.seed + robot
        description = TableDescription(
            robot=task.name, base=base, learning=config.learning, signals=list(policy.names), motion=motion_of(env),
            control_period_s=model.control_period_s, scenario=config.scenario, training=provenance(seed),
        )  # fmt: skip
        saved.append(folder if len(policy.tables) == 1 else folder / f"robot_{seed}")
        save_table(saved[-1], description, table)
    return saved
