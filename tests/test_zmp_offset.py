"""The planned ZMP that is shifted against its mean error."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import PolicyInputs, Zero
from baselines.walking.zmp_offset import ZmpOffset, ZmpOffsetGains
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import RobotModel

OFFSET_M = np.array([0.011, -0.004])
STEPS = 500


def vector(scenario: str = "nominal", num_envs: int = 2) -> Any:
    """Worlds of the walker at 3 s."""
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        scenario=scenario,
        num_threads=1,
    )


class Recorder(Zero):
    """A policy that notes how far it is asked to shift the ZMP."""

    def __init__(self, model: RobotModel) -> None:
        super().__init__(model)
        self.shifts: list[Array] = []

    def act(self, rows: Array, memory: None, inputs: PolicyInputs) -> tuple[Array, None]:
        assert inputs.zmp is not None
        self.shifts.append(inputs.zmp.copy())
        return super().act(rows, memory, inputs)


def standing(env: Any) -> Array:
    """Observations of two worlds that stand; the ground's forces act off the planned ZMP, in the
    second one not."""
    observation, _ = env.reset(seed=0)
    rows = np.array(observation, dtype=np.float64)
    table = env.unwrapped.task.observation_table
    biped = env.unwrapped.task.assumed_model.biped
    half = biped.weight / 2.0
    x, y = OFFSET_M
    feet = FootSensors.of_biped(biped)
    wrench = np.zeros((2, 2, 2, 3))
    for foot in range(2):
        mass_n = -feet.weight[foot, 2]
        wrench[:, foot, 0, 2] = half - mass_n  # what the ankle carries
        # the ground pushes up at (x, y) from the ankle, and the foot's own weight pulls down at its
        # center
        wrench[0, foot, 1] = [y * half, -x * half, 0.0]
        wrench[:, foot, 1, :2] += np.array([-feet.com[foot, 1], feet.com[foot, 0]]) * mass_n
    rows[:, table.group("wrench")] = wrench.reshape(2, -1)
    rows[:, table.group("zmp_reference")] = biped.ankles[:, :2].mean(axis=0)
    return rows


def test_a_constant_error_is_integrated_up_to_the_limit() -> None:
    """Catches a wrong sign, a foot that weighs nothing, a rate per step in place of per second,
    and no limit."""
    env = vector()
    model = env.unwrapped.task.assumed_model
    recorder = Recorder(model)
    policy = ZmpOffset(recorder, model, ZmpOffsetGains(time_constant_s=2.0, limit_m=0.008))
    rows = standing(env)
    state = None
    for step in range(STEPS):
        _, state = policy.predict(rows, state, np.full(2, step == 0))
    time_s = np.arange(1, STEPS + 1) * model.control_period_s
    expected = np.clip(-OFFSET_M * time_s[:, None] / 2.0, -0.008, 0.008)
    assert abs(expected[-1, 0]) == 0.008 > abs(expected[-1, 1])
    shifts = np.array(recorder.shifts)
    np.testing.assert_allclose(shifts[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(shifts[:, 1], 0.0, atol=1e-12)
    policy.predict(
        rows, state, np.array([True, False]), inputs=PolicyInputs(zmp=np.full((2, 2), 0.01))
    )
    np.testing.assert_allclose(
        recorder.shifts[-1][0], 0.01 - OFFSET_M * time_s[0] / 2.0, atol=1e-12
    )
    np.testing.assert_allclose(recorder.shifts[-1][1], 0.01, atol=1e-12)


def test_on_a_slope_the_mean_error_of_the_zmp_goes() -> None:
    """Catches an integral that the body does not follow, and one that is never built in: two
    robots with the offset beside the same two without."""
    env = vector("slope", 4)
    policies = [
        baselines.make("adaptive_posture", env, zmp_offset=offset)
        for offset in (None, {"time_constant_s": 1.0})
    ]
    observation, _ = env.reset(seed=[3, 4, 3, 4])
    states: list[Any] = [None, None]
    deviations = []
    for step in range(950):
        actions = []
        for i, rows in enumerate(np.split(observation, 2)):
            action, states[i] = policies[i].predict(rows, states[i], np.full(2, step == 0))
            actions.append(action)
        observation, *_, info = env.step(np.concatenate(actions))
        deviations.append([info["zmp_deviation_x"], info["zmp_deviation_y"]])
    mean = np.linalg.norm(np.nanmean(deviations[650:], axis=0), axis=0)
    plain, shifted = np.split(mean, 2)
    assert (plain > 5e-3).all()
    assert (shifted < 0.5 * plain).all()


def test_gains_that_are_not_named_keep_the_values_of_the_policy() -> None:
    """Catches the time constant of `adaptive_posture` in `foothold`, whose own is 23 s."""
    env = vector("slope")
    given = (
        {"limit_m": 0.02},
        {"limit_m": 0.02, "time_constant_s": 23.0},
        {"limit_m": 0.02, "time_constant_s": 6.0},
    )
    policies = [baselines.make("foothold", env, zmp_offset=gains) for gains in given]
    states: list[Any] = [None] * 3
    observation, _ = env.reset(seed=3)
    for _ in range(100):
        moves = [
            policy.predict(observation, state)
            for policy, state in zip(policies, states, strict=True)
        ]
        states = [state for _, state in moves]
        observation, *_ = env.step(moves[0][0])
    np.testing.assert_array_equal(moves[0][0], moves[1][0])
    assert not np.array_equal(moves[0][0], moves[2][0])


def test_policies_without_posture_feedback_have_none() -> None:
    """Catches an option that is taken and has no effect."""
    with pytest.raises(ConfigurationError, match="zmp_offset"):
        baselines.make("input_output", vector(), zmp_offset={})
