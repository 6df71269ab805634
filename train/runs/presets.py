"""Presets: configurations that come with the package, each known by the name of its file.

They lie in the folder `configs` of a checkout, to which `train/presets` is a link. The installed
package holds copies of them in that place.
"""

import difflib
import re
from importlib import resources
from pathlib import Path

from rich.console import Console

from elastic_env.core.config import read_mapping
from elastic_env.core.errors import ConfigurationError, quote, shorten
from train.runs.console import make_table
from train.runs.user_code import TELLING, kind_of

_SENTENCE = re.compile(r".+?[.?:](?=\s[A-Z`]|$)")
"""The first sentence of a text; Fig. 6 does not end one."""


def presets() -> dict[str, Path]:
    """Files of all presets, by name."""
    folder = Path(str(resources.files("train") / "presets"))
    return {file.stem: file for file in sorted(folder.glob("*.yaml"))}


def find_configuration(given: Path, kind: str) -> Path:
    """The file that a user means: one of their own, else the preset of that name.

    Args:
        given: Path of a file, or name of a preset.
        kind: Of the configuration, one of `TELLING`.

    Raises:
        ConfigurationError: There is neither; presets of a similar name are named.
    """
    if given.exists() and not given.is_dir():
        return given
    known = presets()
    name = str(given)
    if name in known:
        return known[name]
    command = TELLING[kind][0]
    if given.stem in known and not given.exists():
        cure = f"the preset of this name needs no path: {command} {given.stem}"
        raise ConfigurationError(f"no configuration file at {shorten(given)}; {cure}")
    if given.suffix or given.name != name or given.exists():
        return given  # a path, and reading it says what is wrong
    close = difflib.get_close_matches(name, _of_kind(kind), n=3)
    similar = f"similar presets are {', '.join(close)}; " if close else ""
    problem = f"no file and no preset is called {quote(name)}"
    raise ConfigurationError(f"{problem}; {similar}{command} --list shows all of them")


def print_presets(kind: str, console: Console) -> None:
    """List the presets of a kind, with what the first sentence in each says.

    Args:
        kind: One of `TELLING`.
        console: Where the list goes.
    """
    found = _of_kind(kind)
    rows = [(name, first_sentence(file)) for name, file in found.items()]
    command = TELLING[kind][0]
    console.print(make_table(f"{command} NAME", ("name", "what it is"), rows, left=2))
    folder = next(iter(found.values())).parent
    console.print(f"To change one, copy it from {folder}, and name the copy.")


def first_sentence(file: Path) -> str:
    """The first sentence of the comment that a preset begins with."""
    comment = re.match(r"(?:#.*\n)+", file.read_text(encoding="utf-8"))
    text = " ".join(re.sub(r"^#", "", comment[0] if comment else "", flags=re.MULTILINE).split())
    found = _SENTENCE.match(text)
    return (found[0] if found else text).rstrip(":")


def _of_kind(kind: str) -> dict[str, Path]:
    """The presets of a kind, by name."""
    known = presets().items()
    return {name: file for name, file in known if kind_of(read_mapping(file)) == kind}
