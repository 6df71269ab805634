r"""Dry friction of a joint: constant, growing with the load, and higher at rest.

Small servos with worm, planetary or cheap spur gears lose a share of the torque that they pass. The
teeth are pressed together by the load, so friction grows with it [Rhoban2025]; it falls from rest
to motion [ArmstrongHelouvry1994].

[Rhoban2025] M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended Friction Models for the Physics
Simulation of Servo Actuators", ICRA 2025. [ArmstrongHelouvry1994] B. Armstrong-Hélouvry, P. Dupont,
C. Canudas de Wit, "A survey of models, analysis tools and compensation methods for the control of
machines with friction", Automatica 30(7).
"""

from typing import Any

import numpy as np

from elastic_env.core.compiled import compiled, within_compiled
from elastic_env.core.signals import Array, Parameter


@within_compiled
def dry_friction(
    speed: Array,
    load: Array,
    coulomb: Parameter,
    load_ratio: Parameter = 0.0,
    static: Parameter = 0.0,
    stribeck_speed: Parameter = 0.0,
) -> Array:
    r"""Largest torque by which dry friction opposes motion [ArmstrongHelouvry1994].

    .. math:: F = F_0 + c |\tau_J| + F_s \exp(-(\omega / \omega_s)^2)

    A link that moves feels all of it against its speed. A link at rest feels what balances the
    other torques, up to this at zero speed.

    Args:
        speed: ω of the link, (..., n) [rad/s].
        load: τ_J, the torque that the transmission passes, (..., n) [N·m].
        coulomb: F₀, broadcast against (..., n) [N·m].
        load_ratio: c, share of the load that is lost to friction, likewise [1].
        static: F_s, excess of the friction at rest, likewise [N·m].
        stribeck_speed: ω_s, by which F_s falls to 37 %, likewise; 0 for F_s at rest only [rad/s].

    Returns:
        F, (..., n) [N·m]; never negative.
    """
    has_width = stribeck_speed > 0.0
    width = np.where(has_width, stribeck_speed, 1.0)
    # exp(-100²) is 0; the squares of larger ratios may overflow
    relative = np.minimum(np.abs(speed), 100.0 * width) / width
    at_rest = np.where(speed == 0.0, 1.0, 0.0)
    excess = np.where(has_width, np.exp(-(relative * relative)), at_rest)
    return coulomb + load_ratio * np.abs(load) + static * excess


@compiled
def dry_friction_rows(rows: Array, places: Any, speed: Array, columns: Any, load: Array) -> Array:
    """Compute `dry_friction` of joints whose parameters differ between worlds.

    Args:
        rows: Parameters of the worlds, (num_worlds, ...), or of all, (1, ...).
        places: Places of F₀, c, F_s and ω_s in a row, (4, n).
        speed: Speeds of the worlds, (num_worlds, ...) [rad/s].
        columns: Columns of the joints in it, (n,).
        load: τ_J, (num_worlds, n) [N·m].

    Returns:
        F, (num_worlds, n) [N·m].
    """
    limits = np.empty_like(load)
    for world in range(len(load)):
        terms = rows[world % len(rows)]
        for i in range(len(columns)):
            limits[world, i] = dry_friction(
                speed[world, columns[i]],
                load[world, i],
                terms[places[0, i]],
                terms[places[1, i]],
                terms[places[2, i]],
                terms[places[3, i]],
            )
    return limits


def passed_torque(
    torque: Array, direction: Parameter, friction: Parameter, load_ratio: Parameter = 0.0
) -> Array:
    r"""Torque that a transmission must pass to move a link against friction that grows with it.

    It solves :math:`\tau_J = \tau + s (F + c |\tau_J|)`:

    .. math:: \tau_J = \frac{\tau + s F}{1 - s c \,\mathrm{sign}(\tau + s F)}

    Against a positive load that is (τ + F)/(1 − c), with it (τ − F)/(1 + c).

    Args:
        torque: τ that the link needs, gravity and inertia, (..., n) [N·m].
        direction: s, the sign of the motion or, where the friction turns round, a share between −1
            and 1, broadcast against (..., n) [1].
        friction: F without the share of the load, likewise [N·m].
        load_ratio: c, below 1, likewise [1].

    Returns:
        τ_J, (..., n) [N·m].
    """
    needed = torque + direction * friction
    return needed / (1.0 - direction * load_ratio * np.sign(needed))
