"""Settings of elastic joints by name or pattern, in YAML or a mapping: K, servo, friction.

This is the only reader of such files: a file means the same to `elastic_env/Robot-v0` and to
`baselines.PositionCompensator`.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.config import Model, quantity, read_mapping
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.joint.elastic_joint import FrictionTerms
from elastic_env.joint.motor import Motor
from elastic_env.joint.small_servos import SMALL_SERVOS, small_servo

GivenJoints = str | Path | Mapping[str, Any]
"""A YAML file, or a mapping from joint names or patterns to `JointSettings`, K alone [N·m/rad],
the name of one of `SMALL_SERVOS`, "rigid" or "held".
"""
HELD = "held"
"""Value of a joint that is not commanded: it stays at its angle of the model's first keyframe."""
RIGID = "rigid"
"""Value of a joint without a spring; the same as an infinite stiffness."""
SOFTEST = 1e-9
"""Least stiffness and position gain; below it 1/K may overflow [N·m/rad]."""
CURE = (
    "K has no default. `elastic identify --robot MODEL --log poses.csv` identifies it"
    " from static poses and writes a file for `joints`; `elastic identify --robot MODEL"
    " --plan 20` proposes poses"
)
"""Advice on how to get a stiffness, for errors."""


class ServoSettings(Model):
    """Known values of a servo; the rest comes from the model's actuator, or from defaults.

    A servo with a position gain and no integral gain gives way under a load. A servo holds its
    angle if neither the settings nor the model have these gains.
    """

    position_gain: float | None = quantity("N·m/rad", None, ge=SOFTEST)
    """k_p; default that of the model's position actuator, else 50 K [N·m/rad]."""
    velocity_gain: float | None = quantity("N·m·s/rad", None, ge=0)
    """k_v; default the damping of the model's actuator; else 0 with a position gain and a motor,
    whose back-EMF brakes; else critical damping [N·m·s/rad].
    """
    integral_gain: float | None = quantity("N·m/(rad·s)", None, ge=0)
    """k_i; default 0 with a position gain, else that of the model's actuator, else 5 k_p per
    second [N·m/(rad·s)].
    """
    torque_limit: float | None = quantity("N·m", None, gt=0)
    """Default the model's force range, else the torque for three times the weight and 20 rad/s²
    [N·m].
    """
    speed_limit: float | None = quantity("rad/s", None, gt=0)
    """No-load speed; default that of the motor, else a turn a second [rad/s]."""
    motor: Motor | None = quantity("1", None)
    """DC motor, with which the torque falls with the speed; default none [1]."""

    @property
    def braking(self) -> float:
        """k_v and the damping by the back-EMF, as far as they are known [N·m·s/rad]."""
        return (self.velocity_gain or 0.0) + (0.0 if self.motor is None else self.motor.damping)

    @property
    def fastest(self) -> float:
        """No-load speed as far as it is known, else infinite [rad/s]."""
        if self.speed_limit is not None:
            return self.speed_limit
        return float("inf") if self.motor is None else self.motor.no_load_speed

    def over(self, servo: "ServoSettings") -> "ServoSettings":
        """Return these settings, completed by those of the model's servo.

        A given position gain belongs to another servo: then the model's gains are not used.
        """
        if self.position_gain is not None:
            return self.replace(integral_gain=self.integral_gain or 0.0)
        return servo.replace(**self.model_dump(exclude_none=True))

    def sagging_gain(self, joint: str) -> float:
        """Return k_p of a servo that gives way under a load, infinity for one that holds [N·m/rad].

        Args:
            joint: Its joint, for the error.

        Raises:
            ConfigurationError: It has no integrator, and its position gain is not known.
        """
        holds = self.integral_gain is None and self.position_gain is None
        if holds or self.integral_gain:
            return float("inf")
        if self.position_gain is None:
            raise ConfigurationError(
                f"the servo of joint {joint!r} gives way under a load, as its"
                " integral_gain is 0; give its position_gain [N·m/rad], too"
            )
        return self.position_gain


class JointSettings(FrictionTerms):
    """Known values of a joint; all but K has a default."""

    stiffness: float = quantity("N·m/rad", ge=SOFTEST, allow_inf_nan=True)
    """K, stiffness of the transmission, without a default; infinite for a rigid joint [N·m/rad]."""
    damping: float | None = quantity("N·m·s/rad", None, ge=0)
    """D; default a damping ratio of 0.17, or enough to bring the links to rest [N·m·s/rad]."""
    rotor_inertia: float | None = quantity("kg·m²", None, gt=0)
    """B; default the model's armature, else K/(100 rad/s)² or that of the links [kg·m²]."""
    coulomb_friction: float | None = quantity("N·m", None, ge=0)
    """Dry friction on the link; default the model's frictionloss [N·m]."""
    viscous_friction: float | None = quantity("N·m·s/rad", None, ge=0)
    """Viscous friction on the link; default the joint's damping, unless it damps the servo
    [N·m·s/rad].
    """
    backlash: float = quantity("rad", 0.0, ge=0, lt=np.pi)
    """Dead band; default none, as the scenario has one [rad]."""
    encoder_counts_per_turn: int | None = quantity("1", None, gt=0)
    """Motor encoder, counts per turn of the output; default continuous [1]."""
    servo: ServoSettings = ServoSettings()

    @property
    def is_rigid(self) -> bool:
        """True if it has no spring."""
        return bool(np.isinf(self.stiffness))


def read_joints(
    given: GivenJoints, hinges: Sequence[str], others: Collection[str] = ()
) -> dict[str, JointSettings | None]:
    """Return the settings of the named hinges, in the order of the model; None for a held one.

    A name goes before patterns, and a later pattern before an earlier one. Hinges without name and
    pattern are left out.

    Args:
        given: File or mapping.
        hinges: Hinges of the model.
        others: Its further joints, which may only be held.

    Raises:
        ConfigurationError: No file or mapping, a name or pattern without a joint, or an invalid
            value.
    """
    mapping = joint_mapping(given)
    for key, value in mapping.items():
        known = [*hinges, *others] if _equals(value, HELD) else hinges
        if not isinstance(key, str) or not any(_fits(name, key) for name in known):
            raise unknown_name("joint or pattern of joints", key, hinges)
    settings: dict[str, JointSettings | None] = {}
    for name in hinges:
        key = key_of(mapping, name)
        if key is not None:
            settings[name] = _read_joint(name, mapping[key])
    return settings


def key_of(mapping: Iterable[str], name: str) -> str | None:
    """Return the key for a joint: its name, else the last pattern that fits, or None."""
    fitting = [key for key in mapping if isinstance(key, str) and _fits(name, key)]
    return name if name in fitting else next(reversed(fitting), None)


def _fits(name: str, key: str) -> bool:
    return name == key or fnmatchcase(name, key)


def _equals(value: Any, word: str) -> bool:
    return isinstance(value, str) and value == word


def joint_mapping(given: GivenJoints) -> Mapping[str, Any]:
    """Return a given mapping, or read that of a file.

    Raises:
        ConfigurationError: It is neither, or the file holds none.
    """
    if isinstance(given, Mapping):
        return given
    if not isinstance(given, str | Path):
        raise ConfigurationError(
            "joints must be a YAML file or a mapping such as {'*': {'stiffness': 1000}}, got"
            f" {quote(given)}. {CURE}"
        )
    return read_mapping(Path(given))


def _read_joint(name: str, value: Any) -> JointSettings | None:
    """Convert the value of one joint to its settings, None for a held joint."""
    if _equals(value, HELD):
        return None
    if isinstance(value, JointSettings):
        return value
    if isinstance(value, str) and value in SMALL_SERVOS:
        return JointSettings(**small_servo(value).model_dump())
    fields = value if isinstance(value, Mapping) else {"stiffness": value}
    if fields.get("stiffness") is None:
        beside = f" beside {quote(list(fields))}" if isinstance(value, Mapping) else ""
        raise ConfigurationError(
            f"stiffness of joint {name!r} is missing{beside}; write 'stiffness: K' [N·m/rad]: joint"
            f" {name!r} needs its stiffness K, or the value {HELD} or {RIGID}. {CURE}"
        )
    if _equals(fields["stiffness"], RIGID):
        fields = {**fields, "stiffness": np.inf}
    settings: dict[str, Any] = {str(key): part for key, part in fields.items()}
    try:
        return JointSettings(**settings)
    except ConfigurationError as error:
        raise ConfigurationError(f"joint {name!r}: {error}") from None
