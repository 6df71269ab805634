"""The key of a cell: a digest of everything that its result depends on."""

import ast
import hashlib
import importlib.util
import json
from collections.abc import Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from baselines.adaptation import offset_table
from baselines.policies import is_saved
from baselines.residual.residual_policy import DESCRIPTION, WEIGHTS, find_folder
from elastic_env.core.files import read_bounded
from train.evaluate.conditions import Condition
from train.evaluate.environments import files_of_robot
from train.workers.versions import physics

_NOT_OF_THE_RESULT = {"policy": {"level", "track"}, "member": {"rival"}}
"""Parts of a condition that change nothing of its episodes: what it is compared with, and where
tables list it.
"""
_LABELS = {"label": True, "policy": {"label"}, "member": {"base"}}
"""Parts of a condition that are text for people and name no files."""
_SAVED = (DESCRIPTION, WEIGHTS, offset_table.DESCRIPTION, offset_table.OFFSETS)
"""Files of which the folder of a policy consists."""
_LARGEST_SOURCE = 10_000_000
"""Bytes of a Python file that is looked through for imports."""


def cell_key(condition: Condition) -> str:
    """SHA-256 digest of a condition, of the files that it names, and of the physics' versions.

    Files are weights of residuals, tables of offsets and stiffness, robots with their models and
    joints, and Python files of the user's, with those of their folder that they import. They are
    read and never imported. What such a file reads when it runs is not seen. Labels are text and
    name no files.
    """
    content = condition.model_dump(mode="json", exclude=_NOT_OF_THE_RESULT)  # type: ignore[arg-type]
    named = condition.model_dump(mode="json", exclude=_LABELS)  # type: ignore[arg-type]
    found = [file for text in _texts(named) for file in named_files(text)]
    files = {str(file): _digest(file) for file in found}
    whole = {"condition": content, "files": files, "versions": physics()}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def named_files(text: str) -> list[Path]:
    """Files that a text stands for: residual:FOLDER, FILE.py:NAME, module:NAME, or a path."""
    if is_saved(text):
        folder = find_folder(Path(text.partition(":")[2]))
        return [folder / name for name in _SAVED if _is_file(folder / name)]
    place, _, name = text.rpartition(":")
    if name.isidentifier():
        source = Path(place) if place.endswith(".py") else _source(place)
        if source is not None:
            return _with_imports(source)
    if not _is_file(Path(text)):
        return []
    return [file for file in (Path(text), *files_of_robot(text)) if _is_file(file)]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # text that is no path, such as one that is too long
        return False


def _source(module: str) -> Path | None:
    """The file of a module; None where there is none.

    Neither it nor the packages around it are imported.
    """
    package, *parts = module.split(".")
    if not all(part.isidentifier() for part in (package, *parts)):
        return None
    try:
        # one name alone: of a name with dots it would import the packages around it
        found = importlib.util.find_spec(package)
        found = found or PathFinder.find_spec(package, [str(Path.cwd())])
    except (ImportError, ValueError):
        return None
    if found is None:
        return None
    if not parts:
        origin = found.origin or ""
        return Path(origin) if origin.endswith(".py") else None
    for folder in found.submodule_search_locations or ():
        for file in _files_of(Path(folder).joinpath(*parts)):
            if _is_file(file):
                return file
    return None


def _files_of(module: Path) -> list[Path]:
    """Files of a module, by its path without an ending: a package, or a file."""
    return [module / "__init__.py", module.with_name(f"{module.name}.py")]


def _with_imports(file: Path) -> list[Path]:
    """A Python file and those that it imports from its folder, directly or not, sorted."""
    seen = set[Path]()
    waiting = [file]
    while waiting:
        file = waiting.pop()
        if file in seen or not _is_file(file):
            continue
        seen.add(file)
        for name in _imports(file):
            waiting += _files_of(file.parent.joinpath(*name.split(".")))
    return sorted(seen)


def _imports(file: Path) -> Iterator[str]:
    """Modules that a file imports, by full name; none of a file that is no Python."""
    try:
        tree = ast.parse(read_bounded(file, _LARGEST_SOURCE))
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
    """All texts within plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


def _digest(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
