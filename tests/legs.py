"""Legs under forces that are given in the pelvis frame, composed from what works in the frames
of the feet. One posture at a time, (n,) or (L, J)."""

from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid.leg_chains import LegChains, LegTorque


def foot_frames(chains: LegChains, q: Array) -> tuple[Array, Array]:
    """Ankles and orientations of the feet in the pelvis frame, (L, 3) and (L, 3, 3)."""
    ankle, *ends = (
        chains.com_and_feet(q.reshape(1, -1), point)[1][0] for point in (np.zeros(3), *np.eye(3))
    )
    return ankle, np.stack([end - ankle for end in ends], axis=-1)


def torque_of(chains: LegChains, q: Array, gravity: Array | float = 0.0, **loads: Any) -> Array:
    """Torques under loads of one posture, in its shape."""
    return chains.torque(chains.loads(1, gravity, **loads), q.reshape(1, -1)).reshape(q.shape)


def gradient_of(chains: LegChains, q: Array, gravity: Array | float = 0.0, **loads: Any) -> Array:
    """Gradients of the legs of one posture, (L, J, J)."""
    legs = LegTorque(chains, chains.loads(1, gravity, **loads))
    gradient = legs.gravity_gradient(q.reshape(1, -1))[0]
    J = q.shape[1]
    return np.stack([gradient[i : i + J, i : i + J] for i in range(0, q.size, J)])


def holding_torque(
    chains: LegChains,
    q: Array,
    gravity: Array,
    force: Array,
    point: Array,
    moment: Array | float = 0.0,
) -> Array:
    """Torques of legs under forces at points and moments about them, (L, 3) each, all in the
    pelvis frame."""
    ankle, R = foot_frames(chains, q)
    about_ankle = np.cross(point - ankle, force) + moment
    seen = (np.einsum("lji,lj->li", R, force), np.einsum("lji,lj->li", R, about_ankle))
    return torque_of(chains, q, gravity, wrench=seen)
