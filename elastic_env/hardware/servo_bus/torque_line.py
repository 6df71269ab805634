"""Torque of the servo from its motor current: the line that was measured at an H54-200-S500-R.

    |τ| = 4.338 N·m/A |I| − 2.694 N·m

Source: a public ROS configuration for this model, repository not identified (see `elastic_env/joint/dynamixel.py`,
which takes the torque limit from the same line). It is a rough figure: gear and temperature change it.
"""

import numpy as np
import numpy.typing as npt

from elastic_env.core.signals import Array
from elastic_env.joint.dynamixel import LOSS_NM, SERVO, TORQUE_PER_CURRENT

LARGEST_TORQUE_NM = SERVO.torque_limit
"""What the leg's servos of THORMANG3 are limited to, 20 A on this line; more hurts the gear [N·m]."""


def torque_of_current(current: npt.ArrayLike) -> Array:
    """Torque at the output [N·m] for signed currents [A]; zero where the current only meets the losses."""
    given = np.asarray(current, dtype=np.float64)
    return np.sign(given) * np.maximum(TORQUE_PER_CURRENT * np.abs(given) - LOSS_NM, 0.0)


def current_of_torque(torque: float) -> float:
    """Signed current [A] for a torque at the output [N·m]."""
    return float(np.sign(torque) * (abs(torque) + LOSS_NM) / TORQUE_PER_CURRENT)
