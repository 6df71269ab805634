"""Stiffness adapted online, and sensors of the deflection: closed forms, a regression by
matrices, and the plant."""

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.adaptation.estimators import StiffnessPrior, mean_load, regress
from baselines.adaptation.online_stiffness import AdaptationGains, OnlineStiffness
from baselines.compensation.dry_friction import PRESLIDING_RAD, presliding_friction
from baselines.compensation.measured import DeflectionSensors
from baselines.compensation.policy import PolicyInputs, Zero
from baselines.policies import sensors_needed
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import RobotModel
from tests.test_walk_policies import PERIOD_S, first, recording, scalar

PRIOR = StiffnessPrior(common=0.4, own=0.15, offset_rad=0.003, noise_rad=0.004)


def by_matrices(h: Array, delta: Array) -> Array:
    """The same regression by the normal equations of all unknowns at once, r and c of n joints."""
    times, n = h.shape
    covariance = np.zeros((2 * n, 2 * n))
    covariance[:n, :n] = PRIOR.common**2 + PRIOR.own**2 * np.eye(n)
    covariance[n:, n:] = PRIOR.offset_rad**2 * np.eye(n)
    design = np.vstack([np.hstack([np.diag(h[t]), np.eye(n)]) for t in range(times)])
    normal = np.linalg.inv(covariance) + design.T @ design / PRIOR.noise_rad**2
    return np.linalg.solve(normal, design.T @ (delta - h).ravel() / PRIOR.noise_rad**2)[:n]


def sums_of(h: Array, delta: Array) -> Array:
    """What the observer keeps of measurements, (5, n)."""
    y = delta - h
    return np.stack(
        [np.full(h.shape[1], float(len(h))), h.sum(0), (h * h).sum(0), y.sum(0), (h * y).sum(0)]
    )


def test_regression_is_that_of_the_normal_equations() -> None:
    """Catches a wrong elimination of the offsets, and a wrong inversion of the rank-one prior."""
    generator = np.random.default_rng(3)
    h = generator.normal(0.0, [0.03, 0.02, 0.001, 0.0], (40, 4))
    delta = 1.3 * h + generator.normal(0.0, 0.004, h.shape) + 0.002
    np.testing.assert_allclose(regress(sums_of(h, delta), PRIOR), by_matrices(h, delta), rtol=1e-9)


def test_joints_without_load_take_after_the_others() -> None:
    """Catches a prior that keeps them at zero: with three joints at +0.4 the fourth is nearer to
    them than to 0."""
    h = np.outer(np.sin(np.arange(200.0)), [0.03, 0.03, 0.03, 0.0])
    r = regress(sums_of(h, 1.4 * h), PRIOR)
    np.testing.assert_allclose(r[:3], 0.4, atol=0.01)
    assert 0.3 < r[3] < 0.4


def test_friction_turns_round_as_dahl_has_it() -> None:
    """From −F over a displacement s: F (1 − 2 exp(−s/s₀)); many small displacements are one
    large one."""
    coulomb = np.array([5.4])
    s = 2e-3
    turned = presliding_friction(-coulomb, np.array([s]), coulomb)
    np.testing.assert_allclose(turned, coulomb * (1.0 - 2.0 * np.exp(-s / PRESLIDING_RAD)))
    slowly = -coulomb
    for _ in range(20):
        slowly = presliding_friction(slowly, np.array([s / 20]), coulomb)
    np.testing.assert_allclose(slowly, turned)


def test_the_mean_load_starts_at_the_assumed_one() -> None:
    """Five measurements' worth of prior: after n of 10 % the mean is 10 % n / (5 + n)."""
    memory = np.zeros((1, 2))
    for n in range(1, 20):
        load, memory = mean_load(memory, np.array([[0.1]]))
        assert load[0, 0] == pytest.approx(0.1 * n / (5 + n))


class Fixed:
    """An estimator that says the same of every joint."""

    measures_load = False

    def begin(self, num_worlds: int) -> Array:
        return np.zeros((num_worlds, 1))

    def estimate(self, rows: Array, memory: Array) -> tuple[Array, None, Array]:
        return np.full((len(rows), 12), 0.5), None, memory + 1.0


class Recorded(Zero):
    """A policy that keeps the corrections it gets."""

    def __init__(self, model: RobotModel) -> None:
        super().__init__(model)
        self.corrections: list[Array] = []

    def act(self, rows: Array, memory: None, inputs: PolicyInputs) -> tuple[Array, None]:
        assert inputs.deflection is not None
        self.corrections.append(inputs.deflection[0])
        return super().act(rows, memory, inputs)


def test_the_correction_is_filtered_and_joined_with_another() -> None:
    """First order in time, and (1 + r)(1 + r') − 1; an estimate is made once a period."""
    model = scalar().unwrapped.assumed_model
    gains = AdaptationGains(period_s=0.1, filter_s=0.2, limit=0.4)
    inner = Recorded(model)
    policy = OnlineStiffness(inner, model, Fixed(), gains)
    state = None
    for step, observation in enumerate(recording()[:50]):
        further = PolicyInputs(deflection=np.full((1, 12), 0.1) if step == 49 else None)
        _, state = policy.predict(observation, state, step == 0, inputs=further)
    share = 1.0 - np.exp(-np.arange(1, 51) * PERIOD_S / gains.filter_s)
    expected = gains.limit * share  # the target of 0.5 is bounded
    np.testing.assert_allclose(np.array(inner.corrections)[:49, 3], expected[:49])
    np.testing.assert_allclose(inner.corrections[49], (1.0 + expected[49]) * 1.1 - 1.0)
    assert state.estimator[0, 0] == 2  # estimates in 50 steps of 4 ms


@cache
def walked(
    name: str, scenario: str = "ideal+soft", step_period: float = 1.1, **options: Any
) -> tuple[Any, Any, Array]:
    """Environment, policy state and last observation after two fast steps, and then the
    correction of each joint."""
    env = gymnasium.make(
        "elastic_env/WalkInPlace-v0",
        step_period=step_period,
        num_steps=2,
        scenario=scenario,
        sensors=sensors_needed(name),
    )
    policy = baselines.make(name, env, **options)
    state = None
    observation, _ = env.reset(seed=4)
    for _ in range(env.unwrapped.task.num_steps - 1):
        action, state = policy.predict(observation, state)
        observation, *_ = env.step(action)
    return env, state, observation


def correction(state: Any) -> Array:
    """Filtered r of the joints, (2 legs, 6)."""
    return state.correction[0].reshape(2, 6)


@pytest.mark.parametrize(
    ("name", "joints"),
    [
        ("adaptive", [1]),
        pytest.param("torque_sensor", [1], marks=pytest.mark.slow),
        ("link_encoder", [1, 3]),
    ],
)
def test_softer_joints_are_found_out(name: str, joints: list[int]) -> None:
    """K × 0.7 bends 0.43 more; asked of the joints that carry most, hip roll and knee."""
    _, state, _ = walked(name)
    np.testing.assert_allclose(correction(state)[:, joints], 1.0 / 0.7 - 1.0, atol=0.06)


def test_joints_without_a_sensor_stay_as_assumed() -> None:
    """`hip_sensor` knows of the hips alone: knees and ankles keep the assumed compliance, the
    load aside."""
    _, state, _ = walked("hip_sensor")
    found = correction(state)
    assert (found[:, 1] > 0.3).all()
    assert np.abs(found[:, 3:]).max() < 0.02


@pytest.mark.parametrize("sensor", ["joint_torque", "link_encoder"])
def test_deflections_are_those_of_the_plant(sensor: str) -> None:
    """Catches a sign, and a stiffness that is the true one: by torque a soft joint bends 0.7 of
    what it does."""
    env = gymnasium.make("elastic_env/WalkInPlace-v0", scenario="ideal+soft", sensors=[sensor])
    observation = first(env)
    sensors = DeflectionSensors(env.unwrapped.assumed_model, sensor)
    truth = env.unwrapped.truth()
    scale = 0.7 if sensor == "joint_torque" else 1.0
    found = sensors.deflection(observation[None])
    np.testing.assert_allclose(found, scale * (truth.theta - truth.q), atol=1e-6)
    assert np.abs(found).max() > 5e-3


def test_a_policy_whose_sensor_is_missing_names_it() -> None:
    """Catches a KeyError of the observation table."""
    with pytest.raises(ConfigurationError, match=r"reads link_encoder.*sensors=\['link_encoder'\]"):
        baselines.make("link_encoder", scalar())


def test_link_encoders_show_the_links() -> None:
    """The policy sees the true link angles, whatever the stiffness."""
    env, state, observation = walked("link_encoder")
    env.unwrapped.truth()
    policy = baselines.make("link_encoder", env)
    _, state = policy.predict(observation, state)
    np.testing.assert_allclose(
        policy.link_estimate(observation, state), env.unwrapped.truth().q[0], atol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("torque_sensor", {}),
        pytest.param("hip_sensor", {}, marks=pytest.mark.slow),
        ("adaptive", {"base": "dynamic"}),
    ],
)
def test_a_load_that_is_measured_counts_once(name: str, options: dict[str, str]) -> None:
    """Torque sensors and foot wrenches show 5 kg, which are 9 % more: in what is seen r must not
    have them again."""
    env, state, observation = walked(name, "ideal+payload", step_period=1.6, **options)
    assert correction(state)[:, 3].min() > 0.05
    policy = baselines.make(name, env, **options)
    _, state = policy.predict(observation, state)
    truth = env.unwrapped.truth()
    theta = truth.theta[0]
    seen = (theta - policy.link_estimate(observation, state)).reshape(2, 6)
    bent = (theta - truth.q[0]).reshape(2, 6)
    np.testing.assert_allclose(seen[:, 3], bent[:, 3], rtol=0.04)


def test_a_controller_that_weighs_the_robot_finds_its_load() -> None:
    """5 kg on 57 kg: 49 N more within three time constants; without the filter it keeps the
    assumed weight."""
    env = gymnasium.make("elastic_env/WalkInPlace-v0", scenario="ideal+payload")
    weights = []
    for filter_s in (0.2, None):
        policy = baselines.make("uncompensated", env, gains={"weight_filter_s": filter_s})
        state = None
        observation, _ = env.reset(seed=0)
        for _ in range(200):
            action, state = policy.predict(observation, state)
            observation, *_ = env.step(action)
        weights.append(state["weight"][0] - env.unwrapped.assumed_model.biped.weight)
    assert weights[0] == pytest.approx(5.0 * 9.81, abs=2.0)
    assert weights[1] == 0.0


def test_other_gains_leave_the_weight_measured() -> None:
    """Catches a gain of the feedback that turns off the measurement of the weight, unseen."""
    env = gymnasium.make("elastic_env/WalkInPlace-v0", scenario="ideal+payload")
    last = []
    for gains in (None, {"dcm": 0.4}, {"weight_filter_s": None}):
        policy = baselines.make("adaptive_posture", env, gains=gains)
        state = None
        observation, _ = env.reset(seed=0)
        for _ in range(300):
            action, state = policy.predict(observation, state)
            observation, *_ = env.step(action)
        last.append(action)
    np.testing.assert_array_equal(last[1], last[0])
    assert not np.array_equal(last[2], last[0])
