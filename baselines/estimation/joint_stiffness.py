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

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array


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
    common = alone.sum(axis=-1) / (1.0 - shared.sum(axis=-1))
    return alone + shared * common[..., None]
