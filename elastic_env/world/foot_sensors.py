r"""Six-axis force-torque sensors of the feet: their load, and their errors in addition to noise.

A sensor at the ankle measures the wrench of the foot on the leg: force and moment of the ground
minus the weight of the foot itself, (f, n) about the ankle, in the frame of the foot.

It measures this wrench w = (f, n) with a constant bias b, a drift of rate d, and cross-talk:

.. math:: w_{measured} = w + b + d \, t + S C S^{-1} w

C has zeros on its diagonal. Its other entries are shares of the full scale, as in data sheets: the
reading of one axis, over its range, at full load on another axis. S contains the ranges of the
axes; only the ratio of moments to forces counts.
"""

from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid.biped import Biped
from elastic_env.world.robot_ranges import CROSS_TALK_ENTRIES, FOOT_ERRORS, DrawnRobot

_RANGE_RATIO_M = 0.04
"""Range of the moments over the range of the forces [m]: 8 N·m over 200 N for a commercial six-axis
sensor (RealMan), 120 N·m over 2800 N for an ATI Mini58-SI-2800-120, by its name."""


class FootSensors:
    """Force-torque sensors at the ankles of feet that hardly accelerate.

    Args:
        foot_mass: Mass of the feet, (L,) [kg].
        foot_com: Center of mass of the feet from the ankle, in the frame of the foot, (L, 3) [m].
        gravity: Acceleration of gravity in the world, (3,) [m/s²].

    Attributes:
        com: `foot_com`.
        weight: Weight of each foot in the world frame, (L, 3) [N].
    """

    def __init__(self, foot_mass: Array, foot_com: Array, gravity: Array) -> None:
        self.com = foot_com
        self.weight = foot_mass[:, None] * gravity

    @classmethod
    def of_biped(cls, biped: Biped) -> "FootSensors":
        """Make the force-torque sensors at the ankles of a biped."""
        model = biped.rigid
        feet = biped.feet
        return cls(model.body_mass[feet], model.body_ipos[feet], model.opt.gravity)


def cross_talk_matrix(shares: Array) -> Array:
    """Matrix S C S⁻¹ of one sensor.

    Args:
        shares: Entries of C outside its diagonal by rows, (..., 30) [1].

    Returns:
        (..., 6, 6); rows and columns are forces, then moments [1], [m], [1/m].
    """
    matrix = np.zeros((*shares.shape[:-1], 6, 6))
    matrix[..., ~np.eye(6, dtype=np.bool_)] = shares
    ranges = np.repeat([1.0, _RANGE_RATIO_M], 3)
    return matrix * ranges[:, None] / ranges


def foot_errors(robot: DrawnRobot) -> dict[str, Any]:
    """Errors of both feet's sensors, as fields of the walker's record `BIAS`."""
    drawn = {name: np.array(getattr(robot, name)) for name in FOOT_ERRORS}
    force, moment, force_rate, moment_rate = (
        drawn[name].reshape(2, 3) for name in FOOT_ERRORS if name != "cross_talk"
    )
    shares = drawn["cross_talk"].reshape(2, CROSS_TALK_ENTRIES)
    return {
        "has_foot_errors": any(values.any() for values in drawn.values()),
        "wrench": np.stack([force, moment], axis=1),
        "wrench_rate": np.stack([force_rate, moment_rate], axis=1),
        "cross_talk": cross_talk_matrix(shares),
    }
