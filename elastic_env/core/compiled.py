"""Functions that Numba compiles: arithmetic row by row.

NumPy takes longer, as each of its operations has a fixed cost on small arrays.

Numba compiles them when they are first called with arrays of a kind. It keeps the code beside the
source file or in the user's cache folder, by the file of the function that was called. So a kernel
stands in one file with all that it calls, and takes sizes from types, not from constants of other
files; a test sees to that. Sums run in the order that is written and no operation is fused with
another. So a row's result does not depend on how many rows there are.

The logger `elastic_env.core.compiled` says at level INFO that a function of ours is compiled, and
nothing where it is loaded. So a program can say why its first use takes long.
"""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
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
_EVER = "for some seconds in every program: there is no folder to keep it that can be written"
_said_of: dict[Any, str] = {}
"""When a function is compiled, by its Python code."""


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function of arrays and numbers; its own Python code is the attribute `py_func`."""
    return _by_numba(function)


def compiled_part(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate what only compiled functions call.

    Without the code that Python's calls need, all kernels compile in five sixths of the time.
    """
    kernel = _by_numba(function, no_cpython_wrapper=True)
    return function if kernel is function else _Part(kernel)  # Numba may be switched off


def _by_numba(function: Callable[_P, _R], **options: Any) -> Any:
    # as in NumPy, what is divided by zero is infinite or nan; nobody calls it from C, which saves
    # some compiling
    options |= {"error_model": "numpy", "no_cfunc_wrapper": True}
    _said_of[function] = _ONCE
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder can be written: every program compiles its own
        _said_of[function] = _EVER
        return numba.njit(**options)(function)


class _Part(Generic[_P, _R]):
    """A function that compiled functions call. The first call from Python compiles an entry."""

    def __init__(self, kernel: Any) -> None:
        self.py_func = kernel.py_func
        self.kernel = kernel
        self._numba_type_ = types.Dispatcher(kernel)  # what Numba takes it for

    def __call__(self, *arguments: _P.args, **keywords: _P.kwargs) -> _R:
        return self._entry(*arguments, **keywords)

    @cached_property
    def _entry(self) -> Any:
        part: Any = self
        return numba.njit(lambda *arguments: part(*arguments))


class _Compilations(events.Listener):
    """Logs that a function of ours is compiled; Numba tells nothing of one that it loads."""

    def on_start(self, event: events.Event) -> None:
        """A compilation begins, of whatever function."""
        dispatcher = (event.data or {}).get("dispatcher")
        said = _said_of.get(getattr(dispatcher, "py_func", None))
        if said is not None:
            _LOG.info("compiling, %s", said)

    def on_end(self, event: events.Event) -> None:
        """It ends."""


events.register("numba:compile", _Compilations())


def record_type(**fields: Any) -> np.dtype[Any]:
    """Type of the rows of a record array for kernels.

    Args:
        **fields: Shape of each field of numbers, () for a number.
    """
    parts = [(name, np.float64, shape) for name, shape in fields.items()]
    return np.dtype((np.record, parts))


def within_compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a formula that kernels compile and Python calls as it is, with NumPy's arrays."""
    return register_jitable(error_model="numpy")(function)


def compile_now(function: Callable[..., Any], *arguments: Any) -> None:
    """Call a function so that all that it needs is compiled, or loaded, before it is needed.

    This happens in a thread of its own. The compiler calls Python back from C code, where the
    exception of a signal such as Ctrl-C would be lost. The main thread, which gets signals, waits.
    """

    def call() -> None:
        try:
            function(*arguments)
        except OSError:
            # compiled, and not kept: a full disk costs the next program time
            function(*arguments)

    with ThreadPoolExecutor(max_workers=1) as beside:
        beside.submit(call).result()
