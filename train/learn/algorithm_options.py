"""Options of the learning algorithms, with their bounds and meanings.

A number beyond its bound would become nan or fill the memory during a training, so it is refused
before.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from elastic_env.core.config import Model, quantity

CONSTANTS = "CMA-ES"
"""Algorithm that searches constants instead of training a network."""

_SET_BY_TRAINING = {
    "policy": "the network is an MlpPolicy; policy_kwargs has its parameters",
    "env": "the configuration's env and scenarios name the worlds",
    "device": "training runs on the CPU, so that a resumed run ends with the same weights",
    "seed": "the configuration's seeds are the training seeds",
    "verbose": "elastic train shows the progress",
    "tensorboard_log": "TensorBoard's files go to the folder of the training seed",
    "_init_setup_model": "the model is built whole",
}
"""Arguments of the algorithms that are no options, and what is used instead."""

_LARGEST_WEIGHT = 1e3

_Width = Annotated[int, Field(ge=1, le=4096)]
_Widths = Annotated[list[_Width], Field(max_length=16)]
"""Widths of the hidden layers of a network."""


class _ActorAndValue(Model):
    pi: _Widths
    vf: _Widths


class _ActorAndCritics(Model):
    pi: _Widths
    qf: _Widths


_Auto = Annotated[str, Field(pattern=r"^auto(_|_[0-9]{1,3}(\.[0-9]{1,9})?)?$")]


class _Options(Model):
    """Options that every algorithm has."""

    learning_rate: float = quantity("1", 5e-4, gt=0, le=1)
    """Step of the optimiser."""
    gamma: float = quantity("1", 0.95, ge=0, le=1)
    """Discount of the reward per decision."""
    stats_window_size: int = quantity("1", 100, ge=1, le=10**6)
    """Episodes in a mean of TensorBoard's."""

    @model_validator(mode="before")
    @classmethod
    def _refuse_set_by_training(cls, values: Any) -> Any:
        cures = [f"leave out {n!r}: {text}" for n, text in _SET_BY_TRAINING.items() if n in values]
        if cures:
            raise ValueError("; ".join(cures))
        return values


class _NetworkOptions(Model):
    """Parameters of a network, `policy_kwargs`."""

    activation_fn: Literal["Tanh", "ReLU"] = "Tanh"
    log_std_init: float = quantity("1", -1.0, ge=-20, le=2)
    """Logarithm of the first standard deviation of the residual, which is in ±1."""
    use_expln: bool = False
    share_features_extractor: bool = False
    optimizer_kwargs: dict[str, Any] | None = None


class _ActorCriticNetwork(_NetworkOptions):
    """Parameters of the network of PPO and A2C."""

    net_arch: _Widths | _ActorAndValue = [64, 64]
    """Widths of the hidden layers of both networks, or of actor (pi) and value (vf)."""
    share_features_extractor: bool = True
    ortho_init: bool = True
    full_std: bool = True
    squash_output: bool = False


class _SACNetwork(_NetworkOptions):
    """Parameters of the networks of SAC."""

    net_arch: _Widths | _ActorAndCritics = _ActorAndCritics(pi=[64, 64], qf=[256, 256])
    """Widths of the hidden layers of both networks, or of actor (pi) and critics (qf)."""
    activation_fn: Literal["Tanh", "ReLU"] = "ReLU"
    log_std_init: float = quantity("1", -3.0, ge=-20, le=2)
    clip_mean: float = quantity("1", 2.0, ge=0, le=100)
    """Bound of the mean before tanh."""
    n_critics: int = quantity("1", 2, ge=1, le=16)
    """Number of critics."""


class _OnPolicy(_Options):
    """Options of PPO and A2C."""

    n_steps: int = quantity("1", 32, ge=1, le=100_000)
    """Decisions of every world between updates."""
    gae_lambda: float = quantity("1", 0.95, ge=0, le=1)
    """Weight of later advantages."""
    ent_coef: float = quantity("1", 0.0, ge=0, le=_LARGEST_WEIGHT)
    """Weight of the entropy in the loss."""
    vf_coef: float = quantity("1", 0.5, ge=0, le=_LARGEST_WEIGHT)
    """Weight of the value in the loss."""
    max_grad_norm: float = quantity("1", 0.5, gt=0, le=1e6)
    """Bound of the gradient's norm."""
    normalize_advantage: bool = True
    use_sde: bool = False
    sde_sample_freq: int = quantity("1", -1, ge=-1, le=10**6)
    """Decisions between draws of the noise."""
    policy_kwargs: _ActorCriticNetwork = _ActorCriticNetwork()


class _PPO(_OnPolicy):
    """Options of PPO."""

    batch_size: int = quantity("1", 512, ge=2, le=10**7)
    """Decisions in a minibatch."""
    n_epochs: int = quantity("1", 10, ge=1, le=1000)
    """Passes over the decisions in an update."""
    clip_range: float = quantity("1", 0.2, gt=0, le=10)
    """Bound of the policy's ratio, about 1."""
    clip_range_vf: float | None = quantity("1", None, gt=0, le=1e6)
    """Bound of a value's change."""
    target_kl: float | None = quantity("1", None, gt=0, le=1e3)
    """Divergence that ends an update."""


class _A2C(_OnPolicy):
    """Options of A2C; the defaults of stable_baselines3 apply instead of these."""

    rms_prop_eps: float = quantity("1", 1e-5, ge=1e-12, le=1)
    """Smallest divisor of the optimiser."""
    use_rms_prop: bool = True


class _SAC(_Options):
    """Options of SAC."""

    ent_coef: _Auto | Annotated[float, Field(ge=0, le=_LARGEST_WEIGHT)] = "auto"
    """Weight of the entropy, at most 1000; auto to learn it, auto_0.1 to begin at 0.1."""
    batch_size: int = quantity("1", 512, ge=1, le=10**7)
    """Decisions in a minibatch."""
    buffer_size: int = quantity("1", 200_000, ge=1, le=10**7)
    """Decisions in the replay buffer."""
    learning_starts: int = quantity("1", 2_000, ge=0, le=10**9)
    """Decisions before the first update."""
    train_freq: int = quantity("1", 4, ge=1, le=10**6)
    """Decisions of every world between updates."""
    gradient_steps: int = quantity("1", 8, ge=-1, le=10_000)
    """Steps of an update; -1: one per decision."""
    tau: float = quantity("1", 0.005, ge=0, le=1)
    """Share of the critic in a change of its target."""
    target_update_interval: int = quantity("1", 1, ge=1, le=10**6)
    """Steps between changes of the target."""
    target_entropy: Literal["auto"] | Annotated[float, Field(ge=-1e6, le=1e6)] = "auto"
    """Target of the entropy for a learned weight."""
    n_steps: int = quantity("1", 1, ge=1, le=1000)
    """Decisions of a return."""
    policy_kwargs: _SACNetwork = _SACNetwork()


class _CMAES(Model):
    """Options of the search for residuals that never change."""

    population_size: int = quantity("1", 16, ge=2, le=100_000)
    """Candidates of a generation."""
    sigma: float = quantity("1", 0.3, gt=0, le=2)
    """First standard deviation of the residual in ±1."""


class _UserOptions(_Options, extra="allow"):
    """Options of a user's class, which itself checks those that are not among these."""


MODELS = {"A2C": _A2C, "PPO": _PPO, "SAC": _SAC, CONSTANTS: _CMAES}
"""Options by the name of the algorithm."""


def validate_options(algorithm: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Check the options of an algorithm, and return them without adding defaults.

    Raises:
        ModelError: One does not exist, is set by the training itself, or is beyond its bound.
    """
    return MODELS.get(algorithm, _UserOptions)(**options).model_dump(exclude_unset=True)


def complete_options(algorithm: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Add our defaults to the options of an algorithm; A2C and a user's class keep their own."""
    if algorithm not in ("PPO", "SAC", CONSTANTS):
        return dict(options)
    return MODELS[algorithm](**options).model_dump()
