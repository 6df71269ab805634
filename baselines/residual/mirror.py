"""A walker seen in the mirror of its plane of symmetry, x and z: what the right leg does looks as if the left did it.

A robot that is its own mirror image needs one answer for both of its steps. A residual that always sees the step on
the left foot has half as much to learn, and learns it from twice as many steps. In the mirror left and right change
places; vectors change their y, axes of rotation their x and z, and a share of the load or the choice of a foot, p,
becomes 1 − p [Abdolhosseini2019].

[Abdolhosseini2019] F. Abdolhosseini et al., "On Learning Symmetric Locomotion", Motion, Interaction and Games.
"""

import re
from collections.abc import Sequence

import numpy as np

from baselines.residual.correction import Corrected
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.dynamics.biped import Biped
from elastic_env.runtime.further_sensors import SENSORS
from elastic_env.runtime.robot_model import WalkerModel

_SHARES = {"clock.support", "load_share"}
"""0 on the left, 1 on the right."""
_ODD = {
    "imu_attitude.roll",
    "own_tilt.roll",
    "imu_rate.x",
    "imu_rate.z",
    "zmp_reference.y",
    "contact_error.y",
    "contact_error.share",
    *(f"{group}.{part}" for group in ("wrench", "level_wrench") for part in ("fy", "mx", "mz")),
}
"""What changes its sign, but for the sides in the names."""
_EVEN = {
    "imu_attitude.pitch",
    "own_tilt.pitch",
    "imu_rate.y",
    "zmp_reference.x",
    "contact_error.x",
    "clock.time",
    "clock.swing",
    "excess_load",
    *(f"{group}.{part}" for group in ("wrench", "level_wrench") for part in ("fx", "fz", "my")),
    *(f"{group}.{axis}" for group in ("model_error", "uncertainty") for axis in ("roll", "pitch")),
}
"""What keeps it."""
_OF_SENSORS = {
    f"{name}.{axis}": sign
    for name, sensor in SENSORS.items()
    for axis, sign in zip(sensor.axes, sensor.mirrored, strict=True)
}
"""What the columns of further sensors are, by their declarations."""
_LATERAL_AXES = (0, 2)
_SIDE = re.compile(r"(?<=\.)[lr]_")


class Mirror:
    """What signals of a walker are in its mirror.

    Args:
        names: What the columns hold, as in the tables of observations and features; joints after a dot.
        biped: The robot.

    Raises:
        ConfigurationError: A name of which it is not known what it is in the mirror, or one of a side alone.
    """

    def __init__(self, names: Sequence[str], biped: Biped) -> None:
        lateral = {
            name
            for leg in np.split(np.array(biped.joint_names), 2)
            for name, axis in zip(leg.tolist(), biped.chains.axis, strict=True)
            if axis in _LATERAL_AXES
        }
        joints = set(biped.joint_names)
        columns = {name: column for column, name in enumerate(names)}
        lacking = [_other_side(name) for name in names if _other_side(name) not in columns]
        if lacking:
            raise ConfigurationError(
                f"in the mirror left and right change places, but there is no {', '.join(lacking)}; observe both, or "
                "mirror: false"
            )
        self._source = np.array([columns[_other_side(name)] for name in names], dtype=np.int64)
        self._sign = np.array([_sign(name, joints, lateral) for name in names])
        self._offset = np.array([float(name in _SHARES) for name in names])

    def __call__(self, values: Array) -> Array:
        """Values in the mirror, (..., columns)."""
        return self._offset + self._sign * values[..., self._source]


class LeftFirst:
    """Shows steps on the right foot in the mirror, as steps on the left.

    Args:
        names: Of the features, earlier measurements left out.
        measured: Of the measurements of one earlier decision.
        corrected: The base and its correction, which is the same in the mirror.

    Raises:
        ConfigurationError: No walker, a name without a mirror image, or a joint corrected unlike the other leg's.
    """

    def __init__(self, names: Sequence[str], measured: Sequence[str], corrected: Corrected) -> None:
        model, settings = corrected.model, corrected.settings
        if not isinstance(model, WalkerModel):
            raise ConfigurationError(
                f"mirror is for a walker, whose legs are mirror images, got a {type(model).__name__}; set mirror: false"
            )
        scale = np.zeros(len(model.joint_names))
        scale[corrected.joints] = settings.scales(model.joint_names)
        unlike = [
            name for name, *pair in zip(model.joint_names, *np.split(scale, 2), strict=False) if np.ptp(pair) > 0.0
        ]
        if unlike:
            raise ConfigurationError(
                f"mirror needs joints and scale that are the same on both legs, they are not for {', '.join(unlike)}; "
                "name joints without l_ and r_, or mirror: false"
            )
        self._now, self._past = Mirror(names, model.biped), Mirror(measured, model.biped)
        self._split, self._earlier = len(names), (settings.history, len(measured))
        self._support = model.observation_table.columns("clock.support")

    def __call__(self, rows: Array, features: Array) -> Array:
        """Features as they are while the left foot is that of the step, and mirrored while the right is.

        Args:
            rows: Observations, (num_worlds, m).
            features: Of the same measurements, earlier ones last, (num_worlds, width).

        Returns:
            (num_worlds, width).
        """
        now, past = np.split(features, [self._split], axis=1)
        past = self._past(past.reshape(len(past), *self._earlier)).reshape(past.shape)
        return np.where(rows[:, self._support] == 1.0, np.hstack([self._now(now), past]), features)


def _other_side(name: str) -> str:
    """The name of the same on the other leg; itself where it has no side."""
    return _SIDE.sub(lambda side: "r_" if side[0] == "l_" else "l_", name)


def _sign(name: str, joints: set[str], lateral: set[str]) -> float:
    joint, plain = name.rpartition(".")[2], _SIDE.sub("", name)
    if joint in joints:
        return -1.0 if joint in lateral else 1.0
    if plain in _OF_SENSORS:
        return _OF_SENSORS[plain]
    if plain in _EVEN:
        return 1.0
    if plain in _ODD or plain in _SHARES:
        return -1.0
    raise ConfigurationError(f"it is not known what {name!r} is in the mirror; leave it out, or mirror: false")
