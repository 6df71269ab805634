"""Random generators of new episodes, by seeds of worlds and of robots."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import ConfigurationError, quote


def episode_generators(
    generators: Sequence[np.random.Generator], robot_seeds: Sequence[int | None]
) -> list[EpisodeRandom]:
    """Generators of new episodes; the robot comes from its seed, if there is one."""
    return [
        EpisodeRandom(rng) if seed is None else EpisodeRandom(new_generator(seed), rng)
        for rng, seed in zip(generators, robot_seeds, strict=True)
    ]


def new_generator(seed: int | None = None) -> np.random.Generator:
    """Generator of a world, as Gymnasium makes it; of a random seed without one."""
    return seeding.np_random(seed)[0]


def robot_seeds_of(options: dict[str, Any] | None, num_envs: int) -> list[int | None]:
    """Seeds of the robots of all worlds, by options["robot_seed"]; None for a new robot."""
    return seeds_of((options or {}).get("robot_seed"), num_envs, "options['robot_seed']")


def seeds_of(seed: Any, num_envs: int, name: str = "seed") -> list[int | None]:
    """Seeds of all worlds.

    Args:
        seed: Seed of the first world, whose successors follow; or one for each world; or None.
        num_envs: Number of worlds.
        name: Name of the argument, for the error.

    Raises:
        ConfigurationError: A seed is no whole number, or there is not one per world.
    """
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, int | np.integer):
        return [int(seed) + i for i in range(num_envs)]
    seeds = list(seed) if isinstance(seed, Sequence | np.ndarray) else [seed]
    if not all(isinstance(value, int | np.integer | None) for value in seeds):
        needed = f"a whole number, one per world ({num_envs}), or None"
        raise ConfigurationError(f"{name} must be {needed}; got {quote(seed)}")
    if len(seeds) != num_envs:
        needed = f"must have one seed per world, {num_envs}"
        raise ConfigurationError(f"a list of seeds {needed}, got {len(seeds)}")
    return [None if value is None else int(value) for value in seeds]
