"""Errors that teach: what was required, what was given, and which choices exist."""

import difflib
from collections.abc import Iterable
from typing import ClassVar


class ElasticError(ValueError):
    """Base of every error that this project raises on purpose.

    Attributes:
        exit_code: What the command `elastic` ends with: 2 for a wrong input, 3 where the system failed.
    """

    exit_code: ClassVar[int] = 2


class SystemFailedError(ElasticError):
    """The input was right and the system failed: a full disk, a killed process, a lost port."""

    exit_code = 3


class ConfigurationError(ElasticError):
    """A parameter, a name or a configuration file is not what it has to be."""


class ActionError(ElasticError):
    """An action has the wrong shape or holds a value that is not finite."""


class ResultsExistError(ElasticError):
    """An output folder already holds results, which are never overwritten."""


class MissingExtraError(ElasticError):
    """A command needs a package of an optional extra that is not installed."""


def missing_extra(package: str, extra: str, purpose: str) -> MissingExtraError:
    """The error for an optional package that is not there, with the command that installs it."""
    return MissingExtraError(
        f"{purpose} needs the package {package}; install it with: pip install 'elastic-env[{extra}]'"
    )


def unknown_name(kind: str, name: object, choices: Iterable[str]) -> ConfigurationError:
    """The error for a name that does not exist, listing those that do.

    Args:
        kind: What the name should have named ("scenario", "policy", ...).
        name: The name that was given.
        choices: The names that exist.
    """
    known = list(choices)
    close = difflib.get_close_matches(str(name), known, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return ConfigurationError(f"unknown {kind} {name!r}; choose one of: {', '.join(known)}.{hint}")
