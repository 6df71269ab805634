"""Judgement of a model for compensators: which joints move, and what else acts on them.

Everything that a model has is either part of the torque at rest, held, or refused with its name.
"""

import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence

import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.core.signals import Array
from elastic_env.joint.model_file import require_sound

MOST_ELASTIC = 80
"""Joints that are commanded; whether the physics follows them takes a time that grows with their
cube.
"""

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_WRAP_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)
_WRAP_SITE = int(mujoco.mjtWrap.mjWRAP_SITE)
_WRAP_GEOMS = (int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER))
_EQ_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)
_EQ_TENDON = int(mujoco.mjtEq.mjEQ_TENDON)
_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_SITE = int(mujoco.mjtTrn.mjTRN_SITE)
_SLIDERCRANK = int(mujoco.mjtTrn.mjTRN_SLIDERCRANK)
_RESTING = ("gravity", "spring", "damper", "actuation")
"""Flags of <option> that take away what bends a joint at rest, or what brings it there."""
_FLAGS = {
    name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
    for name in (*_RESTING, "frictionloss", "equality", "constraint")
}
"""Flags that say whether something acts on a joint, and their bits."""
_POSES = (0.0, 0.37, -0.83)
"""Offsets from the home pose at which two joints about one axis would still have one axis [rad]."""
_SINGULAR = 1e-10


def hinges_of(model: MjModel) -> list[str]:
    """Names of all hinges with a name, in the order of the model."""
    return [name for j in _hinges(model) if (name := model.joint(j).name)]


def has_nameless_hinge(model: MjModel) -> bool:
    """True if a hinge has no name, by which its stiffness could be given."""
    return any(not model.joint(j).name for j in _hinges(model))


def nameless_hinge() -> ConfigurationError:
    """The error for a hinge without a name that is to be elastic."""
    return ConfigurationError(
        "a hinge of the model has no name; give each one, the stiffness is by name, or name the"
        " joints that are elastic: the others are held"
    )


def commanded_hinges(model: MjModel, named: Collection[str] = ()) -> list[str]:
    """Hinges that are commanded where nobody says which: all but fingers that the model couples.

    Args:
        model: Compiled rigid model.
        named: Joints that somebody names, which are commanded in any case.

    Raises:
        ConfigurationError: See `require_robot`; or a hinge has no name.

    Warns:
        UserWarning: Fingers are held.
    """
    require_robot(model)
    if has_nameless_hinge(model):
        raise nameless_hinge()
    return without_fingers(model, hinges_of(model), named)


def without_fingers(model: MjModel, joints: Iterable[str], named: Collection[str]) -> list[str]:
    """The joints without the fingers that the model couples and that nobody names.

    Arguments as in `commanded_hinges`.
    """
    joints = list(joints)
    coupled = [name for name in coupled_fingers(model) if name not in named]
    fingers = [name for name in coupled if name in joints]
    if fingers:
        warnings.warn(
            f"{_listed(fingers)} are coupled in the model (mimic), and are held, unlike all others",
            stacklevel=5,
        )
    return [name for name in joints if name not in fingers]


def coupled_fingers(model: MjModel) -> list[str]:
    """Hinges of fingers that follow one another: coupled by equalities, side by side at the end.

    Two fingers are on different branches, and carry no other joint. Loops may close within them.
    Coupled joints within the arm are none, nor are loops without joints that are coupled, as of a
    parallelogram.
    """
    groups: list[set[int]] = []
    coupled: set[int] = set()
    for e in _active(model):
        acts, _ = _equality(model, e)
        if len(acts) > 1:
            joined = [group for group in groups if group & acts]
            apart = [group for group in groups if not group & acts]
            groups = [*apart, acts.union(*joined)]
        if len(acts) > 1 and model.eq_type[e] == _EQ_JOINT:
            coupled |= acts
    hands = [group for group in groups if group & coupled and _is_gripper(model, group)]
    fingers = set().union(*hands)
    names = [model.joint(j).name for j in _hinges(model) if j in fingers]
    return [name for name in names if name]


def home_of(model: MjModel) -> Array:
    """Positions of the joints in the first keyframe, or the model's reference, (nq,) [rad], [m]."""
    return model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()


def held_positions(model: MjModel, joints: Sequence[str]) -> dict[int, float]:
    """Positions at home of all joints but these, by their numbers [rad], [m]."""
    home = home_of(model)
    others = [j for j in range(model.njnt) if model.joint(j).name not in joints]
    return {j: float(home[model.jnt_qposadr[j]]) for j in others}


def mass_matrix(model: MjModel, data: mujoco.MjData) -> Array:
    """Inertia of all joints with armature at the positions of a state, (nv, nv) [kg·m²]."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_crb(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def require_robot(model: MjModel) -> None:
    """Refuse a model of which no joint can be commanded, whatever is said of its joints.

    Raises:
        ConfigurationError: It contradicts itself; a joint is free or a ball joint, as of a base
            that floats; or no hinge has a name.
    """
    require_sound(model, "the model")
    for j in range(model.njnt):
        if model.jnt_type[j] not in (_HINGE, _SLIDE):
            raise ConfigurationError(
                f"joint {model.joint(j).name!r} is free or a ball joint; a fixed base, hinges and"
                " slides are needed: the torque of a floating robot depends on its contacts."
                " Without compensation elastic_env.make_elastic takes it"
            )
    require_hinge(model)


def require_hinge(model: MjModel) -> None:
    """Refuse a model of which no joint can be elastic.

    Raises:
        ConfigurationError: It has no hinge, or none with a name.
    """
    if not _hinges(model):
        raise ConfigurationError(
            "the model has no hinge, and elastic joints are hinges; give a robot with rotary joints"
        )
    if not hinges_of(model):
        raise nameless_hinge()


def require_few(joints: Collection[str]) -> None:
    """Refuse more elastic joints than can be simulated.

    Raises:
        ConfigurationError: There are more than `MOST_ELASTIC`.
    """
    if len(joints) > MOST_ELASTIC:
        problem = f"at most {MOST_ELASTIC} joints can be elastic, got {len(joints)}"
        cure = "name those that matter"
        raise ConfigurationError(f"{problem}; {cure}")


def require_flags(disabled: int, flags: Collection[str]) -> None:
    """Refuse flags of a model that take away what its elastic joints need.

    Args:
        disabled: Its flags that are disabled, a bit each.
        flags: Those that must not be.

    Raises:
        ConfigurationError: One of them is.
    """
    for flag in flags:
        if disabled & _FLAGS[flag]:
            cure = "take the flag out"
            if flag == "gravity":
                cure += "; for no gravity write gravity='0 0 0'"
            raise ConfigurationError(
                f'the model has <flag {flag}="disable"/> in <option>, with which its'
                f" joints do not bend as they do on a robot; {cure}"
            )


def require_known_torque(model: MjModel, joints: Sequence[str]) -> None:
    """Refuse a model in which something acts on the commanded joints that is not known in advance.

    Args:
        model: Compiled rigid model.
        joints: Hinges that are commanded; all others are held.

    Raises:
        ConfigurationError: See `require_robot`; a joint does not exist, is no hinge or is named
            twice; or a constraint, a tendon, a drive that is not on a joint, a deformable body, a
            plugin, wind or a flag acts on the joints.
    """
    require_robot(model)
    ids = _ids_of(model, joints)
    require_flags(int(model.opt.disableflags), _RESTING)
    _require_no_others(model)
    for e in _active(model):
        acts, ends = _equality(model, e)
        if acts & ids:
            raise ConfigurationError(
                f"the model has an equality constraint of {ends}, whose torque is not known in"
                f" advance; take it out of the model{_or_hold(model, acts & ids, ids)}"
            )
    for t in range(model.ntendon):
        if _pulls(model, t) and (acts := _joints_of_tendon(model, t) & ids):
            raise ConfigurationError(
                f"the model's tendon {model.tendon(t).name!r} has stiffness, damping, friction or"
                " inertia; the torque of tendons with stiffness is not compensated; take it out of"
                f" the model{_or_hold(model, acts, ids)}"
            )
    for a in range(model.nactuator):
        if acts := _driven_beside_joints(model, a) & ids:
            raise ConfigurationError(
                f"the model's actuator {model.actuator(a).name!r} drives {_names(model, acts)} by"
                f" {_TRANSMISSIONS[int(model.actuator_trntype[a])]}, which is not compensated;"
                " drive each joint by an actuator of its own, or take this one out of the"
                f" model{_or_hold(model, acts, ids)}"
            )
    for j in np.flatnonzero(model.jnt_stiffnesspoly.any(axis=-1)):
        if int(j) in ids:
            raise ConfigurationError(
                f"joint {model.joint(int(j)).name!r} has a spring whose torque is not linear, which"
                " is not compensated; give it one number"
            )
    _require_inertia(model, joints)


_PULLING = "stiffness stiffnesspoly damping frictionloss armature"
"""Properties by which a tendon pulls."""
_TRANSMISSIONS = {_TENDON: "a tendon", _SITE: "a site", _SLIDERCRANK: "a slider-crank"}


def _hinges(model: MjModel) -> list[int]:
    return [j for j in range(model.njnt) if model.jnt_type[j] == _HINGE]


def _ids_of(model: MjModel, joints: Sequence[str]) -> set[int]:
    known = {name: j for j in range(model.njnt) if (name := model.joint(j).name)}
    require_known("joint", joints, known)
    if len(set(joints)) != len(joints) or not joints:
        raise ConfigurationError(
            f"joints must name at least one joint, and each once, got {quote(list(joints))}"
        )
    require_few(joints)
    for name in joints:
        if model.jnt_type[known[name]] != _HINGE:
            raise ConfigurationError(
                f"joint {name!r} of the rigid model is no hinge; elastic joints are hinges"
            )
    return {known[name] for name in joints}


def _require_no_others(model: MjModel) -> None:
    """Refuse what acts on all links."""
    unknown = "are not known in advance; take it out"
    if model.nflex:
        raise ConfigurationError(
            f"the model has a deformable body (flex), whose forces on the links {unknown}"
        )
    if (model.body_plugin >= 0).any() or (model.actuator_plugin >= 0).any():
        problem = "the model has a plugin of a body or an actuator"
        raise ConfigurationError(f"{problem}, whose forces {unknown}")
    is_fluid = model.opt.density > 0.0 or model.opt.viscosity > 0.0
    if model.opt.wind.any() and is_fluid:
        raise ConfigurationError(
            "the model has wind, whose force on the links is not compensated; take `wind` out"
        )


def _active(model: MjModel) -> Iterator[int]:
    """Equality constraints that act from the start."""
    if not int(model.opt.disableflags) & (_FLAGS["equality"] | _FLAGS["constraint"]):
        yield from (e for e in range(model.neq) if model.eq_active0[e])


def _equality(model: MjModel, equality: int) -> tuple[set[int], str]:
    """Joints that feel an equality constraint, and the names of what it couples."""
    kind = int(model.eq_type[equality])
    both = (model.eq_obj1id[equality], model.eq_obj2id[equality])
    ends = [int(i) for i in both if i >= 0]
    if kind == _EQ_JOINT:
        acts = set(ends)
        element = model.joint
    elif kind == _EQ_TENDON:
        acts = set().union(*(_joints_of_tendon(model, t) for t in ends))
        element = model.tendon
    elif model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        acts = _between(model, [int(model.site_bodyid[site]) for site in ends])
        element = model.site
    elif model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_BODY:
        acts = _between(model, [*ends, 0][:2])
        element = model.body
    else:
        return set(range(model.njnt)), "a deformable body"
    names = [quote(element(i).name)[1:-1] or f"number {i}" for i in ends]
    return acts, " and ".join(names)


def _chain(model: MjModel, body: int) -> set[int]:
    """Joints between a body and the world."""
    joints: set[int] = set()
    while body > 0:
        first = int(model.body_jntadr[body])
        joints.update(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return joints


def _between(model: MjModel, bodies: Sequence[int]) -> set[int]:
    """Joints that move bodies against one another."""
    chains = [_chain(model, body) for body in bodies]
    return set().union(*(chain ^ chains[0] for chain in chains))


def _joints_of_tendon(model: MjModel, tendon: int) -> set[int]:
    """Joints with which the length of a tendon changes."""
    joints: set[int] = set()
    bodies: list[int] = []
    first = int(model.tendon_adr[tendon])
    for at in range(first, first + int(model.tendon_num[tendon])):
        kind = int(model.wrap_type[at])
        one = int(model.wrap_objid[at])
        if kind == _WRAP_JOINT:
            joints.add(one)
        elif kind == _WRAP_SITE:
            bodies.append(int(model.site_bodyid[one]))
        elif kind in _WRAP_GEOMS:
            bodies.append(int(model.geom_bodyid[one]))
    return joints | _between(model, bodies)


def _pulls(model: MjModel, tendon: int) -> bool:
    fields = [getattr(model, f"tendon_{name}") for name in _PULLING.split()]
    return any(np.any(values[tendon]) for values in fields)


def _driven_beside_joints(model: MjModel, actuator: int) -> set[int]:
    """Joints that an actuator moves without being on one of them."""
    kind = int(model.actuator_trntype[actuator])
    first, second = (int(i) for i in model.actuator_trnid[actuator])
    if kind == _TENDON:
        return _joints_of_tendon(model, first)
    if kind in (_SITE, _SLIDERCRANK):
        sites = [site for site in (first, second) if site >= 0]
        bodies = [int(model.site_bodyid[site]) for site in sites]
        return _between(model, [*bodies, 0][:2])
    return set()


def _or_hold(model: MjModel, acts: set[int], moving: set[int]) -> str:
    """How to hold the joints that something acts on, where others are left."""
    if acts == moving:
        return ""
    names = [model.joint(j).name for j in sorted(acts)]
    lines = ", ".join(f"'{name}: held'" for name in names[:8])
    more = ", ..." if len(names) > 8 else ""
    return (
        ", or hold the joints on which it acts: in the file of joints (`joints`, --stiffness"
        f" joints.yaml) write '\"*\": K', {lines}{more}; PositionCompensator takes `joints` without"
        " them"
    )


def _names(model: MjModel, joints: set[int]) -> str:
    return _listed([model.joint(j).name for j in sorted(joints)])


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def _is_gripper(model: MjModel, group: set[int]) -> bool:
    """True if coupled joints are fingers: on two branches or more, with no joint beyond them."""
    body_of = model.jnt_bodyid.tolist()
    parent_of = model.body_parentid.tolist()
    bodies = {body_of[j] for j in group}
    carried = {j for j in range(model.njnt) if _chain(model, body_of[j]) & group}
    first = [body for body in bodies if not _chain(model, parent_of[body]) & group]
    return carried <= group and len(first) > 1 and len(group) < model.njnt


def _require_inertia(model: MjModel, joints: Sequence[str]) -> None:
    """Refuse joints that move no inertia of their own, such as two about one axis."""
    data = mujoco.MjData(model)
    at = [int(model.joint(name).id) for name in joints]
    dofs = model.jnt_dofadr[at]
    smallest = []
    for offset in _POSES:
        data.qpos[:] = home_of(model)
        data.qpos[model.jnt_qposadr[at]] += offset
        full = mass_matrix(model, data)
        links = full[np.ix_(dofs, dofs)] - np.diag(model.dof_armature[dofs])
        scale = np.sqrt(np.maximum(np.diag(links), np.finfo(np.float64).tiny))
        with np.errstate(over="ignore"):
            scaled = links / np.outer(scale, scale)
        if not np.isfinite(scaled).all():
            problem = "the masses and inertias of the model are too large"
            raise ConfigurationError(f"{problem}; see their units")
        values, vectors = np.linalg.eigh(scaled)
        smallest.append((values[0], vectors[:, 0]))
    value, vector = max(smallest, key=lambda pair: pair[0])
    if value < _SINGULAR:
        names = " and ".join(joints[int(i)] for i in np.argsort(-np.abs(vector))[:2])
        raise ConfigurationError(
            f"the links that {names} move have no inertia of their own, or two joints have one"
            " axis; give each link its mass and inertia, and each joint its own axis"
        )
