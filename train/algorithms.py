"""Learning algorithms by name."""

import importlib
from typing import Any

import stable_baselines3

from elastic_env.errors import ConfigurationError, unknown_name
from train.train_config import CONSTANTS


def algorithm_class(name: str) -> Any:
    """Class of an algorithm: A2C, PPO or SAC of stable_baselines3, or "module:Class".

    Raises:
        ConfigurationError: It does not exist.
    """
    if ":" in name:
        module, _, attribute = name.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigurationError(f"algorithm {name!r}: {error}") from None
    known = ("A2C", "PPO", "SAC")
    if name not in known:
        raise unknown_name("algorithm", name, [*known, CONSTANTS, "module:Class"])
    return getattr(stable_baselines3, name)
