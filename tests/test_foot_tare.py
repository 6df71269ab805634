"""Foot sensors that are set to zero in every swing."""

from typing import Any

import gymnasium
import numpy as np

import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import PolicyInputs, Zero
from baselines.walking.foot_tare import FootTare, FootTareGains, unloaded_wrench
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import RobotModel

BIAS = np.arange(12.0).reshape(2, 2, 3) - 5.0


class Recorder(Zero):
    """A policy that notes the wrenches that it sees."""

    def __init__(self, model: RobotModel) -> None:
        super().__init__(model)
        self.wrench = model.observation_table.group("wrench")
        self.seen: list[Array] = []

    def act(self, rows: Array, memory: None, inputs: PolicyInputs) -> tuple[Array, None]:
        self.seen.append(rows[0, self.wrench].reshape(2, 2, 3).copy())
        return super().act(rows, memory, inputs)


def walker(**options: Any) -> Any:
    return gymnasium.make("elastic_env/WalkInPlace-v0", **options).unwrapped


def test_a_constant_bias_goes_with_the_first_swing_of_each_foot() -> None:
    """Catches the wrong foot, the wrong sign, a mean that goes on, and a loaded foot."""
    walk = walker(num_steps=4, step_period=1.1).task
    model = walk.assumed_model
    recorder = Recorder(model)
    policy = FootTare(recorder, model, FootTareGains())
    timing = walk.plan.timing
    unloaded = unloaded_wrench(model)
    table = walk.observation_table
    state = None
    ends = np.flatnonzero(np.diff((timing.swing > 0.3) & (timing.swing < 0.7 - 1e-9)) == 1)[1::2]
    for row in range(1, len(timing.time)):
        shown = unloaded[row - 1] + BIAS
        standing = int(timing.support[row])
        shown[standing, 0, 2] += 500.0
        observation = np.zeros(len(table))
        observation[table.group("wrench")] = shown.ravel()
        clock = [timing.time[row], timing.swing[row], timing.support[row]]
        observation[table.group("clock")] = clock
        given = observation.copy()
        _, state = policy.predict(observation, state, row == 1)
        np.testing.assert_array_equal(observation, given)
        seen = recorder.seen[-1]
        seen[standing, 0, 2] -= 500.0
        swings = np.zeros(2)
        swings[1] = row > ends[0]
        swings[0] = row > ends[1]
        expected = unloaded[row - 1] + BIAS * (1.0 - swings[:, None, None])
        np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_a_foot_in_the_air_weighs_itself() -> None:
    """Catches the sign of the acceleration, and a moment about another point: MuJoCo's sensor."""
    env = walker(scenario="ideal", num_steps=1, form="rigid")
    walk = env.task
    env.reset(seed=0)
    unloaded = unloaded_wrench(walk.assumed_model)
    swing = walk.plan.timing.swing
    columns = walk.observation_table.group("wrench")
    action = np.zeros(12, dtype=np.float32)
    differences = []
    for row in range(1, walk.num_steps):
        rows, *_ = env.step(action)
        if 0.3 < swing[row] < 0.7:
            differences.append(rows[columns].reshape(2, 2, 3)[1] - unloaded[row, 1])
    mean = np.mean(differences, axis=0)
    weight = abs(unloaded[0, 1, 0, 2])
    still = unloaded[0, 1]
    planned = unloaded[swing > 0.3, 1].mean(axis=0)
    assert not np.allclose(planned, still)
    assert np.abs(mean[0]).max() < 0.04 * weight
    assert np.abs(mean[1]).max() < 0.04 * np.abs(still[1]).max() + 0.01
