"""Keys of cells: digests of everything on which the result of a cell depends."""

import ast
import hashlib
import importlib.util
import json
from collections.abc import Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from baselines.adaptation import offset_folder
from baselines.policies import is_saved
from baselines.residual.residual_folder import DESCRIPTION, WEIGHTS, find_folder
from elastic_env.core.files import digest_of, is_file, read_bounded
from train.evaluate.conditions import Condition
from train.evaluate.robot_file import files_of_robot
from train.workers.versions import physics

_IRRELEVANT_FIELDS = {"policy": {"level", "track"}, "member": {"rival"}}
"""Parts of a condition that do not affect its episodes: the opponent, and the place in tables."""
_LABELS = {"label": True, "policy": {"label"}, "member": {"base"}}
"""Parts of a condition that are text for people and name no files."""
_SAVED_FILES = (DESCRIPTION, WEIGHTS, offset_folder.DESCRIPTION, offset_folder.OFFSETS)
"""Files in the folder of a saved policy."""
_MAX_SOURCE_BYTES = 10_000_000
"""Largest size of a Python file that is searched for imports [B]."""


def cell_key(condition: Condition) -> str:
    """Return the SHA-256 digest of a condition, its files, and the versions of the physics.

    Files are weights of residuals, tables of offsets and stiffness, and robots with their models
    and joints. Python files of the user count too, with the files of their folder that they import.
    They are read and never imported. Files that such code reads when it runs are not noticed.
    Labels are text and name no files.
    """
    relevant = condition.model_dump(mode="json", exclude=_IRRELEVANT_FIELDS)  # type: ignore[arg-type]
    named = condition.model_dump(mode="json", exclude=_LABELS)  # type: ignore[arg-type]
    files = [file for text in _texts(named) for file in named_files(text)]
    digests = {str(file): digest_of(file) for file in files}
    content = {"condition": relevant, "files": digests, "versions": physics()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def named_files(text: str) -> list[Path]:
    """Return the files that a text names: residual:FOLDER, FILE.py:NAME, module:NAME, or a path."""
    if is_saved(text):
        folder = find_folder(Path(text.partition(":")[2]))
        return [folder / name for name in _SAVED_FILES if is_file(folder / name)]
    place, _, name = text.rpartition(":")
    if name.isidentifier():
        source = Path(place) if place.endswith(".py") else _module_file(place)
        if source is not None:
            return _source_files(source)
    if not is_file(Path(text)):
        return []
    return [file for file in (Path(text), *files_of_robot(text)) if is_file(file)]


def _module_file(module: str) -> Path | None:
    """Return the file of a module, without importing it or its packages; None if there is none."""
    package, *parts = module.split(".")
    if not all(part.isidentifier() for part in (package, *parts)):
        return None
    try:
        # the first name only: for a name with dots, `find_spec` imports the packages
        spec = importlib.util.find_spec(package)
        spec = spec or PathFinder.find_spec(package, [str(Path.cwd())])
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if not parts:
        origin = spec.origin or ""
        return Path(origin) if origin.endswith(".py") else None
    for folder in spec.submodule_search_locations or ():
        for file in _module_paths(Path(folder).joinpath(*parts)):
            if is_file(file):
                return file
    return None


def _module_paths(module: Path) -> list[Path]:
    """Return the possible files of a module, from its path without suffix: package or file."""
    return [module / "__init__.py", module.with_name(f"{module.name}.py")]


def _source_files(file: Path) -> list[Path]:
    """Return a Python file and all that it imports from its folder, directly or not, sorted."""
    seen = set[Path]()
    waiting = [file]
    while waiting:
        file = waiting.pop()
        if file in seen or not is_file(file):
            continue
        seen.add(file)
        for name in _imports(file):
            waiting += _module_paths(file.parent.joinpath(*name.split(".")))
    return sorted(seen)


def _imports(file: Path) -> Iterator[str]:
    """Yield the full names of the modules that a file imports; none if it is not Python."""
    try:
        tree = ast.parse(read_bounded(file, _MAX_SOURCE_BYTES))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = [node.module] if node.module else []
            yield from package
            yield from (".".join([*package, alias.name]) for alias in node.names)


def _texts(value: Any) -> Iterator[str]:
    """Yield all texts within plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)
