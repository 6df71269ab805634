"""How far a cautious residual may act: the closed form, and what gets through where the model is right and wrong."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from baselines.evidence import EXCESS_LOAD, MODEL_ERROR, evidence
from elastic_env.errors import ConfigurationError
from train.residual_env import ResidualVectorWrapper, ResidualWrapper

HIP_ROLLS = [1, 7]


@pytest.mark.parametrize(
    ("model_error", "deviation", "load", "expected"),
    [
        ((0.0, 0.0), 0.0, 0.0, 0.0),
        ((MODEL_ERROR, -MODEL_ERROR), 0.0, 0.0, 0.5),
        ((0.0, np.sqrt(2.0) * MODEL_ERROR), 0.0, 0.0, 0.5),
        ((0.0, 0.0), 0.3, -EXCESS_LOAD, 0.5),
        ((MODEL_ERROR, MODEL_ERROR), 0.0, EXCESS_LOAD, 0.8),
        ((0.0, 0.0), 0.0, 2.0 * EXCESS_LOAD, 16.0 / 17.0),
        ((0.2, -0.2), np.sqrt(0.04 - MODEL_ERROR**2) / 2.0, 0.0, 0.5),
    ],
)
def test_evidence_is_the_closed_form(model_error: Any, deviation: float, load: float, expected: float) -> None:
    """Catches a sign that counts, a leg that does not, an error that counts though it is unsure, a wrong sum."""
    g = evidence(np.array(model_error), np.full(2, deviation), np.array(load))
    np.testing.assert_allclose(g, expected)


def walk(scenario: str, cautious: bool, step_period: float) -> tuple[Any, Any]:
    """Evidence at every decision of a short walk, and the corrections at its end of a residual that is one throughout.

    Returns:
        (decisions, 2 worlds) and (2 worlds, 12).
    """
    envs = gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0", 2, vectorization_mode="vector_entry_point", autoreset_mode="Disabled",
        scenario=scenario, step_period=step_period, num_steps=1, num_threads=1,
    )  # fmt: skip
    wrapper = ResidualVectorWrapper(
        envs, "input_output", scale=0.05, joints=("hip_roll",), observe=("clock", "evidence"), cautious=cautious
    )
    features, _ = wrapper.reset(seed=0)
    seen, correction, ended = [], np.zeros((2, 12)), False
    while not ended:
        seen.append(features[:, -1])
        features, _, terminated, truncated, _ = wrapper.step(np.ones((2, 2)))
        correction = wrapper._deciding._state[0]
        ended = bool((terminated | truncated).all())
    return np.array(seen), correction


@pytest.mark.parametrize("step_period", [3.0, 1.6])
def test_only_a_wrong_model_leaves_evidence(step_period: float) -> None:
    """Catches a load that is not averaged, which swings by more than a payload with every fast step."""
    right, _ = walk("nominal", False, step_period)
    assert right.mean() < 0.05
    assert (right[-1] < 0.1).all()
    for scenario in ("soft", "payload"):
        wrong, _ = walk(scenario, False, step_period)
        assert (wrong[0] < 0.1).all()
        assert (wrong[-1] > 0.5).all(), scenario


def test_a_cautious_residual_acts_as_far_as_there_is_evidence() -> None:
    """Catches caution that does not arrive at the correction, or stays where it is not asked for."""
    seen, cautious = walk("soft", True, 1.6)
    _, free = walk("soft", False, 1.6)
    np.testing.assert_allclose(free[:, HIP_ROLLS], 0.05, rtol=1e-3)
    np.testing.assert_allclose(cautious[:, HIP_ROLLS], 0.05 * seen[-1][:, None] * np.ones(2), rtol=0.05)
    _, right = walk("nominal", True, 1.6)
    assert np.abs(right).max() < 0.1 * 0.05


def test_what_sees_no_evidence_cannot_be_cautious() -> None:
    """Catches a residual that is cautious in name only."""
    env = gymnasium.make("elastic_env/WalkInPlace-v0")
    with pytest.raises(ConfigurationError, match="add evidence to observe"):
        ResidualWrapper(env, "input_output", observe=("bending",), cautious=True)
