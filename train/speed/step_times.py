"""Processor time of policies for a control step of one world, in turn on one thread."""

import statistics
import time
from collections.abc import Sequence
from itertools import islice
from typing import Any

from train.evaluate.conditions import Condition
from train.evaluate.rollout import control_steps, make_policy, make_vector_env

_STEPS = 50
"""Control steps per round: two decisions of a residual, which take 25 steps each."""
_ROUNDS = 15
"""Rounds; the result is their median."""


def step_times(
    conditions: Sequence[Condition], steps: int = _STEPS, rounds: int = _ROUNDS
) -> dict[str, float]:
    """Return the median processor time of every policy for a control step [µs], by title.

    The policies play one world in turn, round by round, so that other load on the computer concerns
    all of them. The first round compiles and does not count. A residual plays with its first
    training seed. Processor time excludes other programs.

    Args:
        conditions: Cells of a comparison; each policy plays its first cell.
        steps: Control steps per round.
        rounds: Counted rounds.
    """
    first: dict[str, Condition] = {}
    for condition in conditions:
        first.setdefault(condition.policy.title, condition)
    players = {title: _Player(condition) for title, condition in first.items()}
    try:
        times: dict[str, list[float]] = {title: [] for title in players}
        for number in range(rounds + 1):
            for title, player in players.items():
                spent_s = player.play(steps)
                if number > 0:
                    times[title].append(1e6 * spent_s / steps)
    finally:
        for player in players.values():
            player.close()
    return {title: statistics.median(values) for title, values in times.items()}


class _Player:
    """A policy in an environment of one world; it measures its own processor time."""

    def __init__(self, condition: Condition) -> None:
        self._env = make_vector_env(condition, 1, num_threads=1)
        self._policy = make_policy(condition.policy, self._env, condition.policy_options)
        self._spent_s = 0.0
        self._steps = control_steps(self._env, self, condition.seed)

    def predict(self, *arguments: Any, **options: Any) -> tuple[Any, Any]:
        """Return the command of the policy, and add its processor time to the sum."""
        begin = time.process_time()
        prediction = self._policy.predict(*arguments, **options)
        self._spent_s += time.process_time() - begin
        return prediction

    def play(self, steps: int) -> float:
        """Play control steps, and return the time of the policy alone [s]."""
        before = self._spent_s
        for _ in islice(self._steps, steps):
            pass
        return self._spent_s - before

    def close(self) -> None:
        """Close the environment."""
        self._env.close()
