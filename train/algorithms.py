"""Learning algorithms by name."""

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import stable_baselines3

from elastic_env.errors import ConfigurationError, shown, unknown_name
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


_BAD_OPTIONS = (
    TypeError, ValueError, AssertionError, AttributeError, ArithmeticError, LookupError, MemoryError, RuntimeError,
)  # fmt: skip
"""What algorithms raise for options that they cannot take, such as arrays beyond the memory."""


@contextmanager
def options_named(algorithm: str, options: Mapping[str, Any]) -> Iterator[None]:
    """Name algorithm and options in what it raises while it is built from them.

    Raises:
        ConfigurationError: It does not take them.
    """
    try:
        yield
    except ConfigurationError:
        raise
    except _BAD_OPTIONS as error:
        raise ConfigurationError(
            f"{algorithm} cannot be built with algorithm_options {shown(dict(options))}: "
            f"{error or type(error).__name__}"
        ) from error
