"""Algorithms of SB3 by name, and export of their models to folders that play without torch."""

import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import stable_baselines3
from gymnasium.spaces.utils import flatdim
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from baselines.residual.residual_folder import save_residual
from elastic_env.core.errors import ConfigurationError, ElasticError, quote, shorten, unknown_name
from train.learn.algorithm_options import CONSTANTS
from train.learn.train_config import TrainConfig, joints_of, training_worlds
from train.runs.folders import provenance
from train.runs.user_code import named_object

Tensors = dict[str, npt.NDArray[Any]]


def algorithm_class(name: str) -> Any:
    """Class of an algorithm: A2C, PPO or SAC of SB3, "module:Class" or "FILE.py:Class".

    Raises:
        ConfigurationError: It does not exist.
    """
    if ":" in name:
        try:
            return named_object(name)
        except ConfigurationError as error:
            raise ConfigurationError(f"algorithm {name!r}: {error}") from error
    names = ("A2C", "PPO", "SAC")
    if name not in names:
        raise unknown_name("algorithm", name, [*names, CONSTANTS, "module:Class"])
    return getattr(stable_baselines3, name)


@contextmanager
def explain_option_errors(algorithm: str, options: Mapping[str, Any]) -> Iterator[None]:
    """Add algorithm and options to errors that it raises while it is built from them.

    Raises:
        ConfigurationError: The algorithm does not accept the options.
    """
    try:
        yield
    except (ElasticError, OSError):
        raise
    except Exception as error:
        raise ConfigurationError(
            f"{algorithm} cannot be built with algorithm_options"
            f" {quote(dict(options))}: {error or type(error).__name__}"
        ) from error


def network_of(model: BaseAlgorithm, normaliser: Any) -> tuple[Tensors, dict[str, Any]]:
    """Weights of a model's deterministic actor, and its activation and output function.

    Args:
        model: Model with an actor as in PPO and A2C, or as in SAC and TQC.
        normaliser: The `VecNormalize` of its observations; None without one.

    Raises:
        ConfigurationError: The actor is of another kind.
    """
    policy: Any = model.policy
    if hasattr(policy, "mlp_extractor") and hasattr(policy, "action_net"):
        layers = [*policy.mlp_extractor.policy_net, policy.action_net]
        output = "clip"
    elif hasattr(policy, "actor") and hasattr(policy.actor, "latent_pi"):
        layers = [*policy.actor.latent_pi, policy.actor.mu]
        output = "tanh"
    else:
        problem = f"a policy of {type(model).__name__} cannot be exported; use PPO, A2C, SAC or TQC"
        raise ConfigurationError(problem)
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    activations = {type(layer) for layer in layers if not isinstance(layer, nn.Linear)}
    names = {nn.Tanh: "tanh", nn.ReLU: "relu"}
    if len(activations) != 1 or not activations <= set(names):
        problem = f"activations must be all Tanh or all ReLU, got {sorted(map(str, activations))}"
        raise ConfigurationError(problem)
    tensors: Tensors = {}
    for i, layer in enumerate(linear):
        tensors[f"weight{i}"] = layer.weight.detach().cpu().numpy().astype(np.float32)
        tensors[f"bias{i}"] = layer.bias.detach().cpu().numpy().astype(np.float32)
    features = tensors["weight0"].shape[1]
    tensors |= {"mean": np.zeros(features), "std": np.ones(features)}
    if normaliser is not None:
        statistics = normaliser.obs_rms  # the actor's columns are the first ones
        tensors["mean"] = statistics.mean[:features].copy()
        tensors["std"] = np.sqrt(statistics.var[:features] + normaliser.epsilon)
    return tensors, {"activation": names[activations.pop()], "output": output}


def _require_widths(tensors: Tensors, config: TrainConfig) -> list[str]:
    """Check that a network has the widths of its residual; return the joints of the robot."""
    worlds = training_worlds(config, [(config.scenarios[0], 1)], 1)
    num_features = worlds.actor_features
    num_residuals = flatdim(worlds.single_action_space)
    joints = joints_of(worlds)
    worlds.close()
    layers = sum(name.startswith("bias") for name in tensors)
    widths = tensors["weight0"].shape[1], len(tensors[f"bias{layers - 1}"])
    if widths != (num_features, num_residuals):
        raise ConfigurationError(
            f"the model takes {widths[0]} features and gives {widths[1]} residuals, a"
            f" residual on {config.base} of the {config.env} with these settings sees"
            f" {num_features} and gives {num_residuals}"
        )
    return joints


def export_zip(
    path: Path,
    config: TrainConfig,
    output: Path,
    normaliser: Path | None = None,
    trust_pickle: bool = False,
) -> Path:
    """Export a model that SB3 saved to a residual folder.

    Args:
        path: Zip of `model.save`.
        config: Configuration of the training: algorithm, base, settings and clip of the policy.
        output: Folder to write.
        normaliser: File of `VecNormalize.save`; None if observations were not normalised.
        trust_pickle: True to load both files, which are pickles: loading runs code from them.

    Raises:
        ConfigurationError: The model is a teacher, its pickles are not trusted, it is missing, or
            it does not fit the configuration.
    """
    if config.settings.privileged:
        raise ConfigurationError(
            f"a teacher, which sees the true {', '.join(config.settings.privileged)},"
            " is no residual for a robot and is not exported; leave privileged out"
        )
    if not trust_pickle:
        raise ConfigurationError(
            f"{path} is a pickle in a zip, and loading it runs code from it; add"
            " --trust-pickle if you trust its origin"
        )
    for file in (path, normaliser):
        if file is not None and not file.is_file():
            raise ConfigurationError(f"no model at {shorten(file)}")
    try:
        model = algorithm_class(config.algorithm).load(path, device="cpu")
        statistics = pickle.loads(normaliser.read_bytes()) if normaliser else None
        tensors, network = network_of(model, statistics)
    except ConfigurationError:
        raise
    except Exception as error:  # a pickle of something else may raise anything
        files = " with ".join(map(str, filter(None, (path, normaliser))))
        problem = f"{files} is no model that SB3's {config.algorithm} saved: {error}"
        raise ConfigurationError(problem) from error
    joints = _require_widths(tensors, config)
    recorded = config.model_dump(mode="json")
    training = {"config": recorded, **provenance(None), "exported_from": path.name}
    description = config.description(joints, training=training, **network)
    save_residual(output, description, tensors)
    return output
