"""Transfer of the keyframes of a rigid specification to one with rotors and servos."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco

from elastic_env.joint.joint_names import JointAddresses, servo_name


@contextmanager
def carry_keyframes(spec: mujoco.MjSpec, joints: Sequence[str]) -> Iterator[None]:
    """Keep the keyframes of a specification whose joints become elastic in the block.

    Their vectors do not fit the elastic model. So they are removed first, and added again with
    rotors at their link angles and servos that hold these angles.
    """
    if not spec.keys:
        yield
        return
    rigid = spec.compile()
    links = sorted(spec.joints, key=lambda joint: joint.id)
    actuators = sorted(spec.actuators, key=lambda actuator: actuator.id)
    for key in list(spec.keys):
        spec.delete(key)
    yield
    model = spec.compile()
    names = {actuator.name for actuator in spec.actuators}
    kept = {  # servos replace the others
        number: actuator.id
        for number, actuator in enumerate(actuators)
        if actuator.id >= 0 and actuator.name in names
    }
    old = mujoco.MjData(rigid)
    new = mujoco.MjData(model)
    at = JointAddresses.of(model, joints)
    for k in range(rigid.nkey):
        mujoco.mj_resetDataKeyframe(rigid, old, k)
        mujoco.mj_resetData(model, new)
        for number, joint in enumerate(links):
            new.joint(joint.id).qpos = old.joint(number).qpos
            new.joint(joint.id).qvel = old.joint(number).qvel
        for number, actuator in kept.items():
            new.actuator(actuator).ctrl = old.actuator(number).ctrl
            new.act[_states(model, actuator)] = old.act[_states(rigid, number)]
        new.qpos[at.theta] = new.qpos[at.q]
        new.qvel[at.theta_dot] = new.qvel[at.q_dot]
        for name, q in zip(joints, new.qpos[at.q], strict=True):
            if servo_name(name) in names:
                new.actuator(servo_name(name)).ctrl = q
        spec.add_key(
            name=rigid.key(k).name,
            time=rigid.key_time[k],
            qpos=new.qpos,
            qvel=new.qvel,
            act=new.act,
            ctrl=new.ctrl,
            mpos=rigid.key_mpos[k].ravel(),
            mquat=rigid.key_mquat[k].ravel(),
        )


def _states(model: mujoco.MjModel, actuator: int) -> slice:
    """Return the columns of an actuator's state in `act`; none without a state."""
    first = int(model.actuator_actadr[actuator])
    return slice(first, first + int(model.actuator_actnum[actuator]))
