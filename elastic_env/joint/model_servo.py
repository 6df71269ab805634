"""Drive of a joint by the actuators of a model: servo gains, rotor inertia, torque limits."""

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
    """Position servo of a joint in a model.

    Attributes:
        settings: Gains at the joint. Without any damping there is no velocity gain.
        joint_damping: Part of the velocity gain that is the `damping` of the joint [N·m·s/rad].
    """

    settings: ServoSettings
    joint_damping: float


def position_servo(model: MjModel, joint: str) -> ModelServo | None:
    """Return the model's position servo of a joint, with gains behind the gear; None for none.

    A further damper or velocity actuator, whose command is zero, is part of the velocity gain. So
    is the `damping` of the joint, if it exceeds these: in models without a `kv` it damps the servo,
    and is no friction.

    Raises:
        ConfigurationError: There are several position actuators, or one with another law than a
            `Servo`.
    """
    actuators = _actuators(model, joint)
    if (model.actuator_gaintype[actuators] == mujoco.mjtGain.mjGAIN_DCMOTOR).any():
        raise ConfigurationError(
            f"joint {joint!r} has a dcmotor, whose gains are not read; give"
            " position_gain, and `motor` with torque_constant, back_emf, resistance and"
            " voltage, under `servo` of this joint in `joints`"
        )
    position = [i for i in actuators if model.actuator_biasprm[i, 1] != 0.0]
    if not position:
        return None  # a position servo replaces a motor or a velocity servo
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
    is_position_law = is_pid or (is_fixed and np.isclose(gain[0], kp))
    is_servo = len(position) == 1 and not is_filtered and is_position_law
    if not is_servo or bias[0] != 0.0 or kp <= 0.0 or kv < 0.0 or gear == 0.0:
        raise ConfigurationError(
            f"the actuators of joint {joint!r} are no single position servo of the form"
            " kp (u - q) - kv q_dot; give its position_gain, velocity_gain and"
            " integral_gain under `servo` of this joint in `joints`"
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
    """Return the armature of a joint and of the actuators on it, 0 for none [kg·m²]."""
    actuators = _actuators(model, joint)
    gears = model.actuator_gear[actuators, 0]
    armatures = (gears**2 * model.actuator_armature[actuators]).tolist()
    return float(model.joint(joint).armature[0] + sum(armatures))


def force_limit(model: MjModel, joint: str) -> float | None:
    """Return the torque limit of a joint and its actuators [N·m]; None where the model has none.

    Raises:
        ConfigurationError: A range allows no torque in one direction.
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
            at = model.actuator_ctrladr[i]  # others may have several commands
            limits.append((gain, model.actuator_ctrllimited[at], model.actuator_ctrlrange[at]))
    torques = [_limit(joint, *limit) for limit in limits]
    return min((torque for torque in torques if torque is not None), default=None)


def _actuators(model: MjModel, joint: str) -> list[int]:
    """Return the actuators on a joint."""
    number = model.joint(joint).id
    is_on_joint = np.isin(model.actuator_trntype, _ON_JOINT)
    return np.flatnonzero(is_on_joint & (model.actuator_trnid[:, 0] == number)).tolist()


def _braking(model: MjModel, joint: str) -> float:
    """Return the damping by actuators at zero command, without the position servo [N·m·s/rad]."""
    braking = 0.0
    for i in _actuators(model, joint):
        damping = float(model.actuator_damping[i])
        has_state = model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE
        if model.actuator_biasprm[i, 1] == 0.0 and not has_state:
            damping += max(-float(model.actuator_biasprm[i, 2]), 0.0)
        braking += float(model.actuator_gear[i, 0]) ** 2 * damping
    return braking


def _limit(joint: str, scale: float, is_limited: bool, interval: Array) -> float | None:
    """Return the smaller end of an interval about zero, scaled [N·m]; None if it is no limit.

    Raises:
        ConfigurationError: The interval allows no torque in one direction.
    """
    if not is_limited:
        return None
    lowest, highest = map(float, interval)
    if not lowest < 0.0 < highest:
        raise ConfigurationError(
            f"a force range of joint {joint!r} is {lowest:g} to {highest:g}, and a"
            " servo has to push both ways; give its torque_limit [N·m] under `servo` of"
            " this joint in `joints`, or mend the range"
        )
    return scale * min(-lowest, highest)
