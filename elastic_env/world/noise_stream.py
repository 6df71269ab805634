"""Random numbers of sensors, drawn in blocks."""

from typing import Any

import numpy as np
from numpy.random import Generator

from elastic_env.core.signals import BoolArray


class NoiseStream:
    """Standard normal samples, one independent stream per world, drawn in blocks.

    The samples of a world depend on its generator and on how many it has used, never on the other
    worlds.

    Args:
        num_worlds: Number of worlds.
        record: Structured type of a sample, with real numbers only.
        block: Samples that are drawn at once; no more can be prepared.

    Attributes:
        samples: Samples of the present block, (block, num_worlds).
        used: Number of used samples of each world, (num_worlds,), which is the index of the next.
    """

    def __init__(self, num_worlds: int, record: np.dtype[Any], block: int = 256) -> None:
        # samples of a step are neighbours in memory: worlds mostly use theirs together
        self.samples = np.zeros((block, num_worlds), record)
        self.used = np.zeros(num_worlds, dtype=np.int64)
        self._world = np.arange(num_worlds)
        self._most_used = 0
        self._generators = [np.random.default_rng(0) for _ in range(num_worlds)]

    def restart(self, world: int, generator: Generator) -> None:
        """Begin a new stream for one world."""
        self._generators[world] = generator
        self.used[world] = len(self.samples)
        self._refill(world)

    def next(self, worlds: BoolArray) -> Any:
        """Return the next sample of some worlds, (num_worlds,).

        The rows of the other worlds are not valid.
        """
        self.prepare()
        sample = self.samples[np.minimum(self.used, len(self.samples) - 1), self._world]
        self.used += worlds
        return sample

    def prepare(self, count: int = 1) -> None:
        """Make sure that each world has so many unused samples; their user increments `used`."""
        assert count <= len(self.samples)
        if self._most_used + count > len(self.samples):
            for world in np.flatnonzero(self.used).tolist():
                self._refill(world)
            self._most_used = 0
        self._most_used += count

    def _refill(self, world: int) -> None:
        """Replace the used samples of a world by new ones behind the others."""
        used = int(self.used[world])
        record = self.samples.dtype
        numbers = self._generators[world].standard_normal((used, record.itemsize // 8))
        samples = self.samples[:, world]
        samples[:-used] = samples[used:]
        samples[-used:] = numbers.view(record)[:, 0]
        self.used[world] = 0
