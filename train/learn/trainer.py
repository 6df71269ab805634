"""Base class of trainings: the loop over decisions with evaluations and checkpoints.

Policies are evaluated on episodes that the training never uses. The best and the last policy are
kept.
"""

import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from baselines.residual.residual_folder import save_residual
from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import ConfigurationError, ElasticError, shorten
from elastic_env.core.files import read_bounded, write_whole
from elastic_env.core.signals import Array, IntArray
from train.evaluate.environments import environment
from train.evaluate.episodes import evaluate_together, group_by
from train.evaluate.learning_curves import MOST_BYTES, PROGRESS
from train.evaluate.rollout import shared_settings
from train.learn import checkpoint as checkpoints
from train.learn.train_config import TrainConfig
from train.runs.folders import provenance


class DivergedError(ElasticError):
    """A quantity of a training is no longer a finite number.

    Args:
        quantity: Its name, such as the reward.
    """

    def __init__(self, quantity: str) -> None:
        super().__init__(f"{quantity} is not a finite number")
        self.quantity = quantity


def require_finite(quantity: str, values: Any) -> None:
    """Refuse nan and infinity in a quantity of a training.

    Raises:
        DivergedError: A value is not finite.
    """
    if not np.isfinite(values).all():
        raise DivergedError(quantity)


CHECKPOINT = "checkpoint"
"""Folder of the checkpoint in the folder of a training seed."""
Scores = tuple[Array, IntArray]
"""Means of metrics over episodes that did not fail, (scenarios, metrics), and numbers of failed
episodes, (scenarios,)."""


class Trainer(ABC):
    """One training seed of a configuration, in a folder of its own.

    Args:
        config: Configuration of the training.
        seed: Training seed.
        folder: Folder for its files: `progress.csv`, `best/`, `last/` and the checkpoint, from
            which it resumes.
        threads: Threads of the physics, 0 for all cores; the result does not depend on it.
    """

    def __init__(self, config: TrainConfig, seed: int, folder: Path, threads: int = 0) -> None:
        self.config = config
        self.folder = folder
        self._seed = seed
        self._threads = threads
        self._checkpoint_decisions: int | None = None
        self._provenance = provenance(seed)
        self._table = ""
        self._base: Scores | None = None
        self._best: float | None = None
        """Score of the best policy so far: mean ratio to the base, plus failures per scenario."""
        self._prepare(threads)
        folder.mkdir(parents=True, exist_ok=True)
        self._resume()

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """Learn until the configuration's decisions are done; `progress` gets the decisions so far.

        Raises:
            ElasticError: A quantity is no longer finite; the last checkpoint stays.
        """
        config = self.config
        if self.done == 0:
            self._evaluate()
        while self.done < config.decisions:
            before = self.done
            try:
                self._advance()
            except DivergedError as error:
                raise ElasticError(self._divergence_text(error.quantity)) from error
            if config.is_due(config.evaluate_every, before, self.done):
                self._evaluate()
            if config.is_due(config.checkpoint_every, before, self.done):
                self.checkpoint()
            if progress is not None:
                progress(self.done)
        self._keep_policy("last")

    @property
    @abstractmethod
    def done(self) -> int:
        """Decisions so far."""

    def checkpoint(self) -> None:
        """Write everything that the rest of the training depends on."""
        with checkpoints.write_checkpoint(self.folder / CHECKPOINT) as folder:
            self._write_state(folder)
        self._checkpoint_decisions = self.done

    def _resume(self) -> None:
        """Resume from the checkpoint, if there is one.

        Raises:
            ElasticError: The checkpoint is damaged.
        """
        path = self.folder / CHECKPOINT
        if checkpoints.recover_checkpoint(path):
            checkpoints.require_complete(path)
            try:
                self._read_state(path)
            except (LookupError, TypeError, ValueError, RuntimeError) as error:
                raise checkpoints.damage_error(path, f"{type(error).__name__}: {error}") from error
            self._checkpoint_decisions = self.done
        self._drop_later_scores()

    def _divergence_text(self, quantity: str) -> str:
        """Error text for a quantity that is no longer finite."""
        place = shorten(self.folder / CHECKPOINT)
        state = f"the checkpoint of decision {self._checkpoint_decisions} is kept in {place}"
        if self._checkpoint_decisions is None:
            state = f"no checkpoint was due yet (checkpoint_every: {self.config.checkpoint_every})"
        return (
            f"{quantity} is not a finite number at decision {self.done} of training"
            f" seed {self._seed}; {state}; start again with a smaller learning_rate or"
            " log_std_init, or smaller weights of the reward"
        )

    @abstractmethod
    def _prepare(self, threads: int) -> None:
        """Make the training worlds and the learner; `threads` are those of the physics."""

    @abstractmethod
    def _write_state(self, checkpoint: Path) -> None:
        """Write everything that the rest depends on as files of a folder."""

    @abstractmethod
    def _read_state(self, checkpoint: Path) -> None:
        """Read the files of `_write_state`."""

    @abstractmethod
    def _advance(self) -> None:
        """Learn from some more decisions."""

    @abstractmethod
    def _policy(self) -> tuple[dict[str, Any], ResidualDescription]:
        """Tensors and description of the current policy, for its export."""

    def _evaluate(self) -> None:
        """Score the current policy, and keep it if it is the best so far.

        Before the first decision the residual has the base's score, since it differs from the base
        by at most a hundredth of its range.
        """
        current = self._keep_policy("current")
        columns = [column.metric for column in environment(self.config.env).judged]
        if self._base is None:
            self._base = play_scenarios(self.config, self.config.base, columns, self._threads)
        base, base_failed = self._base
        mine, failed = self._base
        if self.done > 0:
            name = f"residual:{current}"
            mine, failed = play_scenarios(self.config, name, columns, self._threads)
        names = self.config.scenarios
        table = pd.DataFrame({"decisions": self.done, "scenario": names})
        table[columns] = mine
        table[[f"base_{name}" for name in columns]] = base
        table = table.assign(failed=failed, base_failed=base_failed)
        self._table += table.to_csv(index=False, header=not self._table, na_rep="nan")
        write_whole(self.folder / PROGRESS, self._table)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = mine / base
        score = float((np.nan_to_num(ratios, nan=10.0).mean(axis=1) + failed).mean())
        if self._best is None or score < self._best:
            self._best = score
            self._keep_policy("best")
        shutil.rmtree(current)
        changes = {"failed": float(failed.sum())}
        for name, ratio in zip(columns, ratios.mean(axis=0).tolist(), strict=True):
            if np.isfinite(ratio):
                changes[f"{name}_change"] = ratio - 1.0
        self._log_scores(changes)

    def _log_scores(self, changes: Mapping[str, float]) -> None:  # noqa: B027  optional
        """Log the scores of an evaluation, in trainings that log curves.

        Args:
            changes: METRIC_change of every judged metric: change relative to the base [1], mean
                over the scenarios; negative is better. A metric is left out if all episodes of a
                scenario failed. And `failed`: the number of failed episodes.
        """

    def _keep_policy(self, name: str) -> Path:
        """Write the current policy as a folder, replacing the one of that name."""
        tensors, description = self._policy()
        recorded = self.config.model_dump(mode="json")
        training = {"config": recorded, "decisions": self.done, **self._provenance}
        new = self.folder / f"{name}.new"
        shutil.rmtree(new, ignore_errors=True)
        save_residual(new, description.replace(training=training), tensors)
        shutil.rmtree(self.folder / name, ignore_errors=True)
        return new.rename(self.folder / name)

    def _drop_later_scores(self) -> None:
        """Drop evaluations after the checkpoint from `progress.csv`; they will be repeated.

        Raises:
            ConfigurationError: The table is no text, no plain file, or too large.
        """
        path = self.folder / PROGRESS
        try:
            content = read_bounded(path, MOST_BYTES)
        except FileNotFoundError:
            return
        try:
            lines = content.decode("utf-8").splitlines(keepends=True)
            rows = [line for line in lines[1:] if line.endswith("\n")]
            rows = [row for row in rows if int(row.split(",")[0]) <= self.done]
        except ValueError as error:
            problem = f"{path} is no table of evaluations ({error}); remove it"
            raise ConfigurationError(problem) from None
        if self.done == 0 or not lines:
            path.unlink()
            return
        self._table = "".join([lines[0], *rows])
        write_whole(path, self._table)


def play_scenarios(
    config: TrainConfig, policy: str, metrics: Sequence[str], num_threads: int = 0
) -> Scores:
    """Scores of a policy in every scenario of a training, on the episodes of its evaluations.

    Args:
        config: Configuration of the training.
        policy: Name of the policy.
        metrics: Names of scores.
        num_threads: Threads, 0 for all cores.
    """
    conditions = [config.condition(scenario, policy) for scenario in config.scenarios]
    evaluations = {
        evaluation.condition.scenario: evaluation
        for group in group_by(conditions, shared_settings).values()
        for evaluation in evaluate_together(group, num_threads=num_threads)
    }
    results = [evaluations[scenario] for scenario in config.scenarios]
    means = [
        [np.mean(v) if len(v) else np.nan for v in map(result.values, metrics)]
        for result in results
    ]
    return np.array(means), np.array([result.num_failed for result in results])
