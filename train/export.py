"""Trained SB3 models as residual folders: weights that a NumPy forward pass reads, without torch."""

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from elastic_env.errors import ConfigurationError

Tensors = dict[str, npt.NDArray[Any]]


def network_of(model: BaseAlgorithm, normaliser: Any | None) -> tuple[Tensors, str, Literal["clip", "tanh"]]:
    """Weights, activation and output of the network that a model acts by deterministically.

    Args:
        model: With an actor as PPO and A2C have it, or as SAC and TQC have it.
        normaliser: The `VecNormalize` of its observations; None for none.

    Raises:
        ConfigurationError: An actor of another kind.
    """
    policy: Any = model.policy
    if hasattr(policy, "mlp_extractor") and hasattr(policy, "action_net"):
        layers, output = [*policy.mlp_extractor.policy_net, policy.action_net], "clip"
    elif hasattr(policy, "actor") and hasattr(policy.actor, "latent_pi"):
        layers, output = [*policy.actor.latent_pi, policy.actor.mu], "tanh"
    else:
        raise ConfigurationError(f"a policy of {type(model).__name__} cannot be exported; use PPO, A2C, SAC or TQC")
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    activations = {type(layer) for layer in layers if not isinstance(layer, nn.Linear)}
    names = {nn.Tanh: "tanh", nn.ReLU: "relu"}
    if len(activations) != 1 or not activations <= set(names):
        raise ConfigurationError(f"activations must be all Tanh or all ReLU, got {sorted(map(str, activations))}")
    tensors: Tensors = {}
    for i, layer in enumerate(linear):
        tensors[f"weight{i}"] = layer.weight.detach().cpu().numpy().astype(np.float32)
        tensors[f"bias{i}"] = layer.bias.detach().cpu().numpy().astype(np.float32)
    features = tensors["weight0"].shape[1]
    tensors |= {"mean": np.zeros(features), "std": np.ones(features)}
    if normaliser is not None:
        tensors["mean"] = normaliser.obs_rms.mean.copy()
        tensors["std"] = np.sqrt(normaliser.obs_rms.var + normaliser.epsilon)
    return tensors, names[activations.pop()], output  # type: ignore[return-value]
