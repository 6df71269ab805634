"""Sensors beyond the standard set, on one joint, on three and on the walker: the truth and its
errors."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
from baselines.residual.mirror import Mirror
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.world import further_sensors
from elastic_env.world.further_sensors import SENSORS
from tests.three_joints import ARM

ARM.register()
ROOT = Path(__file__).parents[1]
QUICK = {"kind": "sine", "duration_s": 0.3, "onset_s": 0.4, "amplitude": 0.1}
MOTIONS: dict[str, dict[str, Any]] = {
    "elastic_env/Testbed-v0": {"reference": QUICK},
    "elastic_env/Arm-v0": {"reference": QUICK},
    "elastic_env/WalkInPlace-v0": {"step_period": [0.3, 0.4, 0.3], "num_steps": 1},
}
ROBOTS = pytest.mark.parametrize("robot", MOTIONS)
ARM_AT_NIGHT = pytest.mark.parametrize(
    "robot", [pytest.param(r, marks=[pytest.mark.slow] * ("Arm" in r)) for r in MOTIONS]
)
"""One class makes it and the testbed."""


def made(robot: str, worlds: int = 2, **arguments: Any) -> Any:
    given = {**MOTIONS[robot], "sensors": list(SENSORS), "scenario": "ideal", **arguments}
    return gymnasium.make_vec(
        robot, num_envs=worlds, vectorization_mode="vector_entry_point", **given
    )


def played(env: Any, steps: int = 30) -> Array:
    observation, _ = env.reset(seed=3)
    generator = np.random.default_rng(0)
    for _ in range(steps):
        observation = env.step(
            generator.uniform(-0.01, 0.01, env.action_space.shape).astype(np.float32)
        )[0]
    return observation


def shown(env: Any, observation: Array, sensor: str) -> Array:
    return observation[:, env.unwrapped.task.observation_table.group(sensor)]


def of_springs(truth: Any) -> Array:
    """Torque of springs and dampers without backlash, K δ + D δ̇."""
    return truth.stiffness * (truth.theta - truth.q) + truth.model.damping * (
        truth.theta_dot - truth.q_dot
    )


@ROBOTS
def test_without_error_they_show_the_truth(robot: str) -> None:
    """Catches a sensor of another joint, of another time, with another sign."""
    env = made(robot)
    observation = played(env)
    truth = env.unwrapped.truth()
    np.testing.assert_array_equal(shown(env, observation, "link_encoder"), truth.q)
    np.testing.assert_allclose(
        shown(env, observation, "joint_torque"), of_springs(truth), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("robot", ["elastic_env/Testbed-v0", "elastic_env/Arm-v0"])
def test_at_rest_the_specific_force_is_minus_gravity(robot: str) -> None:
    """Catches an acceleration that forgets gravity, and a frame that is not that of the link."""
    env = made(robot, reference={**QUICK, "amplitude": 1e-6})
    observation, _ = env.reset(seed=3)
    for _ in range(100):
        observation = env.step(np.zeros(env.action_space.shape, dtype=np.float32))[0]
    q = env.unwrapped.truth().q
    force = shown(env, observation, "accelerometer")
    pitch = (
        q[:, 0] if q.shape[1] == 1 else -q[:, 1:].sum(axis=1)
    )  # the testbed turns about −y, the arm's links about y
    expected = 9.81 * np.stack([np.sin(pitch), np.zeros_like(pitch), np.cos(pitch)], axis=1)
    np.testing.assert_allclose(force, expected, atol=5e-3)


def test_a_standing_walker_feels_its_weight() -> None:
    """Catches a frame that is not that of the pelvis, which leans under its weight."""
    env = made("elastic_env/WalkInPlace-v0")
    observation, _ = env.reset(seed=3)
    upwards = env.unwrapped.truth().pelvis_R[
        :, 2
    ]  # in the frame of the pelvis, which its springs let tilt
    assert np.abs(upwards[:, 0]).min() > 0.02
    np.testing.assert_allclose(shown(env, observation, "accelerometer"), 9.81 * upwards, atol=1e-3)


@ARM_AT_NIGHT
def test_what_is_not_asked_for_changes_nothing(robot: str) -> None:
    """Catches a sensor that draws from the noise of others, or disturbs the physics."""
    with_all = made(robot, scenario="nominal")
    without = made(robot, scenario="nominal", sensors=[])
    one = played(with_all)
    other = played(without)
    width = other.shape[1]
    assert one.shape[1] == with_all.unwrapped.task.observation_table.__len__() > width
    np.testing.assert_array_equal(with_all.unwrapped.truth().q, without.unwrapped.truth().q)
    np.testing.assert_array_equal(one[:, :width], other)


@ARM_AT_NIGHT
def test_their_errors_are_as_declared(robot: str) -> None:
    """Catches noise that is left out or drawn once, an offset per step, and worlds that share
    theirs."""
    env = made(robot, worlds=40, scenario="nominal")
    env.reset(seed=1)
    errors = []
    for _ in range(40):
        observation = env.step(np.zeros(env.action_space.shape, dtype=np.float32))[0]
        truth = env.unwrapped.truth()
        errors.append(shown(env, observation, "joint_torque") - of_springs(truth))
    error = np.array(errors)
    sensor = SENSORS["joint_torque"]
    assert np.std(error, axis=0).mean() == pytest.approx(sensor.noise, rel=0.1)
    offset = error.mean(axis=0)
    assert np.abs(offset).max() < sensor.offset + 0.2
    assert offset.std() == pytest.approx(sensor.offset / np.sqrt(3.0), rel=0.3)
    counts = shown(env, observation, "link_encoder") / (
        2 * np.pi / truth.model.encoder_counts_per_turn
    )
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)


@ARM_AT_NIGHT
def test_they_are_as_old_as_the_other_measurements(robot: str) -> None:
    """Catches a sensor that a delay leaves out."""
    env = made(robot, scenario="ideal+sensor")
    env.reset(seed=2)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    before = None
    for _ in range(5):
        observation = env.step(action)[0]
        if before is not None:
            homing = shown(env, observation, "link_encoder") - before
            assert np.abs(homing).max() <= 2e-3 + 1e-12
            assert np.ptp(homing) > 0.0
        before = env.unwrapped.truth().q


def test_the_names_of_sensors_are_told() -> None:
    with pytest.raises(
        ConfigurationError, match="unknown sensor 'gyro'; choose one of: link_encoder, joint_torque"
    ):
        made("elastic_env/Testbed-v0", sensors=["gyro"])
    with pytest.raises(ConfigurationError, match="accelerometer"):
        gymnasium.make("elastic_env/Testbed-v0", sensors=["accelerometr"])


def test_the_mirror_knows_every_sensor() -> None:
    """Catches a declaration without its mirror image: in the mirror the truth of the mirrored
    robot is shown."""
    env = made("elastic_env/WalkInPlace-v0")
    table = env.unwrapped.task.observation_table
    mirrored = Mirror(table.signals)
    row = np.arange(1.0, len(table) + 1.0)
    seen = mirrored(row)
    np.testing.assert_array_equal(mirrored(seen), row)
    force = table.group("accelerometer")
    np.testing.assert_array_equal(seen[force], row[force] * [1.0, -1.0, 1.0])
    left, right = (table.names.index(f"joint_torque.{side}_hip_roll") for side in "lr")
    assert seen[left] == -row[right]


@ROBOTS
def test_policies_play_with_all_of_them(robot: str) -> None:
    """Catches a policy that counts columns from the end."""
    env = made(robot)
    plain = made(robot, sensors=[])
    actions = []
    for one in (env, plain):
        policy = baselines.make("input_output" if "Walk" in robot else "dynamic", one)
        observation, _ = one.reset(seed=4)
        actions.append(policy.predict(observation)[0])
    np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize(
    "text", [str(further_sensors.__doc__), (ROOT / "docs" / "robots.md").read_text("utf-8")]
)
def test_tables_have_every_sensor_with_its_unit_columns_and_noise(text: str) -> None:
    """Catches a sensor that is declared and not documented, and a number in a table that is not
    the declared one."""
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    table = {row[0].strip("`"): row[1:] for row in rows if row[0].strip("`") in SENSORS}
    assert table.keys() == SENSORS.keys()
    for name, sensor in SENSORS.items():
        columns, unit, _, error = table[name]
        assert columns == (", ".join(sensor.axes) if sensor.axes else "a joint each")
        assert unit == sensor.unit
        assert f"{sensor.noise:.3g}" in error or sensor.is_encoder
        assert f"{sensor.offset:.3g}" in error or not sensor.offset
