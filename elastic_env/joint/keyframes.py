"""Keyframes of a rigid specification, carried over to one with rotors and servos."""

from dataclasses import dataclass

import mujoco
import numpy as np

from elastic_env.core.signals import Array, IntArray
from elastic_env.joint.joint_names import JointAddresses, link_name, servo_name


@dataclass(frozen=True)
class Keyframes:
    """The keyframes of the rigid model, and its joints and actuators in the order of their
    vectors.
    """

    model: mujoco.MjModel
    joints: list[mujoco.MjsJoint]
    actuators: list[mujoco.MjsActuator]


def take_keyframes(spec: mujoco.MjSpec) -> Keyframes | None:
    """Remove the keyframes, whose vectors no longer fit once joints are added."""
    if not spec.keys:
        return None
    model = spec.compile()
    keyframes = Keyframes(
        model, sorted(spec.joints, key=lambda j: j.id), sorted(spec.actuators, key=lambda a: a.id)
    )
    for key in list(spec.keys):
        spec.delete(key)
    return keyframes


def give_keyframes(spec: mujoco.MjSpec, keyframes: Keyframes | None, joints: list[str]) -> None:
    """Add the keyframes again, with rotors at their link angles and servos holding them."""
    if keyframes is None:
        return
    rigid = keyframes.model
    model = spec.compile()
    series = [name for name in joints if any(t.name == link_name(name) for t in spec.tendons)]
    for k in range(rigid.nkey):
        qpos = model.qpos0.copy()
        qvel = np.zeros(model.nv)
        for old, joint in enumerate(keyframes.joints):
            new = joint.id
            qpos[_range(model.jnt_qposadr, new, model.nq)] = rigid.key_qpos[
                k, _range(rigid.jnt_qposadr, old, rigid.nq)
            ]
            qvel[_range(model.jnt_dofadr, new, model.nv)] = rigid.key_qvel[
                k, _range(rigid.jnt_dofadr, old, rigid.nv)
            ]
        act = np.zeros(model.na)
        ctrl = np.zeros(model.nu)
        for old, actuator in enumerate(keyframes.actuators):
            if actuator.id < 0 or actuator.name not in {a.name for a in spec.actuators}:
                continue  # replaced by a servo
            new = actuator.id
            ctrl[_ctrl_range(model, new)] = rigid.key_ctrl[k, _ctrl_range(rigid, old)]
            act[_act_range(model, new)] = rigid.key_act[k, _act_range(rigid, old)]
        for name in joints:
            _start_undeflected(model, name, qpos, qvel, ctrl, name in series)
        spec.add_key(
            name=rigid.key(k).name,
            time=rigid.key_time[k],
            qpos=qpos,
            qvel=qvel,
            act=act,
            ctrl=ctrl,
            mpos=rigid.key_mpos[k].ravel(),
            mquat=rigid.key_mquat[k].ravel(),
        )


def _start_undeflected(
    model: mujoco.MjModel, name: str, qpos: Array, qvel: Array, ctrl: Array, series: bool
) -> None:
    """θ = q, θ̇ = q̇ and the servo's command at the link angle, in one keyframe's vectors."""
    at = JointAddresses.of(model, [name])
    qpos[at.theta] = qpos[at.q]
    qvel[at.theta_dot] = qvel[at.q_dot]
    servos = {model.actuator(i).name: i for i in range(model.nactuator)}
    if servo_name(name) in servos:
        ctrl[_ctrl_range(model, servos[servo_name(name)])] = qpos[at.theta]
    if series:
        qpos[at.q] = 0.0
        qvel[at.q_dot] = 0.0


def _range(starts: IntArray, index: int, total: int) -> slice:
    """The columns of one element in a vector of all elements, from the elements' first columns."""
    end = starts[index + 1] if index + 1 < len(starts) else total
    return slice(int(starts[index]), int(end))


def _ctrl_range(model: mujoco.MjModel, index: int) -> slice:
    return slice(
        int(model.actuator_ctrladr[index]),
        int(model.actuator_ctrladr[index] + model.actuator_ctrlnum[index]),
    )


def _act_range(model: mujoco.MjModel, index: int) -> slice:
    first = int(model.actuator_actadr[index])
    return slice(first, first + int(model.actuator_actnum[index])) if first >= 0 else slice(0, 0)
