"""Joints of a rigid model: names of its hinges, home positions, inertia."""

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.errors import ConfigurationError, list_names
from elastic_env.core.signals import Array

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


def hinge_ids(model: MjModel) -> list[int]:
    """Return the numbers of all hinges."""
    return [j for j in range(model.njnt) if model.jnt_type[j] == _HINGE]


def hinges_of(model: MjModel) -> list[str]:
    """Return the names of all hinges with a name, in the order of the model."""
    return [name for j in hinge_ids(model) if (name := model.joint(j).name)]


def has_nameless_hinge(model: MjModel) -> bool:
    """Return True if a hinge has no name, by which its stiffness could be set."""
    return any(not model.joint(j).name for j in hinge_ids(model))


def nameless_hinge() -> ConfigurationError:
    """Return the error for an elastic hinge without a name."""
    return ConfigurationError(
        "a hinge of the model has no name; give each one, the stiffness is by name, or"
        " name the joints that are elastic: the others are held"
    )


def home_of(model: MjModel) -> Array:
    """Return the joint positions of the first keyframe or the reference, (nq,) [rad], [m]."""
    return model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()


def held_positions(model: MjModel, joints: Sequence[str]) -> dict[int, float]:
    """Return the home positions of all joints except these, by joint number [rad], [m]."""
    home = home_of(model)
    others = [j for j in range(model.njnt) if model.joint(j).name not in joints]
    return {j: float(home[model.jnt_qposadr[j]]) for j in others}


def describe_home(model: MjModel, joints: Iterable[int]) -> str:
    """List joints with their home positions, such as "elbow at 0.5 rad, finger at 0.01 m".

    Args:
        model: Compiled rigid model.
        joints: Numbers of hinges and slides.
    """
    home = home_of(model)
    texts: list[str] = []
    for j in joints:
        name = model.joint(j).name or f"joint {j}"
        unit = "rad" if model.jnt_type[j] == _HINGE else "m"
        texts.append(f"{name} at {home[model.jnt_qposadr[j]]:.4g} {unit}")
    return list_names(texts)


def mass_matrix(model: MjModel, data: mujoco.MjData) -> Array:
    """Return the inertia of all joints with armature in the pose of a state, (nv, nv) [kg·m²]."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_crb(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def first_names(names: Sequence[str]) -> str:
    """List the first eight names, with dots for the others."""
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
