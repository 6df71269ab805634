"""Transform of a model in which only named hinges move: all other joints are held in place."""

from collections.abc import Collection

import mujoco
import numpy as np
from mujoco import MjModel, MjsBody, MjSpec

from elastic_env.core.quaternions import matrix_of, quaternion_of
from elastic_env.core.signals import Array
from elastic_env.joint.compile_model import compile_spec
from elastic_env.joint.model_joints import home_of
from elastic_env.joint.supported_models import require_known_torque

_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def hold_other_joints(spec: MjSpec, joints: Collection[str]) -> MjSpec:
    """Return a copy in which all joints except the named hinges are held at the first keyframe.

    Held joints are removed, and their bodies get their place. All keyframes, sensors, tendons and
    constraints are removed too, and the actuators of held joints.

    Args:
        spec: Any specification on a fixed base; it is not changed.
        joints: Hinges that move.

    Raises:
        ConfigurationError: See `require_known_torque`.
    """
    model = compile_spec(spec.copy(), "the model")
    require_known_torque(model, list(joints))
    held = spec.copy()
    constraints = [*held.equalities, *held.tendons, *held.tuples]
    for element in [*held.keys, *held.sensors, *constraints]:  # keyframes would not fit
        held.delete(element)
    for actuator in list(held.actuators):
        if actuator.trntype not in _ON_JOINT or actuator.target not in joints:
            held.delete(actuator)
    _put_bodies_in_place(held, model, joints, home_of(model))
    return held


def _put_bodies_in_place(
    spec: MjSpec, model: MjModel, joints: Collection[str], home: Array
) -> None:
    """Move every body by its held joints, and remove these."""
    bodies = sorted(spec.bodies, key=lambda body: body.id)
    by_joint = {joint.id: joint for joint in spec.joints}
    for b in range(1, model.nbody):
        ids = range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])
        if all(model.joint(j).name in joints for j in ids):
            continue
        R = matrix_of(model.body_quat[b])
        p = model.body_pos[b].copy()
        before: list[int] = []
        for j in ids:
            if model.joint(j).name in joints:
                before.append(j)
                continue
            R_moved, p_moved = _displacement(model, j, home)
            p = p + R @ p_moved
            R = R @ R_moved
            for i in before:  # the held joint moves the axes of the hinges before it
                hinge = by_joint[i]
                hinge.axis = R_moved.T @ hinge.axis
                hinge.pos = R_moved.T @ (hinge.pos - p_moved)
            spec.delete(by_joint[j])
        _place(bodies[b], R, p)


def _place(body: MjsBody, R: Array, p: Array) -> None:
    """Set the pose of a body in its parent, without the frames in which it was written."""
    body.set_frame(body.parent.add_frame())
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos = p
    body.quat = quaternion_of(R)


def _displacement(model: MjModel, joint: int, home: Array) -> tuple[Array, Array]:
    """Return rotation and translation of a body by a joint, from the reference to home."""
    at = model.jnt_qposadr[joint]
    displacement = home[at] - model.qpos0[at]
    axis = model.jnt_axis[joint]
    anchor = model.jnt_pos[joint]
    if model.jnt_type[joint] == _SLIDE:
        return np.eye(3), displacement * axis
    quaternion = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, axis, displacement)
    R = matrix_of(quaternion)
    return R, anchor - R @ anchor
