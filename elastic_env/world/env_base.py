"""The base of the environments of one world and of many."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec

from elastic_env.core.errors import ConfigurationError
from elastic_env.rendering.picture import Picture
from elastic_env.world.physics import Simulation
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.task import Task

Observation: TypeAlias = npt.NDArray[Any]
Action: TypeAlias = npt.NDArray[Any]
Seeds: TypeAlias = int | list[int | None] | None
"""Seed of the first world, whose successors follow; or one seed for each world; or none."""
Flags: TypeAlias = npt.NDArray[Any]
Info: TypeAlias = dict[str, Any]


class EnvBase:
    """Properties of both kinds of environments."""

    task: Task
    """The rules of this environment; its control step is a `ControlStep`."""
    _picture: Picture | None = None
    _make_picture: Callable[[], Picture] | None = None
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification of this environment, with the length of its episodes."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = dataclasses.replace(spec, max_episode_steps=self.task.num_steps)
        self._spec = spec

    @property
    def assumed_model(self) -> RobotModel:
        """The robot as a compensator may know it."""
        return self.task.assumed_model

    @property
    def simulation(self) -> Simulation:
        """The physics, for benchmarks and tests; policies must not use it."""
        return self.task.simulation

    def truth(self) -> Any:
        """Return noise-free state and true parameters, only for scoring and the `oracle` policy."""
        return self.task.truth()

    @property
    def picture(self) -> Picture:
        """The picture of the worlds, created at first use."""
        if self._picture is None:
            if self._make_picture is None:
                raise ConfigurationError("this environment has no picture")
            self._picture = self._make_picture()
        return self._picture

    def __getstate__(self) -> Info:
        """Return everything except window and renderer, which are created again on demand."""
        return {**vars(self), "_picture": None}

    def _release(self) -> None:
        """Close the window, free the renderer, release the hardware."""
        self.task.simulation.close()
        if self._picture is not None:
            self._picture.close()
            self._picture = None
