"""A policy against the clock: whether its command is ready within the control period, as on a
robot.
"""

import json
import time
from dataclasses import asdict, dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from rich.console import Console
from rich.table import Table

from elastic_env.core.signals import Array
from elastic_env.hardware.safety.realtime import Priority, give_up_realtime, prefer_realtime
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.environments import environment
from train.evaluate.rollout import control_steps, make_policy, policy_errors
from train.runs.console import make_table
from train.runs.folders import run_folder

_PERCENTILES = {"median": 50.0, "p99": 99.0, "p999": 99.9}


@dataclass(frozen=True)
class RealTimeResult:
    """Latencies of a policy against the clock.

    The latency of a cycle is the time from the moment at which it is due to the moment at which its
    command is ready. So it has the delay with which the system wakes the program. The time in the
    policy is without that.

    Attributes:
        env: Environment.
        policy: What was timed.
        is_real_time: Whether the system granted real-time scheduling.
        period_us: Control period [µs].
        cycles: Commands.
        late: Those that were not ready when the next one was due.
        late_share: Their share, from 0 to 1.
        latency_median_us: Median latency.
        latency_p99_us: The latency that 99 % of the cycles do not exceed.
        latency_p999_us: The same of 99.9 %.
        latency_max_us: Longest latency.
        policy_median_us: Median time in the policy.
        policy_p99_us: The time in the policy that 99 % of the cycles do not exceed.
        policy_p999_us: The same of 99.9 %.
        policy_max_us: Longest time in the policy.
    """

    env: str
    policy: str
    is_real_time: bool
    period_us: float
    cycles: int
    late: int
    late_share: float
    latency_median_us: float
    latency_p99_us: float
    latency_p999_us: float
    latency_max_us: float
    policy_median_us: float
    policy_p99_us: float
    policy_p999_us: float
    policy_max_us: float


def play_against_the_clock(
    env_name: str, policy_name: str | None, seconds: float
) -> RealTimeResult:
    """Record what the policy observes in an episode, then call it with that once in every control
    period.

    The loop asks for real-time scheduling, as the one of a motion on hardware does, and tells
    whether it has it.

    The episode begins again, with a policy that remembers nothing, where it is shorter than what is
    to be played.

    Args:
        env_name: Environment.
        policy_name: Policy that is timed; None for adaptive_posture on the walker, input on the
            testbed.
        seconds: How long it is played against the clock [s].

    Raises:
        ConfigurationError: Environment or policy does not exist.
        PolicyFailedError: The policy failed.
    """
    known = environment(env_name)
    name = policy_name or known.live_policy or known.looped_policy
    condition = Condition(
        env=env_name, policy=PolicySpec(name=name), reference=known.default_reference
    )
    env = gymnasium.make(condition.environment.id, **condition.arguments)
    try:
        policy = make_policy(condition.policy, env)
        period_s = env.unwrapped.assumed_model.control_period_s  # type: ignore[attr-defined]
        cycles = max(round(seconds / period_s), 1)
        with policy_errors(condition):
            observations = _record(env, policy, cycles)
            is_real_time = prefer_realtime(Priority.LOOP)
            try:
                latency_s, policy_s = _time(policy, observations, cycles, period_s)
            finally:
                give_up_realtime()
    finally:
        env.close()
    return summary(env_name, name, period_s, latency_s, policy_s, is_real_time=is_real_time)


def _record(env: Any, policy: Any, most: int) -> list[Any]:
    """Observations of an episode with the policy in its loop, at most so many."""
    steps = list(islice(control_steps(env, policy, seed=0), max(most - 1, 1)))
    return [steps[0].seen, *(step.observation for step in steps)][:most]


def _time(
    policy: Any, observations: list[Any], cycles: int, period_s: float
) -> tuple[Array, Array]:
    """Latency and time in the policy, (cycles,) [s]; a cycle that begins late is not left out."""
    latency_s = np.empty(cycles)
    policy_s = np.empty(cycles)
    state: Any = None
    begin = time.perf_counter() + period_s
    for number, (index, observation) in enumerate(islice(cycle(enumerate(observations)), cycles)):
        due = begin + number * period_s
        memory = state if index else None
        start = np.array(index == 0)
        remaining = due - time.perf_counter()
        if remaining > 0.0:
            time.sleep(remaining)
        called = time.perf_counter()
        _, state = policy.predict(
            observation, state=memory, episode_start=start, deterministic=True
        )
        ready = time.perf_counter()
        latency_s[number] = ready - due
        policy_s[number] = ready - called
    return latency_s, policy_s


def summary(
    env: str, policy: str, period_s: float, latency_s: Array, policy_s: Array, *, is_real_time: bool
) -> RealTimeResult:
    """Share of late cycles, and percentiles.

    Args:
        env: Environment.
        policy: What was timed.
        period_s: Control period [s].
        latency_s: Time from when a cycle was due until its command was ready, (cycles,) [s].
        policy_s: Time in the policy, (cycles,) [s].
        is_real_time: Whether the system granted real-time scheduling.
    """
    late = int(np.count_nonzero(latency_s > period_s))
    figures = {
        f"{title}_{name}_us": 1e6 * float(np.percentile(values, percentile))
        for title, values in (("latency", latency_s), ("policy", policy_s))
        for name, percentile in (*_PERCENTILES.items(), ("max", 100.0))
    }
    return RealTimeResult(
        env=env,
        policy=policy,
        is_real_time=is_real_time,
        period_us=1e6 * period_s,
        cycles=len(latency_s),
        late=late,
        late_share=late / len(latency_s),
        **figures,
    )


def measure_real_time(
    env: str, policy: str | None, seconds: float, console: Console, output: Path | None = None
) -> Path:
    """Play, print the latencies, and write them as JSON.

    Args:
        env: Environment.
        policy: Policy that is timed; None for the environment's own.
        seconds: How long it is played [s].
        console: Where the table goes.
        output: Folder for the result; default runs/speed, numbered if taken.

    Returns:
        The file.

    Raises:
        ConfigurationError: Environment or policy does not exist.
        PolicyFailedError: The policy failed.
        ResultsExistError: The output folder holds results.
    """
    with run_folder(
        "speed", {"env": env, "policy": policy, "seconds": seconds}, 0, output
    ) as folder:
        console.print(f"recording an episode, then {seconds:g} s against the clock")
        result = play_against_the_clock(env, policy, seconds)
        path = folder / "real_time.json"
        path.write_text(json.dumps(asdict(result), indent=2) + "\n")
    console.print(_table(result))
    console.print(
        f"late: {result.late} of {result.cycles} cycles, {100.0 * result.late_share:.3f} %",
        highlight=False,
    )
    if not result.is_real_time:
        console.print(
            "without real-time scheduling, to which this user has no right", highlight=False
        )
    return path


def _table(result: RealTimeResult) -> Table:
    title = f"{result.policy} on the {result.env}, once in {result.period_us:.0f} µs; times in µs"
    figures = asdict(result)
    rows = [
        (what, *(f"{figures[f'{key}_{name}_us']:.0f}" for name in (*_PERCENTILES, "max")))
        for what, key in (("from due to command", "latency"), ("in the policy", "policy"))
    ]
    return make_table(title, ["", "median", "99 %", "99.9 %", "longest"], rows)
