r"""By how much each joint bends more than its model, from sensors of the deflection.

The measured foot wrenches and the assumed model give the deflection to expect, :math:`h = K^{-1} (\tau + \tau_F)`. The
Coulomb friction :math:`\tau_F` turns round over a short displacement of the link [Dahl1968]. Sensors show

.. math:: \delta = (1 + r) h + c

with c for homing errors. This is linear regression of δ − h on h, joint by joint, after every measurement. Its prior
says that the joints of a robot are alike: :math:`r \sim N(0, \sigma_c^2 \mathbf{1}\mathbf{1}^T + \sigma_i^2 I)`, so
that joints without load take after the others [Gelman2013, chapter 15]. The normal matrix is diagonal but for one rank,
which the matrix inversion lemma solves in closed form.

[Dahl1968] P. R. Dahl, "A Solid Friction Model", The Aerospace Corporation, TOR-0158(3107-18)-1.
[Gelman2013] A. Gelman et al., "Bayesian Data Analysis", 3rd edition.
"""

import numpy as np

from baselines.compensation.compensators import GravityCompensator, presliding_friction
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray
from elastic_env.runtime.robot_model import WalkerModel


class StiffnessPrior(Model):
    """What is known of the joints before they are measured, as standard deviations."""

    common: float = quantity("1", 0.5, gt=0, description="relative error that all joints share")
    own: float = quantity("1", 0.1, gt=0, description="relative error of a joint beside it")
    offset_rad: float = quantity("rad", 0.002, gt=0, description="offset of a measured deflection")
    noise_rad: float = quantity("rad", 0.01, gt=0, description="model error of a measured deflection")


def regressed(sums: Array, prior: StiffnessPrior) -> Array:
    """Relative errors r of the joints by the regression of the module.

    Args:
        sums: Number of measurements, and sums of h, h², y = δ − h, and h y of each joint, (5, ..., n), with h in [rad].
        prior: Standard deviations.

    Returns:
        (..., n) [1].
    """
    number, h, hh, y, hy = sums
    counted = number + (prior.noise_rad / prior.offset_rad) ** 2  # c is eliminated
    information = (hh - h * h / counted) / prior.noise_rad**2
    right = (hy - h * y / counted) / prior.noise_rad**2
    own, common, n = prior.own**2, prior.common**2, h.shape[-1]
    diagonal = 1.0 / own + information
    rank_one = common / (own * (own + n * common))
    alone, shared = right / diagonal, rank_one / diagonal
    return alone + shared * (alone.sum(axis=-1) / (1.0 - shared.sum(axis=-1)))[..., None]


class JointStiffnessObserver:
    """Relative errors of the joints' deflections from measured ones, see the module.

    Memory per world and joint: friction, last link angle, sums of the regression.

    Args:
        model: Assumed walker.
        prior: What is known before.
    """

    def __init__(self, model: WalkerModel, prior: StiffnessPrior | None = None) -> None:
        self._prior, self._n = prior or StiffnessPrior(), len(model.joint_names)
        self._compensator = GravityCompensator(model, output="wrench")
        self._theta = model.observation_table.group("encoder_angle")
        self._coulomb, self._stiffness = model.coulomb_friction, model.stiffness
        self.memory_width = 7 * self._n

    def begin(self, num_worlds: int) -> Array:
        """Memory before the first measurement, (num_worlds, memory_width)."""
        return np.zeros((num_worlds, self.memory_width))

    def observe(self, rows: Array, deflection: Array, measured: BoolArray, memory: Array) -> tuple[Array, Array]:
        """Relative errors r after a measurement, (num_worlds, n) [1], and the new memory.

        Args:
            rows: Observations, (num_worlds, m).
            deflection: Measured δ = θ − q, (num_worlds, n) [rad].
            measured: Which joints have a sensor, (n,).
            memory: (num_worlds, memory_width).
        """
        friction, last, *sums = memory.reshape(len(rows), 7, self._n).swapaxes(0, 1)
        theta = rows[:, self._theta]
        q = theta - deflection
        moved = np.where(sums[0] > 0.0, q - last, 0.0)
        friction = presliding_friction(friction, moved, self._coulomb)
        h = theta - self._compensator.at(rows).link_angle(theta, theta) + friction / self._stiffness
        y = deflection - h
        new = np.stack(sums) + measured * np.stack([np.ones_like(h), h, h * h, y, h * y])
        kept = np.concatenate([friction[None], q[None], new]).swapaxes(0, 1).reshape(memory.shape)
        return regressed(new, self._prior), kept
