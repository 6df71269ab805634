"""Code of the user that a name stands for: "module:function", or "FILE.py:function".

Naming it runs it: that is what the name is for. Nothing else of a configuration or a residual
folder runs code. A configuration that was found, as in the folder of a run, and not named by the
user, is read by `load_without_code`: all imports go through `named_object`, which then imports
nothing. One that is given to the wrong command is recognised by `is_a`.
"""

import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from elastic_env.core.config import Model, load_yaml
from elastic_env.core.errors import ConfigurationError, quote, shorten, unknown_name
from train.runs.folders import require_run
from train.runs.import_path import look_last_in

TELLING = {
    "comparison": (
        "elastic compare",
        "references policies episodes scenario_episodes reference_scenarios figure_policies sweep"
        " map groups leaderboard",
    ),
    "training": (
        "elastic train",
        "weights base base_options settings algorithm algorithm_options anneal clip worlds"
        " decisions seeds evaluate_every evaluation_episodes checkpoint_every",
    ),
    "bench": ("elastic bench", "cases margin"),
}
"""Command of each kind, and keys that no other kind has."""


def kind_of(values: Mapping[str, Any]) -> str:
    """The kind of configuration, one of `TELLING`, that most of the keys tell of."""
    return max(TELLING, key=lambda kind: _count_telling(values, kind))


def _count_telling(values: Mapping[str, Any], kind: str) -> int:
    """How many of the keys only configurations of a kind have."""
    return len(set(values).intersection(TELLING[kind][1].split()))


def is_a(kind: str) -> Callable[[Any], Any]:
    """A check of raw parameters: they are of a kind, or of none in particular.

    Raises:
        ValueError: More of the keys are of another kind.
    """

    def check(values: Any) -> Any:
        given = values if isinstance(values, dict) else {}
        likely = kind_of(given)
        if _count_telling(given, likely) > _count_telling(given, kind):
            command = f"{TELLING[likely][0]} FILE"
            raise ValueError(f"this is the configuration of a {likely}: {command}")
        return values

    return check


class CodeNamingModel(Model):
    """A configuration with names that may stand for code."""

    @property
    def names_of_code(self) -> list[str]:
        """Those names."""
        raise NotImplementedError


_Config = TypeVar("_Config", bound=CodeNamingModel)
_FILES = "elastic_user_file_"
_ROOT = Path(__file__).parents[2]
_OURS = tuple(_ROOT / name for name in ("elastic_env", "baselines", "train"))
_Refuse = Callable[[str], None]
_REFUSE: ContextVar[_Refuse] = ContextVar("refuse", default=lambda _: None)
"""Called with each name before its code runs."""
_TRUST = "say --trust-code, or name a configuration of yours"
"""What the user can do who trusts the folder of a run."""


def _refuse(file: Path, cure: str, name: str) -> None:
    """Refuse a name that stands for code in a file whose names must not run any."""
    problem = f"{file} names {quote(name)}, whose code would run"
    raise ConfigurationError(f"{problem}; look at it, then {cure}")


def load_without_code(file: Path, kind: type[_Config], cure: str) -> _Config:
    """A configuration that was found and not named by the user; nothing that it names is imported.

    Args:
        file: Where it was found.
        kind: Of the configuration.
        cure: What the user can do who trusts it, in words.

    Raises:
        ConfigurationError: It is no such configuration, or names code.
    """
    refuse = partial(_refuse, file, cure)
    before = _REFUSE.set(refuse)
    try:
        config = load_yaml(file, kind)
    finally:
        _REFUSE.reset(before)
    for name in config.names_of_code:
        if ":" in name:
            refuse(name)
    return config


def recorded_config(folder: Path, kind: type[_Config], trust_code: bool = False) -> _Config:
    """The configuration of a run that is gone on with.

    Args:
        folder: Of the run.
        kind: Of the configuration.
        trust_code: Whether code that it names may run: it may lie in the folder.

    Raises:
        ConfigurationError: The folder is no such run, or names code that is not trusted.
    """
    file = require_run(folder)
    if trust_code:
        return load_yaml(file, kind)
    return load_without_code(file, kind, _TRUST)


def named_object(name: str) -> Any:
    """The object that a name stands for.

    Args:
        name: "module:attribute", or "FILE.py:attribute" with the path of a file, which need not be
            on the module path.

    Raises:
        ConfigurationError: There is no such module, file or attribute, or it fails while it is
            imported; or code is refused here, and nothing was imported.
    """
    _REFUSE.get()(name)
    place, _, attribute = name.rpartition(":")
    look_last_in(Path.cwd())
    try:
        module = _from_file(Path(place)) if place.endswith(".py") else _from_path(place)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(
            f"{shorten(place)} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    if not hasattr(module, attribute):
        _require_unshadowed(module, attribute)
        functions = inspect.getmembers(module, inspect.isfunction)
        classes = inspect.getmembers(module, inspect.isclass)
        known = [*functions, *classes]
        own = [name for name, found in known if found.__module__ == module.__name__]
        if not own:
            problem = f"{shorten(place)} has no {attribute!r}"
            raise ConfigurationError(f"{problem}, and no function or class of its own")
        raise unknown_name(f"function or class of {shorten(place)}", attribute, own)
    return getattr(module, attribute)


def line_of_user(error: BaseException) -> str:
    """The last line of a user's code that an error came through, as " (FILE:LINE)"; or nothing.

    The user's code begins where ours calls it. Libraries that it calls lie in other folders.
    """
    frames = traceback.extract_tb(error.__traceback__)
    paths = [Path(frame.filename) for frame in frames]
    theirs = [path.parent for path in paths if not any(map(path.is_relative_to, _OURS))]
    lines = [
        f" ({path.name}:{frame.lineno})"
        for frame, path in zip(frames, paths, strict=True)
        if path.parent in theirs[:1]
    ]
    return lines[-1] if lines else ""


def _require_unshadowed(module: ModuleType, attribute: str) -> None:
    """Refuse a module that was meant to be a file of the working folder, which comes last."""
    file = Path(f"{module.__name__.replace('.', '/')}.py")
    found = getattr(module, "__file__", None)
    if file.is_file() and (found is None or file.resolve() != Path(found).resolve()):
        problem = f"{found or 'a built-in module'} stands before your {file}"
        raise ConfigurationError(f"{problem}; name the file itself: {file}:{attribute}")


def _from_path(module: str) -> ModuleType:
    if not module or module.startswith("."):
        raise ImportError("the module must have its full name")
    return importlib.import_module(module)


def _from_file(path: Path) -> ModuleType:
    """A file as a module of a name of its own, so that train.py is not taken for our package."""
    resolved = path.resolve()
    name = _FILES + resolved.stem
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(resolved):
        return known
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
