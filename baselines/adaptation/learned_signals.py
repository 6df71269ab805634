"""Signals that `iterative` learns: errors, and the offsets that correct them.

| robot | error, by sensors alone | correction |
|---|---|---|
| walker | roll and pitch of the IMU | the same offset on both hip rolls, or on both hip pitches |
| walker | planned less measured ZMP | another ZMP of the plan, see `baselines.walking.zmp_shift` |
| joints | q_ref − q by link encoders, or by the IMU of the only link | the offset of the joint |

A positive offset of both hip rolls turns the pelvis to a negative roll, so the error is the roll
itself. The ZMP and the links follow their offsets, so their error is the desired value less the
measured one.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from typing_extensions import override

from baselines.adaptation.learning_law import ChannelGains
from baselines.compensation.measured import LINK_ENCODER
from baselines.walking.flat_feet import FlatFeet
from baselines.walking.posture import hip_offsets
from baselines.walking.zmp_shift import zmp_shift_offsets
from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import RobotModel, WalkerModel

_LINK_ANGLE = "link_angle_imu"
"""Measured angle of the only link, in the info of a step."""
_LEAST_LOAD = 0.15
"""Share of the weight below which there is no ZMP."""
_ZMP = ChannelGains(gain=0.6, lead_s=0.26, cutoff_hz=2.0, surprise=0.006, limit=0.06)
_ZMP = _ZMP.replace(forgetting=0.1, halved_after=3.0)


class LearningGains(Model):
    """Gains with which `iterative` learns, and the number of its trials."""

    trials: int = quantity("1", 10, ge=1, le=1000)
    """Trials, such as walks, that it learns from [1]."""
    attitude: ChannelGains = ChannelGains(
        gain=2.0, lead_s=0.032, cutoff_hz=6.0, surprise=1.5e-3, limit=0.08
    )
    """Walker: hip angle per tilt of the pelvis [1], in rad."""
    zmp_x: ChannelGains = _ZMP
    """Walker: forward shift of the planned ZMP per deviation of the ZMP [1], in m."""
    zmp_y: ChannelGains = _ZMP
    """Walker: the same to the left."""
    joint: ChannelGains = ChannelGains(
        gain=0.5, lead_s=0.08, cutoff_hz=1.4, surprise=0.01, limit=0.2
    )
    """Robots on a fixed base: offset per error of the link [1], in rad."""


class LearnedSignals(Protocol):
    """Errors, and the offsets that correct them."""

    names: tuple[str, ...]
    """Names of the columns, with their unit."""
    gains: tuple[ChannelGains, ...]
    """Gains of the columns."""

    @abstractmethod
    def error(self, before: Array, after: Array, info: Mapping[str, Any]) -> Array:
        """Errors measured after a control step, (num_worlds, k); nan where nothing was measured.

        Args:
            before: Observations before the step, with the reference for its end, (num_worlds, m).
            after: Observations after it, (num_worlds, m).
            info: Info that the environment returned with it.
        """

    @abstractmethod
    def offsets(self, table: Array) -> Array:
        """Offsets of the joints for a table over time, (T, k) to (T, n) [rad]."""


class WalkSignals(LearnedSignals):
    """Attitude and ZMP of a walker, see the module.

    Args:
        model: Assumed walker.
        gains: Gains of the channels.
    """

    names: tuple[str, ...] = ("roll_rad", "pitch_rad", "zmp_x_m", "zmp_y_m")

    def __init__(self, model: WalkerModel, gains: LearningGains) -> None:
        self.gains = (gains.attitude, gains.attitude, gains.zmp_x, gains.zmp_y)
        table = model.observation_table
        self._model = model
        self._feet = FlatFeet(model, _LEAST_LOAD * model.biped.weight)
        self._attitude = table.group("imu_attitude")
        self._wrench = table.group("wrench")

    @override
    def error(self, before: Array, after: Array, info: Mapping[str, Any]) -> Array:
        """Tilt, and error of the ZMP of feet that are flat where planned, (num_worlds, 4)."""
        error = self._feet.zmp_error(before, after[:, self._wrench])
        return np.hstack([after[:, self._attitude], -error])

    @override
    def offsets(self, table: Array) -> Array:
        return hip_offsets(table[:, :2]) + zmp_shift_offsets(self._model, table[:, 2:])


class JointSignals(LearnedSignals):
    """Links of a robot on a fixed base, see the module.

    Args:
        model: Assumed robot.
        gains: Gains of the channels.

    Raises:
        ConfigurationError: No sensor measures its links.
    """

    def __init__(self, model: RobotModel, gains: LearningGains) -> None:
        joints = model.joint_names
        table = model.observation_table
        self.names = tuple(f"{joint}_rad" for joint in joints)
        self.gains = (gains.joint,) * len(joints)
        self._reference = table.group("reference_angle")
        has_encoders = LINK_ENCODER in {name.split(".")[0] for name in table.names}
        self._encoder = table.group(LINK_ENCODER) if has_encoders else None
        if self._encoder is None and len(joints) > 1:
            raise ConfigurationError(
                f"learning the offsets of {len(joints)} joints needs their links"
                f" measured; make the environment with sensors=[{LINK_ENCODER!r}]"
            )

    @override
    def error(self, before: Array, after: Array, info: Mapping[str, Any]) -> Array:
        if self._encoder is None:
            return before[:, self._reference] - np.reshape(info[_LINK_ANGLE], (-1, 1))
        return before[:, self._reference] - after[:, self._encoder]

    @override
    def offsets(self, table: Array) -> Array:
        return table


def learned_signals(model: RobotModel, gains: LearningGains) -> LearnedSignals:
    """Make the signals that `iterative` learns for a robot."""
    if isinstance(model, WalkerModel):
        return WalkSignals(model, gains)
    return JointSignals(model, gains)
