"""The key of a cell: a digest of everything that its result depends on."""

import ast
import hashlib
import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from baselines.policies import is_saved
from baselines.residual.residual import located
from train.evaluate.conditions import Condition
from train.evaluate.robot_file import files_of_robot
from train.workers.versions import physics

_NOT_OF_THE_RESULT = {"policy": {"level", "track"}, "member": {"rival"}}
"""Parts of a condition that change nothing of its episodes: what it is compared with, and where tables list it."""


def cell_key(condition: Condition) -> str:
    """SHA-256 digest of a condition, of the files that it names, and of the versions of the physics.

    Files are weights of residuals, tables of offsets and stiffness, robots with their models and joints, and Python
    files of the user's, with those of their folder that they import. What such a file reads when it runs is not seen.
    """
    content = condition.model_dump(mode="json", exclude=_NOT_OF_THE_RESULT)  # type: ignore[arg-type]
    files = {str(file): _digest(file) for text in _texts(content) for file in named_files(text)}
    whole = {"condition": content, "files": files, "versions": physics()}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def named_files(text: str) -> list[Path]:
    """Files that a text of a configuration stands for: residual:FOLDER, FILE.py:NAME, module:NAME, or a path."""
    if is_saved(text):
        folder = located(Path(text.partition(":")[2]))
        return sorted(file for file in folder.glob("*") if file.is_file())
    place, _, name = text.rpartition(":")
    if name.isidentifier() and place.endswith(".py"):
        return sorted(_with_imports(Path(place), set()))
    if name.isidentifier() and (source := _source(place)):
        return sorted(_with_imports(source, set()))
    return [Path(text), *files_of_robot(text)] if _is_file(Path(text)) else []


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # text that is no path, such as one that is too long
        return False


def _source(module: str) -> Path | None:
    """The file of a module; None where there is none."""
    try:
        found = importlib.util.find_spec(module) if module else None
    except (ImportError, ValueError):
        return None
    return Path(found.origin) if found is not None and found.origin and found.origin.endswith(".py") else None


def _with_imports(file: Path, seen: set[Path]) -> set[Path]:
    """A Python file and those that it imports from its own folder, and these from there."""
    if file in seen or not _is_file(file):
        return seen
    seen.add(file)
    for name in _imported(file):
        path = file.parent.joinpath(*name.split("."))
        _with_imports(path.with_suffix(".py"), seen)
        _with_imports(path / "__init__.py", seen)
    return seen


def _imported(file: Path) -> Iterator[str]:
    """Modules that a file imports, by full name."""
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ([node.module] if node.module else [])
            yield from (".".join(filter(None, [node.module, alias.name])) for alias in node.names)


def _texts(value: Any) -> Iterator[str]:
    """All texts within plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
