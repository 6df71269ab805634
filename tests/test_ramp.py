"""How a compensation begins: the shares of the ramp, and what it leaves of the robot's swing."""

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.ramp import Ramp
from elastic_env.core.signals import Array
from elastic_env.motion.sway import sway_frequencies
from elastic_env.motion.trajectory import quintic
from elastic_env.robots.thormang.config import WalkConfig
from elastic_env.robots.thormang.task import WalkTask
from elastic_env.world.robot_model import WalkerModel
from tests.trees import pendulum

PERIOD_S = 0.004
STEPS = np.arange(0.0, 400.0)


@cache
def walker() -> WalkerModel:
    """What is assumed of the walker."""
    assumed = WalkTask(WalkConfig(), 1).assumed_model
    assert isinstance(assumed, WalkerModel)
    return assumed


def half_period(model: WalkerModel) -> float:
    """Half a period of the slowest sway, springs in series with the position gain of the servos
    [s]."""
    compliance = 1.0 / model.stiffness + 1.0 / np.array(
        [servo.position_gain for servo in model.servos]
    )
    return float(np.pi / sway_frequencies(model.biped, model.plan.pelvis[0], 1.0 / compliance)[0])


def plain(steps: Array, duration_s: float) -> Array:
    """A ramp without shape."""
    return quintic(steps * PERIOD_S / duration_s)[0]


@pytest.mark.parametrize("model", [walker(), pendulum()], ids=["walker", "testbed"])
def test_ramp_grows_from_nothing_to_everything_without_turning_back(model: Any) -> None:
    """Catches a ramp that starts with a jump, overshoots, or is not over at its end, also for
    rows of worlds."""
    ramp = Ramp(model, 1.0)
    share = ramp.share(STEPS)
    assert share[0] == 0.0
    assert np.all(np.diff(share) >= 0.0)
    assert np.all(share[250:] == 1.0)
    assert 0.0 < share[1] < 1e-4
    np.testing.assert_array_equal(ramp.is_over(STEPS), STEPS >= 250)
    np.testing.assert_array_equal(ramp.share(STEPS.reshape(-1, 1)), share.reshape(-1, 1))
    steps = STEPS.astype(np.int64).reshape(-1, 1)
    np.testing.assert_array_equal(ramp.table.take(steps, mode="clip"), share.reshape(-1, 1))
    np.testing.assert_array_equal(ramp.table, share[: len(ramp.table)])
    assert len(ramp.table) == 251


def test_ramp_of_the_walker_is_two_halves_half_a_sway_apart() -> None:
    """Catches a delay of a whole period, of the springs alone, or halves that do not end
    together with the ramp."""
    delay = half_period(walker())
    assert 0.3 < delay < 0.8
    each = 1.0 - delay
    first = plain(STEPS, each)
    second = plain(STEPS - delay / PERIOD_S, each)
    np.testing.assert_allclose(
        Ramp(walker(), 1.0).share(STEPS), 0.5 * (first + second), rtol=0.0, atol=1e-12
    )


def test_halves_cancel_the_swing_of_an_oscillator() -> None:
    """Catches a shape that does not cancel: an undamped pendulum of the sway's period must stand
    still after the ramp.

    Its swing after a ramp is |∫ ṡ e^{iωt} dt| of what is ramped; the plain ramp leaves much of it.
    """
    omega = np.pi / half_period(walker())
    time = np.arange(0.0, 1.2, 1e-4)
    swing = {}
    for name, share in (
        ("shaped", Ramp(walker(), 1.0).share(time / PERIOD_S)),
        ("plain", plain(time / PERIOD_S, 1.0)),
    ):
        swing[name] = abs(
            (np.diff(share) * np.exp(1j * omega * 0.5 * (time[1:] + time[:-1]))).sum()
        )
    assert swing["shaped"] < 1e-3
    assert swing["plain"] > 0.1


def test_testbed_has_the_plain_ramp() -> None:
    """Catches the sway of a walker asked of a robot without legs."""
    np.testing.assert_array_equal(Ramp(pendulum(), 0.6).share(STEPS), plain(STEPS, 0.6))


@pytest.mark.parametrize(
    ("scale", "margin"),
    [(1.0, 0.99), (1.0, 0.5), (0.1, 1.0)],
    ids=["just too short", "short", "unstable"],
)
def test_ramp_is_plain_where_half_a_period_does_not_fit(scale: float, margin: float) -> None:
    """Catches a delay that leaves the halves no time, and the nan of a robot so soft that it has
    no sway."""
    model = walker().with_stiffness(scale * walker().stiffness)
    duration = margin * half_period(walker()) / 0.8
    assert np.isnan(half_period(model)) == (scale < 1.0)  # type: ignore[arg-type]
    np.testing.assert_array_equal(Ramp(model, duration).share(STEPS), plain(STEPS, duration))


def test_ramp_is_shaped_as_soon_as_half_a_period_fits() -> None:
    """Catches a bound other than four fifths of the ramp."""
    duration = 1.01 * half_period(walker()) / 0.8
    assert np.abs(Ramp(walker(), duration).share(STEPS) - plain(STEPS, duration)).max() > 0.1


@pytest.mark.parametrize("duration_s", [PERIOD_S, 0.5 * PERIOD_S, 0.0])
def test_a_ramp_of_one_control_step_is_over_in_the_first(duration_s: float) -> None:
    """Catches a division by zero, and a first action without compensation."""
    ramp = Ramp(walker(), duration_s)
    np.testing.assert_array_equal(ramp.share(np.array([0.0, 1.0, 2.0])), [0.0, 1.0, 1.0])


def test_standing_walker_is_not_left_swinging() -> None:
    """Catches a ramp that excites the sway: the shaped one leaves less than a third of the plain
    one's swing.

    Two robots without friction in a gait so slow that they nearly stand, 1.5 s after the ramp.
    """
    env: Any = gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        step_period=24.0,
        num_steps=1,
        scenario="ideal",
    )
    shaped, unshaped = (baselines.make("input_open", env) for _ in range(2))
    unshaped.ramp = plain(np.arange(len(shaped.ramp)), 1.0)  # type: ignore[attr-defined]
    pitch_rate = env.unwrapped.task.observation_table.names.index("imu_rate.y")
    observation, _ = env.reset(seed=0)
    states: list[Any] = [None, None]
    rates = []
    for step in range(625):
        actions = []
        for world, policy in enumerate((shaped, unshaped)):
            action, states[world] = policy.predict(observation[world], states[world], step == 0)
            actions.append(action)
        observation, *_ = env.step(np.array(actions))
        rates.append(observation[:, pitch_rate])
    swing = np.array(rates)[250:].std(axis=0)
    assert swing[1] > 0.01
    assert swing[0] < swing[1] / 3.0
