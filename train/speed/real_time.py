"""Latency of a policy that is called at the control rate, as on a robot."""

import contextlib
import time
from itertools import islice
from typing import Any

import gymnasium
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware.safety import realtime
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.environments import environment
from train.evaluate.rollout import control_steps, make_policy, policy_errors

PERCENTILES = {"median": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}
"""Reported percentiles of the latency [%]."""


def play_against_the_clock(
    env_name: str, policy_name: str | None, seconds: float
) -> dict[str, Any]:
    """Record what a policy observes in an episode, then call it with that at the control rate.

    The loop requests real-time scheduling, as a motion on hardware does. If the episode is too
    short, it starts again, with a policy that remembers nothing.

    Args:
        env_name: Name of the environment.
        policy_name: Policy that is timed; None for adaptive_posture on the walker, input on the
            testbed.
        seconds: Time for which the policy is called [s].

    Returns:
        Environment, policy, whether the system granted real-time scheduling, and the figures of
        `summarise`.

    Raises:
        ConfigurationError: Environment or policy does not exist.
        PolicyFailedError: The policy failed.
    """
    defaults = environment(env_name)
    name = policy_name or defaults.live_policy or defaults.looped_policy
    condition = Condition(env=env_name, policy=PolicySpec(name=name))
    env: Any = gymnasium.make(condition.environment.id, **condition.arguments)
    with contextlib.closing(env):
        policy = make_policy(condition.policy, env)
        period_s = env.unwrapped.assumed_model.control_period_s
        cycles = max(round(seconds / period_s), 1)
        with policy_errors(condition):
            steps = list(islice(control_steps(env, policy, seed=0), max(cycles - 1, 1)))
            observations = [steps[0].seen, *(s.observation for s in steps)][:cycles]
            is_real_time = realtime.prefer_realtime(realtime.Priority.LOOP)
            try:
                latency_s, policy_s = _measure(policy, observations, cycles, period_s)
            finally:
                realtime.give_up_realtime()
    figures = summarise(period_s, latency_s, policy_s)
    return {"env": env_name, "policy": name, "is_real_time": is_real_time, **figures}


def _measure(
    policy: Any, observations: list[Any], cycles: int, period_s: float
) -> tuple[Array, Array]:
    """Return latency and time in the policy, (cycles,) [s]; cycles that begin late count too."""
    latency_s = np.empty(cycles)
    policy_s = np.empty(cycles)
    state: Any = None
    begin = time.perf_counter() + period_s
    for number in range(cycles):
        due = begin + number * period_s
        index = number % len(observations)
        observation = observations[index]
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


def summarise(period_s: float, latency_s: Array, policy_s: Array) -> dict[str, float]:
    """Return number and share of late cycles, and percentiles of latency and policy time [µs].

    A cycle is late if its command is not ready when the next cycle is due.

    Args:
        period_s: Control period [s].
        latency_s: Time from when a cycle was due until its command was ready, (cycles,) [s]. It
            includes the delay with which the system wakes the program.
        policy_s: Time in the policy, without that delay, (cycles,) [s].
    """
    late = int(np.count_nonzero(latency_s > period_s))
    percentiles = {
        f"{title}_{name}_us": 1e6 * float(np.percentile(values, percentile))
        for title, values in (("latency", latency_s), ("policy", policy_s))
        for name, percentile in PERCENTILES.items()
    }
    return {
        "period_us": 1e6 * period_s,
        "cycles": len(latency_s),
        "late": late,
        "late_share": late / len(latency_s),
        **percentiles,
    }
