r"""By how much each joint bends more than its model, from sensors of the deflection.

The measured foot wrenches and the assumed model give the deflection to expect, :math:`h = K^{-1}
(\tau + \tau_F)`. The Coulomb friction :math:`\tau_F` turns round over a short displacement of the
link [Dahl1968]. Sensors show

.. math:: \delta = (1 + r) h + c

with c for homing errors. This is linear regression of δ − h on h, joint by joint, after every
measurement. Its prior says that the joints of a robot are alike: :math:`r \sim N(0, \sigma_c^2
\mathbf{1}\mathbf{1}^T + \sigma_i^2 I)`, so that joints without load take after the others
[Gelman2013, chapter 15]. The normal matrix is diagonal but for one rank, which the matrix inversion
lemma solves in closed form.

[Dahl1968] P. R. Dahl, "A Solid Friction Model", The Aerospace Corporation, TOR-0158(3107-18)-1.
[Gelman2013] A. Gelman et al., "Bayesian Data Analysis", 3rd edition.
"""

from typing import NamedTuple

import numpy as np

from baselines.compensation.dry_friction import presliding_friction
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.robot_model import RobotModel


class StiffnessPrior(Model):
    """Knowledge of the joints before they are measured, as standard deviations."""

    common: float = quantity("1", 0.5, gt=0)
    """Relative error that all joints share [1]."""
    own: float = quantity("1", 0.1, gt=0)
    """Relative error of a joint beside it [1]."""
    offset_rad: float = quantity("rad", 0.002, gt=0)
    """Offset of a measured deflection [rad]."""
    noise_rad: float = quantity("rad", 0.01, gt=0)
    """Model error of a measured deflection [rad]."""


def regress(sums: Array, prior: StiffnessPrior) -> Array:
    """Relative errors r of the joints by the regression of the module.

    Args:
        sums: Number of measurements, and sums of h, h², y = δ − h, and h y of each joint, (5, ...,
            n), with h in [rad].
        prior: Standard deviations.

    Returns:
        (..., n) [1].
    """
    number, h, hh, y, hy = sums
    counted = number + (prior.noise_rad / prior.offset_rad) ** 2  # c is eliminated
    information = (hh - h * h / counted) / prior.noise_rad**2
    right = (hy - h * y / counted) / prior.noise_rad**2
    own = prior.own**2
    common = prior.common**2
    n = h.shape[-1]
    diagonal = 1.0 / own + information
    rank_one = common / (own * (own + n * common))
    alone = right / diagonal
    shared = rank_one / diagonal
    return alone + shared * (alone.sum(axis=-1) / (1.0 - shared.sum(axis=-1)))[..., None]


class RegressionMemory(NamedTuple):
    """Memory of the regression.

    Attributes:
        friction: That holds the links back, (num_worlds, n) [N·m].
        q: Link angles of the last measurement, (num_worlds, n) [rad].
        sums: As of `regress`, (num_worlds, 5, n).
    """

    friction: Array
    q: Array
    sums: Array


class StiffnessRegression:
    """The regression of the module, measurement by measurement.

    Args:
        model: Assumed robot.
        prior: What is known before.

    Raises:
        ConfigurationError: Friction changes with load or speed.
    """

    def __init__(self, model: RobotModel, prior: StiffnessPrior) -> None:
        self._prior = prior
        model.require_constant_friction("the estimate of the stiffness")
        self._coulomb = model.coulomb_friction

    def begin(self, num_worlds: int) -> RegressionMemory:
        """Memory before the first measurement."""
        zero = np.zeros((num_worlds, len(self._coulomb)))
        return RegressionMemory(zero, zero, np.stack([zero] * 5, axis=1))

    def friction(self, q: Array, memory: RegressionMemory) -> Array:
        """Coulomb friction of links that have moved to q, (num_worlds, n) [rad] to [N·m]."""
        moved = np.where(memory.sums[:, 0] > 0.0, q - memory.q, 0.0)
        return presliding_friction(memory.friction, moved, self._coulomb)

    def add(
        self,
        h: Array,
        deflection: Array,
        friction: Array,
        q: Array,
        memory: RegressionMemory,
        measured: BoolArray,
    ) -> tuple[Array, RegressionMemory]:
        """Relative errors r after a measurement, (num_worlds, n) [1], and the new memory.

        Args:
            h: Expected deflection, (num_worlds, n) [rad].
            deflection: Measured deflection [rad].
            friction: As of `friction` [N·m].
            q: Link angles [rad].
            memory: That of the last measurement.
            measured: Which joints have a sensor, (n,).
        """
        y = deflection - h
        own = np.stack([np.ones_like(h), h, h * h, y, h * y], axis=1)
        sums = memory.sums + measured * own
        error = regress(sums.swapaxes(0, 1), self._prior)
        return error, RegressionMemory(friction, q, sums)
