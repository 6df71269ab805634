"""A compiled MuJoCo model as the links of a tree of hinges."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.signals import Array
from elastic_env.rigid.tree.kernels import LINK

Held = Mapping[str, float] | Mapping[int, float]
"""Positions of fixed joints, by name or number, of a hinge [rad] or a slide [m]."""


@dataclass(frozen=True)
class Tree:
    """Links of a tree of hinges, and the places of MuJoCo's bodies in it.

    Attributes:
        links: Rows of `LINK`, the base first and parents before their children.
        carrier: Link with which each body moves, 0 for the base.
        place, R: Position [m] and orientation of each body in the frame of that link.
    """

    links: Any
    carrier: list[int]
    place: Array
    R: Array

    @classmethod
    def of(cls, model: MjModel, joints: Sequence[str], held: Held, root: int = 0) -> Self:
        """Make the tree of a model whose other joints are held.

        Args:
            model: Compiled rigid model.
            joints: Hinges that move, in the order of the last axis of arrays.
            held: Position of every other joint by name or number, a hinge [rad] or a slide [m].
            root: Body of the base, 0 for the world.
        """
        data = mujoco.MjData(model)
        for name, position in held.items():
            data.qpos[model.joint(name).qposadr[0]] = position
        mujoco.mj_kinematics(model, data)  # moving joints are at their reference
        moving = sorted(model.joint(name).id for name in joints)
        carrier = _carriers(model, moving)
        frames = [_frame_about(data.xaxis[j]) for j in moving]
        R_wl = np.stack([data.xmat[root].reshape(3, 3), *frames])
        p_wl = np.stack([data.xpos[root], *(data.xanchor[j] for j in moving)])
        R_lw = R_wl[carrier].transpose(0, 2, 1)
        links = _new_links(model, joints, moving, carrier)
        for i in range(1, len(links)):
            parent = links[i]["parent"]
            links[i]["R"] = R_wl[parent].T @ R_wl[i]
            links[i]["anchor"] = R_wl[parent].T @ (p_wl[i] - p_wl[parent])
        com = _rotate(R_lw, data.xipos - p_wl[carrier])
        R_li = R_lw @ data.ximat.reshape(-1, 3, 3)
        for b in range(1, model.nbody):
            inertia = R_li[b] @ np.diag(model.body_inertia[b]) @ R_li[b].T
            share = 1.0 - float(model.body_gravcomp[b])
            mass = float(model.body_mass[b])
            _add_mass(links[carrier[b]], mass, com[b], inertia, share)
        place = _rotate(R_lw, data.xpos - p_wl[carrier])
        return cls(links, carrier, place, R_lw @ data.xmat.reshape(-1, 3, 3))

    def add_load(self, body: int, mass: float, place: Array) -> Any:
        """Return the links with a further point mass [kg] at a place in a body [m]."""
        links = self.links.copy()
        place = self.place[body] + self.R[body] @ place
        _add_mass(links[self.carrier[body]], mass, place)
        return links


def _carriers(model: MjModel, moving: Sequence[int]) -> list[int]:
    """Return the link of each body: that of its last moving joint, or of its parent."""
    last = {int(model.jnt_bodyid[j]): i for i, j in enumerate(moving, start=1)}
    carrier = [0]
    for body in range(1, model.nbody):
        carrier.append(last.get(body, carrier[int(model.body_parentid[body])]))
    return carrier


def _new_links(
    model: Any, joints: Sequence[str], moving: Sequence[int], carrier: Sequence[int]
) -> Any:
    """Return links with parents and joints, but without frames and masses."""
    links = np.zeros(1 + len(moving), LINK)
    links["tip"] = -1
    for i, j in enumerate(moving, start=1):
        body = int(model.jnt_bodyid[j])
        is_first = i == 1 or model.jnt_bodyid[moving[i - 2]] != body
        links[i]["parent"] = carrier[model.body_parentid[body]] if is_first else i - 1
        links[i]["column"] = list(joints).index(model.joint(j).name)
        links[i]["zero"] = model.qpos0[model.jnt_qposadr[j]]
    return links


def _add_mass(
    link: Any, mass: float, com: Array, inertia: Array | float = 0.0, share: float = 1.0
) -> None:
    """Add a mass to a link, with its own inertia and a share of its weight."""
    link["mass"] += mass
    link["mass_moment"] += mass * com
    link["inertia"] += inertia + mass * ((com @ com) * np.eye(3) - np.outer(com, com))
    link["weight"] += share * mass
    link["weight_moment"] += share * mass * com


def _frame_about(axis: Array) -> Array:
    """Return a right-handed frame with its z axis along a unit vector, as columns."""
    x = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _rotate(R: Array, vectors: Array) -> Array:
    return (R @ vectors[..., None])[..., 0]
