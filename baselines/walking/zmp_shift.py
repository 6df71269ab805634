r"""A shift of the ZMP as offsets of the joints: the pelvis moves as an inverted pendulum has to.

The ZMP p of a pendulum whose center of mass moves by c is [Kajita2003]

.. math:: p = c - \ddot c / \omega^2

A shift that is known over the whole walk has one c that stays bounded. Its Fourier transform is that of p over
1 + (ν/ω)²: a low-pass filter without phase shift, which looks as far ahead as back. The pelvis is moved by c over feet
that stay, by inverse kinematics. A learned p makes a plan of its own of the ZMP, as in [Hu2015].

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of Zero-Moment Point", ICRA.
[Hu2015] K. Hu, C. Ott, D. Lee, "Online Iterative Learning Control of Zero-Moment Point for Biped Walking
Stabilization", ICRA.
"""

import numpy as np
from scipy import linalg

from elastic_env.core.signals import Array
from elastic_env.runtime.robot_model import WalkerModel


def center_of_mass_shift(zmp: Array, omega: float, period_s: float) -> Array:
    """The bounded c of a ZMP shift, at rest before the first and after the last row.

    Args:
        zmp: Shift p over time, (T, k) [m].
        omega: Natural frequency of the pendulum [rad/s].
        period_s: Time between rows [s].

    Returns:
        (T, k) [m]; its second difference fulfils the equation of the module.
    """
    stiff = 1.0 / (omega * period_s) ** 2
    bands = np.tile([[-stiff], [1.0 + 2.0 * stiff], [-stiff]], len(zmp))
    bands[1, [0, -1]] = 1.0 + stiff
    return linalg.solve_banded((1, 1), bands, zmp)


def zmp_shift_offsets(model: WalkerModel, zmp: Array) -> Array:
    """Offsets of the joints that shift the ZMP of the plan.

    Args:
        model: Assumed walker.
        zmp: Shift at every row of the plan, x forward and y left, (T, 2) [m].

    Returns:
        (T, 12) [rad].
    """
    plan = model.plan
    shift = center_of_mass_shift(zmp, plan.omega, model.control_period_s)
    return model.biped.joint_angles(plan.pelvis + np.pad(shift, ((0, 0), (0, 1))), plan.ankles) - plan.q
