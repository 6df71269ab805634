r"""TODO signals"""

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

LINK_IMU = "link_angle_imu"
_LEAST_LOAD = 0.15  # share of the weight below which there is no ZMP
_ZMP = ChannelGains(gain=0.6, lead_s=0.26, cutoff_hz=2.0, surprise=0.006, limit=0.06)
_ZMP = _ZMP.replace(forgetting=0.1, halved_after=3.0)


class LearningGains(Model):
    """How the offsets of `iterative` are learned."""

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
    """Errors that are corrected, and how."""

    names: tuple[str, ...]
    """Of the columns, with their unit."""
    gains: tuple[ChannelGains, ...]
    """Of the columns."""

    @abstractmethod
    def error(self, asked: Array, seen: Array, info: Mapping[str, Any]) -> Array:
        """Errors measured after a control step, (num_worlds, k); nan where nothing was measured.

        Args:
            asked: Observations before the step, whose reference is that of its end, (num_worlds,
                m).
            seen: Observations after it.
            info: What the environment says of it.
        """

    @abstractmethod
    def offsets(self, table: Array) -> Array:
        """Offsets of the joints for a table over time, (T, k) to (T, n) [rad]."""


class WalkSignals(LearnedSignals):
    """Attitude and ZMP of a walker, see the module.

    Args:
        model: Assumed walker.
        gains: How they are learned.
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
    def error(self, asked: Array, seen: Array, info: Mapping[str, Any]) -> Array:
        """Tilt, and error of the ZMP of feet that are flat where planned, (num_worlds, 4)."""
        error = self._feet.zmp_error(asked, seen[:, self._wrench])
        return np.hstack([seen[:, self._attitude], -error])

    @override
    def offsets(self, table: Array) -> Array:
        return hip_offsets(table[:, :2]) + zmp_shift_offsets(self._model, table[:, 2:])


class JointSignals(LearnedSignals):
    """Links of a robot on a fixed base, see the module.

    Args:
        model: Assumed robot.
        gains: How they are learned.

    Raises:
        ConfigurationError: Nothing shows its links.
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
                f"learning the offsets of {len(joints)} joints needs their links measured; make the"
                f" environment with sensors=[{LINK_ENCODER!r}]"
            )

    @override
    def error(self, asked: Array, seen: Array, info: Mapping[str, Any]) -> Array:
        by_imu = self._encoder is None
        link = np.reshape(info[LINK_IMU], (-1, 1)) if by_imu else seen[:, self._encoder]
        return asked[:, self._reference] - link

    @override
    def offsets(self, table: Array) -> Array:
        return table


def learned_signals(model: RobotModel, gains: LearningGains) -> LearnedSignals:
    """Signals that are learned of a robot."""
    if isinstance(model, WalkerModel):
        return WalkSignals(model, gains)
    return JointSignals(model, gains)
