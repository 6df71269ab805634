"""A policy that walks a refined plan of its own."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.compensators import Compensated
from baselines.compensation.dynamic_compensator import DynamicCompensator
from baselines.compensation.policy import PolicyInputs, Zero
from baselines.walking.controller import WalkingController
from baselines.walking.refined_plan import RefinedWalk, refine_model
from elastic_env.core.signals import Array
from tests.played import play_to_the_end

GROUPS = ("reference_angle", "reference_rate", "reference_acceleration")


def walker(**options: Any) -> Any:
    """Two steps of 1.1 s."""
    return gymnasium.make("elastic_env/WalkInPlace-v0", step_period=1.1, num_steps=2, **options)


class Recorder(Zero):
    """A policy that notes what it sees, and asks for a hundredth of a radian."""

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.seen: list[Array] = []

    def act(self, rows: Array, memory: None, inputs: PolicyInputs) -> Any:
        self.seen.append(rows.copy())
        action, _ = super().act(rows, memory, inputs)
        return action + np.float32(0.01), None


def test_the_policy_sees_the_refined_plan_and_its_offset_adds_to_the_change() -> None:
    """Catches a row of another time, columns of another signal, and a change that is lost."""
    env = walker(scenario="ideal")
    model = env.unwrapped.assumed_model
    further = refine_model(model)
    inside = Recorder(model)
    policy = RefinedWalk(inside, model, further)
    table = model.observation_table
    plans = ((further.plan.q, further.plan.q_dot, further.plan.q_ddot), GROUPS)
    observation, _ = env.reset(seed=0)
    state = None
    for step in range(1, 400):
        action, state = policy.predict(observation, state, step == 1)
        for planned, group in zip(*plans, strict=True):
            np.testing.assert_allclose(
                inside.seen[-1][0, table.group(group)], planned[step], rtol=0.0, atol=1e-5
            )
        change = further.plan.q[step] - model.plan.q[step]
        np.testing.assert_allclose(action, 0.01 + change, rtol=0.0, atol=1e-8)
        observation, *_ = env.step(action)
    assert np.abs(further.plan.q - model.plan.q).max() > 5e-3


def test_a_robot_without_friction_walks_with_a_third_of_the_error() -> None:
    """Catches a change of the wrong sign, one that comes too late, and a compensation of the other
    plan's torque."""
    metrics = []
    for is_refined in (False, True):
        env = walker(scenario="ideal")
        model = env.unwrapped.assumed_model
        walked = refine_model(model) if is_refined else model
        compensator = DynamicCompensator(walked, "wrench")
        policy: Any = Compensated(WalkingController(walked), compensator)
        if is_refined:
            policy = RefinedWalk(policy, model, walked)
        metrics.append(play_to_the_end(env, policy)["episode_metrics"])
    deviations = [own["zmp_deviation_rms_m"] for own in metrics]
    assert deviations[0] > 8e-3
    assert deviations[1] < deviations[0] / 3.0
    assert metrics[1]["pelvis_error_rms_rad"] < metrics[0]["pelvis_error_rms_rad"]


@pytest.mark.parametrize("name", ["foothold", "phase_table", "oracle"])
def test_what_a_policy_inside_has_learned_is_known_outside(name: str) -> None:
    """Catches a wrapper that looks for a memory of its own where it has none."""
    env = gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0", num_envs=2, vectorization_mode="vector_entry_point"
    )
    policy = baselines.make(name, env)
    assert {"standing", "zmp_offset", "feet", "landing", "shear"} <= {*policy.estimates}
    observation, _ = env.reset(seed=0)
    state = None
    for step in range(20):
        action, state = policy.predict(observation, state, np.full(2, step == 0))
        observation, *_ = env.step(action)
    standing = policy.estimate("standing", np.asarray(observation, np.float64), state)
    assert np.abs(standing).max() > 1e-5
    for estimate in policy.estimates:
        assert len(policy.estimate(estimate, np.asarray(observation, np.float64), state)) == 2
    env.close()
