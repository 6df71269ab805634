r"""Model error of a walker's bending joints, from the disagreement of motors and IMU.

A sole lies flat on the ground. By the motors' angles θ and the attitude of the IMU it seems to be
tilted: by the bending of the joints of its leg, δ = θ − q about their axes z, and by a constant c
of the tilt of the ground and the errors of homing and mounting,

.. math:: e = \sum_j z_j \delta_j + c

The model and the measured foot wrenches give the expected bending, s = Σ z_j K⁻¹τ_j. With a common
relative error ρ of that leg's model, e = (1 + ρ) s + c. Bending changes with the load and c does
not. So recursive least squares over the time that a foot is loaded separate ρ from c, for roll and
pitch of each leg [Kalman1960, without drift].

[Kalman1960] R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", J. Basic
Eng. 82.
"""

import math
from typing import Any

import numpy as np

from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.compiled_rows import Records
from baselines.compensation.policy import WalkView
from elastic_env.core.compiled import compiled, compiled_part, record_type
from elastic_env.core.signals import Array, Signal
from elastic_env.world.robot_model import WalkerModel

LOADED_SHARE = 0.15
"""Share of the weight from which on a foot counts as loaded, and flat on the ground."""
MODEL_ERROR = 0.3
OFFSET_RAD = 0.02
DISAGREEMENT_RAD = 0.002
"""Standard deviations before the first measurement, of ρ and c, and of a measurement."""

_UNKNOWNS = 2  # ρ and c
_FILTERS = tuple(f".{side}_{axis}" for side in "lr" for axis in ("roll", "pitch"))
_PRIOR: Array = np.diag([MODEL_ERROR, OFFSET_RAD])[np.triu_indices(_UNKNOWNS)] ** 2
"""Upper triangle of the covariance before the first measurement."""

ESTIMATE = record_type(
    unknowns=(2, 2, 2),  # legs, roll and pitch: ρ [1] and c [rad]
    covariance=(2, 2, 3),  # its upper triangle
)
"""Estimates of a robot's legs."""


class BendingObserver:
    """Estimates of the model's error from a walker's observations; memory: rows of `ESTIMATE`.

    Args:
        model: Assumed walker.

    Attributes:
        carried: Force that the feet carry [N].
    """

    signals = tuple(
        Signal(f"{name}{filtered}", "1", meaning, mirrored="same")
        for name, meaning, filters in (
            ("model_error", "relative error ρ of a leg's model", _FILTERS),
            ("uncertainty", "its standard deviation", _FILTERS),
            ("excess_load", "measured over assumed load, less one", ("",)),
        )
        for filtered in filters
    )
    """Values of `observe`."""

    def __init__(self, model: WalkerModel) -> None:
        self._model = model
        self._compensator = GravityCompensator(model, output="wrench")
        table = model.observation_table
        self._theta = table.group("encoder_angle")
        self._attitude = table.group("imu_attitude")
        self._view = WalkView(table)
        self.carried = model.biped.chains_above_feet.mass * model.biped.gravity

    def begin(self, num_worlds: int) -> Records:
        """Memory before the first measurement, (num_worlds,)."""
        memory = np.zeros(num_worlds, ESTIMATE)
        memory["covariance"] = _PRIOR
        return memory

    def observe(
        self, rows: Array, memory: Records, bending: Array | None = None
    ) -> tuple[Array, Records]:
        """Estimates after a measurement, see `signals`, and the new memory.

        Args:
            rows: Observations, (num_worlds, m).
            memory: Rows of `ESTIMATE`, (num_worlds,).
            bending: Bending of the joints by the model, (num_worlds, 12) [rad]; None for the
                bending under the foot wrenches.
        """
        if bending is None:
            bending = self.bending(rows)
        measured, expected = self.disagreement(rows, bending)
        memory = memory.copy()
        estimates = np.empty((len(rows), len(self.signals)))
        observations = self._view.fields(rows)
        regress(observations, measured, expected, self.carried, memory, estimates)
        return estimates, memory

    def bending(self, rows: Array) -> Array:
        """Expected bending under the measured foot wrenches, δ = θ − q, (num_worlds, 12) [rad]."""
        theta = rows[:, self._theta]
        return theta - self._compensator.at(rows).link_angle(theta)

    def expected_tilt(self, rows: Array) -> Array:
        """Tilt of the pelvis over each flat foot by bending, s, (num_worlds, 2, 2) [rad]."""
        return self.disagreement(rows, self.bending(rows))[1]

    def disagreement(self, rows: Array, bending: Array) -> Array:
        """Tilt of a flat foot's sole by motors and IMU, e, and the expected bending, s.

        Args:
            rows: Observations, (num_worlds, m).
            bending: Bending of the joints, (num_worlds, 12) [rad].

        Returns:
            Both, (2, num_worlds, 2 legs, 2), roll and pitch [rad].
        """
        chains = self._model.biped.chains
        return chains.sole_tilts(rows[:, self._theta], rows[:, self._attitude], bending)


@compiled
def regress(
    observations: Any,
    measured: Array,
    expected: Array,
    carried_n: float,
    memory: Any,
    estimates: Array,
) -> None:
    """Update estimates by recursive least squares for measured − expected = ρ · expected + c.

    Only loaded feet count.

    Args:
        observations: Rows with fields.
        measured: Tilts of the soles by motors and IMU, (n, 2, 2) [rad].
        expected: Tilts by the expected bending, (n, 2, 2) [rad].
        carried_n: Force that the feet carry [N].
        memory: Rows of `ESTIMATE`, to be updated, (n,).
        estimates: To be filled, (n, 9): ρ of legs and axes, their standard deviations, measured
            over assumed load less one.
    """
    for world in range(len(estimates)):
        load = 0.0
        for leg in range(2):
            force = observations[world].wrench[leg, 0, 2]
            load += force
            for axis in range(2):
                x = memory[world].unknowns[leg, axis]
                P = memory[world].covariance[leg, axis]
                if force >= LOADED_SHARE * carried_n:
                    at = (world, leg, axis)
                    update(x, P, expected[at], measured[at], DISAGREEMENT_RAD)
                estimates[world, 2 * leg + axis] = x[0]
                estimates[world, 4 + 2 * leg + axis] = math.sqrt(P[0])
        estimates[world, 8] = load / carried_n - 1.0


@compiled_part
def update(x: Array, P: Array, expected: float, measured: float, sigma: float) -> None:
    """Update by a measurement of (expected, 1) · x = measured − expected, of deviation sigma."""
    first = P[0] * expected + P[1]
    second = P[1] * expected + P[2]
    variance = (expected * first + second) + sigma**2
    error = (measured - expected) - (expected * x[0] + x[1])
    gain = first / variance
    second_gain = second / variance
    x[0] += gain * error
    x[1] += second_gain * error
    P[0] -= gain * first
    P[1] -= gain * second
    P[2] -= second_gain * second
