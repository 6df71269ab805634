"""The drive of a joint by a model's actuators: gains, rotor inertia, limits."""

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_settings import ServoSettings

_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


@dataclass(frozen=True)
class ModelServo:
    """The position servo of a joint, as the model has it.

    Attributes:
        settings: Gains at the joint. There is no velocity gain where nothing damps it.
        joint_damping: Part of the velocity gain that is the `damping` of the joint [N·m·s/rad].
    """

    settings: ServoSettings
    joint_damping: float


def position_servo(model: MjModel, joint: str) -> ModelServo | None:
    """The model's position actuator of a joint, by its gear on the joint; None where there is none.

    A damper or a velocity actuator beside it, whose command is zero, is part of the velocity gain.
    So is the `damping` of the joint, if it is more than these: it is what damps the servo in models
    without a `kv`, and no friction.

    Raises:
        ConfigurationError: There are several, or it has a law that a `Servo` has not.
    """
    actuators = _actuators(model, joint)
    if (model.actuator_gaintype[actuators] == mujoco.mjtGain.mjGAIN_DCMOTOR).any():
        raise ConfigurationError(
            f"joint {joint!r} has a dcmotor, whose gains are not read; say position_gain, and"
            " `motor` with torque_constant, back_emf, resistance and voltage, under `servo` of this"
            " joint in `joints`"
        )
    position = [i for i in actuators if model.actuator_biasprm[i, 1] != 0.0]
    if not position:
        return None  # a motor or a velocity servo: a position servo takes its place
    i = position[0]
    gear = float(model.actuator_gear[i, 0])
    gain = model.actuator_gainprm[i]
    bias = model.actuator_biasprm[i]
    is_pid = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_PID
    kp = -float(bias[1])
    kv = -float(bias[2])
    ki = float(gain[0]) if is_pid else 0.0
    is_filtered = not is_pid and model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE
    is_fixed = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
    is_plain = is_pid or (is_fixed and np.isclose(gain[0], kp))
    is_one = len(position) == 1 and not is_filtered and is_plain
    if not is_one or bias[0] != 0.0 or kp <= 0.0 or kv < 0.0 or gear == 0.0:
        raise ConfigurationError(
            f"the actuators of joint {joint!r} are no single position servo of the form kp (u - q)"
            " - kv q_dot; say its position_gain, velocity_gain and integral_gain under `servo` of"
            " this joint in `joints`"
        )
    braking = gear**2 * kv + _braking(model, joint)
    damping = float(model.dof_damping[model.joint(joint).dofadr[0]])
    joint_damping = damping if damping > braking else 0.0
    settings = ServoSettings(
        position_gain=gear**2 * kp,
        velocity_gain=braking + joint_damping or None,
        integral_gain=gear**2 * ki,
    )
    return ModelServo(settings, joint_damping)


def rotor_inertia(model: MjModel, joint: str) -> float:
    """Armature of a joint and of the actuators on it, 0 where there is none [kg·m²]."""
    actuators = _actuators(model, joint)
    gears = model.actuator_gear[actuators, 0]
    of_actuators = (gears**2 * model.actuator_armature[actuators]).tolist()
    return float(model.joint(joint).armature[0] + sum(of_actuators))


def force_limit(model: MjModel, joint: str) -> float | None:
    """Torque limit of a joint and its actuators [N·m]; None where the model has none.

    Raises:
        ConfigurationError: A range leaves no torque in one direction.
    """
    number = model.joint(joint).id
    limits = [(1.0, model.jnt_actfrclimited[number], model.jnt_actfrcrange[number])]
    for i in _actuators(model, joint):
        gear = abs(float(model.actuator_gear[i, 0]))
        force = (model.actuator_forcelimited[i], model.actuator_forcerange[i])
        limits.append((gear, *force))
        is_fixed = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        is_unbiased = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
        if is_fixed and is_unbiased and model.actuator_dyntype[i] == 0:
            gain = gear * abs(float(model.actuator_gainprm[i, 0]))
            at = model.actuator_ctrladr[i]  # actuators before may have several commands
            limits.append((gain, model.actuator_ctrllimited[at], model.actuator_ctrlrange[at]))
    found = [_bound(joint, *limit) for limit in limits]
    return min((value for value in found if value is not None), default=None)


def _actuators(model: MjModel, joint: str) -> list[int]:
    """Actuators that act on a joint."""
    number = model.joint(joint).id
    is_on_joint = np.isin(model.actuator_trntype, _ON_JOINT)
    is_on_it = is_on_joint & (model.actuator_trnid[:, 0] == number)
    return np.flatnonzero(is_on_it).tolist()


def _braking(model: MjModel, joint: str) -> float:
    """Damping by a joint's actuators at zero command, without its position servo [N·m·s/rad]."""
    braking = 0.0
    for i in _actuators(model, joint):
        own = float(model.actuator_damping[i])
        has_state = model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE
        if model.actuator_biasprm[i, 1] == 0.0 and not has_state:
            own += max(-float(model.actuator_biasprm[i, 2]), 0.0)
        braking += float(model.actuator_gear[i, 0]) ** 2 * own
    return braking


def _bound(joint: str, scale: float, is_limited: bool, interval: Array) -> float | None:
    """The smaller end of an interval about zero [N·m]; None where it is no limit.

    Raises:
        ConfigurationError: It leaves no torque in one direction.
    """
    if not is_limited:
        return None
    lowest, highest = map(float, interval)
    if not lowest < 0.0 < highest:
        raise ConfigurationError(
            f"a force range of joint {joint!r} is {lowest:g} to {highest:g}, and a servo has to"
            " push both ways; say its torque_limit [N·m] under `servo` of this joint in `joints`,"
            " or mend the range"
        )
    return scale * min(-lowest, highest)
