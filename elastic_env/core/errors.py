"""Errors that teach: what was required, what was given, and which choices exist."""

import difflib
import reprlib
from collections.abc import Collection, Iterable
from typing import Any, ClassVar


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
        f"{purpose} needs the package {package}; in the checkout of elastic-env install it with: "
        f"pip install -c constraints.txt '.[{extra}]'"
    )


class _Shown(reprlib.Repr):
    """Short representations, also of integers that Python does not convert to text."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = 24
        self.maxstring = self.maxother = self.maxlong = _LONGEST_SHOWN // 2
        self.maxlevel = 4

    def repr_int(self, x: int, level: int) -> str:
        if abs(x) >= 10**_LONGEST_SHOWN:
            return f"a whole number of {x.bit_length()} bits"
        return super().repr_int(x, level)

    def repr_str(self, x: str, level: int) -> str:
        return repr(x) if len(x) <= self.maxstring else super().repr_str(x, level)


_LONGEST_SHOWN = 240
_SHOWN = _Shown()


def shown(value: Any) -> str:
    """A given value as an error shows it: its representation, shortened where that would flood the terminal."""
    text = _SHOWN.repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def shortened(text: object) -> str:
    """Text of a user's, such as a path, as an error shows it without quotes: at most 200 characters."""
    return _cut(str(text))


def _cut(text: str) -> str:
    if len(text) <= _LONGEST_SHOWN:
        return text
    end = _LONGEST_SHOWN // 4
    return f"{text[: _LONGEST_SHOWN - end - 3]}...{text[-end:]}"


def unknown_name(kind: str, name: object, choices: Iterable[str]) -> ConfigurationError:
    """The error for a name that does not exist, listing those that do.

    Args:
        kind: What the name should have named ("scenario", "policy", ...).
        name: The name that was given.
        choices: The names that exist.
    """
    return ConfigurationError(f"unknown {kind} {shown(name)}; {choices_listed(name, choices)}")


def require_known(kind: str, names: Iterable[str], choices: Collection[str]) -> None:
    """Refuse names that do not exist; arguments as `unknown_name`.

    Raises:
        ConfigurationError: One of them is not among the choices.
    """
    for name in names:
        if name not in choices:
            raise unknown_name(kind, name, choices)


def choices_listed(name: object, choices: Iterable[str]) -> str:
    """The names that exist, and the one that is closest to what was given."""
    known = list(choices)
    close = difflib.get_close_matches(name[:_LONGEST_SHOWN], known, n=1) if isinstance(name, str) else []
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"choose one of: {', '.join(known)}.{hint}"
