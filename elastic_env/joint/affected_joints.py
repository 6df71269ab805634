"""Joints on which the constraints, tendons and actuators of a model act."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.errors import quote

TRANSMISSIONS = {
    int(mujoco.mjtTrn.mjTRN_TENDON): "a tendon",
    int(mujoco.mjtTrn.mjTRN_SITE): "a site",
    int(mujoco.mjtTrn.mjTRN_SLIDERCRANK): "a slider-crank",
}
"""Names of the transmissions of actuators that are not on a joint."""
_FLAG = mujoco.mjtDisableBit
_NO_EQUALITIES = int(_FLAG.mjDSBL_EQUALITY) | int(_FLAG.mjDSBL_CONSTRAINT)
_PULLING = "stiffness stiffnesspoly damping frictionloss armature"
"""Properties by which a tendon pulls."""


def active_equalities(model: MjModel) -> Iterator[int]:
    """Yield the equality constraints that act from the start."""
    if not int(model.opt.disableflags) & _NO_EQUALITIES:
        yield from (e for e in range(model.neq) if model.eq_active0[e])


def equality_joints(model: MjModel, equality: int) -> tuple[set[int], str]:
    """Return the joints on which an equality acts, and the names of its coupled elements."""
    kind = int(model.eq_type[equality])
    both = (model.eq_obj1id[equality], model.eq_obj2id[equality])
    ends = [int(i) for i in both if i >= 0]
    if kind == mujoco.mjtEq.mjEQ_JOINT:
        joints = set(ends)
        element = model.joint
    elif kind == mujoco.mjtEq.mjEQ_TENDON:
        joints = set().union(*(tendon_joints(model, t) for t in ends))
        element = model.tendon
    elif model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        joints = joints_between(model, [int(model.site_bodyid[site]) for site in ends])
        element = model.site
    elif model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_BODY:
        joints = joints_between(model, [*ends, 0][:2])
        element = model.body
    else:
        return set(range(model.njnt)), "a deformable body"
    names = [quote(element(i).name)[1:-1] or f"number {i}" for i in ends]
    return joints, " and ".join(names)


def joints_to_world(model: MjModel, body: int) -> set[int]:
    """Return the joints between a body and the world."""
    joints: set[int] = set()
    while body > 0:
        first = int(model.body_jntadr[body])
        joints.update(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return joints


def joints_between(model: MjModel, bodies: Sequence[int]) -> set[int]:
    """Return the joints that move bodies relative to one another."""
    chains = [joints_to_world(model, body) for body in bodies]
    return set().union(*(chain ^ chains[0] for chain in chains))


def tendon_joints(model: MjModel, tendon: int) -> set[int]:
    """Return the joints that change the length of a tendon."""
    joints: set[int] = set()
    bodies: list[int] = []
    first = int(model.tendon_adr[tendon])
    for at in range(first, first + int(model.tendon_num[tendon])):
        kind = int(model.wrap_type[at])
        element = int(model.wrap_objid[at])
        if kind == mujoco.mjtWrap.mjWRAP_JOINT:
            joints.add(element)
        elif kind == mujoco.mjtWrap.mjWRAP_SITE:
            bodies.append(int(model.site_bodyid[element]))
        elif kind in (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER):
            bodies.append(int(model.geom_bodyid[element]))
    return joints | joints_between(model, bodies)


def tendon_pulls(model: MjModel, tendon: int) -> bool:
    """Return True if a tendon has stiffness, damping, friction or inertia."""
    fields = [getattr(model, f"tendon_{name}") for name in _PULLING.split()]
    return any(np.any(values[tendon]) for values in fields)


def remote_actuator_joints(model: MjModel, actuator: int) -> set[int]:
    """Return the joints that an actuator moves by a tendon, a site or a slider-crank."""
    kind = int(model.actuator_trntype[actuator])
    first, second = (int(i) for i in model.actuator_trnid[actuator])
    if kind == mujoco.mjtTrn.mjTRN_TENDON:
        return tendon_joints(model, first)
    if kind in TRANSMISSIONS:
        sites = [site for site in (first, second) if site >= 0]
        bodies = [int(model.site_bodyid[site]) for site in sites]
        return joints_between(model, [*bodies, 0][:2])
    return set()
