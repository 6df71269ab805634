r"""Shares of the feet in the ground's force: Eqs. 5 and 6 of the paper, contact at the ZMP.

Each foot takes its share of the force, F_r = μ F and F_l = (1 − μ) F, at a point of its own. Both
together act at the ZMP:

.. math:: c_i = p_i + r, \quad r = p_{ZMP} - \mu p_r - (1 - \mu) p_l

with the middles p_i of the soles. That balances any force, also horizontal ones. It is continuous
where μ reaches 0 or 1, without jumps at lift-off and touch-down.
"""

import numpy as np

from elastic_env.core.signals import Array


def load_share(point: Array, feet: Array) -> Array:
    r"""Eq. 6: share μ of the weight on the right foot.

    .. math:: \mu = \mathrm{clip}((p - p_l) \cdot (p_r - p_l) / \|p_r - p_l\|^2, 0, 1)

    Args:
        point: COM or ZMP in the ground plane, (..., 2) [m]; at rest they are the same.
        feet: Middles of left and right sole, (..., 2, 2) [m].

    Returns:
        (...) in [0, 1].
    """
    left = feet[..., 0, :]
    between = feet[..., 1, :] - feet[..., 0, :]
    along = ((point - left) * between).sum(axis=-1) / (between**2).sum(axis=-1)
    return np.clip(along, 0.0, 1.0)


def shares(share_right: Array) -> Array:
    """Return the shares of left and right foot, (...) to (..., 2)."""
    return np.stack([1.0 - share_right, share_right], axis=-1)


def contact_points(zmp: Array, share_right: Array, feet: Array) -> Array:
    """Return the points at which the forces of the feet act, (..., 2, 2) [m]; see `load_share`."""
    offset = zmp - (shares(share_right)[..., None] * feet).sum(axis=-2)
    return feet + offset[..., None, :]
