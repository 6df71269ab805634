r"""How far a walk shows that the model is wrong, and with it how far a cautious residual may act.

Where the model is right there is nothing to correct, and whatever a residual does there does harm: it moves the feet
by a millimeter per step, and the ZMP with them. So a cautious one acts in proportion to what speaks against the model:
the relative error ρ of its stiffness in roll, as the bending shows it on either leg, with the uncertainty u that is
left (`baselines.estimation.bending`), and the mean excess μ of the load over the assumed weight,

.. math:: E = \overline{\rho^2 / (\sigma_\rho^2 + (2 u)^2)} + (\mu / \sigma_\mu)^2, \qquad g = E^2 / (1 + E^2)

Well below σ the base is left alone, well above it the residual is free. An uncertain error is measured by two of its
standard deviations: friction bends the joints of a leg that has not carried the robot yet, too. Pitch does not count,
where friction hides more of the bending than a small error would show.
"""

import numpy as np

from baselines.estimation.bending import BendingObserver
from baselines.residual.correction import Corrected
from elastic_env.core.signals import Array, SignalTable
from elastic_env.runtime.robot_model import WalkerModel

ERROR_SCALE, LOAD_SCALE = 0.1, 0.05
"""σ_ρ and σ_μ [1]: between what a right model shows in a walk, and errors that matter."""
PRIOR_S = 0.5
"""Time for which the assumed load counts in the mean [s]: a robot that steps presses with more and with less."""

_SEEN = SignalTable(BendingObserver.signals)
_ERROR, _UNCERTAINTY = (_SEEN.columns(f"{group}.l_roll", f"{group}.r_roll") for group in ("model_error", "uncertainty"))
_LOAD = _SEEN.names.index("excess_load")


class Evidence:
    """The evidence g, from 0 to 1, from the observations of a walker.

    Memory per world: number of measurements, the sum of their excess loads, then that of the observer.

    Args:
        model: Assumed walker.
        period_s: Time between two measurements [s].
    """

    def __init__(self, model: WalkerModel, period_s: float) -> None:
        self._bending, self._prior = BendingObserver(model), PRIOR_S / period_s
        self.memory_width = 2 + self._bending.memory_width

    def begin(self, num_worlds: int) -> Array:
        """Memory before the first measurement, (num_worlds, memory_width)."""
        return np.hstack([np.zeros((num_worlds, 2)), self._bending.begin(num_worlds)])

    def observe(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """Evidence after a measurement, (num_worlds, m) to (num_worlds, 1), and the new memory."""
        seen, kept = self._bending.observe(rows, memory[:, 2:])
        load = memory[:, :2] + np.column_stack([np.ones(len(rows)), seen[:, _LOAD]])
        excess_load = load[:, 1] / (self._prior + load[:, 0])
        g = evidence(seen[:, _ERROR], seen[:, _UNCERTAINTY], excess_load)
        return g[:, None], np.hstack([load, kept])


class Unreserved:
    """Caution that lets everything pass; see `Evidence`."""

    memory_width = 0

    def begin(self, num_worlds: int) -> Array:
        """No memory, (num_worlds, 0)."""
        return np.zeros((num_worlds, 0))

    def observe(self, rows: Array, memory: Array) -> tuple[Array, Array]:
        """Ones, (num_worlds, 1)."""
        return np.ones((len(rows), 1)), memory


def caution(corrected: Corrected) -> Evidence | Unreserved:
    """What says how far a residual may act."""
    model, settings = corrected.model, corrected.settings
    if settings.cautious and isinstance(model, WalkerModel):  # `Corrected` refuses it for other robots
        return Evidence(model, settings.decision_period * model.control_period_s)
    return Unreserved()


def evidence(model_error: Array, uncertainty: Array, excess_load: Array) -> Array:
    """g, (...), from ρ of the legs and its uncertainty, (..., 2), and the mean excess μ of the load, (...) [1]."""
    bending = model_error**2 / (ERROR_SCALE**2 + (2.0 * uncertainty) ** 2)
    squared = (np.mean(bending, axis=-1) + (excess_load / LOAD_SCALE) ** 2) ** 2
    return squared / (1.0 + squared)
