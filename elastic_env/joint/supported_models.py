"""Checks of a model for compensators: its joints, and everything else that acts on them.

Every element of a model is part of the torque at rest, is held, or is refused with its name.
"""

from collections.abc import Collection, Sequence

import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.joint import affected_joints, model_joints
from elastic_env.joint.compile_model import require_sound

MOST_ELASTIC = 80
"""Largest number of elastic joints: the time of the stability check grows with their cube."""

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_RESTING = ("gravity", "spring", "damper", "actuation")
"""Flags of <option> whose forces bend a joint at rest, or bring it to rest."""
_FLAGS = {
    name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
    for name in (*_RESTING, "frictionloss", "constraint")
}
"""Flags of forces on a joint, and their bits."""
_POSES = (0.0, 0.37, -0.83)
"""Offsets from the home pose [rad]: two joints on one axis share it in each of these poses."""
_SINGULAR = 1e-10
"""Least eigenvalue of the scaled inertia of the links; below it a joint has no inertia."""


def require_robot(model: MjModel) -> None:
    """Refuse a model without joints that can be commanded, for any settings of its joints.

    Raises:
        ConfigurationError: It contradicts itself; a joint is free or a ball joint, as that of a
            floating base; or no hinge has a name.
    """
    require_sound(model, "the model")
    for j in range(model.njnt):
        if model.jnt_type[j] not in (_HINGE, _SLIDE):
            raise ConfigurationError(
                f"joint {model.joint(j).name!r} is free or a ball joint; a fixed base,"
                " hinges and slides are needed: the torque of a floating robot depends on"
                " its contacts. Without compensation elastic_env.make_elastic takes it"
            )
    require_hinge(model)


def require_hinge(model: MjModel) -> None:
    """Refuse a model without joints that can be elastic.

    Raises:
        ConfigurationError: It has no hinge, or none with a name.
    """
    if not model_joints.hinge_ids(model):
        raise ConfigurationError(
            "the model has no hinge, and elastic joints are hinges; give a robot with rotary joints"
        )
    if not model_joints.hinges_of(model):
        raise model_joints.nameless_hinge()


def require_few(joints: Collection[str]) -> None:
    """Refuse more elastic joints than can be simulated.

    Raises:
        ConfigurationError: There are more than `MOST_ELASTIC`.
    """
    if len(joints) > MOST_ELASTIC:
        problem = f"at most {MOST_ELASTIC} joints can be elastic, got {len(joints)}"
        raise ConfigurationError(f"{problem}; name those that matter")


def require_flags(disabled: int, flags: Collection[str]) -> None:
    """Refuse a model that disables forces that its elastic joints need.

    Args:
        disabled: Disabled flags of the model, a bit each.
        flags: Flags that must be enabled.

    Raises:
        ConfigurationError: One of them is disabled.
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
    """Refuse a model whose commanded joints feel a torque that is not known in advance.

    Args:
        model: Compiled rigid model.
        joints: Commanded hinges; all others are held.

    Raises:
        ConfigurationError: See `require_robot`; a joint does not exist, is no hinge or is named
            twice; or a constraint, a tendon, a drive that is not on a joint, a deformable body, a
            plugin, wind or a flag acts on the joints.
    """
    require_robot(model)
    ids = _ids_of(model, joints)
    require_flags(int(model.opt.disableflags), _RESTING)
    _require_no_body_forces(model)
    for e in affected_joints.active_equalities(model):
        affected, ends = affected_joints.equality_joints(model, e)
        if affected & ids:
            raise ConfigurationError(
                f"the model has an equality constraint of {ends}, whose torque is not known in"
                f" advance; take it out of the model{_hold_cure(model, affected & ids, ids)}"
            )
    for t in range(model.ntendon):
        affected = affected_joints.tendon_joints(model, t) & ids
        if affected and affected_joints.tendon_pulls(model, t):
            raise ConfigurationError(
                f"the model's tendon {model.tendon(t).name!r} has stiffness, damping,"
                " friction or inertia; the torque of tendons with stiffness is not"
                f" compensated; take it out of the model{_hold_cure(model, affected, ids)}"
            )
    for a in range(model.nactuator):
        if affected := affected_joints.remote_actuator_joints(model, a) & ids:
            names = [model.joint(j).name for j in sorted(affected)]
            means = affected_joints.TRANSMISSIONS[int(model.actuator_trntype[a])]
            raise ConfigurationError(
                f"the model's actuator {model.actuator(a).name!r} drives"
                f" {model_joints.first_names(names)} by {means}, which is not"
                " compensated; drive each joint by an actuator of its own, or take this"
                f" one out of the model{_hold_cure(model, affected, ids)}"
            )
    for j in np.flatnonzero(model.jnt_stiffnesspoly.any(axis=-1)):
        if int(j) in ids:
            raise ConfigurationError(
                f"joint {model.joint(int(j)).name!r} has a spring whose torque is not"
                " linear, which is not compensated; give it one number"
            )
    _require_inertia(model, joints)


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


def _require_no_body_forces(model: MjModel) -> None:
    """Refuse deformable bodies, plugins and wind, which act on all links."""
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


def _hold_cure(model: MjModel, affected: set[int], moving: set[int]) -> str:
    """Describe how to hold the affected joints; empty where no other joint is left."""
    if affected == moving:
        return ""
    names = [model.joint(j).name for j in sorted(affected)]
    lines = ", ".join(f"'{name}: held'" for name in names[:8])
    more = ", ..." if len(names) > 8 else ""
    return (
        ", or hold the joints on which it acts: in the file of joints (`joints`, --stiffness"
        f" joints.yaml) write '\"*\": K', {lines}{more}; PositionCompensator takes `joints` without"
        " them"
    )


def _require_inertia(model: MjModel, joints: Sequence[str]) -> None:
    """Refuse joints that move no inertia of their own, such as two joints on one axis."""
    data = mujoco.MjData(model)
    at = [int(model.joint(name).id) for name in joints]
    dofs = model.jnt_dofadr[at]
    smallest = []
    for offset in _POSES:
        data.qpos[:] = model_joints.home_of(model)
        data.qpos[model.jnt_qposadr[at]] += offset
        full = model_joints.mass_matrix(model, data)
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
