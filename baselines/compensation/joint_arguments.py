"""Arguments `stiffness`, `position_gain` and `friction` of `PositionCompensator`, by joint."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from baselines.compensation.command_warnings import warn_caller
from baselines.compensation.dry_friction import FrictionCompensation
from elastic_env.core.config import Model, quantity, read_mapping
from elastic_env.core.errors import ConfigurationError, quote, unknown_name
from elastic_env.core.signals import Array
from elastic_env.joint.joint_settings import (
    HELD,
    RIGID,
    SOFTEST,
    JointSettings,
    ServoSettings,
    key_of,
    read_joints,
)
from elastic_env.joint.model_joints import hinges_of
from elastic_env.joint.model_servo import position_servo
from elastic_env.joint.supported_models import require_known_torque

PerJoint = float | Sequence[float] | Mapping[str, Any] | npt.NDArray[Any]
"""A number for all joints, one per joint in order, or by name or pattern, such as {"*": 1000,
"wrist_*": 300}.
"""
_Settings = Mapping[str, JointSettings]
_FILES = (".yaml", ".yml")


def read_joint_file(model: mujoco.MjModel, stiffness: Any, commanded: Any) -> Any:
    """Content of a file of joints, in which commanded hinges that it leaves out are rigid.

    Args:
        model: Compiled rigid model.
        stiffness: YAML file with a mapping by joint; anything else is returned as it is.
        commanded: Names of the commanded joints; None for all.
    """
    if not isinstance(stiffness, str | Path) or Path(stiffness).suffix not in _FILES:
        return stiffness
    mapping = read_mapping(Path(stiffness))
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    names = [model.joint(int(j)).name for j in hinges]
    left_out = [name for name in names if name and key_of(mapping, name) is None]
    rigid = [name for name in left_out if commanded is None or name in commanded]
    if not rigid or len(left_out) == len(names):
        return mapping
    warn_caller(
        f"{stiffness} leaves out {', '.join(rigid)}, taken for rigid; write"
        f" {rigid[0]}: {RIGID}, {rigid[0]}: {HELD} or its stiffness K [N·m/rad] there"
    )
    return mapping | dict.fromkeys(rigid, RIGID)


class PositionGain(Model):
    """A servo that gives way under a load, or holds its angle."""

    position_gain: float = quantity("N·m/rad", ge=SOFTEST, allow_inf_nan=True)
    """k_p, infinite for a servo that holds its angle [N·m/rad]."""


def read_stiffness(
    model: mujoco.MjModel, stiffness: Any, joints: Sequence[str], leaves_out_held: bool
) -> dict[str, JointSettings]:
    """Settings of the commanded joints, in order.

    Args:
        model: Compiled rigid model.
        stiffness: The argument.
        joints: Hinges that may be commanded.
        leaves_out_held: True to leave out joints that are held, False to refuse them.

    Raises:
        ConfigurationError: A value is missing or cannot be used.
    """
    hinges = hinges_of(model)
    settings: dict[str, JointSettings | None] = {}
    if isinstance(stiffness, Mapping):
        settings = read_joints(stiffness, hinges, set(_joint_names(model)) - set(hinges))
    held = [name for name, joint in settings.items() if joint is None]
    if leaves_out_held:
        joints = [name for name in joints if name not in held]
        if not joints:
            raise ConfigurationError(
                f"all joints are {HELD}; give at least one of them its stiffness K [N·m/rad]"
            )
    for name in joints:
        if name in held:
            raise ConfigurationError(
                f"joint {name!r} is named by `joints`, but {HELD} in stiffness; give"
                " it a stiffness K [N·m/rad], or leave it out of `joints`"
            )
    require_known_torque(model, joints)
    if not isinstance(stiffness, Mapping):
        settings = read_joints(_map_by_joint("stiffness", stiffness, joints), joints)
    commanded: dict[str, JointSettings] = {}
    for name in joints:
        joint = settings.get(name)
        if joint is None:
            raise ConfigurationError(
                f"stiffness of joint {name!r} is missing; give {name!r} or a pattern"
                " such as '*', and inf for a rigid joint. It is measured by a known"
                " torque and the deflection under it"
            )
        if joint.backlash > 0.0:
            raise ConfigurationError(
                f"backlash of joint {name!r} is {joint.backlash:g} rad, which this"
                f" compensator cannot take away: at rest {joint.backlash / 2.0:g} rad"
                " remain to either side; leave the key out of what you give it"
            )
        commanded[name] = joint
    return commanded


def servo_gains(model: mujoco.MjModel, settings: _Settings, argument: Any) -> Array:
    """k_p of servos that give way, infinite for servos that hold their angle, (n,) [N·m/rad].

    Args:
        model: Compiled rigid model; its position actuators give what `settings` leave out.
        settings: Commanded joints.
        argument: `position_gain`; None for the servos of `settings`.

    Raises:
        ConfigurationError: A value is missing, given twice, or cannot be used.

    Warns:
        UserWarning: Servos of the model give way, and neither argument gives their k_p.
    """
    if argument is not None:
        return _read_gains(model, settings, argument)
    gains: list[float] = []
    ignored: dict[str, float] = {}
    for joint, joint_settings in settings.items():
        servo = joint_settings.servo
        actuator = position_servo(model, joint) if servo.position_gain is None else None
        of_model = ServoSettings() if actuator is None else actuator.settings
        if _has_gains(servo):
            gains.append(servo.over(of_model).sagging_gain(joint))
            continue
        gains.append(np.inf)
        if np.isfinite(gain := of_model.sagging_gain(joint)):
            ignored[joint] = gain
    if ignored:
        listed = ", ".join(f"{name}: {gain:g}" for name, gain in ignored.items())
        warn_caller(
            "the model has position servos that give way under a load, which is not"
            f" compensated; give position_gain={{{listed}}} [N·m/rad], or"
            " position_gain=math.inf for servos that hold their angle"
        )
    return np.array(gains)


def make_friction(settings: _Settings, friction: bool | None) -> FrictionCompensation | None:
    """Compensation of the dry friction of joints; None without.

    Args:
        settings: Commanded joints.
        friction: The argument; None to compensate friction that grows with the load or falls from
            rest.
    """
    joints = list(settings.values())
    if friction is None:
        friction = any(j.load_friction > 0.0 or j.static_friction > 0.0 for j in joints)
    if not friction:
        return None
    return FrictionCompensation(
        coulomb=np.array([joint.coulomb_friction or 0.0 for joint in joints]),
        load_ratio=np.array([joint.load_friction for joint in joints]),
        static=np.array([joint.static_friction for joint in joints]),
        stribeck_speed=np.array([joint.stribeck_speed for joint in joints]),
    )


def _has_gains(servo: ServoSettings) -> bool:
    return servo.position_gain is not None or servo.integral_gain is not None


def _read_gains(model: mujoco.MjModel, settings: _Settings, argument: Any) -> Array:
    """The argument `position_gain`, (n,) [N·m/rad]."""
    by_joint = _map_by_joint("position_gain", argument, list(settings))
    names = _joint_names(model)
    for key in by_joint:
        if not isinstance(key, str) or not any(key_of([key], name) for name in names):
            raise unknown_name("joint or pattern of joints", key, names)
    gains: list[float] = []
    for joint, joint_settings in settings.items():
        if _has_gains(joint_settings.servo):
            raise ConfigurationError(
                f"the servo of joint {joint!r} is given twice, under `servo` in"
                " stiffness and by position_gain; keep one of them"
            )
        key = key_of(by_joint, joint)
        if key is None:
            raise ConfigurationError(
                f"position_gain of joint {joint!r} is missing; give {joint!r} or a"
                " pattern such as '*', and inf for a servo that holds its angle"
            )
        try:
            gains.append(PositionGain(position_gain=by_joint[key]).position_gain)
        except ConfigurationError as error:
            raise ConfigurationError(f"joint {joint!r}: {error}") from None
    return np.array(gains)


def _map_by_joint(name: str, given: Any, joints: Sequence[str]) -> Mapping[str, Any]:
    """Numbers by joints' names or patterns."""
    if given is None or isinstance(given, str | Path):
        raise ConfigurationError(
            f"{name} must be numbers [N·m/rad], got {quote(given)}; give a number for all joints,"
            " one per joint, a mapping by name, or a YAML file (.yaml) of that"
        )
    if isinstance(given, Mapping):
        return given
    if not isinstance(given, list | tuple | np.ndarray):
        return dict.fromkeys(joints, given)
    if len(given) != len(joints):
        needed = f"{len(joints)} numbers [N·m/rad], of {', '.join(joints)}"
        raise ConfigurationError(f"{name} must be {needed}, got {len(given)}")
    return dict(zip(joints, given, strict=True))


def _joint_names(model: mujoco.MjModel) -> list[str]:
    return [name for j in range(model.njnt) if (name := model.joint(j).name)]
