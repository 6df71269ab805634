r"""Dry friction along a desired motion: its direction, and the torque that overcomes it.

At rest the sign of dry friction is known from the last motion only. So the direction s follows the
reference: it changes over a displacement [Dahl1968], keeps its value at rest, and ignores motion in
a dead zone. The torque of the transmission solves

.. math:: \tau_J = \tau + s (F_0 + F_s e^{-(\omega / \omega_s)^2} + c |\tau_J|)

[Dahl1968] P. R. Dahl, "A Solid Friction Model", The Aerospace Corporation, TOR-0158(3107-18)-1.
"""

from typing import NamedTuple

import numpy as np

from elastic_env.core.signals import Array, Parameter
from elastic_env.joint.friction import dry_friction, passed_torque

PRESLIDING_RAD = 1e-3
"""Displacement over which dry friction changes its sign [rad]."""
DEAD_ZONE_RAD = 1.6e-3
"""Displacement to either side that does not change the direction, for joints whose friction varies:
more than one of the 4096 counts per turn of small servos [rad].
"""


def presliding_friction(friction: Array, displacement: Array, coulomb: Parameter) -> Array:
    r"""Coulomb friction with presliding [Dahl1968].

    It changes its sign over a displacement, and keeps its value at rest.

    .. math:: f_{k+1} = F s + (f_k - F s) e^{-|\Delta q| / x_0}, \quad s = \mathrm{sign}(\Delta q)

    Args:
        friction: f, that holds the link back, before the displacement, (..., n) [N·m].
        displacement: Δq, (..., n) [rad].
        coulomb: F, (n,) [N·m].
    """
    full = coulomb * np.sign(displacement)
    return full + (friction - full) * np.exp(-np.abs(displacement) / PRESLIDING_RAD)


class FrictionMemory(NamedTuple):
    """Memory of the friction, (..., n) each.

    Attributes:
        coulomb: Coulomb friction that holds the link back [N·m].
        direction: s, from −1 to 1 [1].
        slack: Way of the reference within the dead zone [rad].
    """

    coulomb: Array
    direction: Array
    slack: Array


class FrictionCompensation:
    """Torque that moves links against the dry friction of their joints.

    Attributes:
        dead_zone: Displacement to either side that does not change the direction, (n,) [rad]. The
            arguments are attributes too.

    Args:
        coulomb: F₀, (n,) [N·m].
        load_ratio: c, (n,) [1].
        static: F_s, (n,) [N·m].
        stribeck_speed: ω_s, (n,) [rad/s].
    """

    def __init__(
        self, coulomb: Array, load_ratio: Array, static: Array, stribeck_speed: Array
    ) -> None:
        self.coulomb = coulomb
        self.load_ratio = load_ratio
        self.static = static
        self.stribeck_speed = stribeck_speed
        self.dead_zone = DEAD_ZONE_RAD * ((load_ratio > 0.0) | (static > 0.0))

    def begin(self, shape: tuple[int, ...]) -> FrictionMemory:
        """Memory before any motion, for links of this shape: friction acts on neither side."""
        zero = np.zeros(shape)
        return FrictionMemory(zero, zero, zero)

    def follow(self, displacement: Array, memory: FrictionMemory) -> FrictionMemory:
        """Memory after the reference has moved by Δq, (..., n) [rad]."""
        total = memory.slack + displacement
        beyond = total - total.clip(-self.dead_zone, self.dead_zone)
        return FrictionMemory(
            coulomb=presliding_friction(memory.coulomb, beyond, self.coulomb),
            direction=presliding_friction(memory.direction, beyond, 1.0),
            slack=total - beyond,
        )

    def joint_torque(self, torque: Array, speed: Array, memory: FrictionMemory) -> Array:
        """Torque τ_J of the transmission, (..., n) [N·m].

        Args:
            torque: τ that the links need, (..., n) [N·m].
            speed: ω of the reference, (..., n) [rad/s].
            memory: Memory after the displacement.
        """
        load = self._total_load(torque, speed, memory)
        return passed_torque(load, memory.direction, 0.0, self.load_ratio)

    def share(self, torque: Array, speed: Array, memory: FrictionMemory) -> Array:
        """∂τ_J/∂τ, (..., n) [1]; arguments as `joint_torque`."""
        load = self._total_load(torque, speed, memory)
        return 1.0 / (1.0 - memory.direction * self.load_ratio * np.sign(load))

    def largest_joint_torque(self, torque: Array) -> Array:
        """Largest τ_J under loads of either sign at rest, (..., n) [N·m] to (..., n) [N·m]."""
        friction = self.coulomb + self.static
        return passed_torque(np.abs(torque), 1.0, friction, self.load_ratio)

    def _total_load(self, torque: Array, speed: Array, memory: FrictionMemory) -> Array:
        """Load with the friction that does not grow with it, (..., n) [N·m]."""
        load = torque + memory.coulomb
        if not self.static.any():
            return load
        excess = dry_friction(
            speed,
            load=torque,
            coulomb=0.0,
            static=self.static,
            stribeck_speed=self.stribeck_speed,
        )
        return load + memory.direction * excess
