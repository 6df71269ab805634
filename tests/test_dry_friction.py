"""Compensation of dry friction that grows with the load: its equation, its direction, no chatter,
and what it takes off on the plant."""

from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.dry_friction import DEAD_ZONE_RAD, FrictionCompensation, FrictionMemory
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.friction import dry_friction
from elastic_env.world.scenario import make_scenario

FRICTION = FrictionCompensation(
    coulomb=np.array([0.05]),
    load_ratio=np.array([0.4]),
    static=np.array([0.03]),
    stribeck_speed=np.array([0.1]),
)
SMALL: dict[str, Any] = {
    "pendulum": {"gravity_torque": 0.4905, "mass": 0.5, "gyration_radius": 0.03},
    "joint": {
        "stiffness": 40.0,
        "damping": 0.02,
        "rotor_inertia": 0.004,
        "coulomb_friction": 0.02,
        "load_friction": 0.3,
        "static_friction": 0.01,
        "stribeck_speed": 0.1,
        "encoder_counts_per_turn": None,
        "servo": {
            "position_gain": 8.0,
            "velocity_gain": 0.1,
            "torque_limit": 2.0,
            "speed_limit": 12.0,
            "motor": {
                "torque_constant": 0.5,
                "back_emf": 0.55,
                "resistance": 2.5,
                "voltage": 6.0,
            },
        },
    },
}


@given(
    torque=st.floats(-2.0, 2.0),
    speed=st.floats(-0.5, 0.5),
    direction=st.floats(-1.0, 1.0),
)
def test_what_is_passed_solves_the_equation(torque: float, speed: float, direction: float) -> None:
    """Catches a share of the load that the link needs in place of the load that is passed."""
    one = np.ones(1)
    memory = FrictionMemory(0.05 * direction * one, direction * one, 0.0 * one)
    passed = FRICTION.joint_torque(torque * one, speed * one, memory)
    friction = dry_friction(speed * one, passed, 0.05, 0.4, 0.03, 0.1)
    np.testing.assert_allclose(passed, torque + direction * friction, atol=1e-12)


def test_the_direction_is_that_of_the_last_motion_beyond_the_dead_zone() -> None:
    """Catches a direction that turns with a tremble, and one that does not turn with a motion."""
    memory = FRICTION.begin((1,))
    for _ in range(20):
        memory = FRICTION.follow(np.array([1e-3]), memory)
    assert memory.direction[0] == pytest.approx(1.0, abs=1e-6)
    for displacement in (-DEAD_ZONE_RAD, 0.5 * DEAD_ZONE_RAD, -1.4 * DEAD_ZONE_RAD):
        kept = memory
        memory = FRICTION.follow(np.array([displacement]), memory)
        np.testing.assert_array_equal(memory.direction, kept.direction)
    memory = FRICTION.follow(np.array([-8e-3]), memory)
    assert memory.direction[0] < -0.99
    assert memory.coulomb[0] == pytest.approx(0.05 * memory.direction[0], rel=1e-9)


@pytest.mark.parametrize("settled", [0.0, 1.0, -1.0])
def test_a_reference_at_rest_with_noise_does_not_make_the_torque_jump(settled: float) -> None:
    """Catches chatter: noise of half a count of an encoder, and of the rate that follows from it."""
    generator = np.random.default_rng(5)
    torque = np.array([0.4])
    memory = FRICTION.begin((1,))
    for _ in range(30):
        memory = FRICTION.follow(np.array([1e-3 * settled]), memory)
    noise = 0.75e-3 * generator.uniform(-1.0, 1.0, 500)
    noise -= noise[0]
    passed: list[float] = []
    for before, now in pairwise(noise):
        memory = FRICTION.follow(np.array([now - before]), memory)
        passed.append(float(FRICTION.joint_torque(torque, np.zeros(1), memory)[0]))
    assert np.ptp(passed) < 1e-12


def test_constant_friction_has_no_dead_zone() -> None:
    """Catches a change for joints whose friction does not grow."""
    plain = FrictionCompensation(np.array([5.4]), np.zeros(1), np.zeros(1), np.zeros(1))
    memory = plain.follow(np.array([1e-5]), plain.begin((1,)))
    assert memory.slack[0] == 0.0
    assert memory.coulomb[0] == pytest.approx(5.4 * -np.expm1(-1e-2))


def largest_errors(policy: str, **settings: Any) -> Array:
    """Largest true link error of an episode of a small servo, [rad]."""
    env: Any = gymnasium.make_vec("elastic_env/Testbed-v0", num_envs=1, **{**SMALL, **settings})
    made = baselines.make(policy, env)
    observation, info = env.reset(seed=2)
    state = None
    errors: list[Array] = []
    for step in range(env.unwrapped.task.num_steps):
        action, state = made.predict(observation, state, np.full(1, step == 0))
        observation, _, _, _, info = env.step(action)
        errors.append(np.abs(info["link_error"]))
    return np.array(errors)[400:]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reference", "share"),
    [
        ({"kind": "sine", "frequency_hz": 0.25, "duration_s": 4.0, "onset_s": 1.0}, 0.1),
        ({"kind": "multisine", "duration_s": 6.0}, 0.4),
    ],
    ids=["sine", "multisine"],
)
def test_the_policy_friction_takes_off_what_dynamic_leaves(
    reference: dict[str, Any], share: float
) -> None:
    """Catches a policy that does not know the load's share, the motor's back-EMF, or the side of
    the friction."""
    scenario = make_scenario("ideal").replace(friction_scale=1.0, name="rubs")
    settings = {"scenario": scenario, "reference": reference}
    left = largest_errors("dynamic", **settings)
    taken = largest_errors("friction", **settings)
    assert np.sqrt(np.mean(left**2)) > 5e-3
    assert np.sqrt(np.mean(taken**2)) < share * np.sqrt(np.mean(left**2))


def test_worlds_of_a_small_servo_are_its_single_world_bit_for_bit() -> None:
    """Catches friction, motor or bound of another world in the whole environment."""
    settings = {**SMALL, "scenario": "nominal", "reference": "multisine", "action_bound_rad": 1.0}
    rows: list[Array] = []
    for num_envs in (1, 3):
        env: Any = gymnasium.make_vec("elastic_env/Testbed-v0", num_envs=num_envs, **settings)
        observation, _ = env.reset(seed=4)
        seen = [observation[0]]
        for step in range(40):
            action = np.full((num_envs, 1), 0.8 * np.sin(0.2 * step), dtype=np.float32)
            seen.append(env.step(action)[0][0])
        rows.append(np.array(seen))
    np.testing.assert_array_equal(rows[0], rows[1])


def test_policies_that_know_constant_friction_alone_refuse_another() -> None:
    """Catches a friction that is ignored in silence."""
    env: Any = gymnasium.make_vec(
        "elastic_env/Testbed-v0", num_envs=1, sensors=("link_imu",), **SMALL
    )
    with pytest.raises(ConfigurationError, match=r"observer knows constant dry friction only"):
        baselines.make("disturbance_observer", env)
    drawn = make_scenario("ideal").replace(name="rough", friction_scale=1.0, friction=(1.0, 4.0))
    with pytest.raises(ConfigurationError, match=r"draws up to 4 times .* load_friction = 0\.3"):
        gymnasium.make_vec("elastic_env/Testbed-v0", num_envs=1, scenario=drawn, **SMALL)


def test_the_walker_refuses_what_its_plan_does_not_know() -> None:
    """Catches a walker with load friction that its policies take for constant."""
    with pytest.raises(ConfigurationError, match=r"neither load_friction nor static_friction"):
        gymnasium.make("elastic_env/WalkInPlace-v0", joint={"load_friction": 0.2})
