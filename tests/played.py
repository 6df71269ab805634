"""An episode played to its end."""

from typing import Any

import numpy as np

import baselines


def play_to_the_end(env: Any, policy: Any, seed: int = 0) -> dict[str, Any]:
    """Info of the last step of an episode without a failure."""
    observation, info = env.reset(seed=seed)
    state = None
    start = np.array(True)
    is_over = False
    while not is_over:
        action, state = policy.predict(observation, state, start)
        observation, _, terminated, truncated, info = env.step(action)
        is_over = terminated or truncated
        start = np.array(False)
    assert info["termination"] == ""
    return info


def metrics_of(env: Any, policy: str) -> dict[str, Any]:
    """Figures of an episode that a named policy plays, without a failure."""
    return play_to_the_end(env, baselines.make(policy, env))["episode_metrics"]
