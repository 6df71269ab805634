"""Warnings of long work: each text once, however many environments and processes give it."""

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

_SAID: ContextVar[set[str] | None] = ContextVar("said", default=None)


def shown_warnings() -> frozenset[str]:
    """Texts that were shown within `warn_once`, for processes that shall not show them again."""
    return frozenset(_SAID.get() or ())


@contextmanager
def warn_once(said: Iterable[str] = ()) -> Iterator[None]:
    """Show each warning within once.

    Args:
        said: Texts that were shown before, such as in the process that started this one.
    """
    outer = _SAID.get()
    known = {*said} if outer is None else outer
    known.update(said)
    token = _SAID.set(known)
    before = warnings.showwarning

    def show(message: Warning | str, *where: Any) -> None:
        if str(message) not in known:
            known.add(str(message))
            before(message, *where)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = before
        _SAID.reset(token)
