"""One world of a task as Gymnasium's `Env`."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from elastic_env.core.errors import unknown_name
from elastic_env.rendering.picture import Picture
from elastic_env.world.control_step import StepInfo
from elastic_env.world.env_base import Action, EnvBase, Info, Observation
from elastic_env.world.episode_seeds import episode_generators, robot_seeds_of
from elastic_env.world.physics import Simulation
from elastic_env.world.task import Task

RENDER_MODES = ("rgb_array", "human")


class ElasticEnv(EnvBase, gymnasium.Env[Observation, Action]):  # pyright: ignore[reportIncompatibleVariableOverride]
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
        generators = episode_generators([self.np_random], robot_seeds_of(options, 1))
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


def _info_of_one(info: Info) -> Info:
    """Info of the only world, with Python scalars."""
    return {
        key: _info_of_one(value) if isinstance(value, dict) else value[0].item()
        for key, value in info.items()
    }
