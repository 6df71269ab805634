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
"""Factor of the slider at the start, and its largest one."""

_FRAMES_PER_S = 50
_PAUSE_S = 0.01
_SOCKET_DIR = "/tmp"
"""Folder of the socket: its path may have about 100 characters, and TMPDIR may be longer."""
_TITLE = "elastic view: reference, motor side, link side"
_FACTOR = "deviations drawn x"
_POSITION = (16.0, 40.0)
_SIZE = (400.0, 130.0)
"""Position and size of the window of sliders [pixels]."""


@dataclass(frozen=True)
class Recording:
    """An episode as frames of a robot.

    Attributes:
        robot: Model of the robot.
        times_s: Time of every frame since the start [s], rising.
        frames: Poses of the robot.
    """

    robot: DisplayRobot
    times_s: Sequence[float]
    frames: Sequence[Sides]

    def at(self, time_s: float) -> Sides:
        """Last frame that is not later than a time, or the first one."""
        return self.frames[max(bisect.bisect_right(self.times_s, time_s) - 1, 0)]


@dataclass
class Playback:
    """State of the page, set by sliders and read by the drawing: time [s], factor, pause."""

    recording: Recording
    time_s: float = 0.0
    factor: float = FIRST_FACTOR
    paused: bool = False
    _last_s: float = field(default_factory=time.monotonic)

    def tick(self) -> None:
        """Advance by the time that has passed; restart at the end."""
        now = time.monotonic()
        last = self._last_s
        self._last_s = now
        if not self.paused:
            end = self.recording.times_s[-1]
            self.time_s = self.time_s + now - last if self.time_s < end else 0.0


def record(condition: Condition, console: Console, max_s: float | None) -> Recording:
    """Play an episode and record its frames.

    Args:
        condition: Conditions of the episode.
        console: Gets the messages.
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
        for step, info in episode(env, policy, condition, steps, console):
            if step % every == 0:
                times_s.append(float(info["time_s"]))
                frames.append(picture.sides(info))
        return Recording(picture.display_robot(), times_s, frames)


class _Poses(plugin.SimPlugin):
    """Poses the three robots, instead of the physics."""

    def __init__(self, playback: Playback, scene: SideBySide) -> None:
        self._playback = playback
        self._scene = scene

    @messages.handler
    def _on_load_model(self, _: messages.LoadModelEvent) -> bool:
        """Keep the three robots: no file and no reload of a page replaces them."""
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
        imgui.SetNextWindowPos(imgui.Vec2(*_POSITION), imgui.Cond.Once)
        imgui.SetNextWindowSize(imgui.Vec2(*_SIZE), imgui.Cond.Once)
        if imgui.Begin(_TITLE):
            end_s = play.recording.times_s[-1]
            _, play.factor = imgui.SliderFloat(_FACTOR, play.factor, 0.0, LARGEST_FACTOR)
            _, play.time_s = imgui.SliderFloat("time [s]", play.time_s, 0.0, end_s)
            _, play.paused = imgui.Checkbox("pause", play.paused)
        imgui.End()


class _PrivateViewer(web_viewer.WebViewer):
    """MuJoCo's web viewer at our socket, instead of a public port; it accepts no models.

    Args:
        endpoint: Connection to the plugin that poses the robots.
        plugins: Plugins of the page.
        listener: Socket at which the viewer listens.
    """

    def __init__(self, endpoint: Any, plugins: Any, listener: socket.socket) -> None:
        self._listener = listener
        config = viewer_protocol.ViewerConfig(title=_TITLE, gfx="web", http_port=0)
        # the viewer prints an address that is not ours
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(config, endpoint, plugins=plugins)

    def _start_server(self) -> None:
        self._http_sock.close()  # bound to every address, but not listening
        self._http_sock = self._listener
        super()._start_server()

    def get_drop_file(self) -> str:
        """Return no file: the page takes none."""
        return ""


@dataclass(frozen=True)
class Page:
    """A page that shows a recording to browsers.

    Attributes:
        handle: Handle whose `sync` runs the loop.
        access: Address of the page, and rules of access.
    """

    handle: viewer_handle.ViewerHandle
    access: Access


@contextlib.contextmanager
def show(recording: Recording, host: str = LOOPBACK, port: int = 0) -> Iterator[Page]:
    """Serve a recording to browsers, in threads, while the block runs.

    Args:
        recording: Recording that is repeated.
        host: Address or name of this machine at which the page listens.
        port: Port of the page; 0 takes the first free one from 8080 on.

    Raises:
        ConfigurationError: Host or port are invalid.
        SystemFailedError: The port is in use.
    """
    browsers = open_listener(host, port)
    access = Access(host, browsers.getsockname()[1])
    with (
        contextlib.closing(browsers),
        tempfile.TemporaryDirectory(prefix="elastic_view_", dir=_SOCKET_DIR) as folder,
        _launch(recording, f"{folder}/viewer") as handle,
        contextlib.closing(Proxy(browsers, f"{folder}/viewer", access)),
    ):
        yield Page(handle, access)


def _launch(recording: Recording, path: str) -> viewer_handle.ViewerHandle:
    """Start the viewer in a thread; it listens on a Unix socket at a path."""
    scene = SideBySide(recording.robot)
    playback = Playback(recording)
    window = app.App(app.Config(show_options=False, show_inspector=False))
    plugins = [window, _Poses(playback, scene), _Sliders(playback)]
    viewer_plugins, sim_plugins = plugin.split_plugins(plugins)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(path)
    listener.listen()
    begun = threading.Event()

    def run(endpoint: Any) -> None:
        try:
            viewer = _PrivateViewer(endpoint, viewer_plugins, listener)
        finally:
            begun.set()
        viewer_protocol.run_viewer_loop(viewer)

    handle = launch_thread.launch_thread(run, sim_plugins=sim_plugins)
    begun.wait()
    handle.set_model(scene.model, data=mujoco.MjData(scene.model))
    return handle


class View(WatchedEpisode):
    """Look at one episode in the browser: reference, motor side and link side, side by side.

    The episode is played first, then repeated by MuJoCo's web viewer until Ctrl-C. Sliders set the
    time, and the factor by which deviations from the reference are enlarged. Only this machine
    reaches the page, at the printed address with its token; from elsewhere: ssh -L
    8080:127.0.0.1:8080 MACHINE

    Example, one joint: elastic view --policy input --reference sine

    Example, a walk: elastic view --env walker --policy input_output --scenario soft
    """

    host: str = LOOPBACK
    """Address or name of this machine at which the page listens; with 0.0.0.0, other machines
    reach it too.
    """
    port: int = quantity("1", 0, ge=0, le=65535)
    """Port of the page; 0 takes the first free one from 8080 on."""

    def run(self, console: Console) -> None:
        """Play an episode, then show it until Ctrl-C."""
        # a wrong host or port must fail before the episode
        open_listener(self.host, self.port).close()
        condition = self.condition
        console.print(f"playing {self.policy} first")
        recording = record(condition, console, self.max_s)
        with show(recording, self.host, self.port) as page:
            console.print(f"the page is at {page.access.address}", highlight=False)
            if not page.access.is_local:
                rights = "see the page and move its sliders; nothing is encrypted"
                console.print(f"anyone with this address can {rights}")
            console.print("Ctrl-C ends it")
            # opens a tab of the browser, if there is a display
            has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            if has_display or not sys.platform.startswith("linux"):
                arguments = (page.access.address, 2)
                threading.Thread(target=webbrowser.open, args=arguments, daemon=True).start()
            while page.handle.is_running():
                page.handle.sync()
