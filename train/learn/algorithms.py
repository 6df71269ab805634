"""Learning algorithms by name."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import stable_baselines3

from elastic_env.core.errors import ConfigurationError, ElasticError, quote, unknown_name
from train.learn.algorithm_options import CONSTANTS
from train.runs.user_code import named_object


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
    known = ("A2C", "PPO", "SAC")
    if name not in known:
        raise unknown_name("algorithm", name, [*known, CONSTANTS, "module:Class"])
    return getattr(stable_baselines3, name)


@contextmanager
def name_options(algorithm: str, options: Mapping[str, Any]) -> Iterator[None]:
    """Name algorithm and options in what it raises while it is built from them.

    Raises:
        ConfigurationError: It does not take them.
    """
    try:
        yield
    except (ElasticError, OSError):
        raise
    except Exception as error:
        raise ConfigurationError(
            f"{algorithm} cannot be built with algorithm_options {quote(dict(options))}: "
            f"{error or type(error).__name__}"
        ) from error
