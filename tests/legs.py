"""Legs under forces that are given in the pelvis frame, composed from what works in the frames
of the links."""

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid.leg_chains import LegChains, LegLoads


def foot_frames(chains: LegChains, q: Array) -> tuple[Array, Array]:
    """Ankles and orientations of the feet in the pelvis frame, (..., L, J) to (..., L, 3) and
    (..., L, 3, 3)."""
    _, ankle = chains.com_and_feet(q)
    columns = [chains.com_and_feet(q, unit)[1] - ankle for unit in np.eye(3).tolist()]
    return ankle, np.stack(columns, axis=-1)


def holding_torque(
    chains: LegChains,
    q: Array,
    gravity: Array,
    force: Array,
    point: Array,
    moment: Array | None = None,
) -> Array:
    """Torques of legs under forces at points and moments about them, (..., L, 3) each, all in
    the pelvis frame."""
    legs = chains.posture(q)
    ankle, R = foot_frames(chains, q)
    about_ankle = np.cross(point - ankle, force) + (0.0 if moment is None else moment)
    seen = (np.einsum("...ji,...j->...i", R, force), np.einsum("...ji,...j->...i", R, about_ankle))
    return LegLoads(legs, gravity, wrench=seen).torque()
