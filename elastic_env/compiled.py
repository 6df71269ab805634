"""Functions that Numba compiles: arithmetic row by row, without what NumPy takes for each operation on small arrays.

They are compiled when first called, once per machine: the result is kept beside the source file, or in the user's cache
folder where that cannot be written. Sums run in the order that is written and no operation is fused with another, so
that a row's result does not depend on how many rows there are.
"""

import functools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core.caching import FunctionCache

_P = ParamSpec("_P")
_R = TypeVar("_R")


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function of arrays and numbers; its own Python code is the attribute `py_func`."""
    # as in NumPy, what is divided by zero is infinite or nan
    made: Any = numba.njit(error_model="numpy")(function)
    made._cache = _Cache(function)
    made.compile = _beside_the_main_thread(made.compile)
    return made


def _beside_the_main_thread(compile_: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Compile, or load, in a thread of its own.

    The compiler calls back from C code, where the exception of a signal such as Ctrl-C would be lost; those are raised
    in the main thread, and only there.
    """

    def compile_beside(signature: Any) -> Any:
        if threading.current_thread() is not threading.main_thread():
            return compile_(signature)
        with ThreadPoolExecutor(max_workers=1) as beside:
            return beside.submit(compile_, signature).result()

    return compile_beside


class _Cache(FunctionCache):
    """What was compiled, until any module of this package changes.

    Numba's own asks for the module of the function alone, but what that calls and the constants that it imports are
    compiled into it.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file._source_stamp = _package_stamp()


@functools.cache
def _package_stamp() -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every module."""
    package = Path(__file__).parent
    modules = ((path, path.stat()) for path in sorted(package.rglob("*.py")))
    return tuple((str(path.relative_to(package)), stat.st_mtime_ns, stat.st_size) for path, stat in modules)
