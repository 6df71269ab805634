"""Many worlds of a task as Gymnasium's `VectorEnv`."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.core.signals import Array, BoolArray, Signals
from elastic_env.rendering.picture import Picture
from elastic_env.world.control_step import Transition
from elastic_env.world.env import ElasticEnv
from elastic_env.world.env_base import Action, EnvBase, Flags, Info, Observation, Seeds
from elastic_env.world.episode_seeds import (
    episode_generators,
    new_generator,
    robot_seeds_of,
    seeds_of,
)
from elastic_env.world.physics import Simulation
from elastic_env.world.task import Task


class ElasticVectorEnv(  # pyright: ignore[reportIncompatibleVariableOverride]  `spec` is a property
    EnvBase, gymnasium.vector.VectorEnv[Observation, Action, npt.NDArray[Any]]
):
    """Many worlds of a task on a thread pool.

    World i of `reset(seed=s)` is exactly the scalar environment of `reset(seed=s + i)`, for any
    number of worlds and threads.

    Args:
        task: Rules for num_envs worlds.
        num_threads: Threads of the physics, 0 for all cores.
        autoreset_mode: Gymnasium's `AutoresetMode` or its value.
        simulation: Replacement for MuJoCo's physics, such as hardware.
        render_mode: "rgb_array" or None.
        picture: Creates the picture of the task when it is first rendered.
    """

    def __init__(
        self,
        task: Task,
        num_threads: int = 0,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        simulation: Simulation | None = None,
        render_mode: str | None = None,
        picture: Callable[[], Picture] | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            kind = "render mode of a vector environment"
            raise unknown_name(kind, render_mode, ["rgb_array"])
        self.render_mode = render_mode
        self._make_picture = picture
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = [mode.value for mode in AutoresetMode]
            raise unknown_name("autoreset mode", autoreset_mode, modes) from None
        n = task.num_worlds
        self.num_envs = n
        self.single_observation_space = task.observation_table.space(np.float64)
        self.single_action_space = task.action_table.space(np.float32)
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(self.single_action_space, n)
        self.task = task
        task.attach(simulation, num_threads)
        self._generators = [new_generator() for _ in range(self.num_envs)]
        self._done = np.zeros(self.num_envs, dtype=np.bool_)

    def reset(self, *, seed: Seeds = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode in every world, or in the worlds of options["reset_mask"].

        With options["robot_seed"] = s world i has the robot and the motion that `reset(seed=s)`
        draws for it, but new noise and pushes: the same robot walks again. Like `seed` it may be a
        list; None then draws a new robot.
        """
        mask = reset_mask(options, self.num_envs)
        seeds = seeds_of(seed, self.num_envs)
        robot_seeds = robot_seeds_of(options, self.num_envs)
        for world in np.flatnonzero(mask):
            if seeds[world] is not None:
                self._generators[world] = new_generator(seeds[world])
        self._restart(mask, robot_seeds)
        return self.task.observe(), self.task.signals()

    def step(self, actions: Action) -> tuple[Observation, Flags, Flags, Flags, Info]:
        """Advance by one control period under command offsets, (num_envs, n) [rad]."""
        restarting = self._done
        offset = np.asarray(actions)
        is_next = self.autoreset_mode is AutoresetMode.NEXT_STEP
        some_restart = is_next and bool(restarting.any())
        if some_restart and offset.shape == self.action_space.shape:
            offset = np.where(restarting[:, None], 0.0, offset)
        result = self.task.step(offset)
        if some_restart:
            result = self._restart_instead(result, restarting)
        self._done = done = result.done
        observation = result.observation
        info = result.info
        if done.any():
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                observation, info = self._restart_after_step(result)
            else:
                info["_episode_metrics"] = done.copy()
        return observation, result.reward, result.terminated, result.truncated, info

    @property
    def metadata(self) -> Info:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Metadata for Gymnasium's wrappers."""
        return {
            **ElasticEnv.metadata,
            "render_modes": ["rgb_array"],
            "autoreset_mode": self.autoreset_mode,
        }

    def render(self) -> tuple[Observation, ...] | None:
        """Return pictures of all worlds, (height, width, 3) uint8; each takes about 20 ms."""
        if self.render_mode is None:
            return None
        signals = self.task.signals()
        return tuple(self.picture.rgb(signals, world) for world in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002  Gymnasium's signature
        """Free the renderer, release the hardware."""
        self._release()

    def _restart(self, worlds: BoolArray, seeds: list[int | None] | None = None) -> None:
        robot_seeds = seeds or [None] * self.num_envs
        self.task.restart(worlds, episode_generators(self._generators, robot_seeds))
        self._done = self._done & ~worlds

    def _restart_instead(self, result: Transition, worlds: BoolArray) -> Transition:
        """Restart worlds that ended in the last step, for NEXT_STEP; their step does not count."""
        self._restart(worlds)
        info = _info_after_reset(result.info, worlds, self.task.signals())
        terminated = result.terminated & ~worlds
        truncated = result.truncated & ~worlds
        if not (terminated | truncated).any():  # no other episode has ended
            info = _without_metrics(info)
        reward = np.where(worlds, 0.0, result.reward)
        return Transition(self.task.observe(), reward, terminated, truncated, info)

    def _restart_after_step(self, result: Transition) -> tuple[Array, Info]:
        """Restart worlds that end in this step, for SAME_STEP.

        The result's info contains their last observation and info.
        """
        done = result.done
        result.info["_episode_metrics"] = done.copy()
        final = final_of(result.observation, result.info, done)
        self._restart(done)
        info = _info_after_reset(result.info, done, self.task.signals())
        return self.task.observe(), _without_metrics(info) | final


def final_of(observation: Array, info: Info, done: BoolArray) -> Info:
    """Last observation and info of worlds that end, in the form of Gymnasium's SAME_STEP."""
    last = np.full(len(done), None, dtype=object)
    for world in np.flatnonzero(done):
        last[world] = observation[world].copy()
    marks = {"_final_obs": done.copy(), "_final_info": done.copy()}
    return {"final_obs": last, "final_info": info, **marks}


def reset_mask(options: Info | None, num_envs: int) -> BoolArray:
    """Worlds that a reset restarts: options["reset_mask"], or all.

    Raises:
        ConfigurationError: The mask does not contain one truth value per world.
    """
    mask = (options or {}).get("reset_mask", np.ones(num_envs, dtype=np.bool_))
    values = np.asarray(mask)
    if values.dtype != np.bool_ or values.shape != (num_envs,):
        needed = f"an array of {num_envs} booleans, one per world"
        raise ConfigurationError(f"options['reset_mask'] must be {needed}, got {quote(mask)}")
    return values


def _info_after_reset(info: Info, worlds: BoolArray, signals: Signals) -> Info:
    """Info of a step in which some worlds restart: they have the values of the reset."""
    reset = {**signals, "termination": "", "clipped": 0.0}
    values = {key: np.where(worlds, value, info[key]) for key, value in reset.items()}
    terms = info["reward_terms"]
    reset_terms = {key: np.where(worlds, 0.0, term) for key, term in terms.items()}
    return info | values | {"reward_terms": reset_terms}


def _without_metrics(info: Info) -> Info:
    """Info without the entries of the end of an episode."""
    at_end = ("episode_metrics", "_episode_metrics")
    return {key: value for key, value in info.items() if key not in at_end}
