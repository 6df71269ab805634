"""Check that feet keep clear of each other: soles as rectangles, standing and swinging."""

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.motion.gait import Footholds
from elastic_env.rigid.leg_kinematics import turn

_SWING_PARTS = 16
"""Parts of a swing; the soles are compared at their ends."""


def require_clear_feet(feet: Footholds, sole_half_size: tuple[float, float]) -> None:
    """Refuse footholds at which soles cross or touch, also during a swing.

    Args:
        feet: Footholds by step.
        sole_half_size: Half length and half width of a sole [m].

    Raises:
        ConfigurationError: The left foot does not stay clear to the left of the right one.
    """
    share = np.linspace(0.0, 1.0, _SWING_PARTS + 1)[:, None, None]
    before = feet.positions[:-1, None]
    yaw_before = feet.yaw[:-1, None]
    positions = before + share * (feet.positions[1:, None] - before)
    yaw = yaw_before + share[..., 0] * (feet.yaw[1:, None] - yaw_before)
    gap = sole_gap(positions, yaw, sole_half_size)
    step = int(np.argmin(gap.min(axis=1)))
    if gap[step].min() <= 0.0:
        half_length, half_width = sole_half_size
        raise ConfigurationError(
            f"the soles of {2 * half_length:g} m x {2 * half_width:g} m touch or cross"
            f" in step {step + 1}; take a larger step_width_m or a smaller turn_rad"
        )


def sole_gap(positions: Array, yaw: Array, half_size: tuple[float, float]) -> Array:
    """Return the gap between two soles along the best of their sides, negative for an overlap.

    The right sole must be to the right of a side of the left one. Or it is in front of it or behind
    it, with its middle to the right. The same holds the other way round.

    Args:
        positions: Middles of the soles, left first, (..., 2, 2) [m].
        yaw: Their headings, (..., 2) [rad].
        half_size: Half length and half width of a sole [m].

    Returns:
        (...) [m]; at most the distance by which the middle of the left sole is to the left.
    """
    half = np.array(half_size)
    offset = positions[..., 0, :] - positions[..., 1, :]
    corners = half * np.array([[1.0, 1.0], [1.0, -1.0]])
    relative_yaw = (yaw[..., 0] - yaw[..., 1])[..., None]
    # extent of the other sole along the sides of a sole
    extent = np.abs(turn(corners, relative_yaw)).max(axis=-2)
    gaps = [np.abs(turn(offset, -yaw[..., foot])) - half - extent for foot in range(2)]
    aside = turn(offset, -yaw.mean(axis=-1))[..., 1]
    return np.minimum(np.concatenate(gaps, axis=-1).max(axis=-1), aside)
