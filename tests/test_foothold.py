"""Feet that land as planned: the law on feet that obey it exactly, geometry, and whole walks."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import Zero
from baselines.walking.foothold import FootholdCorrection, FootholdGains
from baselines.walking.zmp_shift import Stances, move_feet, move_pelvis
from elastic_env.core.signals import Array

STEPS = 8
GAINS = FootholdGains()
LANDING_M = np.array([[0.006, -0.003], [-0.004, 0.005]])
"""Error with which the left and the right foot land, forward and to the left [m]."""


def walker(num_envs: int = 1, **options: Any) -> Any:
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        **options,
    )


class ClosedLegs:
    """Feet that land off by a constant, and legs of a compliance between them, whose shear shows
    less forward the quicker the load comes.
    """

    compliance_m_n = GAINS.compliance_m_n
    load_rate_m_s = GAINS.load_rate_m_s
    landing_m = LANDING_M

    def __init__(self, env: Any, gains: FootholdGains = GAINS) -> None:
        self.task = env.unwrapped.task
        self.plan = self.task.plan
        self.policy = FootholdCorrection(Zero(self.task.assumed_model), self.model, gains)
        self.table = self.task.observation_table
        self.place = np.zeros((2, 2))
        self.landed: list[Array] = []
        self.largest_step = 0.0
        """Of an offset in a control period [m]."""

    @property
    def model(self) -> Any:
        return self.task.assumed_model

    def walk(self, bias_n: float = 0.0) -> None:
        """Walk the plan; the force sensor of the left foot is off by a constant."""
        timing = self.plan.timing
        rate = np.gradient(self.plan.share, self.model.control_period_s)
        state = None
        offset = np.zeros((2, 2))
        for row in range(1, len(timing.time)):
            error = self.place[0] - self.place[1]
            hidden = np.array([-self.load_rate_m_s * rate[row], 0.0])
            shear = (error - offset[0] + offset[1] - hidden) / self.compliance_m_n
            observed = np.zeros((1, len(self.table)))
            wrench = np.zeros((2, 2, 3))
            wrench[0, 0, :2] = shear + bias_n
            wrench[1, 0, :2] = -shear
            observed[:, self.table.group("wrench")] = wrench.ravel()
            clock = [timing.time[row], timing.swing[row], timing.support[row]]
            observed[:, self.table.group("clock")] = clock
            observed[:, self.table.group("load_share")] = self.plan.share[row]
            _, state = self.policy.predict(observed, state, np.array([row == 1]))
            before = offset
            offset = state.own["offset"][0]
            self.largest_step = max(self.largest_step, float(np.abs(offset - before).max()))
            if timing.single[row - 1] and not timing.single[row]:
                foot = 1 - int(timing.support[row])
                aimed = self.place[1 - foot] + state.own["target"][0, foot]
                self.place[foot] = aimed + self.landing_m[foot]
                self.landed.append(self.place.copy())
        self.state = state


def test_feet_that_land_off_by_a_constant_come_to_their_footholds() -> None:
    """Catches a wrong sign of a foot, of the shear or of the offsets, and a bias learned twice."""
    legs = ClosedLegs(walker(num_steps=STEPS))
    legs.walk()
    # the right foot lands first, with nothing known; then each has learned a share
    np.testing.assert_allclose(legs.landed[0][1], LANDING_M[1], atol=1e-12)
    np.testing.assert_allclose(legs.landed[1][0], LANDING_M[0], atol=1e-12)
    left = 1.0 - GAINS.first_gain
    np.testing.assert_allclose(legs.landed[2][1], left * LANDING_M[1], atol=1e-12)
    np.testing.assert_allclose(legs.landed[3][0], left * LANDING_M[0], atol=1e-12)
    left *= 1.0 - GAINS.gain
    np.testing.assert_allclose(legs.landed[4][1], left * LANDING_M[1], atol=1e-12)
    assert np.abs(legs.place).max() < 5e-4
    # a swing of 200 periods, of which 0.8 move the foot with minimum jerk
    largest = np.abs(LANDING_M).max()
    assert 0.0 < legs.largest_step < 3.0 * largest * (15.0 / 8.0) / (0.8 * 200)


def test_a_force_sensor_that_is_off_does_not_let_the_feet_walk_away() -> None:
    """Catches errors that add up: left and right take turns, so a constant one must not."""
    legs = ClosedLegs(walker(num_steps=16, step_period=1.1))
    bias_n = 10.0
    legs.walk(bias_n)
    wide = GAINS.compliance_m_n * bias_n / 2.0
    assert np.abs(legs.place).max() < 1.1 * wide


def test_feet_do_not_walk_forward_by_what_their_shear_hides() -> None:
    """Catches a rate of the load that is left out, or has the sign of the other foot."""
    steps = 14
    period_s = 1.1
    ends = []
    later = []
    for load_rate_m_s in (0.0, GAINS.load_rate_m_s):
        env = walker(num_steps=steps, step_period=period_s)
        legs = ClosedLegs(env, GAINS.replace(load_rate_m_s=load_rate_m_s))
        legs.walk()
        ends.append(legs.place.mean(axis=0))
        later.append(ends[-1] - legs.landed[steps // 2 - 1].mean(axis=0))
    share = legs.plan.share
    walked_s = legs.plan.timing.time - 1.0
    between = (walked_s > period_s) & (walked_s < (steps - 1) * period_s)
    shared = (share > 0.25) & (share < 0.75) & between
    rate = np.gradient(share, legs.model.control_period_s)[shared]
    a_step = GAINS.load_rate_m_s * np.abs(rate).mean()
    assert len(legs.landed) == steps
    assert later[0][0] == pytest.approx(steps / 2 * a_step, rel=0.1)
    assert abs(ends[1][0]) < 1e-4
    assert abs(ends[0][1]) < 1e-4


def test_an_offset_that_goes_before_the_load_comes_needs_no_true_compliance() -> None:
    """Catches an offset that is still there while the shear is felt.

    Legs are stiffer than assumed by a quarter, and feet land ahead by 5 mm. Half of their offset
    on average while the shear is felt makes an error of 0.5 mm a step.
    """
    drift = []
    for return_load in (1.0, 0.25):
        gains = GAINS.replace(return_load=return_load, load_rate_m_s=0.0)
        legs = ClosedLegs(walker(num_steps=16, step_period=1.1), gains)
        legs.load_rate_m_s = 0.0
        legs.compliance_m_n = GAINS.compliance_m_n / 1.25
        legs.landing_m = np.full((2, 2), [0.005, 0.0])
        legs.walk()
        drift.append(np.abs(legs.place).max())
    assert drift[0] == pytest.approx(16 * 0.5e-3, rel=0.2)
    assert drift[1] < 1e-4


def test_moved_feet_stay_level_and_go_where_they_are_told() -> None:
    """Catches a sign, a leg that is taken for the other, and soles that tilt."""
    model = walker().unwrapped.assumed_model
    row = 300
    shift = np.array([[[0.012, -0.007], [-0.009, 0.011]]])
    offsets = np.zeros((1, 12))
    stances = Stances.of(model)
    move_feet(*stances, np.array([row]), shift, offsets)
    q = model.plan.q[row : row + 1]
    chains = model.biped.chains
    level = np.zeros((1, 2))
    point = np.zeros(3)
    before = chains.com_and_feet(q, point, level)[1]
    after = chains.com_and_feet(q + offsets, point, level)[1]
    np.testing.assert_allclose(after[0, :, :2] - before[0, :, :2], shift[0], atol=1e-9)
    np.testing.assert_allclose(after[0, :, 2], before[0, :, 2], atol=1e-9)
    tilts = chains.sole_tilts(q + offsets, level, np.zeros((1, 12)))[0]
    np.testing.assert_allclose(tilts, 0.0, atol=1e-9)
    pelvis = np.zeros((1, 12))
    move_pelvis(*stances, np.array([row]), np.array([[0.01, 0.005]]), pelvis)
    both = np.zeros((1, 12))
    move_feet(*stances, np.array([row]), np.array([[[-0.01, -0.005]] * 2]), both)
    np.testing.assert_array_equal(pelvis, both)


def test_the_base_of_foothold_follows_the_gait() -> None:
    """Catches a fast gait without the torque of its motion."""
    for period_s, base in ((3.0, {}), (1.6, {"base": "dynamic", "output": "taylor"})):
        env = walker(step_period=period_s, num_steps=1)
        rows, _ = env.reset(seed=0)
        named = baselines.make("foothold", env)
        explicit = baselines.make("foothold", env, **base)
        states: list[Any] = [None, None]
        for _ in range(30):
            action, states[0] = named.predict(rows, states[0])
            same, states[1] = explicit.predict(rows, states[1])
            np.testing.assert_array_equal(action, same)
            rows, *_ = env.step(action)


def drift_m(policy: str, num_steps: int) -> float:
    """Largest distance of the middle between the feet from the plan at the end [m]."""
    env = walker(4, scenario="drawn", bank=1, num_steps=num_steps, step_period=1.6)
    task = env.unwrapped.task
    walks = baselines.make(policy, env)
    rows, _ = env.reset(seed=0)
    state = None
    start = np.ones(4, dtype=np.bool_)
    feet = np.zeros((4, 2))
    for _ in range(task.num_steps - 1):
        action, state = walks.predict(rows, state, start)
        rows, _, terminated, _, _ = env.step(action)
        start = np.zeros(4, dtype=np.bool_)
        assert not terminated.any()
        feet = (task.truth().ankles - task.plan.ankles[-1]).mean(axis=1)[:, :2]
    return float(np.linalg.norm(feet, axis=1).max())


@pytest.mark.slow
def test_the_feet_of_drawn_robots_stay_where_they_are_planned() -> None:
    """Catches forces that mean something else in the plant than in the law."""
    assert drift_m("foothold", 10) < 0.4 * drift_m("adaptive_posture", 10)
