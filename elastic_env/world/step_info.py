"""Info of a step, computed only if somebody reads it."""

import functools
from collections.abc import Callable
from typing import Any

_Compute = Callable[[], dict[str, Any]]


class StepInfo(dict[str, Any]):
    """A dictionary that computes some of its entries at first use.

    Reading a key of `known` costs nothing; any other access computes the rest, once.

    Args:
        known: Entries that exist from the start.
        compute_rest: Computes the other entries; the result must not depend on when it is called.
    """

    __slots__ = ("_compute_rest",)

    def __init__(self, known: dict[str, Any], compute_rest: _Compute) -> None:
        super().__init__(known)
        self._compute_rest: _Compute | None = compute_rest

    def _complete(self) -> None:
        if self._compute_rest is not None:
            compute_rest = self._compute_rest
            self._compute_rest = None
            for key, value in compute_rest().items():
                super().setdefault(key, value)

    def __missing__(self, key: str) -> Any:
        if self._compute_rest is None:
            raise KeyError(key)
        self._complete()
        return self[key]

    def __contains__(self, key: object) -> bool:
        if not super().__contains__(key):
            self._complete()
        return super().__contains__(key)

    def clear(self) -> None:
        """Remove all entries, including those not yet computed."""
        self._compute_rest = None
        super().clear()

    def __eq__(self, other: object) -> bool:
        theirs = other.copy() if isinstance(other, StepInfo) else other
        return self.copy() == theirs

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = None  # type: ignore[assignment]

    def __reduce_ex__(self, protocol: Any) -> Any:
        return dict, (self.copy(),)


def _completing_method(name: str) -> Callable[..., Any]:
    """Return a method of `dict` that first computes the missing entries."""
    method: Callable[..., Any] = getattr(dict, name)

    @functools.wraps(method)
    def complete_and_call(self: StepInfo, *arguments: Any) -> Any:
        self._complete()
        return method(self, *arguments)

    return complete_and_call


_WRITERS = ("pop", "popitem", "setdefault", "__delitem__")
_READERS = ("get", "keys", "values", "items", "copy")
_OPERATORS = ("__iter__", "__reversed__", "__len__", "__repr__", "__or__")
for _name in (*_WRITERS, *_READERS, *_OPERATORS):
    setattr(StepInfo, _name, _completing_method(_name))
