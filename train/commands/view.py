"""`elastic view`: reference, motor side and link side, side by side in MuJoCo's web viewer."""

import bisect
import contextlib
import io
import os
import socket
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import mujoco
from mujoco.studio import (
    app,
    launch_thread,
    messages,
    plugin,
    viewer_handle,
    viewer_protocol,
    web_viewer,
)
from mujoco.studio.dear_imgui import dear_imgui as imgui
from rich.console import Console

from elastic_env.core.config import quantity
from elastic_env.core.errors import ElasticError
from elastic_env.rendering.side_by_side import DisplayRobot, SideBySide, Sides
from train.commands.play import WatchedEpisode, episode, steps_within
from train.commands.view_proxy import LOOPBACK, Access, Proxy, open_listener
from train.evaluate.conditions import Condition
from train.evaluate.rollout import make_policy

FIRST_FACTOR = 3.0
LARGEST_FACTOR = 20.0
"""Factors of the slider: the one at the start, and its end."""

_FRAMES_PER_S = 50
_PAUSE_S = 0.01
_SHORT = "/tmp"
"""Folder of a socket: its path has at most about 100 characters, and TMPDIR may be longer."""
_TITLE = "elastic view: reference, motor side, link side"
_FACTOR = "deviations drawn x"
_PLACE = (16.0, 40.0)
_SIZE = (400.0, 130.0)
"""Of the window of sliders [pixels]."""


@dataclass(frozen=True)
class Recording:
    """An episode as it is drawn.

    Attributes:
        robot: What is drawn.
        times_s: Time of every frame since the start [s], rising.
        frames: Where the robot is.
    """

    robot: DisplayRobot
    times_s: Sequence[float]
    frames: Sequence[Sides]

    def at(self, time_s: float) -> Sides:
        """The last frame that is not later than a time, or the first one."""
        return self.frames[max(bisect.bisect_right(self.times_s, time_s) - 1, 0)]


@dataclass
class Playback:
    """State of the page, which sliders set and the drawing reads: time [s], factor, pause."""

    recording: Recording
    time_s: float = 0.0
    factor: float = FIRST_FACTOR
    paused: bool = False
    _last_s: float = field(default_factory=time.monotonic)

    def tick(self) -> None:
        """Go on by the time that has passed, from the end back to the start."""
        now = time.monotonic()
        last = self._last_s
        self._last_s = now
        if not self.paused:
            end = self.recording.times_s[-1]
            self.time_s = self.time_s + now - last if self.time_s < end else 0.0


def record(condition: Condition, console: Console, max_s: float | None) -> Recording:
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
    every = max(round(1.0 / (_FRAMES_PER_S * period)), 1)
    times_s = []
    frames = []
    with contextlib.closing(env):
        steps = steps_within(task, max_s)
        picture = env.unwrapped.picture
        if not hasattr(picture, "sides"):
            cure = "see HasSides in elastic_env.rendering.side_by_side"
            raise ElasticError(f"{type(picture).__name__} has no sides: {cure}")
        policy = make_policy(condition.policy, env)
        for step, now in episode(env, policy, condition, steps, console):
            if step % every == 0:
                times_s.append(float(now["time_s"]))
                frames.append(picture.sides(now))
        return Recording(picture.display_robot(), times_s, frames)


class _Poses(plugin.SimPlugin):
    """Takes the place of the physics: poses the three robots."""

    def __init__(self, playback: Playback, scene: SideBySide) -> None:
        self._playback = playback
        self._scene = scene

    @messages.handler
    def _on_load_model(self, _: messages.LoadModelEvent) -> bool:
        """Keep the three robots: no file of a page, nor its button to reload, replaces them."""
        return True

    @messages.handler
    def _on_step(self, event: messages.StepEvent) -> None:
        playback = self._playback
        if event.model is self._scene.model:
            playback.tick()
            event.data.time = playback.time_s
            frame = playback.recording.at(playback.time_s)
            self._scene.pose(event.data, frame, playback.factor)
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
            end_s = play.recording.times_s[-1]
            most = LARGEST_FACTOR
            _, play.factor = imgui.SliderFloat(_FACTOR, play.factor, 0.0, most)
            _, play.time_s = imgui.SliderFloat("time [s]", play.time_s, 0.0, end_s)
            _, play.paused = imgui.Checkbox("pause", play.paused)
        imgui.End()


class _PrivateViewer(web_viewer.WebViewer):
    """MuJoCo's web viewer at a socket of ours, in place of a public port; it takes no models.

    Args:
        endpoint: To the side that poses the robots.
        plugins: What the page shows.
        listener: Where the viewer listens.
    """

    def __init__(self, endpoint: Any, plugins: Any, listener: socket.socket) -> None:
        self._listener = listener
        config = viewer_protocol.ViewerConfig(title=_TITLE, gfx="web", http_port=0)
        # it prints an address that is not ours
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(config, endpoint, plugins=plugins)

    def _start_server(self) -> None:
        self._http_sock.close()  # it was bound to every address, and has never listened
        self._http_sock = self._listener
        super()._start_server()

    def get_drop_file(self) -> str:
        """No file is taken from the page."""
        return ""


@dataclass(frozen=True)
class Page:
    """A recording that browsers can see.

    Attributes:
        handle: What runs the loop, by its `sync`.
        access: Who may see it, and its address.
    """

    handle: viewer_handle.ViewerHandle
    access: Access


@contextlib.contextmanager
def show(recording: Recording, host: str = LOOPBACK, port: int = 0) -> Iterator[Page]:
    """Serve a recording to browsers, in threads of their own, as long as what is within runs.

    Args:
        recording: What is shown, again and again.
        host: Address or name of this machine at which the page listens.
        port: Port of the page; 0 takes the first free one from 8080 on.

    Raises:
        ConfigurationError: Host or port cannot be.
        SystemFailedError: The port is taken.
    """
    browsers = open_listener(host, port)
    access = Access(host, browsers.getsockname()[1])
    with (
        contextlib.closing(browsers),
        tempfile.TemporaryDirectory(prefix="elastic_view_", dir=_SHORT) as folder,
        _launch(recording, f"{folder}/viewer") as handle,
        contextlib.closing(Proxy(browsers, f"{folder}/viewer", access)),
    ):
        yield Page(handle, access)


def _launch(recording: Recording, place: str) -> viewer_handle.ViewerHandle:
    """Start the viewer in a thread; it listens on a Unix socket of a path."""
    scene = SideBySide(recording.robot)
    playback = Playback(recording)
    window = app.App(app.Config(show_options=False, show_inspector=False))
    plugins = [window, _Poses(playback, scene), _Sliders(playback)]
    of_viewer, of_robots = plugin.split_plugins(plugins)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(place)
    listener.listen()
    begun = threading.Event()

    def run(endpoint: Any) -> None:
        try:
            viewer = _PrivateViewer(endpoint, of_viewer, listener)
        finally:
            begun.set()
        viewer_protocol.run_viewer_loop(viewer)

    handle = launch_thread.launch_thread(run, sim_plugins=of_robots)
    begun.wait()
    handle.set_model(scene.model, data=mujoco.MjData(scene.model))
    return handle


class View(WatchedEpisode):
    """Look at one episode in the browser: reference, motor side and link side, side by side.

    The episode is played first, then shown again and again by MuJoCo's web viewer until Ctrl-C.
    Sliders set the time, and the factor by which deviations from the reference are enlarged. The
    page is reached from this machine alone, at the address that is printed, with its token; from
    elsewhere by: ssh -L 8080:127.0.0.1:8080 MACHINE

    Example, one joint: elastic view --policy input --reference sine

    Example, a walk: elastic view --env walker --policy input_output --scenario soft
    """

    host: str = LOOPBACK
    """Address or name of this machine at which the page listens; 0.0.0.0 for all, then others
    reach it too.
    """
    port: int = quantity("1", 0, ge=0, le=65535)
    """Port of the page; 0 takes the first free one from 8080 on."""

    def run(self, console: Console) -> None:
        """Play an episode, then show it until Ctrl-C."""
        # what cannot be is said before the episode
        open_listener(self.host, self.port).close()
        condition = self.condition
        console.print(f"playing {self.policy} first")
        recording = record(condition, console, self.max_s)
        with show(recording, self.host, self.port) as page:
            console.print(f"the page is at {page.access.address}", highlight=False)
            if not page.access.is_local:
                what = "sees the page and moves its sliders; nothing on the way is encrypted"
                console.print(f"who has this address {what}")
            console.print("Ctrl-C ends it")
            # opens a tab of the browser, where there is a display
            has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            if has_display or not sys.platform.startswith("linux"):
                arguments = (page.access.address, 2)
                threading.Thread(target=webbrowser.open, args=arguments, daemon=True).start()
            while page.handle.is_running():
                page.handle.sync()
