"""What all ways of learning have in common: the loop over decisions with evaluations and checkpoints on the way."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

from baselines.residual.residual import ResidualDescription
from train.learn.checkpoint import damaged, recovered, require_whole, written
from train.learn.scores import Scores
from train.learn.train_config import TrainConfig

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
        self.config, self.folder = config, folder
        self._scores = Scores(config, seed, folder, threads)

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """Learn to the end of the configuration's decisions; `progress` is told the decisions done."""
        config = self.config
        if self.done == 0:
            self._evaluate()
        while self.done < config.decisions:
            before = self.done
            self._advance()
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
        with written(self.folder / CHECKPOINT) as fresh:
            self._write(fresh)

    def _go_on(self) -> None:
        """Go on from the checkpoint, if there is one; the last step of making a trainer.

        Raises:
            ElasticError: The checkpoint is not what was written.
        """
        path = self.folder / CHECKPOINT
        if recovered(path):
            require_whole(path)
            try:
                self._read(path)
            except (KeyError, IndexError, TypeError, ValueError, RecursionError, RuntimeError) as error:
                raise damaged(path, f"{type(error).__name__}: {error}") from error
        self._scores.forget_after(self.done)

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
        self._scores.evaluate(self.done, self._policy())
