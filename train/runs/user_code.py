"""Code of the user that a name stands for: "module:function", or "FILE.py:function".

Naming it runs it: that is what the name is for. Nothing else of a configuration or a residual
folder runs code. A configuration that was found in the folder of a run, rather than named by the
user, is read within `refuse_code`: all imports go through `named_object`, which then imports
nothing.
"""

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType
from typing import Any

from elastic_env.core.errors import ConfigurationError, quote, shorten

_FILES = "elastic_user_file_"
_REFUSED_IN: ContextVar[Path | None] = ContextVar("refused_in", default=None)


@contextmanager
def refuse_code(file: Path) -> Iterator[None]:
    """Refuse to import within what names stand for.

    Args:
        file: Where the names come from.
    """
    before = _REFUSED_IN.set(file)
    try:
        yield
    finally:
        _REFUSED_IN.reset(before)


def require_no_code(file: Path, names: Iterable[str]) -> None:
    """Refuse names that stand for code; arguments as `refuse_code`, and the names.

    Raises:
        ConfigurationError: One of them does.
    """
    for name in names:
        if ":" in name:
            raise _trust_error(file, name)


def _trust_error(file: Path, name: str) -> ConfigurationError:
    return ConfigurationError(
        f"{file} names {quote(name)}, whose code would run; look at it, then say --trust-code, or"
        " name a configuration of yours"
    )


def named_object(name: str) -> Any:
    """The object that a name stands for.

    Args:
        name: "module:attribute", or "FILE.py:attribute" with the path of a file, which need not be
            on the module path.

    Raises:
        ConfigurationError: There is no such module, file or attribute, or it fails while it is
            imported; or code is refused here, and nothing was imported.
    """
    if (file := _REFUSED_IN.get()) is not None:
        raise _trust_error(file, name)
    place, _, attribute = name.rpartition(":")
    try:
        module = _from_file(Path(place)) if place.endswith(".py") else _from_path(place)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(
            f"{shorten(place)} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    if not hasattr(module, attribute):
        _require_unshadowed(module, attribute)
        own = [
            name
            for name, found in inspect.getmembers(module, inspect.isfunction)
            if found.__module__ == module.__name__
        ]
        raise ConfigurationError(
            f"{shorten(place)} has no {attribute!r}; its functions are: {', '.join(own) or 'none'}"
        )
    return getattr(module, attribute)


def _require_unshadowed(module: ModuleType, attribute: str) -> None:
    """Refuse a module that was meant to be a file of the working folder, which comes last."""
    file = Path(f"{module.__name__.replace('.', '/')}.py")
    found = getattr(module, "__file__", None)
    if file.is_file() and (found is None or file.resolve() != Path(found).resolve()):
        raise ConfigurationError(
            f"{found or 'a built-in module'} stands before your {file}; name the file itself:"
            f" {file}:{attribute}"
        )


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
