"""Decorators for kernels that Numba compiles: arithmetic row by row.

NumPy takes longer, as each of its operations has a fixed cost on small arrays.

Numba compiles a kernel at its first call with arrays of a type. It caches the code beside the
source file or in the user's cache folder. Numba compiles again when the file of the called function
has changed; `_compile` adds the files of the kernels that this file imports. A kernel takes sizes
from types, not from constants of other files; a test checks this. Sums run in the written order,
and Numba fuses no operations. So the result of a row does not depend on the number of rows.

The logger `elastic_env.core.compiled` reports at level INFO that a kernel is compiled; it does not
report one that is loaded. So a program can show why its first use takes long.
"""

import hashlib
import inspect
import logging
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

import numba
import numpy as np
from numba.core import event as events
from numba.core import types
from numba.extending import register_jitable

_P = ParamSpec("_P")
_R = TypeVar("_R")

_LOG = logging.getLogger(__name__)
_ONCE = "once after an installation or an update: the first use takes some seconds longer"
_ALWAYS = "for some seconds in every program: there is no folder to keep it that can be written"
_notes: dict[Any, str] = {}
"""How often a function is compiled, by its Python code."""
_imports: dict[str, set[str]] = {}
"""Modules with kernels, and those of them whose kernels they import, also through others."""


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function of arrays and numbers; `py_func` is its Python code."""
    return _compile(function)


def compiled_part(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function that only compiled functions call.

    It has no entry for Python: so all kernels compile in five sixths of the time.
    """
    kernel = _compile(function, no_cpython_wrapper=True)
    return function if kernel is function else _Part(kernel)  # Numba may be off


def _compile(function: Callable[_P, _R], **options: Any) -> Any:
    # division by zero gives infinity or nan, as in NumPy; no entry for C saves compile time
    options |= {"error_model": "numpy", "no_cfunc_wrapper": True}
    _notes[function] = _ONCE
    name = function.__qualname__
    function.__qualname__ += _digest_of_imports(function)  # is in the name of Numba's cache file
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder is writable: every program compiles again
        _notes[function] = _ALWAYS
        return numba.njit(**options)(function)
    finally:
        function.__qualname__ = name


def _digest_of_imports(function: Callable[..., Any]) -> str:
    """Digest of all files with kernels that the function may call, except its own; "" for none."""
    modules = sorted(_imported_modules(function))
    if not modules:
        return ""
    try:
        sources = [inspect.getsource(sys.modules[name]) for name in modules]
    except OSError:  # without source files Numba keeps no code either
        return ""
    return "-" + hashlib.sha256("".join(sources).encode()).hexdigest()[:16]


def _imported_modules(function: Callable[..., Any]) -> set[str]:
    """Modules whose kernels the function's module imports; they are recorded with theirs."""
    own = function.__module__
    names = {getattr(value, "__module__", own) for value in function.__globals__.values()}
    direct = (names & _imports.keys()) - {own}
    _imports[own] = direct.union(*(_imports[name] for name in direct))
    return _imports[own]


class _Part(Generic[_P, _R]):
    """A function for compiled callers; the first call from Python compiles an entry."""

    def __init__(self, kernel: Any) -> None:
        update_wrapper(self, kernel.py_func)
        self.py_func = kernel.py_func
        self.kernel = kernel
        self._numba_type_ = types.Dispatcher(kernel)  # Numba calls it as its dispatcher

    def __call__(self, *arguments: _P.args, **keywords: _P.kwargs) -> _R:
        return self._entry(*arguments, **keywords)

    @cached_property
    def _entry(self) -> Any:
        part: Any = self
        return numba.njit(lambda *arguments: part(*arguments))


class _Compilations(events.Listener):
    """Log the compilation of a kernel; Numba sends no event for one that it loads."""

    def on_start(self, event: events.Event) -> None:
        dispatcher = (event.data or {}).get("dispatcher")
        note = _notes.get(getattr(dispatcher, "py_func", None))
        if note is not None:
            _LOG.info("compiling, %s", note)

    def on_end(self, event: events.Event) -> None:
        """Do nothing: the listener must have this method."""


events.register("numba:compile", _Compilations())


def record_type(**fields: Any) -> np.dtype[Any]:
    """Return the type of the rows of a record array for kernels.

    Args:
        **fields: Shape of each field of numbers, () for a number.
    """
    parts = [(name, np.float64, shape) for name, shape in fields.items()]
    return np.dtype((np.record, parts))


def within_compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a formula that kernels compile, and that Python calls on NumPy arrays as it is."""
    _imported_modules(function)
    return register_jitable(error_model="numpy")(function)


def compile_now(function: Callable[..., Any], *arguments: Any) -> None:
    """Call a function, so that its kernels are compiled or loaded in advance.

    The call runs in a thread of its own: the compiler calls Python back from C code, where the
    exception of a signal such as Ctrl-C would be lost. The main thread, which gets signals, waits.
    """

    def call() -> None:
        try:
            function(*arguments)
        except OSError:
            # compiled but not cached: a full disk costs the next program time
            function(*arguments)

    with ThreadPoolExecutor(max_workers=1) as executor:
        executor.submit(call).result()
