"""Robots as environments: configuration, task and picture, registered with Gymnasium."""

import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from numbers import Integral
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode

from elastic_env.core.config import ModelT
from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.rendering.picture import Picture
from elastic_env.world.env import ElasticEnv
from elastic_env.world.task import Task
from elastic_env.world.vector_env import ElasticVectorEnv

BACKENDS = ("mujoco", "warp")
"""Engines that step the physics of a vector environment."""
_LEAST_WORLD_BYTES = 10_000
"""Memory of a world, measured on the testbed without a policy: the smallest robot [bytes]."""


@dataclass(frozen=True)
class Robot:
    """A robot with its task, as an environment.

    Attributes:
        name: Short name.
        id: Id in Gymnasium, such as elastic_env/Testbed-v0.
        configure: Makes the configuration from the arguments of `gymnasium.make`.
        task: Makes the rules from a configuration and a number of worlds.
        picture: Makes the picture of a task.
    """

    name: str
    id: str
    configure: Callable[..., Any]
    task: Callable[[Any, int], Task]
    picture: Callable[[Any], Picture]

    def make(self, render_mode: str | None = None, **arguments: Any) -> ElasticEnv:
        """Make one environment, Gymnasium's entry point; arguments as in `configure`."""
        task = self.task(self._configuration(arguments), 1)
        return ElasticEnv(task, render_mode, partial(self.picture, task))

    def make_vector(
        self,
        num_envs: int = 1,
        num_threads: int = 0,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        backend: str = "mujoco",
        device: str | None = None,
        **arguments: Any,
    ) -> ElasticVectorEnv:
        """Make many worlds, Gymnasium's vector entry point; further arguments as in `configure`.

        Args:
            num_envs: Number of worlds.
            num_threads: Threads of the physics and the control step, 0 for all cores.
            autoreset_mode: Gymnasium's `AutoresetMode` or its value.
            render_mode: "rgb_array" or None.
            backend: Engine of the physics: "mujoco", or "warp" for MuJoCo Warp on a GPU, which
                needs the extra `gpu`.
            device: Device of the backend "warp": "cuda:0", the default, another GPU, or "cpu" for
                tests.
            **arguments: As in `configure`.

        Raises:
            ConfigurationError: The number of worlds or threads is invalid, the worlds exceed the
                memory, or the backend or device does not exist.
        """
        all_threads = ", 0 for all"
        bounds = [("num_envs", num_envs, 1, ""), ("num_threads", num_threads, 0, all_threads)]
        for name, number, least, note in bounds:
            is_whole = isinstance(number, Integral) and not isinstance(number, bool)
            if not is_whole or number < least:
                needed = f"must be a whole number >= {least}{note}"
                raise ConfigurationError(f"{name} {needed}, got {quote(number)}")
        require_memory("num_envs", num_envs, _LEAST_WORLD_BYTES)
        require_known("backend", [backend], BACKENDS)
        if device is not None and backend != "warp":
            raise ConfigurationError(
                f'device = {quote(device)} needs backend="warp"; the backend "mujoco" runs on the'
                " processor"
            )
        task = self.task(self._configuration(arguments), num_envs)
        simulation = None
        if backend == "warp":
            from elastic_env.world.warp_physics import WarpWorlds  # of the extra `gpu`

            simulation = WarpWorlds(task.model, num_envs, device)
        return ElasticVectorEnv(
            task,
            num_threads,
            autoreset_mode,
            simulation=simulation,
            render_mode=render_mode,
            picture=partial(self.picture, task),
        )

    def register(self) -> None:
        """Register the id with Gymnasium; a second call changes nothing."""
        if self.id not in gymnasium.registry:
            gymnasium.register(
                id=self.id, entry_point=self.make, vector_entry_point=self.make_vector
            )

    def _configuration(self, arguments: dict[str, Any]) -> Any:
        known = inspect.signature(self.configure).parameters
        require_known(f"argument of {self.id}", arguments, known)
        return self.configure(**arguments)


def as_model(name: str, value: ModelT | dict[str, Any] | None, default: ModelT) -> ModelT:
    """Return the model of an argument: a model, a mapping of changes to the default, or None.

    Raises:
        ConfigurationError: The argument is none of these.
    """
    if not isinstance(value, dict | type(default) | None):
        needed = f"a {type(default).__name__} or a mapping of its parameters"
        raise ConfigurationError(f"{name} must be {needed}, got {quote(value)}")
    return default.replace(**(value or {})) if isinstance(value, dict | None) else value


def require_memory(name: str, worlds: int, world_bytes: int) -> None:
    """Refuse more worlds than the memory holds.

    Args:
        name: Parameter that sets the number of worlds.
        worlds: Number of worlds.
        world_bytes: Memory of each [bytes].

    Raises:
        ConfigurationError: They do not fit.
    """
    needed = int(worlds) * world_bytes
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > memory:
        raise ConfigurationError(
            f"{quote(worlds)} worlds take about {quote(needed // 10**9)} GB of memory, this"
            f" computer has {memory / 1e9:.1f} GB; set {name} to at most {memory // world_bytes}"
        )
