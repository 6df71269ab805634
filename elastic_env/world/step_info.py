"""The info of a step, most of which nobody may ever look at."""

import functools
from collections.abc import Callable
from typing import Any


class StepInfo(dict[str, Any]):
    """A dictionary part of which is computed when it is first needed.

    Looking at a key that is given from the start costs nothing; anything else computes the rest,
    once.

    Args:
        given: What is known.
        rest: Makes the rest, without any of the given keys; it must not depend on when it is
            called.
    """

    __slots__ = ("_rest",)

    def __init__(self, given: dict[str, Any], rest: Callable[[], dict[str, Any]] | None) -> None:
        super().__init__(given)
        self._rest = rest

    def _settle(self) -> None:
        if self._rest is not None:
            rest = self._rest
            self._rest = None
            for key, value in rest().items():
                super().setdefault(key, value)

    def __missing__(self, key: str) -> Any:
        if self._rest is None:
            raise KeyError(key)
        self._settle()
        return self[key]

    def __contains__(self, key: object) -> bool:
        if not super().__contains__(key):
            self._settle()
        return super().__contains__(key)

    def clear(self) -> None:
        """As `dict.clear`."""
        self._rest = None
        super().clear()

    def __eq__(self, other: object) -> bool:
        theirs = other.copy() if isinstance(other, StepInfo) else other
        return self.copy() == theirs

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = None  # type: ignore[assignment]

    def __reduce_ex__(self, protocol: Any) -> Any:
        return dict, (self.copy(),)


def _when_complete(name: str) -> Callable[..., Any]:
    """A method of dictionaries, after the rest has been computed."""
    method: Callable[..., Any] = getattr(dict, name)

    @functools.wraps(method)
    def of_all(self: StepInfo, *arguments: Any) -> Any:
        self._settle()
        return method(self, *arguments)

    return of_all


_ALTERED = ("pop", "popitem", "setdefault", "__delitem__")
_READ = ("get", "keys", "values", "items", "copy")
_BY_OPERATORS = ("__iter__", "__reversed__", "__len__", "__repr__", "__or__")
for _name in (*_ALTERED, *_READ, *_BY_OPERATORS):
    setattr(StepInfo, _name, _when_complete(_name))
