r"""Joint torques of a walker at rest on its feet: Eqs. 4 to 6 of the paper, and from measured foot wrenches.

The paper takes τ_g = J_r^T F_r + J_l^T F_l with Jacobians from the center of mass to the contact points. Where the
contact point is, and what of the robot has mass, is chosen by name:

| name | contact | masses |
|---|---|---|
| `com` | at the ZMP, each foot's share at a point of its own (`elastic_env.dynamics.contact_force`) | all links |
| `ankle` | at the ankle axes, so that no ankle carries torque | all links |
| `lumped` | at the ankle axes | all in the pelvis; the legs weigh nothing, as in published code |

In single support over its foot, `com` is the exact multibody torque.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from baselines.compensation import compensation_kernels as kernels
from baselines.compensation.observed import ObservedWalk
from elastic_env.core.signals import Array
from elastic_env.dynamics.leg_chains import LegChains
from elastic_env.dynamics.leg_kernels import solutions
from elastic_env.joint.elasticity import solve_stiffness
from elastic_env.runtime.robot_model import WalkerModel

ContactMethod = Literal["com", "ankle", "lumped"]

_LEGS, _PER_LEG = 2, 6


def gravity_in_pelvis(attitude: Array, gravity: float) -> Array:
    """Acceleration of gravity in the frame of a pelvis with roll and pitch, (..., 2) [rad] to (..., 3) [m/s²]."""
    found = np.empty((*attitude.shape[:-1], 3))
    kernels.gravities(np.ascontiguousarray(attitude).reshape(-1, 2), gravity, found.reshape(-1, 3))
    return found


class LegTorque:
    """Torques of legs under loads that go with any posture; a `GravityModel` on (num_worlds, 12).

    Args:
        chains: The legs.
        loads: What loads them, rows as of `LegChains.loads`, (num_worlds,).
    """

    def __init__(self, chains: LegChains, loads: Any) -> None:
        self._chains, self._loads = chains, loads

    def gravity_torque(self, q: Array) -> Array:
        """See `GravityModel`."""
        return self._chains.torque(self._loads, _by_leg(q)).reshape(q.shape)

    def gravity_gradient(self, q: Array) -> Array:
        """See `GravityModel`; not symmetric under a wrench, which turns with its foot."""
        return _block_diagonal(self.gradient_by_leg(q))

    def gradient_by_leg(self, q: Array) -> Array:
        """∂τ_g/∂q of each leg, which does not depend on the other, (num_worlds, 2, 6, 6) [N·m/rad]."""
        return self._chains.gradient(self._loads, _by_leg(q))

    def solved(self, q: Array, stiffness: Array, torque: Array | None = None) -> Array:
        """(K + ∂τ_g/∂q)⁻¹ τ, leg by leg.

        Args:
            q: (num_worlds, 12) [rad].
            stiffness: K, (12,) [N·m/rad].
            torque: τ, (num_worlds, 12) [N·m]; None for τ_g.

        Returns:
            (num_worlds, 12) [rad].

        Raises:
            ElasticError: The matrix is singular.
        """
        legs, K, x = _by_leg(q), stiffness.reshape(_LEGS, _PER_LEG), np.empty(q.shape)
        given = _OWN if torque is None else _by_leg(torque)
        if not solutions(self._chains.legs, self._loads, legs, K, given, _by_leg(x)):
            torque = self.gravity_torque(q) if torque is None else torque
            # says so if it is singular
            solve_stiffness(np.broadcast_to(K, legs.shape), self.gradient_by_leg(q), _by_leg(torque))
        return x


_OWN: Array = np.empty((0, _LEGS, _PER_LEG))


def _by_leg(values: Array) -> Array:
    """(num_worlds, 12) as (num_worlds, 2, 6), in the same memory where it is one piece."""
    return np.ascontiguousarray(values).reshape(-1, _LEGS, _PER_LEG)


class ContactGravity:
    """Gravity torque of a walker under the planned load share, by one of the methods of the module.

    Args:
        model: Assumed walker.
        method: "com", "ankle" or "lumped".
    """

    def __init__(self, model: WalkerModel, method: ContactMethod = "com") -> None:
        biped = model.biped
        self._observed, self._chains = ObservedWalk(model.observation_table), biped.chains
        contact = (
            biped.gravity, biped.chains.mass, biped.footholds, biped.ankle_height, method == "com", method != "lumped",
        )  # fmt: skip
        self._contact: Any = np.array([contact], kernels.CONTACT)

    def at(self, rows: Array, level: bool = True) -> LegTorque:
        """The gravity torque under the load share of observations, (num_worlds, m).

        Args:
            rows: Observations.
            level: Whether the pelvis is level, as commanded, or tilted as the IMU says.
        """
        return self.level_and_tilted(rows)[0 if level else 1]

    def level_and_tilted(self, rows: Array) -> tuple[LegTorque, LegTorque]:
        """The gravity torques of `at` with a level pelvis, and with one that is tilted as the IMU says."""
        level, tilted = self._chains.loads(len(rows)), self._chains.loads(len(rows))
        kernels.planned_loads(self._observed.fields(rows), self._contact, level, tilted)
        return LegTorque(self._chains, level), LegTorque(self._chains, tilted)


class WrenchTorque:
    """Torque of a walker's joints from the measured foot wrenches and the weight of its legs above the sensors.

    Args:
        model: Assumed walker.
    """

    def __init__(self, model: WalkerModel) -> None:
        self._observed, self._chains = ObservedWalk(model.observation_table), model.biped.chains_above_feet
        self._gravity = model.biped.gravity

    def at(self, rows: Array, level: bool = False) -> LegTorque:
        """The torque under the wrenches of observations, (num_worlds, m); `level` as in `ContactGravity.at`."""
        loads = self._chains.loads(len(rows))
        kernels.measured_loads(self._observed.fields(rows), self._gravity, level, loads)
        return LegTorque(self._chains, loads)


class PlannedTorque:
    """Torque of the planned motion by inverse dynamics, and the static torque of what is commanded beside it.

    Args:
        model: Assumed walker.
        gravity: Static torque.
    """

    def __init__(self, model: WalkerModel, gravity: ContactGravity) -> None:
        self._model, self._gravity = model, gravity
        self._time = model.observation_table.group("clock")
        self._reference = model.observation_table.group("reference_angle")

    def at(self, rows: Array, gravity: LegTorque | None = None) -> "BoundPlannedTorque":
        """The torque at the control steps of observations, (num_worlds, m); `gravity` is the static one, if known."""
        plan = self._model.plan
        row = np.rint(rows[:, self._time][:, 0] / self._model.control_period_s).astype(np.int64)
        torque = plan.torque[np.minimum(np.maximum(row, 0), plan.num_steps)]
        return BoundPlannedTorque(torque, rows[:, self._reference], gravity or self._gravity.at(rows))


@dataclass(frozen=True)
class BoundPlannedTorque:
    """Torque of a planned control step; `inverse_dynamics` as that of a `RigidBody`."""

    torque: Array
    q_ref: Array
    gravity: LegTorque

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:  # noqa: ARG002  the interface's
        """Torque at joint angles near the reference, (num_worlds, 12) [rad] to [N·m]."""
        return self.torque + (self.gravity.gravity_torque(q) - self.gravity.gravity_torque(self.q_ref))


def _block_diagonal(blocks: Array) -> Array:
    """(..., L, J, J) to (..., L J, L J)."""
    L, J = blocks.shape[-3:-1]
    full = np.zeros((*blocks.shape[:-3], L * J, L * J))
    for leg in range(L):
        full[..., leg * J : (leg + 1) * J, leg * J : (leg + 1) * J] = blocks[..., leg, :, :]
    return full
