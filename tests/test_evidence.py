"""How far a cautious residual may act: the closed form, and what gets through where the model is right and wrong."""

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.correction import Corrected, ResidualSettings
from baselines.evidence import EXCESS_LOAD, MODEL_ERROR, Evidence, caution, evidence
from baselines.features import Features
from baselines.residual import Network, ResidualDescription, ResidualPolicy
from elastic_env.errors import ConfigurationError

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


@cache
def walk(scenario: str, cautious: bool) -> tuple[Any, Any]:
    """Evidence at every decision of a short fast walk, and at its end the correction by a residual that is always one.

    Returns:
        (decisions, 2 worlds) and (2 worlds, 12).
    """
    envs: Any = gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0", 2, vectorization_mode="vector_entry_point", autoreset_mode="Disabled",
        scenario=scenario, step_period=1.6, num_steps=2, num_threads=1,
    )  # fmt: skip
    model, base = envs.unwrapped.assumed_model, baselines.make("input_output", envs)
    chosen = ResidualSettings(scale=0.05, joints=("hip_roll",), observe=("clock",), cautious=cautious)
    corrected = Corrected(base, model, chosen)
    width = Features(corrected).width
    tensors = {"mean": np.zeros(width), "std": np.ones(width), "weight0": np.zeros((2, width)), "bias0": np.ones(2)}
    policy = ResidualPolicy(corrected, Network(ResidualDescription(robot="walker", base="input_output"), tensors))
    source = Evidence(model, 25 * model.control_period_s)
    (observation, _), state, memory, seen = envs.reset(seed=0), None, source.begin(2), []
    for step in range(envs.unwrapped.task.num_steps):
        if step % 25 == 0:
            g, memory = source.observe(observation, memory)
            seen.append(g[:, 0])
        action, state = policy.predict(observation, state, np.full(2, step == 0))
        observation, *_ = envs.step(action)
    return np.array(seen), state[1][0]


def test_only_a_wrong_model_leaves_evidence() -> None:
    """Catches a load that is not averaged, which swings by more than a payload with every fast step."""
    right, _ = walk("nominal", True)
    assert right.mean() < 0.05
    assert (right[-1] < 0.1).all()
    for scenario in ("soft", "payload"):
        wrong, _ = walk(scenario, True)
        assert (wrong[0] < 0.1).all()
        assert (wrong[-1] > 0.5).all(), scenario


def test_a_cautious_residual_acts_as_far_as_there_is_evidence() -> None:
    """Catches caution that does not arrive at the correction, or stays where it is not asked for."""
    seen, cautious = walk("soft", True)
    _, free = walk("soft", False)
    np.testing.assert_allclose(free[:, HIP_ROLLS], 0.05, rtol=1e-3)
    np.testing.assert_allclose(cautious[:, HIP_ROLLS], 0.05 * seen[-1][:, None] * np.ones(2), rtol=0.05)
    _, right = walk("nominal", True)
    assert np.abs(right).max() < 0.1 * 0.05


def test_only_a_walker_can_be_cautious() -> None:
    """Catches a residual that is cautious in name only."""
    env: Any = gymnasium.make("elastic_env/Testbed-v0")
    corrected = Corrected(baselines.make("input", env), env.unwrapped.assumed_model, ResidualSettings(cautious=True))
    with pytest.raises(ConfigurationError, match="set cautious: false"):
        caution(corrected)
