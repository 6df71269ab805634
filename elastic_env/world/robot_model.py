"""The robot as a compensator may know it: its rigid model and its elastic joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np
import numpy.typing as npt

from elastic_env.core.config import plain_numbers
from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.files import read_bounded
from elastic_env.core.json_text import LARGEST_JSON, parse_json
from elastic_env.core.signals import NO_SIGNALS, Array, Parameter, SignalTable
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.friction import passed_torque
from elastic_env.joint.mujoco_friction import varies
from elastic_env.motion.walk_plan import WalkPlan
from elastic_env.rigid.biped import Biped

STIFFNESS_KEY = "stiffness_nm_per_rad"
"""Key of K in an identification file."""
Stiffness = float | str | Path | Sequence[float] | Array
"""A stiffness as users give it: a number, one per joint, or a file [N·m/rad]."""
_NO_LIMIT_RAD = 200.0 * np.pi
"""Angle from which on a joint limit counts as none [rad]."""


def _joint_property(parameter: str) -> Any:
    """Make a property of a robot: a parameter of all joints, (n,)."""

    def values(robot: "RobotModel") -> Array:
        each = [getattr(joint, parameter) for joint in robot.joints.values()]
        return np.array(each, dtype=np.float64)

    return property(values)


@dataclass(frozen=True)
class RobotModel:
    """A compiled rigid model and an `ElasticJoint` for each of its elastic hinges, in order.

    The same type describes the robot that compensators assume and, in `truth()`, the true robot.
    """

    joints: Mapping[str, ElasticJoint]
    rigid: mujoco.MjModel
    control_period_s: float
    observation_table: SignalTable = NO_SIGNALS
    """Columns of the observation, in order."""

    @property
    def joint_names(self) -> list[str]:
        """Names of the hinges, in order."""
        return list(self.joints)

    stiffness = _joint_property("stiffness")
    """K, (n,) [N·m/rad]."""
    damping = _joint_property("damping")
    """D, (n,) [N·m·s/rad]."""
    rotor_inertia = _joint_property("rotor_inertia")
    """B, (n,) [kg·m²]."""
    backlash = _joint_property("backlash")
    """Width of the dead bands, (n,) [rad]."""
    coulomb_friction = _joint_property("coulomb_friction")
    """Coulomb friction on the links, (n,) [N·m]."""
    viscous_friction = _joint_property("viscous_friction")
    """Viscous friction on the links, (n,) [N·m·s/rad]."""
    load_friction = _joint_property("load_friction")
    """Shares of the transmitted torques that dry friction takes, (n,) [1]."""
    static_friction = _joint_property("static_friction")
    """Increases of dry friction at rest, (n,) [N·m]."""
    stribeck_speed = _joint_property("stribeck_speed")
    """Speeds at which this increase falls to 37 %, (n,) [rad/s]."""

    def require_constant_friction(self, who: str) -> None:
        """Refuse friction that changes with load or speed, for a policy that does not model it.

        Raises:
            ConfigurationError: A joint has such friction.
        """
        changing = [name for name, joint in self.joints.items() if varies(joint)]
        if changing:
            raise ConfigurationError(
                f"{who} knows constant dry friction only, and that of {', '.join(changing)} has"
                " load_friction or static_friction; the policy 'friction' knows both"
            )

    def needed_torque(self, torque: Array) -> Array:
        """Largest torque that servos need to move links against friction, (..., n) [N·m].

        Args:
            torque: Torque at the links, of either sign, (..., n) [N·m].
        """
        friction = self.coulomb_friction + self.static_friction
        return passed_torque(np.abs(torque), 1.0, friction, self.load_friction)

    def largest_torque(self, speed: Array) -> Array:
        """Largest torques of the servos at speeds, (..., n) [rad/s] to (..., n) [N·m].

        Raises:
            ConfigurationError: A joint has no servo.
        """
        pairs = zip(self.servos, np.moveaxis(speed, -1, 0), strict=True)
        return np.stack([servo.largest_torque(each) for servo, each in pairs], axis=-1)

    def demand(self, torque: Array, speed: Array) -> tuple[Array, Array]:
        """Torques that servos need along a motion, and largest torques that they then have.

        A servo that drives the link works against friction, with its largest torque at that speed.
        A servo that brakes the link is helped by friction and back-EMF; both are neglected.

        Args:
            torque: Torque at the links without friction, (..., n) [N·m].
            speed: Speed of the links, (..., n) [rad/s].

        Returns:
            Needed and largest torque, (..., n) [N·m]; a servo cannot follow where it needs more.

        Raises:
            ConfigurationError: A joint has no servo.
        """
        side = np.where(speed == 0.0, np.sign(torque), np.sign(speed))
        friction = self.coulomb_friction + self.static_friction
        needed = torque + self.viscous_friction * speed
        driving = side * passed_torque(needed, side, friction, self.load_friction)
        holding = -side * torque
        driven = self.largest_torque(speed)
        held = self.largest_torque(np.zeros_like(speed))
        is_driven = driving > 0.0
        return np.where(is_driven, driving, holding), np.where(is_driven, driven, held)

    @property
    def encoder_counts_per_turn(self) -> int | None:
        """Counts per turn of the encoders, which are all the same; None for continuous ones."""
        return next(iter(self.joints.values())).encoder_counts_per_turn

    @property
    def servos(self) -> tuple[Servo, ...]:
        """The servos of the joints.

        Raises:
            ConfigurationError: A joint has no servo.
        """
        servos = {name: joint.servo for name, joint in self.joints.items()}
        without = ", ".join(name for name, servo in servos.items() if servo is None)
        if without:
            needed = "a servo is needed on every joint"
            raise ConfigurationError(f"{needed}, but there is none on: {without}")
        return tuple(servo for servo in servos.values() if servo is not None)

    @property
    def servo_compliance(self) -> Array:
        """Compliance of the servos, (n,) [rad/(N·m)]: 1/k_p; 0 for a servo with an integrator."""
        servos = [joint.servo for joint in self.joints.values()]
        sags = [bool(s and s.integral_gain == 0.0) for s in servos]
        gains = [s.position_gain if s else 1.0 for s in servos]
        return np.where(sags, 1.0 / np.array(gains), 0.0)

    @property
    def servo_lag(self) -> Array:
        """Lag k_v/k_p of strongly damped servos, (n,) [s]; 0 for a joint without a servo.

        The back-EMF of a motor damps like k_v.
        """
        servos = [joint.servo for joint in self.joints.values()]
        return np.array([s.braking / s.position_gain if s else 0.0 for s in servos])

    def rest_stiffness(self, form: str, factor: Parameter = 1.0) -> Array:
        """Stiffness of spring and servo in series at rest; infinite where both are rigid.

        Args:
            form: "rigid" for a robot without springs.
            factor: Factor on K, one number or (..., n) [1].

        Returns:
            (n,) or (..., n) [N·m/rad].
        """
        stiffness = factor * self.stiffness
        if form == "rigid":
            stiffness = np.full_like(stiffness, np.inf)
        compliance = self.servo_compliance
        with np.errstate(divide="ignore"):
            in_series = 1.0 / (1.0 / stiffness + compliance)
        return np.where(compliance > 0.0, in_series, stiffness)

    def with_stiffness(self, stiffness: npt.ArrayLike) -> "RobotModel":
        """Return the robot with another stiffness, one number or one per joint [N·m/rad].

        Raises:
            ConfigurationError: The number of values does not fit, or one is not positive and
                finite.
        """
        return replace(self, joints=with_stiffness(self.joints, stiffness))

    def with_observation_table(self, table: SignalTable) -> Self:
        """Return the robot with this table of observations."""
        return replace(self, observation_table=table)


def with_stiffness(
    joints: Mapping[str, ElasticJoint], stiffness: npt.ArrayLike
) -> dict[str, ElasticJoint]:
    """Return joints with another stiffness, one number for all or one per joint [N·m/rad].

    Raises:
        ConfigurationError: The number of values does not fit, or one is not positive and finite.
    """
    values = np.asarray(stiffness, dtype=np.float64)
    if values.shape not in {(), (len(joints),)}:
        raise ConfigurationError(
            f"stiffness must be one number or a list of {len(joints)} [N·m/rad], one for each"
            f" joint: {', '.join(joints)}; got {quote(values.tolist())}"
        )
    each = np.broadcast_to(values, (len(joints),))
    return {
        name: joint.replace(stiffness=float(K))
        for (name, joint), K in zip(joints.items(), each, strict=True)
    }


def joint_ranges(model: mujoco.MjModel, joints: Sequence[str]) -> tuple[Array, Array]:
    """Lowest and highest angle of every joint, (n,) each [rad]; infinite without a limit.

    Exporters write a limit of more than a hundred turns for a joint without one; it is ignored.
    """
    ids = [model.joint(name).id for name in joints]
    limits = model.jnt_range[ids]
    is_near = np.abs(limits) < _NO_LIMIT_RAD
    is_limited = model.jnt_limited[ids, None].astype(bool) & is_near
    lowest, highest = np.where(is_limited, limits, [-np.inf, np.inf]).T
    return lowest, highest


@dataclass(frozen=True)
class WalkerModel(RobotModel):
    """A walker as a policy may know it, including its legs and its walk plan."""

    biped: Biped = field(kw_only=True)
    plan: WalkPlan = field(kw_only=True)


def read_stiffness(value: Stiffness) -> "float | Array":
    """Read a stiffness: a number, one per joint, or a file of `elastic identify` [N·m/rad].

    Raises:
        ConfigurationError: The file does not exist or holds no identified stiffness.
    """
    given = value
    value = plain_numbers(value)
    if isinstance(value, list | tuple):
        if all(type(item) in (int, float) for item in value):
            return np.asarray(value, dtype=np.float64)
        raise ConfigurationError(f"stiffness must be numbers [N·m/rad], got {quote(given)}")
    if isinstance(value, bool) or not isinstance(value, int | float | str | Path):
        raise ConfigurationError(
            f"stiffness must be a number [N·m/rad] or an identification file, got {quote(value)}"
        )
    try:
        return float(value)  # pyright: ignore[reportArgumentType]  a Path raises TypeError
    except (TypeError, ValueError):
        path = Path(value)  # pyright: ignore[reportArgumentType]
    try:
        content = read_bounded(path, LARGEST_JSON)
    except ConfigurationError:  # the file exists, but has a wrong kind or size
        raise
    except (OSError, ValueError):
        needed = "stiffness must be a number [N·m/rad] or an identification file"
        raise ConfigurationError(f"{needed}, found no file {shorten(path)}") from None
    try:
        return float(parse_json(content.decode("utf-8"))[STIFFNESS_KEY])
    except (KeyError, TypeError, ValueError):
        raise ConfigurationError(
            f"{path} is no identification: it must be JSON with a number"
            f" {STIFFNESS_KEY!r}, see `elastic identify`"
        ) from None
