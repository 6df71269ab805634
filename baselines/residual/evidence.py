r"""How far a walk shows that the model is wrong, and with it how far a cautious residual may act.

Where the model is right there is nothing to correct, and whatever a residual does there does harm:
it moves the feet by a millimeter per step, and the ZMP with them. So a cautious one acts in
proportion to what speaks against the model: the relative error ρ of its stiffness in roll, as the
bending shows it on either leg, with the uncertainty u that is left
(`baselines.estimation.bending`), and the mean excess μ of the load over the assumed weight,

.. math:: E = \overline{\rho^2 / (\sigma_\rho^2 + (2 u)^2)} + (\mu / \sigma_\mu)^2, \qquad g = E^2 / (1 + E^2)

Well below σ the base is left alone, well above it the residual is free. An uncertain error is
measured by two of its standard deviations: friction bends the joints of a leg that has not carried
the robot yet, too. Pitch does not count, where friction hides more of the bending than a small
error would show.
"""  # noqa: E501

from typing import Any

import numpy as np

from baselines.adaptation.estimators import LegEstimator
from baselines.estimation.bending import BendingObserver
from elastic_env.core.signals import Array, SignalTable
from elastic_env.world.robot_model import WalkerModel

ERROR_SCALE = 0.1
LOAD_SCALE = 0.05
"""σ_ρ and σ_μ [1]: between what a right model shows in a walk, and errors that matter."""
PRIOR_S = 0.5
"""Time for which the assumed load counts in the mean [s]: a robot that steps presses with more
and with less.
"""

_SEEN = SignalTable(BendingObserver.signals)
_ERROR = _SEEN.columns("model_error.l_roll", "model_error.r_roll")
_UNCERTAINTY = _SEEN.columns("uncertainty.l_roll", "uncertainty.r_roll")


class Evidence:
    """The evidence g, from 0 to 1, from the observations of a walker.

    Args:
        model: Assumed walker.
        period_s: Time between two measurements [s].
    """

    def __init__(self, model: WalkerModel, period_s: float) -> None:
        self._legs = LegEstimator(model, prior_loads=PRIOR_S / period_s)
        self.begin = self._legs.begin
        """Memory before the first measurement, by the number of worlds."""

    def observe(self, rows: Array, memory: Any) -> tuple[Array, Any]:
        """Evidence after a measurement, (num_worlds, m) to (num_worlds, 1), and the new memory."""
        seen, load, memory = self._legs.observe(rows, memory)
        g = evidence(seen[:, _ERROR], seen[:, _UNCERTAINTY], load[:, 0])
        return g[:, None], memory


def evidence(model_error: Array, uncertainty: Array, excess_load: Array) -> Array:
    """g, (...), from ρ of the legs and its error, (..., 2), and the mean load μ, (...) [1]."""
    bending = model_error**2 / (ERROR_SCALE**2 + (2.0 * uncertainty) ** 2)
    squared = (np.mean(bending, axis=-1) + (excess_load / LOAD_SCALE) ** 2) ** 2
    return squared / (1.0 + squared)
