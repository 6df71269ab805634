"""A simple rival of a learned policy: constant residuals, optimised by CMA-ES.

They have the same budget of decisions. Constants depend neither on the phase of the walk nor on any
measurement, but they are easy to search. A policy that is better gains from its observations.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from cmaes import CMA

from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from train.learn.algorithm_options import complete_options
from train.learn.train_config import first_episode, joints_of, training_worlds
from train.learn.trainer import Trainer, require_finite

_COSTS = "told.json"
"""File of the costs of all generations."""
_FALL_COST = 1e6
"""Cost of a failed episode, beyond any sum of rewards, since an early end also ends penalties."""


class ConstantSearch(Trainer):
    """One training seed of a search, in a folder of its own.

    All candidates of a generation play the same episodes, as many in every scenario as the worlds
    allow. The cost is minus the mean sum of rewards. A candidate that falls ranks behind all that
    do not. The policy is the mean of the distribution.

    Args:
        config: Configuration; its algorithm_options may be population_size and sigma, in residuals.
        seed: Training seed.
        folder: Folder for its files; a search with a checkpoint continues from it.
        threads: Threads of the physics, 0 for all cores; the result does not depend on it.

    Raises:
        ConfigurationError: Names or options that do not exist, or fewer worlds than candidates.
    """

    def _prepare(self, threads: int) -> None:
        config = self.config
        options = complete_options(config.algorithm, config.algorithm_options)
        self._population = options["population_size"]
        needed = len(config.scenarios) * self._population
        episodes = config.worlds // needed
        if episodes == 0:
            raise ConfigurationError(
                f"CMA-ES needs a world for each of {self._population} candidates in"
                f" each scenario, {needed}, got worlds: {config.worlds}"
            )
        self._episodes = episodes
        self._first = first_episode(self._seed)
        worlds = episodes * self._population
        shares = [(scenario, worlds) for scenario in config.scenarios]
        self._worlds = training_worlds(config, shares, threads)
        (num_constants,) = self._worlds.single_action_space.shape or (0,)
        bounds = np.tile([-1.0, 1.0], (num_constants, 1))
        mean = np.zeros(num_constants)
        self._optimiser = CMA(mean, bounds=bounds, seed=self._seed, **options)
        self._costs: list[list[float]] = []
        self._done = 0

    @property
    def done(self) -> int:
        """Decisions so far."""
        return self._done

    def _advance(self) -> None:
        candidates = self._ask()
        self._tell(candidates, self._play(candidates))

    def _write_state(self, checkpoint: Path) -> None:
        """Write the costs of all generations; with the seed they define the state of the search."""
        state = {"decisions": self.done, "best": self._best, "told": self._costs}
        (checkpoint / _COSTS).write_text(json.dumps(state), encoding="utf-8")

    def _read_state(self, checkpoint: Path) -> None:
        state = json.loads((checkpoint / _COSTS).read_text(encoding="utf-8"))
        for costs in state["told"]:
            self._tell(self._ask(), np.array(costs))
        self._done = state["decisions"]
        self._best = state["best"]

    def _ask(self) -> Array:
        """Candidates of a generation, (population, constants)."""
        return np.array([self._optimiser.ask() for _ in range(self._population)])

    def _tell(self, candidates: Array, costs: Array) -> None:
        self._optimiser.tell(list(zip(candidates, costs.tolist(), strict=True)))
        self._costs.append(costs.tolist())

    def _play(self, candidates: Array) -> Array:
        """Play candidates; return their costs, minus the mean sum of rewards, (population,)."""
        n = self._worlds.num_envs
        scenarios = len(self.config.scenarios)
        generation = len(self._costs)
        seeds = self._first + generation * self._episodes + np.arange(self._episodes)
        self._worlds.reset(seed=np.tile(seeds, n // self._episodes).tolist())
        # worlds in the order scenario, candidate, episode
        repeated = np.repeat(candidates, self._episodes, axis=0)
        residuals = np.tile(repeated, (scenarios, 1))
        total = np.zeros(n)
        alive = np.ones(n, dtype=np.bool_)
        while alive.any():
            _, reward, terminated, truncated, _ = self._worlds.step(residuals)
            require_finite("the reward", np.where(alive, reward, 0.0))
            total += np.where(alive, reward - _FALL_COST * terminated, 0.0)
            self._done += int(alive.sum())
            alive &= ~(terminated | truncated)
        sums = total.reshape(scenarios, self._population, self._episodes)
        return -sums.mean(axis=(0, 2))

    def _policy(self) -> tuple[dict[str, Any], ResidualDescription]:
        """The mean of the distribution as a network whose output does not depend on its input."""
        constants = self._optimiser.mean
        (features,) = self._worlds.single_observation_space.shape or (0,)
        tensors = {
            "mean": np.zeros(features),
            "std": np.ones(features),
            "weight0": np.zeros((len(constants), features), dtype=np.float32),
            "bias0": constants.astype(np.float32),
        }
        return tensors, self.config.description(joints_of(self._worlds))
