"""Code of the user, named as "module:function" or "FILE.py:function".

If the user names such code, it runs. Nothing else in a configuration or a residual folder runs
code. `load_without_code` reads a configuration that the user did not name, as in the folder of a
run. All imports use `named_object`, which imports nothing during that. `kind_check` notices a
configuration that is for another command.
"""

import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from elastic_env.core.config import Model, load_yaml
from elastic_env.core.errors import ConfigurationError, quote, shorten, unknown_name
from train.runs.folders import require_run
from train.runs.import_path import append_to_path

KINDS = {
    "comparison": (
        "elastic compare",
        "references policies episodes scenario_episodes reference_scenarios"
        " figure_policies sweep map groups leaderboard",
    ),
    "training": (
        "elastic train",
        "weights base base_options settings algorithm algorithm_options anneal clip"
        " worlds decisions seeds evaluate_every evaluation_episodes checkpoint_every",
    ),
    "bench": ("elastic bench", "cases margin"),
}
"""Kinds of configurations: the command of each, and the keys that no other kind has."""


def kind_of(values: Mapping[str, Any]) -> str:
    """Return the kind of configuration, one of `KINDS`, to which most of the keys belong."""
    return max(KINDS, key=lambda kind: _count_keys(values, kind))


def _count_keys(values: Mapping[str, Any], kind: str) -> int:
    """Return the number of keys that only configurations of a kind have."""
    return len(set(values).intersection(KINDS[kind][1].split()))


def kind_check(kind: str) -> Callable[[Any], Any]:
    """Return a check of raw parameters, which refuses configurations of another kind.

    The check raises ValueError if more of the keys belong to another kind.
    """

    def check(values: Any) -> Any:
        keys = values if isinstance(values, dict) else {}
        likely = kind_of(keys)
        if _count_keys(keys, likely) > _count_keys(keys, kind):
            command = f"{KINDS[likely][0]} FILE"
            raise ValueError(f"this is the configuration of a {likely}: {command}")
        return values

    return check


class CodeNamingModel(Model):
    """A configuration with names that may stand for code."""

    @property
    def names_of_code(self) -> list[str]:
        """Names that may stand for code."""
        raise NotImplementedError


_Config = TypeVar("_Config", bound=CodeNamingModel)
_ROOT = Path(__file__).parents[2]
_OWN_FOLDERS = tuple(_ROOT / name for name in ("elastic_env", "baselines", "train"))
_CODE_CHECK: ContextVar[Callable[[str], None]] = ContextVar("code_check", default=lambda _: None)
"""Called with each name before its code runs."""


def load_without_code(file: Path, kind: type[_Config], cure: str) -> _Config:
    """Load a configuration that the user did not name, without importing code that it names.

    Args:
        file: File of the configuration.
        kind: Class of the configuration.
        cure: Advice for a user who trusts the file.

    Raises:
        ConfigurationError: The file is no such configuration, or it names code.
    """

    def refuse(name: str) -> None:
        problem = f"{file} names {quote(name)}, whose code would run"
        raise ConfigurationError(f"{problem}; look at it, then {cure}")

    token = _CODE_CHECK.set(refuse)
    try:
        config = load_yaml(file, kind)
    finally:
        _CODE_CHECK.reset(token)
    for name in config.names_of_code:
        if ":" in name:
            refuse(name)
    return config


def recorded_config(folder: Path, kind: type[_Config], trust_code: bool = False) -> _Config:
    """Load the configuration of a run that is to be continued.

    Args:
        folder: Folder of the run.
        kind: Class of the configuration.
        trust_code: Run code that the configuration names, which may be in the folder.

    Raises:
        ConfigurationError: The folder is no such run, or names code that is not trusted.
    """
    file = require_run(folder)
    if trust_code:
        return load_yaml(file, kind)
    return load_without_code(file, kind, "say --trust-code, or name a configuration of yours")


def named_object(name: str) -> Any:
    """Import the object that a name stands for.

    Args:
        name: "module:attribute", or "FILE.py:attribute" with the path of a file, which need not be
            on the module path.

    Raises:
        ConfigurationError: There is no such module, file or attribute; or its import fails; or code
            is refused here, and nothing was imported.
    """
    _CODE_CHECK.get()(name)
    source, _, attribute = name.rpartition(":")
    append_to_path(Path.cwd())
    try:
        is_file = source.endswith(".py")
        module = _import_file(Path(source)) if is_file else _import_module(source)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(
            f"{shorten(source)} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    if not hasattr(module, attribute):
        _require_unshadowed(module, attribute)
        functions = inspect.getmembers(module, inspect.isfunction)
        members = [*functions, *inspect.getmembers(module, inspect.isclass)]
        names = [n for n, member in members if member.__module__ == module.__name__]
        if not names:
            problem = f"{shorten(source)} has no {attribute!r}"
            raise ConfigurationError(f"{problem}, and no function or class of its own")
        raise unknown_name(f"function or class in {shorten(source)}:", attribute, names)
    return getattr(module, attribute)


def user_line(error: BaseException) -> str:
    """Return the last line of a user's code in a traceback, as " (FILE:LINE)"; "" if there is none.

    The first frame outside our packages is the user's code. Libraries that it calls are in other
    folders.
    """
    frames = traceback.extract_tb(error.__traceback__)
    paths = [Path(frame.filename) for frame in frames]
    foreign = [p.parent for p in paths if not any(map(p.is_relative_to, _OWN_FOLDERS))]
    lines = [
        f" ({path.name}:{frame.lineno})"
        for frame, path in zip(frames, paths, strict=True)
        if path.parent in foreign[:1]
    ]
    return lines[-1] if lines else ""


def _require_unshadowed(module: ModuleType, attribute: str) -> None:
    """Refuse a module that hides a file of the same name in the working folder."""
    file = Path(f"{module.__name__.replace('.', '/')}.py")
    origin = getattr(module, "__file__", None)
    if file.is_file() and (origin is None or file.resolve() != Path(origin).resolve()):
        problem = f"{origin or 'a built-in module'} is imported instead of your {file}"
        raise ConfigurationError(f"{problem}; name the file itself: {file}:{attribute}")


def _import_module(module: str) -> ModuleType:
    if not module or module.startswith("."):
        raise ImportError("the module must have its full name")
    return importlib.import_module(module)


def _import_file(path: Path) -> ModuleType:
    """Import a file under a name with a prefix, so that train.py does not hide our package."""
    resolved = path.resolve()
    name = f"elastic_user_file_{resolved.stem}"
    imported = sys.modules.get(name)
    if imported is not None and imported.__file__ == str(resolved):
        return imported
    if not resolved.is_file():
        raise FileNotFoundError(f"there is no file {shorten(path)}")
    spec = importlib.util.spec_from_file_location(name, resolved)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
