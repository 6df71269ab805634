"""An episode in MuJoCo's web viewer: reference, motor side and link side, side by side."""

import bisect
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import mujoco
from mujoco.studio import app, launch_web, messages, plugin, viewer_protocol
from mujoco.studio.dear_imgui import dear_imgui as imgui
from rich.console import Console

from elastic_env.core.errors import ElasticError
from elastic_env.rendering.side_by_side import Alone, SideBySide, Sides
from train.evaluate.conditions import Condition
from train.evaluate.evaluate import make_policy
from train.experiments.play import episode

FIRST_FACTOR, LARGEST_FACTOR = 3.0, 20.0
"""Factors of the slider: the one at the start, and its end."""

_FRAMES_PER_S = 50
_PAUSE_S = 0.01
_TITLE = "elastic view: reference, motor side, link side"
_PLACE, _SIZE = (16.0, 40.0), (400.0, 130.0)
"""Of the window of sliders [pixels]."""


@dataclass(frozen=True)
class Recording:
    """An episode as it is drawn.

    Attributes:
        robot: What is drawn.
        times_s: Time of every frame since the start [s], rising.
        frames: Where the robot is.
    """

    robot: Alone
    times_s: Sequence[float]
    frames: Sequence[Sides]

    def at(self, time_s: float) -> Sides:
        """The last frame that is not later than a time, or the first one."""
        return self.frames[max(bisect.bisect_right(self.times_s, time_s) - 1, 0)]


@dataclass
class Playback:
    """What the sliders of the page set and the drawing reads: time [s], factor, and whether time stands still."""

    recording: Recording
    time_s: float = 0.0
    factor: float = FIRST_FACTOR
    paused: bool = False
    _last_s: float = field(default_factory=time.monotonic)

    def tick(self) -> None:
        """Go on by the time that has passed, from the end back to the start."""
        now, last = time.monotonic(), self._last_s
        self._last_s = now
        if not self.paused:
            end = self.recording.times_s[-1]
            self.time_s = self.time_s + now - last if self.time_s < end else 0.0


def record(condition: Condition, console: Console, max_s: float | None = None) -> Recording:
    """Play an episode and keep what is drawn.

    Args:
        condition: What to play.
        console: Where messages go.
        max_s: Stop after this much simulated time [s].

    Raises:
        ElasticError: The picture of the robot cannot be drawn side by side.
    """
    env: Any = gymnasium.make(condition.environment.id, **condition.arguments)
    task = env.unwrapped.task
    period = task.assumed_model.control_period_s
    steps = task.num_steps if max_s is None else min(max(round(max_s / period), 1), task.num_steps)
    every = max(round(1.0 / (_FRAMES_PER_S * period)), 1)
    times_s, frames = [], []
    with closing(env):
        picture = env.unwrapped.picture
        if not hasattr(picture, "sides"):
            raise ElasticError(
                f"{type(picture).__name__} has no sides: see HasSides in elastic_env.rendering.side_by_side"
            )
        for step, now in episode(env, make_policy(condition.policy, env), condition, steps, console):
            if step % every == 0:
                times_s.append(float(now["time_s"]))
                frames.append(picture.sides(now))
        return Recording(picture.alone(), times_s, frames)


class _Poses(plugin.SimPlugin):
    """Takes the place of the physics: poses the three robots."""

    def __init__(self, playback: Playback, scene: SideBySide) -> None:
        self._playback, self._scene = playback, scene

    @messages.handler
    def _on_step(self, event: messages.StepEvent) -> None:
        self._playback.tick()
        event.data.time = self._playback.time_s
        self._scene.pose(event.data, self._playback.recording.at(self._playback.time_s), self._playback.factor)
        time.sleep(_PAUSE_S)


class _Sliders(plugin.ViewerPlugin):
    """Factor, time and pause."""

    def __init__(self, playback: Playback) -> None:
        self._playback = playback

    @messages.handler
    def _on_build_gui(self, _: messages.BuildGuiEvent) -> None:
        play = self._playback
        imgui.SetNextWindowPos(imgui.Vec2(*_PLACE), imgui.Cond.Once)
        imgui.SetNextWindowSize(imgui.Vec2(*_SIZE), imgui.Cond.Once)
        if imgui.Begin(_TITLE):
            _, play.factor = imgui.SliderFloat("deviations drawn x", play.factor, 0.0, LARGEST_FACTOR)
            _, play.time_s = imgui.SliderFloat("time [s]", play.time_s, 0.0, play.recording.times_s[-1])
            _, play.paused = imgui.Checkbox("pause", play.paused)
        imgui.End()


def show(recording: Recording, port: int = 0, open_browser: bool = True) -> Any:
    """Serve a recording to browsers, in threads of their own; what runs the loop is the handle's `sync`.

    Args:
        recording: What is shown, again and again.
        port: Port of the page; 0 takes the first free one from 8080 on.
        open_browser: Whether a tab opens where there is a display.
    """
    scene, playback = SideBySide(recording.robot), Playback(recording)
    config = viewer_protocol.ViewerConfig(title=_TITLE, gfx="web", http_port=port, open_browser=open_browser)
    handle = launch_web.launch(
        config,
        plugins=[
            app.App(app.Config(show_options=False, show_inspector=False)),
            _Poses(playback, scene),
            _Sliders(playback),
        ],
    )
    handle.set_model(scene.model, data=mujoco.MjData(scene.model))
    return handle


def view(condition: Condition, console: Console, port: int = 0, max_s: float | None = None) -> None:
    """Play an episode, then show it until Ctrl-C."""
    console.print(f"playing {condition.policy.title} first", soft_wrap=True)
    with show(record(condition, console, max_s), port) as handle:
        while handle.is_running():
            handle.sync()
