"""A model of the joints that matter: all other joints are held in place, so that only named hinges move."""

from collections.abc import Collection

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_JOINT, _SITE, _SPHERE, _CYLINDER = (
    int(getattr(mujoco.mjtWrap, f"mjWRAP_{kind}")) for kind in ("JOINT", "SITE", "SPHERE", "CYLINDER")
)
_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def frozen(spec: mujoco.MjSpec, joints: Collection[str]) -> mujoco.MjSpec:
    """A copy of a specification in which all joints but the named hinges are held where the first keyframe has them.

    Held joints are taken out and their bodies put in place. Actuators, sensors, tendons and constraints of held joints
    go with them, and so do all keyframes and all sensors.

    Args:
        spec: Any specification on a fixed base; it is not changed.
        joints: Hinges that move.

    Raises:
        ConfigurationError: A joint does not exist or is no hinge, the base floats, or what would act on the hinges is
            not known in advance: a loop, a spring of a tendon, a spring that is not linear.
    """
    model = spec.copy().compile()
    require_fixed_base(model)
    hinges = [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] == _HINGE]
    require_known("hinge of the model", joints, hinges)
    _require_linear_springs(model, joints)
    held = copy_without_keys(spec)
    for element in [*held.sensors, *held.equalities]:
        if isinstance(element, mujoco.MjsEquality):
            _require_held(model, element, joints)
        held.delete(element)
    _drop_tendons(held, model, joints)
    _put_bodies_in_place(held, model, joints, home_of(model))
    return held


def home_of(model: mujoco.MjModel) -> Array:
    """Positions of the joints in the first keyframe, or the model's reference, (nq,) [rad], [m]."""
    return model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()


def require_fixed_base(model: mujoco.MjModel) -> None:
    """Refuse a robot that floats.

    Raises:
        ConfigurationError: A joint is free or a ball joint.
    """
    for j in range(model.njnt):
        if model.jnt_type[j] not in (_HINGE, _SLIDE):
            raise ConfigurationError(
                f"joint {model.joint(j).name!r} is free or a ball joint; a fixed base, hinges and slides are needed: "
                "the torque of a floating robot depends on its contacts"
            )


def copy_without_keys(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """A copy without keyframes, whose vectors would not fit."""
    copied = spec.copy()
    for key in list(copied.keys):
        copied.delete(key)
    return copied


def _require_linear_springs(model: mujoco.MjModel, joints: Collection[str]) -> None:
    for name in joints:
        if model.jnt_stiffnesspoly[model.joint(name).id].any():
            raise ConfigurationError(
                f"joint {name!r} has a spring whose torque is not linear, which is not compensated; give it one number"
            )


def _root(model: mujoco.MjModel, body: int, joints: Collection[str]) -> int:
    """The body whose hinge carries a body, 0 for one that does not move."""
    while body > 0:
        first = int(model.body_jntadr[body])
        if any(model.joint(first + j).name in joints for j in range(model.body_jntnum[body])):
            return body
        body = int(model.body_parentid[body])
    return 0


def _require_held(model: mujoco.MjModel, equality: mujoco.MjsEquality, joints: Collection[str]) -> None:
    """Refuse a constraint on what moves."""
    if not equality.active:
        return
    names = [name for name in (equality.name1, equality.name2) if name]
    if equality.type == mujoco.mjtEq.mjEQ_JOINT:
        holds = not any(name in joints for name in names)
    elif equality.objtype in (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_SITE):
        is_site = equality.objtype == mujoco.mjtObj.mjOBJ_SITE
        bodies = [int(model.site_bodyid[model.site(name).id]) if is_site else model.body(name).id for name in names]
        holds = len({_root(model, body, joints) for body in (*bodies, *[0] * (2 - len(bodies)))}) == 1
    else:
        holds = False
    if not holds:
        raise ConfigurationError(
            f"the model has an equality constraint of {' and '.join(names)}, whose torque is not known in advance; "
            "take it out of the model, or leave its joints out of `joints`"
        )


def _drop_tendons(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Collection[str]) -> None:
    """Take out tendons, which must not pull at a hinge that moves, and all actuators but those of such hinges."""
    for t, tendon in enumerate(list(spec.tendons)):
        of_tendon = model.tendon_stiffness, model.tendon_stiffnesspoly, model.tendon_damping, model.tendon_frictionloss
        if any(np.any(values[t]) for values in of_tendon) and _reaches(model, t, joints):
            raise ConfigurationError(
                f"the model's tendon {tendon.name!r} has stiffness, damping or friction, whose torque is not "
                "compensated; take it out of the model, or leave its joints out of `joints`"
            )
        spec.delete(tendon)
    for actuator in list(spec.actuators):
        if actuator.trntype not in _ON_JOINT or actuator.target not in joints:
            spec.delete(actuator)


def _reaches(model: mujoco.MjModel, tendon: int, joints: Collection[str]) -> bool:
    """Whether the length of a tendon changes with the hinges that move."""
    wraps = range(int(model.tendon_adr[tendon]), int(model.tendon_adr[tendon] + model.tendon_num[tendon]))
    bodies_of = {_SITE: model.site_bodyid, _SPHERE: model.geom_bodyid, _CYLINDER: model.geom_bodyid}
    roots: set[int] = set()
    for at in wraps:
        kind, one = int(model.wrap_type[at]), int(model.wrap_objid[at])
        if kind == _JOINT and model.joint(one).name in joints:
            return True
        if kind in bodies_of:
            roots.add(_root(model, int(bodies_of[kind][one]), joints))
    return len(roots) > 1


def _put_bodies_in_place(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Collection[str], home: Array) -> None:
    """Move every body by its held joints, and take these out."""
    bodies = sorted(spec.bodies, key=lambda body: body.id)
    by_joint = {joint.id: joint for joint in spec.joints}
    for b in range(1, model.nbody):
        own = range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])
        if all(model.joint(j).name in joints for j in own):
            continue
        R, p = _matrix(model.body_quat[b]), model.body_pos[b].copy()
        before: list[int] = []
        for j in own:
            if model.joint(j).name in joints:
                before.append(j)
                continue
            R_moved, p_moved = _displacement(model, j, home)
            R, p = R @ R_moved, p + R @ p_moved
            for i in before:  # they turned about axes that the held joint now moves
                hinge = by_joint[i]
                hinge.axis, hinge.pos = R_moved.T @ hinge.axis, R_moved.T @ (hinge.pos - p_moved)
            spec.delete(by_joint[j])
        _place(bodies[b], R, p)


def _place(body: mujoco.MjsBody, R: Array, p: Array) -> None:
    """Give a body a pose in its parent, whatever frames it was written in."""
    body.set_frame(body.parent.add_frame())
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, R.ravel())
    body.pos, body.quat = p, quaternion


def _displacement(model: mujoco.MjModel, joint: int, home: Array) -> tuple[Array, Array]:
    """Rotation and translation by which a joint moves its body from where the model is drawn."""
    at = model.jnt_qposadr[joint]
    way, axis, anchor = home[at] - model.qpos0[at], model.jnt_axis[joint], model.jnt_pos[joint]
    if model.jnt_type[joint] == _SLIDE:
        return np.eye(3), way * axis
    quaternion = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, axis, way)
    R = _matrix(quaternion)
    return R, anchor - R @ anchor


def _matrix(quaternion: Array) -> Array:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
