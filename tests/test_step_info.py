"""The info that is computed when it is looked at, against a plain dictionary."""

import copy
import json
import pickle
from collections.abc import Callable
from typing import Any

import pytest

from elastic_env.world.control_step import StepInfo

PLAIN = {"given": 1, "other": 2, "late": 3, "later": 4}


class Counted:
    """Makes the rest, and counts how often."""

    calls = 0

    def __call__(self) -> dict[str, Any]:
        """The keys that are not given."""
        self.calls += 1
        return {"late": 3, "later": 4}


def info() -> tuple[StepInfo, Counted]:
    """A fresh info and what makes its rest."""
    rest = Counted()
    return StepInfo({"given": 1, "other": 2}, rest), rest


LOOKS: dict[str, Callable[[Any], Any]] = {
    "item": lambda d: d["late"],
    "get": lambda d: d.get("late"),
    "get nothing": lambda d: d.get("none", 7),
    "in": lambda d: ("late" in d, "none" in d),
    "iter": list,
    "reversed": lambda d: list(reversed(d)),
    "len": len,
    "keys": lambda d: list(d.keys()),
    "values": lambda d: list(d.values()),
    "items": lambda d: list(d.items()),
    "dict": dict,
    "unpack": lambda d: {**d},
    "or": lambda d: d | {"late": 9, "new": 5},
    "ror": lambda d: {"late": 9, "new": 5} | d,
    "equal": lambda d: (d == PLAIN, d != PLAIN, d == {"given": 1}),
    "repr": repr,
    "json": json.dumps,
    "copy": lambda d: d.copy(),
    "copy.copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda d: pickle.loads(pickle.dumps(d)),
    "pop": lambda d: (d.pop("late"), dict(d)),
    "pop nothing": lambda d: d.pop("none", 7),
    "popitem": lambda d: d.popitem(),
    "setdefault": lambda d: (d.setdefault("late", 8), d.setdefault("new", 5), dict(d)),
    "del": lambda d: (d.__delitem__("late"), dict(d)),
    "bool": bool,
}


@pytest.mark.parametrize("look", LOOKS)
def test_it_is_a_dictionary_with_everything(look: str) -> None:
    """Catches a way of looking that misses the rest, computes it twice, or sees another order."""
    lazy, rest = info()
    assert LOOKS[look](lazy) == LOOKS[look](dict(PLAIN))
    LOOKS["items"](lazy)
    assert rest.calls == 1


def test_what_is_given_costs_nothing() -> None:
    """Catches a rest that is computed although nobody asks for it, and one that overwrites what
    was set."""
    lazy, rest = info()
    assert (lazy["given"], "other" in lazy) == (1, True)
    lazy["late"] = "mine"
    assert rest.calls == 0
    assert dict(lazy) == {**PLAIN, "late": "mine"}
    assert isinstance(lazy, dict)


def test_a_key_that_is_nowhere_is_an_error() -> None:
    """Catches a missing key that recurses or passes for None."""
    lazy, _ = info()
    for _ in range(2):
        with pytest.raises(KeyError, match="none"):
            lazy["none"]
