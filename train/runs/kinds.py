"""Which configuration is which, so that one that is given to the wrong command is recognised."""

from collections.abc import Callable
from typing import Any

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


def is_a(kind: str) -> Callable[[Any], Any]:
    """A check of raw parameters: they are of a kind, or of none in particular.

    Raises:
        ValueError: More of the keys are of another kind.
    """

    def check(values: Any) -> Any:
        given = set(values) if isinstance(values, dict) else set()

        def count(name: str) -> int:
            return len(given.intersection(TELLING[name][1].split()))

        likely = max(TELLING, key=count)
        if count(likely) > count(kind):
            command = f"{TELLING[likely][0]} FILE"
            raise ValueError(f"this is the configuration of a {likely}: {command}")
        return values

    return check
