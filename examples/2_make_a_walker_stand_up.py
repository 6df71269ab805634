"""
2. Make a walker stand up straight
==================================

A humanoid of 57 kg walks in place on twelve elastic joints. Without compensation its pelvis tilts
towards the leg in the air.

The first walk on a computer compiles for some ten seconds.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import baselines
import elastic_env  # noqa: F401

env = gymnasium.make("elastic_env/WalkInPlace-v0", step_period=3.0, num_steps=2, scenario="nominal")


def walk(name: str) -> dict:
    """Roll of the pelvis [rad] at every step, and the metrics of the walk."""
    policy = baselines.make(name, env)
    observation, info = env.reset(seed=0)
    state = None
    done = False
    roll = []
    while not done:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        roll.append(info["pelvis_roll"])
        done = terminated or truncated
    return {"roll": np.array(roll), **info["episode_metrics"]}


# %%
# ``input_output`` is the paper's method: Eq. 9 on the command, and Eq. 12 on the encoders that the
# feedback reads.
# ``adaptive_posture`` also estimates the stiffness while it walks, and feeds the IMU back to the
# hips.

walks = {name: walk(name) for name in ("uncompensated", "input_output", "adaptive_posture")}
for name, metrics in walks.items():
    print(
        f"{name:17} pelvis {1e3 * metrics['pelvis_error_rms_rad']:5.1f} mrad,"
        f" ZMP {1e3 * metrics['zmp_deviation_rms_m']:5.1f} mm, fell: {bool(metrics['fell'])}"
    )

fig, ax = plt.subplots(figsize=(7, 3.2))
for name, metrics in walks.items():
    ax.plot(0.004 * np.arange(len(metrics["roll"])), 1e3 * metrics["roll"], label=name)
ax.set(xlabel="time [s]", ylabel="roll of the pelvis [mrad]")
ax.legend()
fig.tight_layout()
plt.show()

assert (
    walks["input_output"]["pelvis_error_rms_rad"]
    < walks["uncompensated"]["pelvis_error_rms_rad"] / 5
)
