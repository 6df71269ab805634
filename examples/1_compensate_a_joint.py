"""
1. Compensate a joint
=====================

One joint with an elastic gear carries a pendulum. We play a slow sine three times, and look at the
link.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import baselines
import elastic_env  # noqa: F401  registers the environments

env = gymnasium.make("elastic_env/Testbed-v0", scenario="nominal", reference="sine")

# %%
# A policy gets an observation and returns a command offset in rad. ``uncompensated`` commands the
# reference.
# ``input`` adds the deflection under gravity (Eq. 9). ``dynamic`` adds that under the full joint
# torque.


def play(name: str) -> dict:
    """Link error [rad] of every step, and the metrics of the episode."""
    policy = baselines.make(name, env)
    observation, info = env.reset(seed=0)
    state = None
    done = False
    errors = []
    while not done:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        errors.append(info["link_error"])
        done = terminated or truncated
    return {"errors": np.array(errors), **info["episode_metrics"]}


results = {name: play(name) for name in ("uncompensated", "input", "dynamic")}
for name, result in results.items():
    print(f"{name:13} {1e3 * result['link_error_rms_rad']:5.2f} mrad rms")

# %%
# Gravity compensation removes the large slow error. The rest is friction: it changes sign where the
# joint turns round.

fig, ax = plt.subplots(figsize=(7, 3.2))
for name, result in results.items():
    ax.plot(0.004 * np.arange(len(result["errors"])), 1e3 * result["errors"], label=name)
ax.set(xlabel="time [s]", ylabel="link error [mrad]")
ax.legend()
fig.tight_layout()
plt.show()

assert results["dynamic"]["link_error_rms_rad"] < results["uncompensated"]["link_error_rms_rad"] / 2
