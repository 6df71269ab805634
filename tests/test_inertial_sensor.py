"""The IMU that computes its attitude: filter against closed forms, accelerometer against MuJoCo,
errors of a walk."""

import math
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.environment import make_vector
from elastic_env.robots.thormang.records import TRUTH
from elastic_env.world import attitude_kernels
from elastic_env.world import walk_kernels as kernels
from elastic_env.world.scenario import make_scenario
from elastic_env.world.sensors import AttitudeSensor, InertialSensor
from tests.three_joints import ARM

G = 9.81
EXACT = InertialSensor(
    gyro_noise_density=0.0,
    gyro_bias_rad_s=0.0,
    accelerometer_noise_density=0.0,
    accelerometer_bias_m_s2=0.0,
    static_error_rad=0.0,
)
STILL = np.zeros((1, 12), np.float32)
SHORT = {"step_period": 1.1, "num_steps": 1}


def filtered(up: Array, rate: Array, force: Array, duration_s: float, tau_s: float) -> Array:
    """The vertical after some time of a constant rate and a constant force in the frame of the
    sensor."""
    up = up.copy()
    period_s = 0.004
    for _ in range(round(duration_s / period_s)):
        attitude_kernels.complementary_filter(
            up, rate * period_s, force, 1.0 - math.exp(-period_s / tau_s)
        )
    return up


@pytest.mark.parametrize("time_s", [2.0, 10.0, 40.0])
def test_an_acceleration_tilts_the_attitude_as_a_first_order_lag(time_s: float) -> None:
    """Catches a wrong gain, a force that is not normalised, and a correction away from the
    accelerometer.

    The angle to go, from the present vertical to that of the accelerometer, θ, obeys θ̇ = −sin θ/τ.
    """
    a = 0.5
    tau = 10.0
    up = filtered(np.array([0.0, 0.0, 1.0]), np.zeros(3), np.array([0.0, a, G]), time_s, tau)
    roll, pitch, _ = attitude_kernels.attitude_from_vertical(*up)
    end = math.atan2(a, G)
    exact = end - 2.0 * math.atan(math.tan(end / 2.0) * math.exp(-time_s / tau))
    assert roll == pytest.approx(exact, rel=1e-6)
    assert roll == pytest.approx(a / G * (1.0 - math.exp(-time_s / tau)), rel=2e-3)
    assert pitch == 0.0


@pytest.mark.parametrize(("axis", "angle"), [(0, 0), (1, 1)])
def test_a_bias_of_the_gyroscope_tilts_it_by_bias_times_time_constant(
    axis: int, angle: int
) -> None:
    """Catches a rotation in the wrong direction: a positive rate about x is a growing roll,
    about y a growing pitch."""
    tau = 10.0
    bias = np.zeros(3)
    bias[axis] = 1e-3
    force = np.array([0.0, 0.0, G])
    for time_s in (1.0, 10.0, 60.0):
        up = filtered(np.array([0.0, 0.0, 1.0]), bias, force, time_s, tau)
        expected = 1e-3 * tau * (1.0 - math.exp(-time_s / tau))
        assert attitude_kernels.attitude_from_vertical(*up)[angle] == pytest.approx(
            expected, rel=1e-3
        )
        assert attitude_kernels.attitude_from_vertical(*up)[1 - angle] == pytest.approx(
            0.0, abs=1e-9
        )
    settled = np.empty(3)
    attitude_kernels.settled_vertical(settled, force, bias, tau)
    np.testing.assert_allclose(settled, filtered(settled, bias, force, 10.0, tau), atol=5e-6)


def test_the_gyroscope_alone_follows_any_rotation() -> None:
    """Catches a first-order integration, and a vertical that turns with the sensor."""
    rng = np.random.default_rng(0)
    up = np.array([0.0, 0.0, 1.0])
    R = Rotation.identity()
    for turned in rng.normal(scale=0.3, size=(50, 3)):
        R = R * Rotation.from_rotvec(turned)
        attitude_kernels.complementary_filter(up, turned, np.zeros(3), 0.0)
    np.testing.assert_allclose(up, R.inv().apply([0.0, 0.0, 1.0]), atol=1e-12)


def test_the_mean_rate_is_that_of_the_rotation_between_two_attitudes() -> None:
    """Catches the order of the quaternions, and a rotation that goes the long way round."""
    rng = np.random.default_rng(1)
    for turned in [np.zeros(3), *rng.normal(scale=0.5, size=(20, 3))]:
        before = Rotation.random(random_state=rng)
        after = before * Rotation.from_rotvec(turned)
        a, b = (np.roll(R.as_quat(), 1) for R in (before, after))
        found = np.empty(3)
        for sign in (1.0, -1.0):
            attitude_kernels.rotation_between(a, sign * b, found)
            np.testing.assert_allclose(found, turned, atol=1e-12)


def truth(R: Rotation, velocity: Array) -> Any:
    """A row of the truth with an attitude and a velocity."""
    row = np.zeros(1, TRUTH)
    row["quaternion"] = np.roll(R.as_quat(), 1)
    row["pelvis_velocity"] = velocity
    return row.view(np.recarray)[0]


def test_a_tilted_sensor_at_rest_feels_gravity() -> None:
    """Catches a specific force of the wrong sign, and one that is left in the frame of the
    world."""
    R = Rotation.from_euler("ZYX", [0.7, -0.2, 0.3])
    force = np.empty(3)
    row = truth(R, np.zeros(3))
    kernels.specific_force(row, row, 0.004, G, force)
    np.testing.assert_allclose(force, R.inv().apply([0.0, 0.0, G]), atol=1e-12)
    roll, pitch, _ = attitude_kernels.attitude_from_vertical(*(force / G))
    assert (roll, pitch) == pytest.approx((0.3, -0.2))


def test_the_specific_force_is_that_of_mujocos_accelerometer() -> None:
    """Catches a frame, a sign or a period: a thrown body that turns, with a force on it, against
    its own sensor."""
    xml = (
        "<mujoco><option timestep='1e-4'/><worldbody><body pos='0 0 9'><freejoint/><site"
        " name='imu'/><geom size='.1 .2 .3'"
        " type='ellipsoid'/></body></worldbody><sensor><accelerometer"
        " site='imu'/></sensor></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    force = np.empty(3)
    data.qvel[:] = [0.3, -0.2, 1.0, 0.5, -1.0, 0.8]
    data.xfrc_applied[1, :3] = [40.0, -25.0, 300.0]

    def now() -> Any:
        return truth(Rotation.from_quat(np.roll(data.qpos[3:7], -1)), data.qvel[:3].copy())

    before = now()
    felt = []
    for _ in range(40):
        mujoco.mj_step(model, data)
        felt.append(data.sensordata.copy())
    kernels.specific_force(before, now(), 40 * model.opt.timestep, G, force)
    # half a period's turn of 1.4 rad/s lies between the mean of the sensor and the frame at the end
    np.testing.assert_allclose(force, np.mean(felt, axis=0), atol=5e-3 * np.linalg.norm(force))
    assert np.linalg.norm(force) > 1.0


# In the walker.


def shown_and_true(
    num_envs: int, steps: int, seed: int = 0, **arguments: Any
) -> tuple[Array, Array, Any]:
    """Roll and pitch by the IMU and of the pelvis, (steps + 1, num_envs, 2), and the
    environment, without offsets."""
    env = make_vector(num_envs=num_envs, **arguments)
    observation, info = env.reset(seed=seed)
    columns = env.unwrapped.task.observation_table.group("imu_attitude")
    shown = []
    true = []
    for step in range(steps + 1):
        shown.append(observation[:, columns])
        true.append(np.stack([info["pelvis_roll"], info["pelvis_pitch"]], axis=1))
        if step < steps:
            observation, *_, info = env.step(np.zeros((num_envs, 12), np.float32))
    return np.array(shown), np.array(true), env


def test_the_imu_sits_at_the_origin_of_the_pelvis() -> None:
    """Catches a site that is moved: then its velocity would not be that of the pelvis' origin."""
    model = make_vector(num_envs=1).unwrapped.task.model
    np.testing.assert_array_equal(model.site("imu").pos, 0.0)
    assert model.site("imu").bodyid[0] == model.body("pelvis").id


def test_the_error_at_rest_is_that_of_the_data_sheet() -> None:
    """Catches biases that are drawn twice or not at all: ±0.25° in roll and in pitch,
    independent, without a mean."""
    shown, true, _ = shown_and_true(256, 0, scenario="imu")
    error = (shown - true)[0]
    assert np.sqrt(np.square(error).mean(axis=0)) == pytest.approx(
        math.radians(0.25), rel=5 / math.sqrt(2 * 256)
    )
    assert np.abs(error.mean(axis=0)).max() < 5 * math.radians(0.25) / math.sqrt(256)
    assert abs(np.corrcoef(error.T)[0, 1]) < 5 / math.sqrt(256)


def test_the_error_in_a_walk_is_within_that_of_the_data_sheet() -> None:
    """±0.25° at rest, ±0.5° in motion: catches a filter that the walk throws off, and one that
    is not disturbed."""
    shown, true, env = shown_and_true(8, 500, scenario="imu", **SHORT)
    walking = env.unwrapped.task.plan.timing.walking[:501]
    # as old as the measurements are, against the truth of then
    error = (shown[1:] - true[:-1])[walking[:-1]]
    rms = np.sqrt(np.square(error).mean(axis=(0, 1)))
    assert (math.radians(0.15) < rms).all()
    assert (rms < math.radians(0.5)).all()
    roll, pitch = np.sqrt(np.square(error - error[0]).mean(axis=(0, 1)))
    assert roll > 5e-4
    assert pitch > 1e-4


def test_what_moves_the_pelvis_disturbs_the_attitude() -> None:
    """Catches a disturbance of the wrong sign or size: finite differences of the velocity, over
    g, over τ, summed."""
    tau = 200.0
    period_s = 0.004
    steps = 400
    env = make_vector(
        num_envs=1,
        scenario=make_scenario("ideal").replace(
            inertial_share=1.0, inertial=EXACT.replace(time_constant_s=tau)
        ),
        **SHORT,
    )
    env.reset(seed=0)
    task = env.unwrapped.task
    columns = task.observation_table.group("imu_attitude")
    error = []
    velocity = [np.zeros(3)]
    for _ in range(steps):
        observation, *_, info = env.step(STILL)
        error.append(observation[0, columns] - [info["pelvis_roll"][0], info["pelvis_pitch"][0]])
        velocity.append(task.sample().worlds["truth"]["pelvis_velocity"][0].copy())
    force = np.diff(velocity, axis=0) / period_s + [0.0, 0.0, G]
    direction = force / np.linalg.norm(force, axis=1)[:, None]
    # to the left is a positive roll, forward a negative pitch; the heading stays
    expected = np.stack([direction[:, 1], -direction[:, 0]], axis=1).cumsum(axis=0) * period_s / tau
    assert np.abs(expected).max(axis=0).min() > 1e-5
    np.testing.assert_allclose(error, expected, atol=1e-6)


def test_without_errors_a_robot_at_rest_shows_its_attitude() -> None:
    """Catches an offset that is not drawn, a filter that starts elsewhere, and gravity of
    another size."""
    shown, true, _ = shown_and_true(
        1,
        10,
        scenario=make_scenario("ideal").replace(inertial_share=1.0, inertial=EXACT),
        step_period=3.0,
    )
    np.testing.assert_allclose(shown, true, atol=1e-6)
    assert abs(true[0, 0, 1]) > 0.02  # pitched by its own weight


def test_a_slower_imu_holds_what_a_faster_one_shows() -> None:
    """Catches a filter that pauses with the output: the device filters on, and shows every fifth
    step."""
    fast = make_scenario("nominal").replace(inertial_share=1.0, inertial=InertialSensor())
    slow = fast.replace(pelvis_imu=AttitudeSensor(rate_hz=50.0))
    (all_shown, *_), (held, *_) = (
        shown_and_true(2, 52, scenario=scenario) for scenario in (fast, slow)
    )
    due = np.arange(53) // 5 * 5
    np.testing.assert_array_equal(held, all_shown[due])


def test_its_rate_has_bias_and_noise_of_the_gyroscope() -> None:
    """Catches the noise of `nominal` in its place, and a rate that is not shown."""
    sensor = InertialSensor(gyro_bias_rad_s=0.02, time_constant_s=1e-3)
    scenario = make_scenario("ideal").replace(inertial_share=1.0, inertial=sensor)
    steps = 12
    worlds = 128
    env = make_vector(num_envs=worlds, scenario=scenario)
    env.reset(seed=0)
    columns = env.unwrapped.task.observation_table.group("imu_rate")
    seen = []
    for _ in range(steps):  # the robot stands
        observation, *_ = env.step(np.zeros((worlds, 12), np.float32))
        seen.append(observation[:, columns])
    bias = env.unwrapped.task._bias["gyro"]
    noise = np.array(seen) - bias
    expected = math.radians(0.005) * math.sqrt(125.0)
    assert noise.std(axis=(0, 1)) == pytest.approx(expected, rel=5 / math.sqrt(2 * steps * worlds))
    assert np.abs(noise.mean(axis=0)).max() < 5 * expected / math.sqrt(steps)
    assert bias.std() == pytest.approx(0.02, rel=0.3)


def test_its_attitude_has_bias_and_noise_of_the_accelerometer() -> None:
    """Catches noise or bias in g, swapped axes, and white noise that goes past the filter.

    With a time constant far below a control period the filter shows the accelerometer alone.
    """
    sensor = InertialSensor(
        gyro_bias_rad_s=0.0,
        static_error_rad=0.05,
        accelerometer_bias_m_s2=0.1,
        time_constant_s=1e-6,
    )
    steps = 12
    worlds = 128
    shown, true, env = shown_and_true(
        worlds, steps, scenario=make_scenario("ideal").replace(inertial_share=1.0, inertial=sensor)
    )
    bias = env.unwrapped.task._bias
    force = bias["specific_force"]
    # to the left is a positive roll, forward a negative pitch
    expected = bias["imu_attitude"] + np.stack([force[:, 1], -force[:, 0]], axis=1) / G
    error = (shown - true)[1:]
    noise = 100e-6 * math.sqrt(125.0)
    assert (error - error.mean(axis=0)).std(axis=(0, 1)) == pytest.approx(
        noise * math.sqrt(11 / 12), rel=0.1
    )
    np.testing.assert_allclose(
        error.mean(axis=0), expected, atol=0.03 * 0.1 / G + 5 * noise / math.sqrt(steps)
    )
    assert force.std() == pytest.approx(0.1, rel=0.2)


def test_one_world_and_many_agree() -> None:
    """Catches worlds that share a filter or noise."""
    many = make_vector(num_envs=3, scenario="imu", num_threads=1)
    alone = gymnasium.make("elastic_env/WalkInPlace-v0", scenario="imu", disable_env_checker=True)
    many.reset(seed=[5, 6, 7])
    first, _ = alone.reset(seed=6)
    for _ in range(20):
        observation, *_ = many.step(np.full((3, 12), 0.01, np.float32))
        first, *_ = alone.step(np.full(12, 0.01, np.float32))
    np.testing.assert_array_equal(observation[1], first)


def test_the_scenario_has_the_age_of_sensor() -> None:
    """Catches measurements that are new where the issue asks for old ones, and robots taken for
    one and the same."""
    scenario = make_scenario("imu")
    assert scenario.delay_share == make_scenario("sensor").delay_share == 1.0
    assert scenario.draws_robots
    assert scenario.is_random
    assert make_scenario("soft+imu").inertial_share == 1.0


def test_the_default_has_the_data_sheets_error_at_rest() -> None:
    """Catches an offset that forgets the biases: together they are 0.25°, of which the biases
    alone are 0.12°."""
    sensor = InertialSensor()
    by_force = sensor.accelerometer_bias_m_s2 / 9.80665
    by_rate = sensor.gyro_bias_rad_s * sensor.time_constant_s
    assert math.hypot(by_force, by_rate, sensor.offset_rad) == pytest.approx(math.radians(0.25))
    assert math.degrees(math.hypot(by_force, by_rate)) == pytest.approx(0.118, abs=1e-3)
    with pytest.raises(ConfigurationError, match="static_error_rad must be at least"):
        InertialSensor(static_error_rad=1e-3)


def pendulum(scenario: Any, **arguments: Any) -> Any:
    """A testbed whose link has an IMU that computes its attitude, observed beside the
    accelerometer."""
    sensors = ["link_imu", "accelerometer"]
    return gymnasium.make("elastic_env/Testbed-v0", scenario=scenario, sensors=sensors, **arguments)


def played(env: Any, steps: int) -> tuple[Array, list[dict[str, Any]]]:
    """Observations and infos of an episode without compensation."""
    observation, info = env.reset(seed=3)
    observations = [observation]
    infos = [info]
    for _ in range(steps):
        observation, _, _, _, info = env.step(np.zeros(1, np.float32))
        observations.append(observation)
        infos.append(info)
    return np.array(observations), infos


SWING = {"kind": "sine", "amplitude": 0.3, "frequency_hz": 0.8}


def test_the_links_accelerometer_is_that_of_mujoco() -> None:
    """Catches a wrong arm, a wrong sign, and a rate in the place of an acceleration.

    With a very short time constant the filter shows the direction of the specific force. MuJoCo's
    accelerometer at the same site knows that force at a physics step; ours is the mean over a
    control period, half of one older.
    """
    fast = make_scenario("ideal").replace(
        inertial_share=1.0, inertial=EXACT.replace(time_constant_s=1e-3, bandwidth_hz=1.0)
    )
    fast = fast.replace(imu=AttitudeSensor(rate_hz=250.0))
    seen, infos = played(pendulum(fast, reference=SWING), 900)
    x = seen[:, 7]
    z = seen[:, 9]
    by_mujoco = np.arctan2(x, z)
    q = np.array([info["link_angle"] for info in infos])
    half = (by_mujoco[1:] + by_mujoco[:-1]) / 2.0
    disturbance = np.abs(by_mujoco - q).max()
    assert disturbance > 0.1
    assert np.abs(seen[1:, 6] - half)[5:].max() < 0.08 * disturbance


def test_the_links_filter_without_errors_shows_the_link() -> None:
    """Catches a gyroscope of the wrong sign or scale: with a long time constant the rate alone
    counts."""
    slow = make_scenario("ideal").replace(
        inertial_share=1.0,
        inertial=EXACT.replace(time_constant_s=1e6),
        imu=AttitudeSensor(rate_hz=250.0),
    )
    seen, infos = played(pendulum(slow, reference=SWING), 900)
    q = np.array([info["link_angle"] for info in infos])
    assert np.ptp(q) > 0.5
    np.testing.assert_allclose(seen[:, 6], q, rtol=0.0, atol=1e-5)


def test_the_links_error_at_rest_is_that_of_the_data_sheet_and_stays() -> None:
    """Catches biases drawn twice or not at all, and a filter that has not settled when the
    episode begins."""
    quiet = InertialSensor(gyro_noise_density=0.0, accelerometer_noise_density=0.0)
    scenario = make_scenario("ideal").replace(inertial_share=1.0, inertial=quiet)
    env = gymnasium.make_vec(
        "elastic_env/Testbed-v0",
        num_envs=256,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        scenario=scenario,
        observe_link=True,
        reference="hold",
    )
    observation, info = env.reset(seed=0)
    error = observation[:, 6] - info["link_angle"]
    assert np.sqrt(np.square(error).mean()) == pytest.approx(
        math.radians(0.25), rel=5 / math.sqrt(2 * 256)
    )
    for _ in range(10):
        observation, _, _, _, info = env.step(np.zeros((256, 1), np.float32))
    np.testing.assert_allclose(observation[:, 6] - info["link_angle"], error, rtol=0.0, atol=1e-6)


def test_robots_without_an_imu_on_the_link_refuse_its_scenario() -> None:
    """Catches a scenario that does nothing on the robot that it is asked of."""
    ARM.register()
    with pytest.raises(
        ConfigurationError, match="about the IMU on a link, which arm does not have"
    ):
        gymnasium.make(ARM.id, scenario="imu")
