"""What a residual sees of the memory of its base, and the phase of a step."""

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import baselines
from baselines.compensation.memory_rows import select_rows
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import ResidualSettings
from baselines.residual_env import ResidualVectorWrapper, ResidualWrapper
from baselines.walking.flat_feet import LEAST_LOAD, FlatFeet
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from tests.test_residual import random_network

WALKER = "elastic_env/WalkInPlace-v0"
QUICK: dict[str, Any] = {"step_period": [0.3, 0.4, 0.3], "num_steps": 4, "scenario": "drawn"}
MEMORY = ["standing", "zmp_offset", "feet", "landing", "shear", "phase", "zmp_of_steps"]
WIDTHS = [5, 2, 4, 4, 2, 16, 4]


def walkers(n: int, **options: Any) -> Any:
    """Many worlds."""
    kind = {"vectorization_mode": "vector_entry_point", "num_envs": n}
    mode = AutoresetMode.SAME_STEP
    return gymnasium.make_vec(WALKER, **kind, autoreset_mode=mode, **{**QUICK, **options})


@cache
def walked(n: int, steps: int) -> tuple[Any, Any, list[Array], list[Any]]:
    """Worlds and base, and its observations and memories before every control step."""
    env = walkers(n)
    base = baselines.make("foothold", env)
    shown, _ = env.reset(seed=3)
    state = None
    observations = []
    states = []
    for _ in range(steps):
        action, following = base.predict(shown, state)
        observations.append(shown)
        states.append(state)
        state = following
        shown = env.step(action)[0]
    return env, base, observations, states


def corrected(env: Any, base: Any, *observe: str, **settings: Any) -> Corrected:
    """A base under a residual that sees some inputs."""
    own = ResidualSettings(observe=observe, **settings)
    return Corrected(base, env.unwrapped.assumed_model, own)


def test_inputs_are_named_groups_that_an_ablation_leaves_out() -> None:
    """Catches an input that cannot be left out alone, and one that takes another's columns."""
    env, base, _, _ = walked(2, 1250)
    for left_out in range(len(MEMORY)):
        kept = [name for i, name in enumerate(MEMORY) if i != left_out]
        names = [one.name for one in Features(corrected(env, base, *kept)).signals]
        widths = [sum(name.startswith(f"{own}.") for name in names) for own in kept]
        assert widths == [width for i, width in enumerate(WIDTHS) if i != left_out]
        assert len(names) == sum(widths)


def test_a_base_without_such_a_memory_says_so() -> None:
    """Catches zeros in the place of what the base does not know."""
    env, _, (shown, *_), _ = walked(2, 1250)
    base = baselines.make("adaptive_posture", env)
    with pytest.raises(ConfigurationError, match=r"'landing'"):
        Features(corrected(env, base, "landing"))
    with pytest.raises(ConfigurationError, match=r"unknown estimate of a policy 'landing'"):
        base.estimate("landing", shown, base.begin(shown))


def test_what_stood_still_is_the_mean_over_the_first_moments() -> None:
    """Catches a mean over another time, one that goes on in the walk, and a load of the feet
    alone."""
    env, base, observations, states = walked(2, 1250)
    model = env.unwrapped.assumed_model
    feet = FlatFeet(model, LEAST_LOAD * model.biped.weight)
    table = model.observation_table
    wrench = table.group("wrench")
    features = Features(corrected(env, base, "standing"))
    expected = []
    fresh = np.zeros(2, np.bool_)
    for k in (1, 7, 15, 16, 59):
        rows = np.array(observations[: min(k, 15)])
        errors, loads = [], []
        for shown in rows:
            force, error = feet.ground(shown, shown[:, wrench])
            errors.append(np.column_stack([error, shown[:, table.group("imu_attitude")]]))
            loads.append(force[:, :, 2].sum(axis=1) / model.biped.weight - 1.0)
        expected = np.column_stack([np.mean(errors, axis=0), np.mean(loads, axis=0)])
        memory = features.begin(2)
        inner = type("State", (), {"inner": states[k]})
        found, _ = features.at(observations[k], memory, fresh, inner, None)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    assert np.ptp(expected[:, 4]) > 0.01  # the robots carry loads


def test_feet_landing_and_shear_are_what_the_foothold_correction_knows() -> None:
    """Catches feet that change places, the errors of an earlier landing, and shear of the last
    double support."""
    _, base, observations, states = walked(2, 1250)
    inner = [None if state is None else state.inner.own for state in states]
    seen = []
    for k in range(250, 1250, 25):
        own = inner[k]
        feet, landing, shear = (
            base.estimate(name, observations[k], states[k]) for name in ("feet", "landing", "shear")
        )
        np.testing.assert_array_equal(feet, own["place"].reshape(2, 4))
        np.testing.assert_array_equal(landing, own["landed"].reshape(2, 4))
        for world in range(2):
            number = own["samples"][world]
            mean = own["total"][world] / number if number else np.zeros(2)
            np.testing.assert_allclose(shear[world], mean, rtol=1e-14)
        seen.append((feet, landing, shear))
    # the last lift-off: the landing before it is kept as it was shown, and moves the foot
    lifts = [k for k in range(300, 1250) if inner[k]["swing"][0] >= 0 > inner[k - 1]["swing"][0]]
    assert len(lifts) == 4
    for k in lifts[1:]:
        foot = 1 - int(inner[k]["swing"][0])
        before = base.estimate("shear", observations[k - 1], states[k - 1])[0]
        after = base.estimate("landing", observations[k], states[k]).reshape(2, 2, 2)[0]
        sign = 1.0 if foot == 0 else -1.0
        np.testing.assert_allclose(after[foot], sign * before, rtol=0, atol=1e-15)
        place = base.estimate("feet", observations[k], states[k]).reshape(2, 2, 2)[0]
        np.testing.assert_allclose(place[foot] - place[1 - foot], after[foot], atol=1e-15)
    assert np.abs(seen[-1][1]).max() > 1e-3


def test_the_phase_repeats_with_every_step_and_tells_its_parts_apart() -> None:
    """Catches a phase that repeats with every stride, and one that stands in double support."""
    env, base, observations, states = walked(2, 1250)
    features = Features(corrected(env, base, "phase"))
    fresh = np.zeros(2, np.bool_)
    found = []
    for k in range(1250):
        inner = type("State", (), {"inner": states[k]})
        found.append(features.at(observations[k], features.begin(2), fresh, inner, None)[0][0])
    phase = np.array(found)
    np.testing.assert_allclose(phase[300:800], phase[550:1050], atol=1e-12)
    angle = 2.0 * np.pi * np.arange(250) / 250
    of_step = phase[249:499]  # the first observation whose control period ends in the walk
    orders = np.arange(1, 9)[:, None] * angle
    expected = np.stack([np.cos(orders), np.sin(orders)], axis=1).reshape(16, 250).T
    np.testing.assert_allclose(of_step, expected, atol=1e-11)


def test_the_zmp_error_is_that_of_flat_feet() -> None:
    """Catches an error on level ground, which `contact_error` has, and one of the other sign."""
    env, base, observations, states = walked(2, 1250)
    feet = FlatFeet(
        env.unwrapped.assumed_model, LEAST_LOAD * env.unwrapped.assumed_model.biped.weight
    )
    features = Features(corrected(env, base, "zmp_error"))
    for k in (1, 200, 399):
        inner = type("State", (), {"inner": states[k]})
        fresh = np.zeros(2, np.bool_)
        found, _ = features.at(observations[k], features.begin(2), fresh, inner, None)
        np.testing.assert_array_equal(found, feet.zmp_error(observations[k]))


def test_the_zmp_of_steps_is_the_mean_of_each_step_until_the_next_on_that_foot() -> None:
    """Catches a mean over standing, a foot's mean under the other one's name, and a mean that goes
    on into the next step."""
    env, base, observations, states = walked(2, 1250)
    features = Features(corrected(env, base, "zmp_of_steps"))
    errors = Features(corrected(env, base, "zmp_error"))
    memory: Any = None
    fresh = np.ones(2, np.bool_)
    seen = []
    shown = []
    for k in range(0, 1250, 25):
        inner = None if states[k] is None else type("State", (), {"inner": states[k]})
        found, memory = features.at(observations[k], memory, fresh, inner, fresh)
        shown.append(errors.at(observations[k], None, fresh, inner, fresh)[0])
        seen.append(found.reshape(2, 2, 2))
        fresh = np.zeros(2, np.bool_)
    steps = np.array(shown)[10:].reshape(4, 10, 2, 2).mean(axis=1)  # ten decisions a step
    for number in range(4):
        now = seen[10 + 10 * number + 5]
        left = steps[number - 1 - (number - 1) % 2] if number >= 1 else np.zeros((2, 2))
        right = steps[number - 1 - number % 2] if number >= 2 else np.zeros((2, 2))
        np.testing.assert_allclose(now[:, 0], left, atol=1e-15)
        np.testing.assert_allclose(now[:, 1], right, atol=1e-15)


def test_inputs_of_many_worlds_are_those_of_each_alone_and_of_the_exported_policy() -> None:
    """Catches memory of another world or of the last episode, and a policy that sees other inputs
    when it is played than while it learned."""
    settings: dict[str, Any] = {
        "acts_on": {"zmp": 0.01, "hip": 0.005, "deflection": {"knee": 0.3}},
        "observe": ["clock.swing", *MEMORY],
        "mirror": True,
        "shared": True,
        "decision_period": 25,
    }
    fast = {"step_period": [0.12, 0.28, 0.12]}  # 100 control steps
    many = ResidualVectorWrapper(walkers(2, **fast), "foothold", **settings)
    shown, _ = many.reset(seed=5)
    alone = ResidualWrapper(gymnasium.make(WALKER, **QUICK | fast), "foothold", **settings)
    np.testing.assert_array_equal(shown[1], alone.reset(seed=6)[0])
    network = random_network(many._loop.corrected, 0.5)
    env = walkers(2, **fast)
    played = ResidualPolicy(many._loop.corrected, network)
    observation, _ = env.reset(seed=5)
    state = None
    for _ in range(20):  # into the third step
        decided = network(shown)
        shown, reward, *_ = many.step(decided.astype(np.float32))
        seen, gained, *_ = alone.step(decided[1].astype(np.float32))
        np.testing.assert_array_equal(seen, shown[1])
        assert gained == reward[1]
        for _ in range(25):
            action, state = played.predict(observation, state)
            observation = env.step(action)[0]
        np.testing.assert_allclose(observation, many._rows, rtol=0, atol=1e-5)
    rows = [select_rows(state, np.arange(2) == i) for i in range(2)]
    both, _ = played.predict(observation, state)
    for i in range(2):
        own, _ = played.predict(observation[i], rows[i])
        np.testing.assert_array_equal(own, both[i])
