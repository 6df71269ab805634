"""Errors that teach: the requirement, the given value, and the choices."""

import difflib
import itertools
import re
import reprlib
from collections.abc import Collection, Iterable
from typing import Any, ClassVar

from elastic_env.core.installed import install_command

_LONGEST_TEXT = 200
"""Characters of a user's text in an error."""
_LONGEST_LINE = 2000
_LONGEST_LIST = 1000
"""Characters of a line, and of names that are listed in it."""


class ElasticError(ValueError):
    """Base of every error that this project raises on purpose.

    Attributes:
        exit_code: Exit status of the command `elastic`: 2 for a wrong input, 3 where the system
            failed.

    A word or a quoted text of more than 200 characters comes from a user, and is shortened.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, *args: Any) -> None:
        parts = [readable(arg) if isinstance(arg, str) else arg for arg in args]
        super().__init__(*parts)


class SystemFailedError(ElasticError):
    """The input was right and the system failed: a full disk, a killed process, a lost port."""

    exit_code = 3


class ConfigurationError(ElasticError):
    """A parameter, a name or a configuration file is invalid."""


class ActionError(ElasticError):
    """An action has the wrong shape or holds a value that is not finite."""


class ResultsExistError(ElasticError):
    """An output folder already holds results, which are never overwritten."""


class MissingExtraError(ConfigurationError):
    """A command needs a package of an optional extra that is not installed."""


def missing_extra(package: str, extra: str, purpose: str) -> MissingExtraError:
    """Return the error for a missing optional package, with the command that installs it."""
    return MissingExtraError(
        f"{purpose} needs the package {package}; install it with: {install_command(extra)}"
    )


class _ShortRepr(reprlib.Repr):
    """Short representations, also of integers that Python does not convert to text."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = 24
        self.maxstring = self.maxother = self.maxlong = _LONGEST_TEXT // 2
        self.maxlevel = 4

    def repr_int(self, x: int, level: int) -> str:
        if abs(x) >= 10**_LONGEST_TEXT:
            return f"a whole number of {x.bit_length()} bits"
        return super().repr_int(x, level)

    def repr_str(self, x: str, level: int) -> str:
        return repr(x) if len(x) <= self.maxstring else super().repr_str(x, level)


_SHORT_REPR = _ShortRepr()


def quote(value: Any) -> str:
    """Return a given value as an error shows it: its representation, at most 200 characters."""
    return shorten(_SHORT_REPR.repr(value))


def shorten(text: object, longest: int = _LONGEST_TEXT) -> str:
    """Return a user's text as an error shows it without quotes: begin and end of a long one.

    Args:
        text: The text.
        longest: Characters to show.
    """
    whole = str(text)
    if len(whole) <= longest:
        return whole
    end = longest // 4
    return f"{whole[: longest - end - 3]}...{whole[-end:]}"


_PIECE = re.compile(r"(?<!\w)'[^'\n]*'(?!\w)|\S+")
"""A quoted text, or a word.

Quotes are paired from the left, so that nothing between two of them counts as one.
"""


def readable(text: str) -> str:
    """Shorten long words, quoted texts and lines of a message, which would flood a terminal."""
    if len(text) <= _LONGEST_TEXT:
        return text
    short = _PIECE.sub(lambda match: shorten(match[0]), text)
    return "\n".join(shorten(line, _LONGEST_LINE) for line in short.split("\n"))


def unknown_name(kind: str, name: object, choices: Iterable[str]) -> ConfigurationError:
    """Return the error for a name that does not exist, with a list of the names that do.

    Args:
        kind: Kind of thing that the name should refer to ("scenario", "policy", ...).
        name: The given name.
        choices: The names that exist.
    """
    listed = choices_listed(name, choices)
    return ConfigurationError(f"unknown {kind} {quote(name)}; {listed}")


def require_known(kind: str, names: Iterable[str], choices: Collection[str]) -> None:
    """Refuse names that do not exist; arguments as `unknown_name`.

    Raises:
        ConfigurationError: One of them is not among the choices.
    """
    for name in names:
        if name not in choices:
            raise unknown_name(kind, name, choices)


def choices_listed(name: object, choices: Iterable[str]) -> str:
    """List the names that exist, and the one that is closest to a given name."""
    known = list(choices)
    text = name[:_LONGEST_TEXT] if isinstance(name, str) else ""
    close = difflib.get_close_matches(text, known, n=1)
    hint = f" Did you mean {quote(close[0])}?" if close else ""
    return f"choose one of: {list_names(known)}.{hint}"


def list_names(names: Iterable[object]) -> str:
    """List names as an error does: the first ones, and the number of the others."""
    known = [shorten(name) for name in names]
    lengths = itertools.accumulate(len(name) + 2 for name in known)
    fitting = max(sum(length <= _LONGEST_LIST for length in lengths), 1)
    more = f" and {len(known) - fitting} more" if fitting < len(known) else ""
    return f"{', '.join(known[:fitting])}{more}"
