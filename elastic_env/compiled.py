"""Functions that Numba compiles: arithmetic row by row, without what NumPy takes for each operation on small arrays.

They are compiled when first called with arrays of a kind, and kept beside the source file or, where that cannot be
written, in the user's cache folder; where that cannot be written either, every program compiles its own. Sums run in
the order that is written and no operation is fused with another, so that a row's result does not depend on how many
rows there are.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core.caching import FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.serialize import dumps

_P = ParamSpec("_P")
_R = TypeVar("_R")


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function of arrays and numbers; its own Python code is the attribute `py_func`."""
    # as in NumPy, what is divided by zero is infinite or nan
    made: Any = numba.njit(error_model="numpy")(function)
    if made is function:  # NUMBA_DISABLE_JIT, with which a debugger sees every line
        return function
    with contextlib.suppress(RuntimeError):  # there is no folder to keep it in
        made._cache = _Cache(function)
    made.compile = _beside_the_main_thread(made.compile)
    return made


def _beside_the_main_thread(compile_: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Compile, or load, in a thread of its own.

    The compiler calls back from C code, where the exception of a signal such as Ctrl-C would be lost; those are raised
    in the main thread, and only there.
    """

    def compile_beside(signature: Any) -> Any:
        # a function that is compiled as part of another waits for no other thread: that one would wait for the lock
        if threading.current_thread() is not threading.main_thread() or global_compiler_lock.is_locked():
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
        self._cache_file = _Files(Path(self._cache_path), self._impl.filename_base, _package_stamp())

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled; where that fails, as on a full disk, it costs the next program time, and no more."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)


class _Files:
    """One file for each signature of a function, so that processes that write at the same time mix nothing up.

    Args:
        folder: Where they are.
        function: What the function is called there.
        stamp: Of the code; files with another one are removed.
    """

    def __init__(self, folder: Path, function: str, stamp: str) -> None:
        self._folder, self._function, self._stamp = folder, function, stamp

    def load(self, key: Any) -> Any:
        """What was saved under a key; None if nothing was, or nothing whole."""
        try:
            saved_key, data = pickle.loads(self._path(key).read_bytes())
        except Exception:  # what is damaged can raise anything, and is compiled again
            return None
        return data if saved_key == key else None

    def save(self, key: Any, data: Any) -> None:
        """Save, whole or not at all."""
        for old in self._folder.glob(f"{self._function}.*.nbc"):
            if not old.name.startswith(f"{self._function}.{self._stamp}."):
                old.unlink(missing_ok=True)
        path = self._path(key)
        being_written = path.with_suffix(f".{os.getpid()}")
        being_written.write_bytes(dumps((key, data)))
        being_written.replace(path)

    def flush(self) -> None:
        """Forget nothing: the stamp does."""

    def _path(self, key: Any) -> Path:
        return self._folder / f"{self._function}.{self._stamp}.{_digest(repr(key).encode())}.nbc"


@functools.cache
def _package_stamp() -> str:
    """Of all code that may be compiled, and of what compiles it."""
    return _stamp_of(Path(__file__).parent)


def _stamp_of(folder: Path) -> str:
    modules = (
        path.relative_to(folder).as_posix().encode() + path.read_bytes() for path in sorted(folder.rglob("*.py"))
    )
    return _digest(numba.__version__.encode(), *modules)


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]
