"""Models in which only named hinges move: all other joints are held in place."""

from collections.abc import Collection

import mujoco
import numpy as np
from mujoco import MjModel, MjsBody, MjSpec

from elastic_env.core.rotations import matrix_of, quaternion_of
from elastic_env.core.signals import Array
from elastic_env.joint.model_file import compiled_spec
from elastic_env.joint.supported_models import home_of, require_known_torque

_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def hold_other_joints(spec: MjSpec, joints: Collection[str]) -> MjSpec:
    """A copy in which all joints but the named hinges are held at the first keyframe.

    Held joints are taken out and their bodies put in place. Actuators, sensors, tendons and
    constraints of held joints go with them, and so do all keyframes and all sensors.

    Args:
        spec: Any specification on a fixed base; it is not changed.
        joints: Hinges that move.

    Raises:
        ConfigurationError: See `require_known_torque`.
    """
    model = compiled_spec(spec.copy(), "the model")
    require_known_torque(model, list(joints))
    held = spec.copy()  # the vectors of keyframes would not fit
    constraints = [*held.equalities, *held.tendons, *held.tuples]
    for element in [*held.keys, *held.sensors, *constraints]:
        held.delete(element)
    for actuator in list(held.actuators):
        if actuator.trntype not in _ON_JOINT or actuator.target not in joints:
            held.delete(actuator)
    _put_bodies_in_place(held, model, joints, home_of(model))
    return held


def _put_bodies_in_place(
    spec: MjSpec, model: MjModel, joints: Collection[str], home: Array
) -> None:
    """Move every body by its held joints, and take these out."""
    bodies = sorted(spec.bodies, key=lambda body: body.id)
    by_joint = {joint.id: joint for joint in spec.joints}
    for b in range(1, model.nbody):
        own = range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])
        if all(model.joint(j).name in joints for j in own):
            continue
        R = matrix_of(model.body_quat[b])
        p = model.body_pos[b].copy()
        before: list[int] = []
        for j in own:
            if model.joint(j).name in joints:
                before.append(j)
                continue
            R_moved, p_moved = _displacement(model, j, home)
            p = p + R @ p_moved
            R = R @ R_moved
            for i in before:  # they turned about axes that the held joint now moves
                hinge = by_joint[i]
                hinge.axis = R_moved.T @ hinge.axis
                hinge.pos = R_moved.T @ (hinge.pos - p_moved)
            spec.delete(by_joint[j])
        _place(bodies[b], R, p)


def _place(body: MjsBody, R: Array, p: Array) -> None:
    """Give a body a pose in its parent, whatever frames it was written in."""
    body.set_frame(body.parent.add_frame())
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos = p
    body.quat = quaternion_of(R)


def _displacement(model: MjModel, joint: int, home: Array) -> tuple[Array, Array]:
    """Rotation and translation by which a joint moves its body from where the model is drawn."""
    at = model.jnt_qposadr[joint]
    way = home[at] - model.qpos0[at]
    axis = model.jnt_axis[joint]
    anchor = model.jnt_pos[joint]
    if model.jnt_type[joint] == _SLIDE:
        return np.eye(3), way * axis
    quaternion = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, axis, way)
    R = matrix_of(quaternion)
    return R, anchor - R @ anchor
