"""Base of all ways of learning: the loop over decisions with evaluations and checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import ElasticError, shorten
from train.learn.checkpoint import damage_error, recover_checkpoint, require_whole, write_checkpoint
from train.learn.scores import Scores
from train.learn.train_config import TrainConfig


class DivergedError(ElasticError):
    """A quantity of a training is no longer a finite number.

    Args:
        quantity: What it is, such as the reward.
    """

    def __init__(self, quantity: str) -> None:
        super().__init__(f"{quantity} is not a finite number")
        self.quantity = quantity


def require_finite(quantity: str, values: Any) -> None:
    """Refuse nan and infinity among the numbers of a training.

    Raises:
        DivergedError: There is one.
    """
    if not np.isfinite(values).all():
        raise DivergedError(quantity)


CHECKPOINT = "checkpoint"
"""Folder, within that of a training seed, to go on from."""


class Trainer(ABC):
    """One training seed of a configuration, in a folder of its own.

    Args:
        config: What is trained.
        seed: Training seed.
        folder: Where its files go; one with a checkpoint is gone on with.
        threads: Threads of the physics, 0 for all cores; the result does not depend on it.
    """

    def __init__(self, config: TrainConfig, seed: int, folder: Path, threads: int = 0) -> None:
        self.config = config
        self.folder = folder
        self._seed = seed
        self._scores = Scores(config, seed, folder, threads)
        self._kept: int | None = None
        self._prepare(threads)
        folder.mkdir(parents=True, exist_ok=True)
        self._go_on()

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """Learn to the end of the configuration's decisions; `progress` is told the decisions done.

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
        self._scores.keep("last", self.done, self._policy())

    @property
    @abstractmethod
    def done(self) -> int:
        """Decisions so far."""

    def checkpoint(self) -> None:
        """Keep everything that the rest depends on."""
        with write_checkpoint(self.folder / CHECKPOINT) as fresh:
            self._write(fresh)
        self._kept = self.done

    def _go_on(self) -> None:
        """Go on from the checkpoint, if there is one.

        Raises:
            ElasticError: The checkpoint is not what was written.
        """
        path = self.folder / CHECKPOINT
        if recover_checkpoint(path):
            require_whole(path)
            try:
                self._read(path)
            except (LookupError, TypeError, ValueError, RuntimeError) as error:
                raise damage_error(path, f"{type(error).__name__}: {error}") from error
            self._kept = self.done
        self._scores.forget_after(self.done)

    def _divergence_text(self, quantity: str) -> str:
        """The sentence for a quantity that is no longer finite."""
        place = shorten(self.folder / CHECKPOINT)
        kept = f"the checkpoint of decision {self._kept} is kept in {place}"
        if self._kept is None:
            kept = f"no checkpoint was due yet (checkpoint_every: {self.config.checkpoint_every})"
        return (
            f"{quantity} is not a finite number at decision {self.done} of training seed"
            f" {self._seed}; {kept}; begin anew with a smaller learning_rate or log_std_init, or"
            " smaller weights of the reward"
        )

    @abstractmethod
    def _prepare(self, threads: int) -> None:
        """Make the worlds, on some threads, and what learns in them."""

    @abstractmethod
    def _write(self, checkpoint: Path) -> None:
        """Write everything that the rest depends on as files of a folder."""

    @abstractmethod
    def _read(self, checkpoint: Path) -> None:
        """Take up what `_write` has written."""

    @abstractmethod
    def _advance(self) -> None:
        """Learn from some more decisions."""

    @abstractmethod
    def _policy(self) -> tuple[dict[str, Any], ResidualDescription]:
        """The present policy, as it is exported."""

    def _evaluate(self) -> None:
        """Score the present policy."""
        self._show(self._scores.evaluate(self.done, self._policy()))

    def _show(self, changes: Mapping[str, float]) -> None:  # noqa: B027  who has curves shows them
        """Show the scores of an evaluation beside the curves of the training."""
