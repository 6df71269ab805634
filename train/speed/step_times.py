"""Processor time of policies for a control step of one world, in turn on one thread."""

import statistics
import time
from collections.abc import Sequence
from itertools import islice
from typing import Any

from train.evaluate.conditions import Condition
from train.evaluate.rollout import control_steps, make_policy, make_vector_env

_STEPS = 50
_ROUNDS = 15
"""Control steps per round: whole decisions of residuals, which take 25; rounds, of which the
median counts.
"""


def step_times(
    conditions: Sequence[Condition], steps: int = _STEPS, rounds: int = _ROUNDS
) -> dict[str, float]:
    """Median processor time of every policy alone for a control step of one world [µs], by title.

    The policies play in turn, round by round, so that what else the computer does concerns all of
    them alike. The first round compiles and warms up, and does not count. Of a residual the first
    training seed plays. Processor time does not count what other programs take meanwhile.

    Args:
        conditions: Cells of a comparison; each policy plays the first of its own.
        steps: Control steps per round.
        rounds: Rounds that count.
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
    return {title: statistics.median(own) for title, own in times.items()}


class _Player:
    """A policy in an environment of one world; it measures itself."""

    def __init__(self, condition: Condition) -> None:
        self._env = make_vector_env(condition, 1, num_threads=1)
        options = condition.policy_options
        self._policy = make_policy(condition.policy, self._env, options)
        self._spent_s = 0.0
        self._steps = control_steps(self._env, self, condition.seed)

    def predict(self, *arguments: Any, **options: Any) -> tuple[Any, Any]:
        """The command of the policy; its processor time is added up."""
        begin = time.process_time()
        found = self._policy.predict(*arguments, **options)
        self._spent_s += time.process_time() - begin
        return found

    def play(self, steps: int) -> float:
        """Play control steps; the time that the policy alone took [s]."""
        before = self._spent_s
        for _ in islice(self._steps, steps):
            pass
        return self._spent_s - before

    def close(self) -> None:
        """End the environment."""
        self._env.close()
