"""Gymnasium environments: one world as an `Env`, many worlds as a `VectorEnv`."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.core.signals import Array, BoolArray, Signals
from elastic_env.rendering.picture import Picture
from elastic_env.world.physics import Simulation
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.step_info import StepInfo
from elastic_env.world.task import Task, Transition

Observation: TypeAlias = npt.NDArray[Any]
Action: TypeAlias = npt.NDArray[Any]

Seeds: TypeAlias = int | list[int | None] | None
"""Seed of the first world, whose successors follow; or one seed for each world; or none."""
Flags: TypeAlias = npt.NDArray[Any]
Info: TypeAlias = dict[str, Any]

RENDER_MODES = ("rgb_array", "human")


class _EnvBase:
    """Properties of both kinds of environments."""

    task: Task
    """The rules of this environment."""
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


class ElasticEnv(_EnvBase, gymnasium.Env[Observation, Action]):  # pyright: ignore[reportIncompatibleVariableOverride]
    """One world of a task.

    Args:
        task: Rules for one world.
        render_mode: "rgb_array", "human" or None.
        picture: Creates the picture of the task when it is first rendered.
        simulation: Replacement for MuJoCo's physics, such as hardware.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 50}

    def __init__(
        self,
        task: Task,
        render_mode: str | None,
        picture: Callable[[], Picture],
        simulation: Simulation | None = None,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise unknown_name("render mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.observation_space = task.observation_table.space(np.float64)
        self.action_space = task.action_table.space(np.float32)
        self.task = task
        task.attach(simulation, num_threads=1, is_scalar=True)
        self._make_picture = picture
        frame_s = 1.0 / self.metadata["render_fps"]
        self._steps_per_frame = max(round(frame_s / task.config.control_period_s), 1)
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode.

        With options["robot_seed"] = s it has the robot and the motion that `reset(seed=s)` draws.
        """
        super().reset(seed=seed, options=options)
        generators = _episode_generators([self.np_random], _robot_seeds(options, 1))
        self.task.restart(np.ones(1, dtype=np.bool_), generators)
        self._steps = 0
        self._render_human()
        return self.task.observe()[0], _info_of_one(self.task.signals())

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, Info]:
        """Advance by one control period under a command offset [rad]."""
        result = self.task.step(np.asarray(action)[None])
        self._steps += 1
        self._render_human()
        return (
            result.observation[0],
            result.reward.item(),
            result.terminated.item(),
            result.truncated.item(),
            StepInfo({}, partial(_info_of_one, result.info)),
        )

    def render(self) -> Any:
        """Return the present picture, (height, width, 3) uint8; None without "rgb_array"."""
        if self.render_mode != "rgb_array":
            return None
        return self.picture.rgb(self.task.signals())

    def close(self) -> None:
        """Close the window, free the renderer, release the hardware."""
        self._release()

    def _render_human(self) -> None:
        if self.render_mode == "human" and self._steps % self._steps_per_frame == 0:
            self.picture.show(self.task.signals())


class ElasticVectorEnv(  # pyright: ignore[reportIncompatibleVariableOverride]  `spec` is a property
    _EnvBase, gymnasium.vector.VectorEnv[Observation, Action, npt.NDArray[Any]]
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
        self._generators = [_generator() for _ in range(self.num_envs)]
        self._done = np.zeros(self.num_envs, dtype=np.bool_)

    def reset(self, *, seed: Seeds = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode in every world, or in the worlds of options["reset_mask"].

        With options["robot_seed"] = s world i has the robot and the motion that `reset(seed=s)`
        draws for it, but new noise and pushes: the same robot walks again. Like `seed` it may be a
        list; None then draws a new robot.
        """
        mask = reset_mask(options, self.num_envs)
        seeds = _seeds(seed, self.num_envs)
        robot_seeds = _robot_seeds(options, self.num_envs)
        for world in np.flatnonzero(mask):
            if seeds[world] is not None:
                self._generators[world] = _generator(seeds[world])
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
        self.task.restart(worlds, _episode_generators(self._generators, robot_seeds))
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


def _episode_generators(
    generators: Sequence[np.random.Generator], robot_seeds: Sequence[int | None]
) -> list[EpisodeRandom]:
    """Generators of new episodes; the robot comes from its seed, if there is one."""
    return [
        EpisodeRandom(rng) if seed is None else EpisodeRandom(_generator(seed), rng)
        for rng, seed in zip(generators, robot_seeds, strict=True)
    ]


def _generator(seed: int | None = None) -> np.random.Generator:
    return seeding.np_random(seed)[0]


def _robot_seeds(options: Info | None, num_envs: int) -> list[int | None]:
    return _seeds((options or {}).get("robot_seed"), num_envs, "options['robot_seed']")


def _seeds(seed: Any, num_envs: int, name: str = "seed") -> list[int | None]:
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


def _info_of_one(info: Info) -> Info:
    """Info of the only world, with Python scalars."""
    return {
        key: _info_of_one(value) if isinstance(value, dict) else value[0].item()
        for key, value in info.items()
    }
