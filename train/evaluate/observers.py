"""Observers of a rollout: metrics that no environment computes, and traces of first episodes."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from baselines.identification.identify import StaticPoints
from baselines.identification.static_points import HoldRecorder
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import WalkerModel
from train.evaluate.environments import Environment
from train.evaluate.local_frame_error import SupportChanges


class Observers:
    """Metrics of the IMU and of a policy's estimate in all worlds, and traces of some.

    Args:
        env: Vector environment.
        policy: Policy that plays in it.
        environment: Its description.
        traced_worlds: Worlds whose first episode is traced.

    Attributes:
        traces: Traces by world.
    """

    def __init__(
        self, env: Any, policy: Any, environment: Environment, traced_worlds: Iterable[int]
    ) -> None:
        task = env.unwrapped.task
        model = task.assumed_model
        has_estimate = hasattr(policy, "link_estimate") and not environment.is_real
        walks = isinstance(model, WalkerModel)
        self._env = env
        self._policy = policy
        self._task = task
        self._estimate = _Rms(env.num_envs) if has_estimate else None
        self._changes = SupportChanges(model) if has_estimate and walks else None
        self._imu = _Rms(env.num_envs) if walks else None
        self.traces = {world: Trace(task, environment.traced, world) for world in traced_worlds}
        self._ended = set[int]()
        self._scored = np.zeros(env.num_envs, dtype=np.bool_)

    def watch(self, step: int, observation: Array, info: Any, memory: Any) -> None:
        """Record a control step, between the command and its effect."""
        scored = self._task.masks(self._task.sample())["scored"]
        self._scored = scored
        for world, trace in self.traces.items():
            if world not in self._ended:
                trace.record(observation, {**info, "scored": scored})
        if self._imu is not None:
            attitude = observation[:, self._task.observation_table.group("imu_attitude")]
            truth = np.stack([info["pelvis_roll"], info["pelvis_pitch"]], axis=1)
            self._imu.add(np.square(attitude - truth).sum(axis=1), scored)
        if self._estimate is not None:
            estimate = self._policy.link_estimate(observation, memory)
            truth = self._env.unwrapped.truth()
            self._estimate.add(np.square(estimate - truth.q).mean(axis=1), scored)
            if self._changes is not None:
                self._changes.record(step, estimate, observation, truth)

    def metrics(self, world: int) -> dict[str, float]:
        """Metrics of a world over its episode so far."""
        metrics: dict[str, float] = {}
        if self._estimate is not None:
            metrics["link_estimate_error_rms_rad"] = self._estimate.value(world)
        if self._changes is not None:
            metrics |= self._changes.metrics(world)
        if self._imu is not None:
            metrics["imu_error_rms_rad"] = self._imu.value(world)
        # only a walker records the robots that it draws from ranges
        if hasattr(self._task, "robot_record"):
            metrics |= self._task.robot_record(world)
        return metrics

    def end(self, world: int, observation: Array, info: dict[str, Any]) -> None:
        """Record the last sample of a world."""
        self._ended.add(world)
        if world in self.traces:
            # `scored` is of the step before, since the world may have begun its next episode
            self.traces[world].record(observation, {**info, "scored": self._scored})


class _Rms:
    """RMS over the scored steps of every world."""

    def __init__(self, worlds: int) -> None:
        self._sum = np.zeros(worlds)
        self._count = np.zeros(worlds)

    def add(self, squared: Array, scored: BoolArray) -> None:
        self._sum += np.where(scored, squared, 0.0)
        self._count += scored

    def value(self, world: int) -> float:
        count = self._count[world]
        return float(np.sqrt(self._sum[world] / count)) if count else float("nan")


class Trace:
    """Time series and static points of the episode of one world.

    Args:
        task: Task of the environment.
        names: Signals that are recorded.
        world: Number of the world.

    Attributes:
        references: References of the static points, (visits,) [rad].
    """

    def __init__(self, task: Any, names: tuple[str, ...], world: int) -> None:
        self._names = names
        self._world = world
        self._encoder = task.observation_table.group("encoder_angle")
        self.references = np.zeros(0)
        self._recorder: HoldRecorder | None = None
        visits = getattr(getattr(task.config, "reference", None), "visits", None)
        # static points need the IMU of the only link
        if visits is not None and "link_angle_imu" in names:
            self.references, directions = visits
            self._recorder = HoldRecorder(directions)
        self._rows: list[list[float]] = []

    def record(self, observation: Array, info: dict[str, Any]) -> None:
        """Record a sample."""
        world = slice(self._world, self._world + 1)
        signals = [info[name] for name in self._names]
        self._rows.append([float(signal[self._world]) for signal in signals])
        if self._recorder is not None:
            encoder = observation[world, self._encoder][:, 0]
            rest = int(info["rest"][self._world])
            self._recorder.take(encoder, info["link_angle_imu"][world], rest)

    def signals(self) -> dict[str, Array]:
        """Time series by name."""
        return dict(zip(self._names, np.array(self._rows).T, strict=True))

    def points(self) -> StaticPoints | None:
        """Static points; None if the motion did not visit all of them."""
        if self._recorder is None or not self._recorder.is_complete:
            return None
        return self._recorder.points()[0]
