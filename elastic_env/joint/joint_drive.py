"""Actuators of an elastic joint: moved to its rotor, or replaced by its servo."""

import warnings
from typing import Literal

import mujoco
import numpy as np
from mujoco import MjsActuator, MjSpec

from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.elastic_joint import Servo
from elastic_env.joint.joint_names import servo_name
from elastic_env.joint.motor import Motor

ActuatorRule = Literal["keep", "replace"]

_JOINT = mujoco.mjtTrn.mjTRN_JOINT
_ON_JOINT = (_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
BLANK = MjSpec()
"""MuJoCo's own defaults: those of a model must not apply to rotor, spring and servo."""


def drive_joint(
    spec: MjSpec, name: str, driven: str, servo: Servo | None, rule: ActuatorRule
) -> None:
    """Put the actuators of a hinge, or its servo, on the driven joint.

    Args:
        spec: Specification, which is changed.
        name: Hinge.
        driven: Joint that is driven: the rotor's hinge, or the hinge itself.
        servo: Servo; None to add none.
        rule: "keep" or "replace", see `make_elastic`.

    Raises:
        ConfigurationError: A sensor reads an actuator that is deleted, and there is no servo.
    """
    on_joints = [a for a in spec.actuators if a.trntype in _ON_JOINT]
    existing = [actuator for actuator in on_joints if actuator.target == name]
    for actuator in existing:
        if rule == "replace":
            _redirect_sensors(spec, actuator.name, name, servo is not None)
            spec.delete(actuator)
        else:
            actuator.target = driven
    if servo is not None and (rule == "replace" or not existing):
        _add_servo(spec, servo_name(name), driven, servo)
    elif servo is not None:
        names = ", ".join(repr(actuator.name) for actuator in existing)
        warnings.warn(
            f"the hinge {name!r} keeps its actuator {names}, so that its servo is left out; choose"
            " actuators='replace' for the servo in its place, or give the joint servo=None",
            stacklevel=4,
        )
    kind = mujoco.mjtSensor.mjSENS_JOINTACTFRC
    for sensor in spec.sensors:
        if sensor.type == kind and sensor.objname == name:
            sensor.objname = driven  # it measures the torque of the actuators


def _redirect_sensors(spec: MjSpec, actuator: str, joint: str, has_servo: bool) -> None:
    """Let sensors of a replaced actuator read the servo instead."""
    kind = mujoco.mjtObj.mjOBJ_ACTUATOR
    of_actuators = [sensor for sensor in spec.sensors if sensor.objtype == kind]
    sensors = [sensor for sensor in of_actuators if sensor.objname == actuator]
    if sensors and not has_servo:
        raise ConfigurationError(
            f"sensor {sensors[0].name!r} reads the actuator {actuator!r}, which is to"
            f" be replaced; give the joint {joint!r} a servo, or delete the sensor"
        )
    for sensor in sensors:
        sensor.objname = servo_name(joint)


def _add_servo(spec: MjSpec, name: str, target: str, servo: Servo) -> None:
    actuator = spec.add_actuator(BLANK.default, name=name, target=target, trntype=_JOINT)
    if servo.motor is None:
        actuator.set_to_pid(
            kp=servo.position_gain,
            kv=servo.velocity_gain,
            ki=servo.integral_gain,
            imax=servo.integral_limit,
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_POS),
        )
    else:
        _set_to_motor(actuator, servo, servo.motor)
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    actuator.forcerange = np.array([-servo.torque_limit, servo.torque_limit])


def _set_to_motor(actuator: MjsActuator, servo: Servo, motor: Motor) -> None:
    """Make an actuator MuJoCo's DC motor, with the servo's PID on its voltage.

    MuJoCo has one motor constant K = k_t = k_e, of a gear without losses. With K = sqrt(k_t k_e)
    and the voltage scaled by sqrt(k_t / k_e), torque at rest and back-EMF are those of the motor.
    Its controller subtracts the back-EMF from the torque, as a driver that controls the current
    does; the velocity gain adds it again.
    """
    limit = motor.voltage * motor.pwm_limit
    actuator.set_to_dcmotor(
        motorconst=[np.sqrt(motor.torque_constant * motor.back_emf), 0.0],
        resistance=motor.resistance,
        controller=[
            servo.position_gain,
            servo.integral_gain,
            servo.braking,
            0.0,
            servo.integral_limit,
            limit * np.sqrt(motor.torque_constant / motor.back_emf),
        ],
        ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_POS),
    )
