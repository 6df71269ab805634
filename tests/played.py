"""An episode played to its end."""

from typing import Any

import numpy as np

import baselines


def metrics_of(env: Any, policy: str) -> dict[str, Any]:
    """Figures of an episode that a policy plays in an environment of one world, without a
    failure."""
    player = baselines.make(policy, env)
    observation, info = env.reset(seed=0)
    state = None
    start = np.array(True)
    while "episode_metrics" not in info:
        action, state = player.predict(observation, state, start)
        observation, *_, info = env.step(action)
        start = np.array(False)
    assert info["termination"] == ""
    return info["episode_metrics"]
