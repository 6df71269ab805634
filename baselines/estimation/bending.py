r"""How much more a walker's joints bend than the model says, from what their motors and the IMU disagree on.

A sole lies flat on the ground. By the motors' angles θ and the attitude of the IMU it seems to be tilted: by what the
joints of its leg bend, δ = θ − q about their axes z, and by what never changes, the tilt of the ground and the errors
of homing and of the mounting,

.. math:: e = \sum_j z_j \delta_j + c

The model and the measured foot wrenches say how much bending to expect, s = Σ z_j K⁻¹τ_j. With a common relative error
ρ of that leg's model, e = (1 + ρ) s + c. Bending comes and goes with the load and c does not, so that recursive least
squares over the time that a foot is loaded tell ρ from c, for roll and pitch of each leg [Kalman1960, without drift].

[Kalman1960] R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", J. Basic Eng. 82.
"""

import numpy as np

from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.observed import ObservedWalk
from baselines.estimation.estimation_kernels import ESTIMATE, regress
from elastic_env.core.signals import Array, Signal
from elastic_env.dynamics.leg_kernels import sole_tilts
from elastic_env.runtime.robot_model import WalkerModel

LOADED_SHARE = 0.15
"""Share of the weight from which an estimate takes a foot for loaded, and flat on the ground."""
MODEL_ERROR, OFFSET_RAD, DISAGREEMENT_RAD = 0.3, 0.02, 0.002
"""Standard deviations before the first measurement, of ρ and c, and of a measurement."""

_UNKNOWNS = 2  # ρ and c
_SHAPE = (2, 2)  # legs, roll and pitch
_FILTERS = tuple(f".{side}_{axis}" for side in "lr" for axis in ("roll", "pitch"))
_VARIANCES = 12  # per world: (legs, axes, upper triangle)
_PRIOR: Array = np.tile(np.diag([MODEL_ERROR, OFFSET_RAD])[np.triu_indices(_UNKNOWNS)] ** 2, 4)
"""The variances before the first measurement."""


class BendingObserver:
    """Estimates of the model's error, from the observations of a walker.

    Memory per world: estimates of ρ and c, and their covariance.

    Args:
        model: Assumed walker.
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
    """What `observe` returns."""
    memory_width = ESTIMATE.itemsize // 8

    def __init__(self, model: WalkerModel) -> None:
        self._model, self._compensator = model, GravityCompensator(model, output="wrench")
        table = model.observation_table
        self._theta, self._attitude = table.group("encoder_angle"), table.group("imu_attitude")
        self._observed = ObservedWalk(table)
        self._carried = model.biped.chains_above_feet.mass * model.biped.gravity

    def begin(self, num_worlds: int) -> Array:
        """Memory before the first measurement, (num_worlds, memory_width)."""
        memory = np.zeros((num_worlds, self.memory_width))
        memory[:, -_VARIANCES:] = _PRIOR
        return memory

    def observe(self, rows: Array, memory: Array, bending: Array | None = None) -> tuple[Array, Array]:
        """Estimates after a measurement, see `signals`, and the new memory.

        Args:
            rows: Observations, (num_worlds, m).
            memory: (num_worlds, memory_width).
            bending: Of the joints as the model has it, (num_worlds, 12) [rad]; None for that under the foot wrenches.
        """
        seen, expected = self.disagreement(rows, self.bending(rows) if bending is None else bending)
        kept, found = np.empty(memory.shape), np.empty((len(rows), len(self.signals)))
        before, now = (np.ndarray(len(rows), ESTIMATE, np.ascontiguousarray(part)) for part in (memory, kept))
        least = self._carried, LOADED_SHARE * self._carried, DISAGREEMENT_RAD
        regress(self._observed.fields(rows), (seen, expected), least, (before, now), found)
        return found, kept

    def bending(self, rows: Array) -> Array:
        """Expected bending of the joints under the measured foot wrenches, δ = θ − q, (num_worlds, 12) [rad]."""
        theta = rows[:, self._theta]
        return theta - self._compensator.at(rows).link_angle(theta, theta)

    def expected_tilt(self, rows: Array) -> Array:
        """By how much the bending tilts the pelvis over each foot if it is flat, s, (num_worlds, 2 legs, 2) [rad]."""
        return self.disagreement(rows, self.bending(rows))[1]

    def disagreement(self, rows: Array, bending: Array) -> tuple[Array, Array]:
        """Tilt of the soles as motors and IMU see it, e, and the bending that is expected, s; of a foot that is flat.

        Args:
            rows: Observations, (num_worlds, m).
            bending: Of the joints, (num_worlds, 12) [rad].

        Returns:
            (num_worlds, 2 legs, 2) each, roll and pitch [rad].
        """
        q, bent = (values.reshape(len(rows), 2, -1) for values in (rows[:, self._theta], bending))
        attitude = np.ascontiguousarray(rows[:, self._attitude])
        seen, expected = np.empty((2, len(rows), *_SHAPE))
        sole_tilts(self._model.biped.chains.axis, q, attitude, bent, seen, expected)
        return seen, expected
