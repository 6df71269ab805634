"""How far a cautious residual may act: the closed form, and what gets through where the model is
right and wrong."""

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import put_rows, select_rows
from baselines.residual.correction import Corrected
from baselines.residual.evidence import ERROR_SCALE, LOAD_SCALE, Evidence, evidence
from baselines.residual.features import Features
from baselines.residual.network import Network
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import ResidualDescription, ResidualSettings
from baselines.residual_env import ResidualWrapper
from elastic_env.core.errors import ConfigurationError

HIP_ROLLS = [1, 7]
PERIOD = 25


@pytest.mark.parametrize(
    ("model_error", "uncertainty", "load", "expected"),
    [
        ((0.0, 0.0), 0.0, 0.0, 0.0),
        ((ERROR_SCALE, -ERROR_SCALE), 0.0, 0.0, 0.5),
        ((0.0, np.sqrt(2.0) * ERROR_SCALE), 0.0, 0.0, 0.5),
        ((0.0, 0.0), 0.3, -LOAD_SCALE, 0.5),
        ((ERROR_SCALE, ERROR_SCALE), 0.0, LOAD_SCALE, 0.8),
        ((0.0, 0.0), 0.0, 2.0 * LOAD_SCALE, 16.0 / 17.0),
        ((0.2, -0.2), np.sqrt(0.04 - ERROR_SCALE**2) / 2.0, 0.0, 0.5),
    ],
)
def test_evidence_is_the_closed_form(
    model_error: Any, uncertainty: float, load: float, expected: float
) -> None:
    """Catches a sign that counts, a leg that does not, an error that counts though it is unsure,
    a wrong sum."""
    g = evidence(np.array(model_error), np.full(2, uncertainty), np.array(load))
    np.testing.assert_allclose(g, expected)


def decided(envs: Any, cautious: bool) -> ResidualPolicy:
    """A policy that decides a residual of one whatever it sees, on the hip rolls."""
    chosen = ResidualSettings(
        scale=0.05, joints=("hip_roll",), observe=("clock",), cautious=cautious
    )
    corrected = Corrected(
        baselines.make("input_output", envs), envs.unwrapped.assumed_model, chosen
    )
    width = Features(corrected).width
    tensors = {
        "mean": np.zeros(width),
        "std": np.ones(width),
        "weight0": np.zeros((2, width)),
        "bias0": np.ones(2),
    }
    return ResidualPolicy(
        corrected, Network(ResidualDescription(robot="walker", base="input_output"), tensors)
    )


def worlds(scenario: str, num_steps: int) -> Any:
    """Two fast walks."""
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        2,
        vectorization_mode="vector_entry_point",
        autoreset_mode="Disabled",
        scenario=scenario,
        step_period=1.6,
        num_steps=num_steps,
        num_threads=1,
    )


@cache
def walk(scenario: str, cautious: bool) -> tuple[Any, Any]:
    """Evidence at every decision of a short walk, and at its end the correction by a residual that
    is always one.

    Returns:
        (decisions, 2 worlds) and (2 worlds, 12).
    """
    envs = worlds(scenario, num_steps=2)
    policy = decided(envs, cautious)
    model = envs.unwrapped.assumed_model
    source = Evidence(model, PERIOD * model.control_period_s)
    observation, _ = envs.reset(seed=0)
    state = None
    memory = source.begin(2)
    seen = []
    for step in range(envs.unwrapped.task.num_steps):
        if step % PERIOD == 0:
            g, memory = source.observe(observation, memory)
            seen.append(g[:, 0])
        action, state = policy.predict(observation, state, np.full(2, step == 0))
        observation, *_ = envs.step(action)
    return np.array(seen), state.inner.values


@pytest.mark.parametrize("scenario", ["nominal", "sensor"])
def test_a_right_model_leaves_no_evidence(scenario: str) -> None:
    """Catches a load that is not averaged, which swings by more than a payload with every fast
    step."""
    seen, correction = walk(scenario, True)
    assert seen.mean() < 0.05
    assert (seen[-1] < 0.1).all()
    assert np.abs(correction).max() < 0.1 * 0.05


@pytest.mark.parametrize("scenario", ["soft", "payload"])
def test_a_wrong_model_leaves_evidence_and_a_cautious_residual_acts_as_far_as_that(
    scenario: str,
) -> None:
    """Catches caution that does not arrive at the correction."""
    seen, correction = walk(scenario, True)
    assert (seen[0] < 0.1).all()
    assert (seen[-1] > 0.5).all()
    np.testing.assert_allclose(
        correction[:, HIP_ROLLS], 0.05 * seen[-1][:, None] * np.ones(2), rtol=0.05
    )


def test_caution_is_only_where_it_is_asked_for() -> None:
    """Catches a default that holds residuals back."""
    _, correction = walk("soft", False)
    np.testing.assert_allclose(correction[:, HIP_ROLLS], 0.05, rtol=1e-3)


def test_evidence_is_of_the_episode_and_counted_once_per_decision() -> None:
    """Catches evidence of the episode before or of another world, and decisions at other steps."""
    envs = worlds("payload", num_steps=1)
    policy = decided(envs, cautious=True)
    model = envs.unwrapped.assumed_model
    source = Evidence(model, PERIOD * model.control_period_s)
    begun = np.zeros(2, dtype=np.int64)
    observation, _ = envs.reset(seed=0)
    state = None
    memory = source.begin(2)
    for step in range(12 * PERIOD):
        starting = np.full(2, step == 0)
        if step == 5 * PERIOD + 7:
            starting[0] = True
            begun[0] = step
            observation, _ = envs.reset(options={"reset_mask": starting})
        due = (step - begun) % PERIOD == 0
        memory = put_rows(memory, starting, select_rows(source.begin(2), starting))
        memory = put_rows(memory, due, select_rows(source.observe(observation, memory)[1], due))
        action, state = policy.predict(observation, state, starting)
        np.testing.assert_array_equal(state.caution.loads, memory.loads)
        np.testing.assert_array_equal(state.caution.observer, memory.observer)
        observation, *_ = envs.step(action)
    assert memory.loads[0, 0] == memory.loads[1, 0] - 5.0 == 7.0


def test_only_a_walker_can_be_cautious() -> None:
    """Catches a residual that is cautious in name only."""
    env = gymnasium.make("elastic_env/Testbed-v0")
    with pytest.raises(ConfigurationError, match="set cautious: false"):
        ResidualWrapper(env, "input", cautious=True)
