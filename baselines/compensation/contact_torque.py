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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.dynamics.contact_force import shares
from elastic_env.dynamics.leg_chains import LegChains, LegLoads, LegPosture
from elastic_env.runtime.robot_model import WalkerModel

ContactMethod = Literal["com", "ankle", "lumped"]

_LEGS, _PER_LEG = 2, 6


def gravity_in_pelvis(attitude: Array, gravity: float) -> Array:
    """Acceleration of gravity in the frame of a pelvis with roll and pitch, (..., 2) [rad] to (..., 3) [m/s²]."""
    roll, pitch = attitude[..., 0], attitude[..., 1]
    down = [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]
    return -gravity * np.stack(down, axis=-1)


class LegTorque:
    """Torques of legs under loads that go with any posture; a `GravityModel` on (num_worlds, 12).

    Args:
        chains: The legs.
        loads: What loads them in a posture.
    """

    def __init__(self, chains: LegChains, loads: Callable[[LegPosture], LegLoads]) -> None:
        self._chains, self._loads = chains, loads
        self._last: tuple[Array, LegLoads] | None = None

    def gravity_torque(self, q: Array) -> Array:
        """See `GravityModel`."""
        return self._at(q).torque().reshape(q.shape)

    def gravity_gradient(self, q: Array) -> Array:
        """See `GravityModel`; not symmetric under a wrench, which turns with its foot."""
        return _block_diagonal(self.gradient_by_leg(q))

    def gradient_by_leg(self, q: Array) -> Array:
        """∂τ_g/∂q of each leg, which does not depend on the other, (num_worlds, 2, 6, 6) [N·m/rad]."""
        return self._at(q).gradient()

    def _at(self, q: Array) -> LegLoads:
        """At joint angles; torque and gradient are asked for at the same ones."""
        if self._last is None or not np.array_equal(self._last[0], q):
            posture = self._chains.posture(q.reshape(*q.shape[:-1], _LEGS, _PER_LEG))
            self._last = q.copy(), self._loads(posture)
        return self._last[1]


class ContactGravity:
    """Gravity torque of a walker under the planned load share, by one of the methods of the module.

    Args:
        model: Assumed walker.
        method: "com", "ankle" or "lumped".
    """

    def __init__(self, model: WalkerModel, method: ContactMethod = "com") -> None:
        self._model, self._method = model, method
        table, biped = model.observation_table, model.biped
        self._share, self._zmp = table.group("load_share"), table.group("zmp_reference")
        self._attitude = table.group("imu_attitude")
        self._down = np.array([0.0, 0.0, -biped.gravity])

    def at(self, rows: Array, level: bool = True) -> LegTorque:
        """The gravity torque under the load share of observations, (num_worlds, m).

        Args:
            rows: Observations.
            level: Whether the pelvis is level, as commanded, or tilted as the IMU says.
        """
        biped = self._model.biped
        weights = shares(rows[:, self._share][:, 0])
        # not by @, whose last bit depends on the number of rows
        middle = (weights[:, :, None] * biped.footholds).sum(axis=1)
        rest = rows[:, self._zmp] - middle
        in_sole = np.zeros((len(rows), _LEGS, 3))
        if self._method == "com":
            in_sole[..., :2] = rest[:, None]
            in_sole[..., 2] = -biped.ankle_height
        gravity = self._down if level else gravity_in_pelvis(rows[:, self._attitude], biped.gravity)
        lifted = -biped.chains.mass * weights  # what the ground carries is a negative mass where it does
        legs_weigh = self._method != "lumped"
        return LegTorque(biped.chains, lambda legs: LegLoads(legs, gravity, lifted, in_sole, legs_weigh=legs_weigh))


class WrenchTorque:
    """Torque of a walker's joints from the measured foot wrenches and the weight of its legs above the sensors.

    Args:
        model: Assumed walker.
    """

    def __init__(self, model: WalkerModel) -> None:
        self._model = model
        table = model.observation_table
        self._wrench, self._attitude = table.group("wrench"), table.group("imu_attitude")

    def at(self, rows: Array, level: bool = False) -> LegTorque:
        """The torque under the wrenches of observations, (num_worlds, m); `level` as in `ContactGravity.at`."""
        biped = self._model.biped
        attitude = np.zeros((len(rows), 2)) if level else rows[:, self._attitude]
        gravity = gravity_in_pelvis(attitude, biped.gravity)
        wrench = rows[:, self._wrench].reshape(-1, _LEGS, 2, 3)
        force, moment = wrench[..., 0, :], wrench[..., 1, :]
        return LegTorque(biped.chains_above_feet, lambda legs: LegLoads(legs, gravity, wrench=(force, moment)))


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

    def at(self, rows: Array) -> "BoundPlannedTorque":
        """The torque at the control steps of observations, (num_worlds, m)."""
        plan = self._model.plan
        row = np.round(rows[:, self._time][:, 0] / self._model.control_period_s).astype(np.int64)
        torque = plan.torque[np.clip(row, 0, plan.num_steps)]
        return BoundPlannedTorque(torque, rows[:, self._reference], self._gravity.at(rows))


@dataclass(frozen=True)
class BoundPlannedTorque:
    """Torque of a planned control step; `inverse_dynamics` as that of a `RigidBody`."""

    torque: Array
    q_ref: Array
    gravity: LegTorque

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:  # noqa: ARG002  the interface's
        """Torque at joint angles near the reference, (num_worlds, 12) [rad] to [N·m]."""
        if np.array_equal(q, self.q_ref):
            return self.torque
        return self.torque + (self.gravity.gravity_torque(q) - self.gravity.gravity_torque(self.q_ref))


def _block_diagonal(blocks: Array) -> Array:
    """(..., L, J, J) to (..., L J, L J)."""
    L, J = blocks.shape[-3:-1]
    full = np.zeros((*blocks.shape[:-3], L * J, L * J))
    for leg in range(L):
        full[..., leg * J : (leg + 1) * J, leg * J : (leg + 1) * J] = blocks[..., leg, :, :]
    return full
