"""`elastic play`: one episode in a window, or as a video file."""

import io
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium
from rich.console import Console

from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import (
    ElasticError,
    ResultsExistError,
    SystemFailedError,
    missing_extra,
    shorten,
)
from train.commands.options import DEFAULT_SCENARIO, MotionOrDefault, name_options
from train.evaluate.conditions import Condition, PolicySpec, Seed, cell_of
from train.evaluate.rollout import control_steps, make_policy, make_vector_env
from train.runs.progress import Show, show_progress

_FRAMES_PER_S = 25
_Step = tuple[int, Mapping[str, Any]]
"""Number and info of a control step."""


def play(
    condition: Condition, console: Console, video: Path | None = None, max_s: float | None = None
) -> None:
    """Play one episode in a window in real time, or into a video file as fast as it goes.

    Args:
        condition: Cell to play.
        console: Console for messages.
        video: File to write (mp4 or gif); None opens a window.
        max_s: Stop after this much simulated time [s], one control step at least.

    Raises:
        ResultsExistError: The video file exists.
        MissingExtraError: The video writer is not installed.
    """
    mode = "human" if video is None else "rgb_array"
    name = condition.environment.id
    env: Any = gymnasium.make(name, render_mode=mode, **condition.arguments)
    task = env.unwrapped.task
    period = task.assumed_model.control_period_s
    with closing(env):
        steps = steps_within(task, max_s)
        policy = make_policy(condition.policy, env)
        if hasattr(policy, "rehearse"):
            # before the window opens or the film begins
            console.print(f"{condition.policy.title} learns on this robot first")
            with closing(make_vector_env(condition, 1)) as worlds:
                policy.rehearse(worlds, condition.seed)
        played = episode(env, policy, condition, steps, console)
        if video is None:
            _play_in_real_time(played, period)
        else:
            with show_progress(console, {"filming": steps}, transient=True, unit="film") as show:
                _film(env, played, period, video, show)
            console.print(f"wrote {video}")


def steps_within(task: Any, max_s: float | None) -> int:
    """Return the number of control steps of a shown episode, at least one.

    Args:
        task: Task of the environment.
        max_s: Stop after this much simulated time [s]; None for the whole episode.
    """
    if max_s is None:
        return task.num_steps
    steps = max_s / task.assumed_model.control_period_s
    return max(round(min(steps, task.num_steps)), 1)


def episode(
    env: Any, policy: Any, condition: Condition, steps: int, console: Console
) -> Iterator[_Step]:
    """Play step by step; yield number and info of each step, and print why the episode ended early.

    Args:
        env: Environment of one world.
        policy: Policy that commands it.
        condition: Cell that is played, for its seed and for errors.
        steps: Largest number of steps.
        console: Console for messages.
    """
    for step in islice(control_steps(env, policy, condition.seed, condition), steps):
        yield step.number, step.info
        if step.terminated:
            when = f"after {step.info['time_s']:.2f} s"
            console.print(f"the episode ended {when}: {step.info['termination']}")


def _play_in_real_time(episode: Iterable[_Step], period: float) -> None:
    begin = time.perf_counter()
    for step, _ in episode:
        time.sleep(max(0.0, begin + (step + 1) * period - time.perf_counter()))


def _film(env: Any, episode: Iterable[_Step], period: float, video: Path, show: Show) -> None:
    if video.exists() or video.is_symlink():
        problem = f"{shorten(video)} exists and is not overwritten; name another file"
        raise ResultsExistError(problem)
    if video.suffix not in {".mp4", ".gif"}:
        raise ElasticError(f"a video is an .mp4 or .gif file, got {video.name!r}")
    try:
        import imageio.v2 as imageio
    except ImportError:
        raise missing_extra("imageio", "report", "writing a video") from None
    every = max(round(1.0 / (_FRAMES_PER_S * period)), 1)
    frame_s = every * period
    frames = 0
    video.parent.mkdir(parents=True, exist_ok=True)
    # a GIF is made in memory, since its writer prints the error of a full disk
    memory = io.BytesIO()
    is_gif = video.suffix == ".gif"
    if is_gif:
        writer: Any = imageio.get_writer(memory, "gif", duration=1e3 * frame_s)
    else:
        # quiet, since an interrupt makes ffmpeg complain; `_require_whole` finds failures
        writer = imageio.get_writer(video, fps=1.0 / frame_s, ffmpeg_log_level="quiet")
    try:
        with writer:
            for step, _ in episode:
                if step % every == 0:
                    writer.append_data(env.render())
                    frames += 1
                show(0, step + 1)
        if is_gif:
            video.write_bytes(memory.getbuffer())
        else:
            _require_whole(video, frames)
    except BaseException:
        video.unlink(missing_ok=True)  # else it would block the next film
        raise


def _require_whole(video: Path, frames: int) -> None:
    """Check that a film has all frames, since the encoder is a process that reports no failure.

    Raises:
        SystemFailedError: Frames are missing, or the file cannot be read.
    """
    from imageio_ffmpeg import count_frames_and_secs

    try:
        readable, _ = count_frames_and_secs(str(video))
    except RuntimeError:
        readable = 0
    if readable != frames:
        problem = f"{video} is not whole, {readable} of {frames} frames can be read"
        cure = "the disk may be full: free some space, then play again"
        raise SystemFailedError(f"{problem}; {cure}")


class WatchedEpisode(Model):
    """Options of an episode that the user watches."""

    policy: str = "uncompensated"
    """Baseline, residual:PATH, or "FILE.py:function" for your own; see elastic evaluate --help."""
    env: str = "testbed"
    """Environment: testbed, walker, robot, ROBOT.yaml (a file of any robot, see docs/robots.md),
    or "FILE.py:ROBOT", a JointRobot."""
    scenario: str = DEFAULT_SCENARIO
    """Scenario."""
    reference: MotionOrDefault = None
    """Motion, as in elastic evaluate; default sine, on the walker 3."""
    seed: Seed = 0
    """Seed of the episode."""
    max_s: float | None = quantity("s", None, gt=0)
    """Stop after this much simulated time [s]."""

    @property
    def condition(self) -> Condition:
        """The cell that is played."""
        with name_options():
            played = cell_of(self, PolicySpec(name=self.policy))
        watched = played.environment.watched_reference
        if self.reference is None and watched is not None:
            return played.replace(reference=watched)
        return played


class Play(WatchedEpisode):
    """Watch one episode: in a window in real time, or with --video as a file.

    Deviations from the reference are drawn enlarged, by a factor that the picture shows.

    Example, one joint: elastic play --policy input --reference sine --video sine.mp4

    Example, a walk: elastic play --env walker --policy input_output --video walk.mp4
    """

    video: Path | None = None
    """Video file to write (.mp4, .gif); without it a window opens."""

    def run(self, console: Console) -> None:
        """Play the episode."""
        play(self.condition, console, self.video, self.max_s)
