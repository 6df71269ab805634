"""Evaluations during a training, on episodes that it never learns from; best and last policy."""

import shutil
from collections.abc import Sequence
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from baselines.residual.residual_policy import save_residual
from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import read_bounded, write_whole
from elastic_env.core.signals import Array, BoolArray
from train.evaluate.conditions import Condition
from train.evaluate.environments import environment
from train.evaluate.progress import MOST_BYTES, PROGRESS
from train.evaluate.rollout import control_steps, make_policy
from train.learn.mixed_env import mixed_env
from train.learn.train_config import TrainConfig
from train.runs.folders import provenance

_Policy = tuple[dict[str, Any], ResidualDescription]
_Scored = tuple[Array, Array]
"""Means of metrics over the episodes that did not fail, (scenarios, metrics), and how many did,
(scenarios,).
"""


class Scores:
    """Evaluations and policies of a training seed.

    Args:
        config: What is trained.
        seed: Training seed.
        folder: Of the seed; `progress.csv`, `best/` and `last/` go there.
        threads: Threads of the physics, 0 for all cores.
    """

    def __init__(self, config: TrainConfig, seed: int, folder: Path, threads: int = 0) -> None:
        self._config = config
        self._folder = folder
        self._threads = threads
        self._provenance = provenance(seed)
        self._base: _Scored | None = None
        self.best: float | None = None
        """Score of the best policy so far: mean ratio to the base, and what falls cost."""

    def evaluate(self, decisions: int, policy: _Policy) -> dict[str, float]:
        """Score a policy after some decisions, and keep it where it is the best so far.

        A residual begins as its base, within a hundredth of its range: before the first decision
        the base's score is its own.

        Returns:
            METRIC_change of every judged metric: relative to the base's, [1], mean over the
            scenarios; negative is better. One is left out where all episodes of a scenario failed.
            And `failed`: how many did.
        """
        current = self.keep("current", decisions, policy)
        columns = [column.metric for column in environment(self._config.env).judged]
        if self._base is None:
            self._base = self._play(self._config.base, columns)
        base, base_failed = self._base
        mine, failed = self._base
        if decisions > 0:
            mine, failed = self._play(f"residual:{current}", columns)
        names = self._config.scenarios
        table = pd.DataFrame({"decisions": decisions, "scenario": names})
        table[columns] = mine
        table[[f"base_{name}" for name in columns]] = base
        table = table.assign(failed=failed, base_failed=base_failed)
        _append(table, self._folder / PROGRESS)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = mine / base
        score = float((np.nan_to_num(ratios, nan=10.0).mean(axis=1) + failed).mean())
        if self.best is None or score < self.best:
            self.best = score
            self.keep("best", decisions, policy)
        shutil.rmtree(current)
        found = {"failed": float(failed.sum())}
        for name, ratio in zip(columns, ratios.mean(axis=0).tolist(), strict=True):
            if np.isfinite(ratio):
                found[f"{name}_change"] = ratio - 1.0
        return found

    def keep(self, name: str, decisions: int, policy: _Policy) -> Path:
        """Write a policy as a folder, replacing the one of that name."""
        tensors, description = policy
        recorded = self._config.model_dump(mode="json")
        training = {"config": recorded, "decisions": decisions, **self._provenance}
        fresh = self._folder / f"{name}.new"
        shutil.rmtree(fresh, ignore_errors=True)
        save_residual(fresh, description.replace(training=training), tensors)
        shutil.rmtree(self._folder / name, ignore_errors=True)
        return fresh.rename(self._folder / name)

    def forget_after(self, decisions: int) -> None:
        """Drop evaluations that were made after a checkpoint; they will be made again."""
        path = self._folder / PROGRESS
        lines = _text_of(path).splitlines(keepends=True)
        whole = [line for line in lines[1:] if line.endswith("\n")]
        try:
            kept = [line for line in whole if int(line.split(",")[0]) <= decisions]
        except ValueError as error:
            raise _no_table(path, error) from None
        if decisions == 0 or not lines:
            path.unlink(missing_ok=True)
            return
        write_whole(path, "".join([lines[0], *kept]))

    def _play(self, policy: str, metrics: list[str]) -> _Scored:
        """Scores of a policy in every scenario."""
        names = self._config.scenarios
        conditions = [self._config.condition(name, policy) for name in names]
        results = play_together(conditions, metrics, self._threads)
        means = [
            [np.mean(some) if len(some) else np.nan for some in scores[~failed].T]
            for scores, failed in results
        ]
        return np.array(means), np.array([failed.sum() for _, failed in results])


def _append(table: pd.DataFrame, path: Path) -> None:
    """Add rows to a table of evaluations, as `Scores.forget_after` leaves it."""
    before = _text_of(path)
    rows = table.to_csv(index=False, header=not before, na_rep="nan")
    write_whole(path, before + rows)


def _text_of(path: Path) -> str:
    """Text of a table; empty where there is none.

    Raises:
        ConfigurationError: It is no text, no plain file, or too large.
    """
    try:
        return read_bounded(path, MOST_BYTES).decode("utf-8")
    except FileNotFoundError:
        return ""
    except UnicodeDecodeError as error:
        raise _no_table(path, error) from None


def _no_table(path: Path, error: object) -> ConfigurationError:
    return ConfigurationError(f"{path} is no table of evaluations ({error}); remove it")


def play_together(
    conditions: Sequence[Condition], metrics: Sequence[str], num_threads: int = 0
) -> list[tuple[Array, BoolArray]]:
    """Play the episodes of several conditions at once: scores as of `evaluate`, without traces.

    Args:
        conditions: Cells of one environment, motion and policy.
        metrics: Names of scores.
        num_threads: Threads, 0 for all cores.

    Returns:
        For each condition the scores, (episodes, metrics), and which episodes failed, (episodes,).
    """
    sizes = [condition.episodes for condition in conditions]
    spans = [range(own.seed, own.seed + own.episodes) for own in conditions]
    seeds = [*chain(*spans)]
    values = np.full((len(seeds), len(metrics)), np.nan)
    failed = np.zeros(len(seeds), dtype=np.bool_)
    playing = np.ones_like(failed)
    with closing(mixed_env(conditions, sizes, num_threads)) as worlds:
        policy = make_policy(conditions[0].policy, worlds)
        for step in control_steps(worlds, policy, seeds):
            first = playing & step.is_over
            if first.any():
                found = step.info["episode_metrics"]
                scores = np.stack([found[name] for name in metrics], axis=1)
                values[first] = scores[first]
                failed[first] = step.terminated[first]
                playing &= ~first
            if not playing.any():
                break
    parts = np.cumsum(sizes)[:-1]
    return list(zip(np.split(values, parts), np.split(failed, parts), strict=True))
