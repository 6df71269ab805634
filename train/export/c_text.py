"""Numbers, names and comments of C, and the templates of what is exported."""

import re
from collections.abc import Iterable
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.signals import Array

_FOLDER = Path(__file__).parent
_PREFIX = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*")
_LONGEST_PREFIX = 40


def require_prefix(prefix: str) -> str:
    """A prefix of names in C.

    Raises:
        ConfigurationError: It is none.
    """
    if len(prefix) > _LONGEST_PREFIX or not _PREFIX.fullmatch(prefix):
        raise ConfigurationError(
            "prefix must be a letter, then letters, digits or _, at most"
            f" {_LONGEST_PREFIX} characters, got {quote(prefix)}"
        )
    return prefix


def prefix_of(name: str) -> str:
    """A prefix from the name of a robot or file; `robot` where nothing of it fits."""
    return identifier(name).lower().lstrip("_0123456789")[:_LONGEST_PREFIX] or "robot"


def fill(template: str, prefix: str, **parts: Any) -> str:
    """A file of a template, with the prefix in the place of its first word.

    Args:
        template: Its name, such as arm_main.c.in, in which `arm_` is the prefix.
        prefix: Of all names.
        **parts: Texts in the place of ${name}.

    Raises:
        ConfigurationError: The prefix is none.
    """
    require_prefix(prefix)
    word = re.split(r"[_.]", template)[0]
    text = (_FOLDER / template).read_text(encoding="utf-8")
    text = re.sub(rf"\b{word}_(?=\w)", f"{prefix}_", text)
    text = re.sub(rf"\b{word.upper()}_(?=\w)", f"{prefix.upper()}_", text)
    return Template(text).substitute(parts)


def c_example(program: str, prefix: str, header: str) -> dict[str, str]:
    """Contents of a program that checks a header and times it, and of its CMakeLists, by name.

    Args:
        program: What the header has: arm, residual or walker.
        prefix: Of the header's names.
        header: Its file, as the program includes it.
    """
    return {
        f"{prefix}_main.c": fill(f"{program}_main.c.in", prefix, header=header),
        "CMakeLists.txt": fill("arm_CMakeLists.txt.in", prefix),
    }


def number(value: Any) -> str:
    """A double, or a float of NumPy as one, read back bit for bit."""
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0.0 else "-INFINITY"
    is_single = np.asarray(value).dtype == np.float32
    return f"{value!s}f" if is_single else repr(float(value))


def numbers(values: Any) -> str:
    """Numbers of a list, without its braces."""
    return ", ".join(map(number, np.ravel(values)))


def number_list(values: Any) -> str:
    """Numbers of a list."""
    return f"{{{numbers(values)}}}"


def members(row: Any, names: str) -> str:
    """Members of a struct, numbers and flat lists of them; their names are parted by spaces."""
    values = [row[name] for name in names.split()]
    return ", ".join(number(own) if np.ndim(own) == 0 else number_list(own) for own in values)


def row_lines(values: Array) -> str:
    """Rows of an array of two or more axes, a row of the first on a line."""
    return ",\n".join(f"    {initialiser(row)}" for row in values)


def initialiser(value: Any) -> str:
    """A number, or an array as lists within lists; whole numbers stay whole."""
    if np.ndim(value) == 0:
        return str(value) if isinstance(value, np.integer) else number(value)
    return "{" + ", ".join(map(initialiser, value)) + "}"


def enum_lines(names: Iterable[str]) -> str:
    """Names of an enumeration, a line each."""
    return ",\n".join(f"    {name}" for name in names)


def unique(start: str, names: Iterable[str]) -> list[str]:
    """Identifiers in capitals, numbered where two would be the same."""
    found: list[str] = []
    for name in names:
        whole = stem = start + identifier(name).upper()
        count = 2
        while whole in found:
            whole = f"{stem}_{count}"
            count += 1
        found.append(whole)
    return found


def identifier(name: str) -> str:
    """A user's name as a part of an identifier."""
    return re.sub(r"[^a-zA-Z0-9_]", "_", name)


def comment(lines: Iterable[str]) -> str:
    """Lines within a comment."""
    return "\n".join(f" * {line}".rstrip() for line in lines)


def plain(name: str) -> str:
    """A user's name for a comment: it cannot end the comment, and is in ASCII."""
    return re.sub(r"[^A-Za-z0-9 _.,:+=()@^/-]", "_", name)
