"""Presets: configurations that come with the package, named after their files.

In a checkout they are in the folder `configs`, to which `train/presets` is a link. The installed
package has copies of them in `train/presets`.
"""

import difflib
import re
from importlib import resources
from pathlib import Path

from rich.console import Console

from elastic_env.core.config import read_mapping
from elastic_env.core.errors import ConfigurationError, quote, shorten
from train.runs.console import make_table
from train.runs.user_code import KINDS, kind_of

_SENTENCE = re.compile(r".+?[.?:](?=\s[A-Z`]|$)")
"""The first sentence of a text; the dot of "Fig. 6" does not end it."""


def presets() -> dict[str, Path]:
    """Return the files of all presets, by name."""
    folder = Path(str(resources.files("train") / "presets"))
    return {file.stem: file for file in sorted(folder.glob("*.yaml"))}


def find_configuration(path: Path, kind: str) -> Path:
    """Return the file that a user names: their own file, else the preset of that name.

    Args:
        path: Path of a file, or name of a preset.
        kind: Kind of the configuration, one of `KINDS`.

    Raises:
        ConfigurationError: Neither exists; the message lists presets with similar names.
    """
    if path.exists() and not path.is_dir():
        return path
    files = presets()
    name = str(path)
    if name in files:
        return files[name]
    command = KINDS[kind][0]
    if path.stem in files and not path.exists():
        cure = f"the preset of this name needs no path: {command} {path.stem}"
        raise ConfigurationError(f"no configuration file at {shorten(path)}; {cure}")
    if path.suffix or path.name != name or path.exists():
        return path  # its reader raises the error
    close = difflib.get_close_matches(name, _presets_of_kind(kind), n=3)
    similar = f"similar presets are {', '.join(close)}; " if close else ""
    problem = f"no file and no preset is called {quote(name)}"
    raise ConfigurationError(f"{problem}; {similar}{command} --list shows all of them")


def print_presets(kind: str, console: Console) -> None:
    """Print the presets of a kind, each with its first sentence.

    Args:
        kind: One of `KINDS`.
        console: Console for the list.
    """
    files = _presets_of_kind(kind)
    rows = [(name, first_sentence(file)) for name, file in files.items()]
    command = KINDS[kind][0]
    console.print(make_table(f"{command} NAME", ("name", "what it is"), rows, left=2))
    folder = next(iter(files.values())).parent
    console.print(f"To change one, copy it from {folder}, and name the copy.")


def first_sentence(file: Path) -> str:
    """Return the first sentence of the comment at the beginning of a preset."""
    comment = re.match(r"(?:#.*\n)+", file.read_text(encoding="utf-8"))
    text = " ".join(re.sub(r"^#", "", comment[0] if comment else "", flags=re.MULTILINE).split())
    match = _SENTENCE.match(text)
    return (match[0] if match else text).rstrip(":")


def _presets_of_kind(kind: str) -> dict[str, Path]:
    """Return the presets of a kind, by name."""
    return {n: f for n, f in presets().items() if kind_of(read_mapping(f)) == kind}
