"""Robots drawn from ranges: the draws themselves, what of them reaches plant and sensors, and
who may know of it."""

import dataclasses
import math
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from elastic_env.core.config_problems import ModelError
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import static_deflection
from elastic_env.robots.thormang import config as walk_config
from elastic_env.robots.thormang.config import floor_tilt, robot_bank
from elastic_env.robots.thormang.environment import configure_walk
from elastic_env.robots.thormang.environment import make as make_walk
from elastic_env.robots.thormang.environment import make_vector as make_walk_vector
from elastic_env.robots.thormang.model import DRAWN_LOAD, add_load, elastic_spec
from elastic_env.world.robot_ranges import (
    FOOT_ERRORS,
    DrawnRobot,
    RobotRanges,
    draw_robots,
    latin_hypercube,
)
from elastic_env.world.scenario import RANGES_BEYOND, TRAINING_RANGES, Scenario, make_scenario
from tests.three_joints import ARM

SHORT: dict[str, Any] = {"step_period": [0.3, 0.5, 0.3], "num_steps": 1}
MASS_KG = 57.0
DRAWN_FIELDS = (
    "tendon_stiffness",
    "tendon_damping",
    "tendon_lengthspring",
    "dof_frictionloss",
    "body_quat",
    "body_pos",
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_invweight0",  # by the masses
)
NAMES = [name for name, _ in RobotRanges().intervals()]


def with_ranges(*ranges: RobotRanges, ground: str = "nominal") -> Scenario:
    """A scenario that draws from some ranges."""
    return make_scenario(ground).replace(mixture=ranges, name="own")


def robot_of(env: Any, world: int = 0) -> DrawnRobot:
    """The robot that a world has drawn."""
    return env.unwrapped.task._robots[world]


def place_of(robot: DrawnRobot) -> Array:
    """Place of a robot's load from the center of mass of the torso, (3,) [m]."""
    return np.array([robot.load_x_m, robot.load_y_m, robot.load_z_m])


def plant_of(env: Any, world: int) -> mujoco.MjModel:
    """The model that a world steps."""
    return env.unwrapped.simulation.model_of(world)


def is_within(ranges: RobotRanges, robot: DrawnRobot) -> bool:
    """Whether a robot lies in ranges; factors on K are taken together."""
    lowest, highest = np.multiply(ranges.stiffness, ranges.joint_stiffness)
    found: list[tuple[tuple[float, float], Any]] = [
        ((lowest, highest), robot.stiffness),
        (ranges.damping, robot.damping),
        (ranges.friction, robot.friction),
        (ranges.backlash_rad, robot.backlash_rad),
        (ranges.load_kg, robot.load_kg),
        *(
            (getattr(ranges, name), getattr(robot, name))
            for name in ("load_x_m", "load_y_m", "load_z_m")
        ),
        (ranges.homing_rad, robot.homing_rad),
        (ranges.mounting_rad, robot.mounting_rad),
        (ranges.slope_rad, robot.slope_rad),
        *((getattr(ranges, name), getattr(robot, name)) for name in FOOT_ERRORS),
    ]
    is_unpushed = robot.push_n == 0.0 and (ranges.push_share < 1.0 or ranges.push_n[0] == 0.0)
    if not is_unpushed:
        found.append((ranges.push_n, robot.push_n))
    shares = (ranges.delay_share, robot.is_delayed), (ranges.inertial_share, robot.is_inertial)
    return all(
        np.all((low <= np.array(v)) & (np.array(v) <= high)) for (low, high), v in found
    ) and all(share > 0.0 if has else share < 1.0 for share, has in shares)


@st.composite
def ranges_of(draw: st.DrawFn) -> RobotRanges:
    """Ranges anywhere within their bounds."""
    given_: dict[str, Any] = {}
    for name in NAMES:
        extra: Any = RobotRanges.model_fields[name].json_schema_extra
        ends = st.floats(*extra["bounds"], allow_subnormal=False)
        given_[name] = tuple(sorted([draw(ends), draw(ends)]))
    for name in ("push_share", "delay_share", "inertial_share"):
        given_[name] = draw(st.floats(0.0, 1.0))
    return RobotRanges(**given_)


# Draws.


@settings(max_examples=20, deadline=None)
@given(ranges_of(), st.integers(1, 12), st.integers(0, 2**31))
def test_robots_lie_in_their_ranges(ranges: RobotRanges, number: int, seed: int) -> None:
    """Catches a factor for an interval, a half-width for an end, and rounding beyond an end."""
    robots = draw_robots([ranges], number, 3, [seed])
    assert len(robots) == number
    for robot in robots:
        assert is_within(ranges, robot)
        assert {len(robot.stiffness), len(robot.homing_rad)} == {3}
        assert 0.0 <= robot.slope_direction_rad <= 2.0 * math.pi


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 40), st.integers(1, 5), st.integers(0, 2**31))
def test_a_latin_hypercube_has_one_value_in_each_interval(
    number: int, columns: int, seed: int
) -> None:
    """Catches independent draws, which leave gaps, and one order for all columns."""
    points = latin_hypercube(number, columns, np.random.default_rng(seed))
    assert points.shape == (number, columns)
    for column in points.T:
        np.testing.assert_array_equal(np.sort(np.floor(column * number)), np.arange(number))


def test_the_bank_of_drawn_fills_its_ranges_evenly_and_its_quantities_are_independent() -> None:
    """Catches a quantity that is drawn once for all robots, or along with another one."""
    bank = robot_bank(make_scenario("drawn"))
    assert len(bank) == walk_config.BANK_SIZE == 256
    columns = np.array(
        [
            [
                *r.stiffness,
                *r.homing_rad,
                *r.mounting_rad,
                r.load_x_m,
                r.load_y_m,
                r.load_z_m,
                r.damping,
                r.friction,
                r.backlash_rad,
                r.load_kg,
                r.slope_rad,
                r.slope_direction_rad,
            ]
            for r in bank
        ]
    )
    joints = columns[:, :12]
    assert 0.5 < np.corrcoef(joints.T)[0, 1] < 0.9  # a factor of their own, and one together
    assert (joints.min(), joints.max()) == pytest.approx((0.6, 1.4), abs=0.04)
    own = np.corrcoef(np.column_stack([joints.mean(axis=1), columns[:, 12:]]).T)
    assert np.abs(own - np.eye(len(own))).max() < 5.0 / np.sqrt(256)
    for column, name in (
        (-6, "damping"),
        (-5, "friction"),
        (-4, "backlash_rad"),
        (-3, "load_kg"),
        (-2, "slope_rad"),
    ):
        low, high = getattr(TRAINING_RANGES, name)
        np.testing.assert_allclose(
            np.sort(columns[:, column]), np.linspace(low, high, 256), atol=(high - low) / 256
        )
    pushes = np.array([r.push_n for r in bank])
    assert (pushes > 0.0).mean() == pytest.approx(0.5, abs=0.01)
    assert pushes.max() <= 50.0
    assert np.mean([r.is_delayed for r in bank]) == pytest.approx(0.5, abs=0.01)


def test_banks_are_the_same_everywhere_and_have_robots_of_their_own() -> None:
    """Catches robots that are new in every process, and an evaluation on robots that training
    has met."""
    for name in ("drawn", "drawn_beyond"):
        scenario = make_scenario(name)
        bank = robot_bank(scenario)
        assert robot_bank(scenario) == bank
        assert not set(robot_bank(scenario, 1)) & set(bank)
    assert robot_bank(make_scenario("drawn"))[0].damping == pytest.approx(
        DAMPING_OF_THE_FIRST, rel=1e-12
    )


DAMPING_OF_THE_FIRST = 0.5748213505602238
"""Damping of the first robot of the bank, to notice a change of the draws."""


def test_every_robot_of_drawn_beyond_has_one_quantity_beyond_the_ranges_of_drawn() -> None:
    """Catches a held-out robot that training could have met."""
    assert all(is_within(TRAINING_RANGES, robot) for robot in robot_bank(make_scenario("drawn")))
    bank = robot_bank(make_scenario("drawn_beyond"))
    assert len(bank) == 256
    shares = np.linspace(0, 256, len(RANGES_BEYOND) + 1).round().astype(int)
    for beyond, begin, end in zip(RANGES_BEYOND, shares, shares[1:], strict=False):
        for robot in bank[begin:end]:
            assert is_within(TRAINING_RANGES.replace(**beyond), robot)
        (name, (low, high)), *_ = beyond.items()
        inside = getattr(TRAINING_RANGES, name)
        assert low >= inside[1] or high <= inside[0], name


def test_a_range_that_changes_leaves_the_other_draws_as_they_are() -> None:
    """Catches robots that all change with one interval, so that a comparison of two ranges is of
    other robots."""
    one = draw_robots([TRAINING_RANGES], 16, 12, [3])
    other = draw_robots([TRAINING_RANGES.replace(load_kg=(0.0, 0.0))], 16, 12, [3])
    assert [dataclasses.replace(robot, load_kg=0.0) for robot in one] == other
    assert max(robot.load_kg for robot in one) > 7.0


def test_several_ranges_have_equal_shares() -> None:
    light = RobotRanges(load_kg=(0.0, 1.0))
    heavy = RobotRanges(load_kg=(5.0, 6.0))
    robots = draw_robots([light, heavy, light], 9, 2, [0])
    assert [robot.load_kg > 2.0 for robot in robots] == [False] * 3 + [True] * 3 + [False] * 3
    assert len({robot.load_kg for robot in robots}) == 9


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        (
            {"load_kg": (4.0, 2.0)},
            r"load_kg must be a number or \[lowest, highest\] within 0 to 100 \[kg\], got \[4, 2\]",
        ),
        (
            {"friction": (-1.0, 2.0)},
            r"friction must be a number or \[lowest, highest\] within 0 to 100 \[1\], got \[-1, 2\]",
        ),
        ({"load": (0.0, 2.0)}, "load"),
        ({"delay_share": 1.5}, "delay_share"),
        ({"load_kg": (0.0, math.nan)}, "load_kg"),
    ],
)
def test_ranges_that_are_none_are_refused(given_: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RobotRanges(**given_)


def test_what_is_drawn_is_not_said_twice() -> None:
    """Catches a slope by one change and another one by `drawn`, of which one would be lost."""
    with pytest.raises(ConfigurationError, match="'drawn' sets slope_rad a second time"):
        make_scenario("slope+drawn")
    with pytest.raises(ConfigurationError, match=r"'drawn' sets .*delay_share, .*homing_rad"):
        make_scenario("sensor+drawn")
    with pytest.raises(ConfigurationError, match="'drawn' sets stiffness a second time"):
        make_scenario("soft+drawn")
    with pytest.raises(ConfigurationError, match=r"'soft.drawn_beyond' sets stiffness a second"):
        make_scenario("soft+drawn_beyond")
    assert make_scenario("slip+drawn").floor_friction == (0.3, 0.3)
    listed = make_scenario("slip+drawn", ranges=[{"load_kg": 1}, {"slope_rad": 0.01}])
    for scenario in (make_scenario("slip+drawn_beyond"), listed):
        assert {own.floor_friction for own in scenario.mixture} == {(0.3, 0.3)}
    assert make_scenario("slip+drawn").draws_robots


def test_a_number_is_an_interval_of_one_point_that_every_robot_has() -> None:
    """Catches a number that becomes a half-width, and rounding: `soft` is 0.7 and nothing else."""
    ends = {"stiffness": 0.7, "backlash_rad": 1.75e-3, "homing_rad": np.float32(0.1), "load_kg": 5}
    ranges = RobotRanges(**ends, cross_talk=-0.3)
    assert ranges.stiffness == (0.7, 0.7)
    assert ranges.homing_rad == (0.1, 0.1)
    assert ranges.is_one_robot
    for robot in draw_robots([ranges], 3, 2, [5]):
        assert robot.stiffness == (0.7, 0.7)
        assert robot.backlash_rad == 1.75e-3
        assert robot.homing_rad == (0.1, 0.1)
        assert robot.load_kg == 5.0
        assert set(robot.cross_talk) == {-0.3}
    assert make_scenario("soft").fixed_value("stiffness") == 0.7
    assert make_scenario("drawn").fixed_value("stiffness") == 1.0
    with pytest.raises(ModelError, match="stiffness"):
        RobotRanges(stiffness=True)


@pytest.mark.parametrize("name", [*NAMES, "push_share", "delay_share", "inertial_share"])
def test_a_quantity_reaches_its_ends_and_leaves_all_others_as_they_are(name: str) -> None:
    """Catches a quantity that is drawn along with another one, or by its stream."""
    others = TRAINING_RANGES.replace(inertial_share=0.5, floor_friction=(0.2, 1.0))
    field = RobotRanges.model_fields[name]
    if name.endswith("share"):
        changes = [{name: 0.0}, {name: 1.0}]
    else:
        low, high = field.json_schema_extra["bounds"]  # type: ignore[index,call-overload]
        middle = (low + high) / 2.0 + 0.1 * (high - low)
        changes = [{name: middle}, {name: (middle, high)}, {name: (low, high)}]
    banks = [draw_robots([others.replace(**own)], 64, 3, [1]) for own in changes]
    own_names = {"delay_share": "is_delayed", "inertial_share": "is_inertial"}
    own_names |= {"push_share": "push_n", "joint_stiffness": "stiffness"}
    own = own_names.get(name, name)
    values = [np.array([getattr(robot, own) for robot in bank]) for bank in banks]
    for bank in banks:
        for robot, first in zip(bank, banks[0], strict=True):
            assert dataclasses.replace(robot, **{own: getattr(first, own)}) == first
    if name.endswith("share"):
        assert not values[0].any()
        assert values[1].all()
    elif "stiffness" not in name and name != "push_n":
        low, high = changes[-1][name]
        assert values[-1].min() < low + 2.0 * (high - low) / 64
        assert values[-1].max() > high - 2.0 * (high - low) / 64
        assert (values[0] == middle).all()


# The plant.


@pytest.mark.parametrize("worlds", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_drawn_robot_accelerates_as_one_that_is_compiled_with_its_values(worlds: int) -> None:
    """Catches a field that is forgotten, such as inertias for the contacts after a change of
    mass."""
    arguments: dict[str, Any] = {**SHORT, "scenario": "drawn"}
    env: Any = (
        make_walk(**arguments) if worlds == 1 else make_walk_vector(num_envs=worlds, **arguments)
    )
    env.reset(seed=2)
    config = env.unwrapped.task.config
    world = worlds - 1
    robot = robot_of(env, world)
    plant = plant_of(env, world)
    joints = {
        name: joint.replace(
            stiffness=joint.stiffness * factor,
            damping=joint.damping * robot.damping,
            coulomb_friction=joint.coulomb_friction * robot.friction,
            backlash=robot.backlash_rad,
        )
        for (name, joint), factor in zip(config.true_joints.items(), robot.stiffness, strict=True)
    }
    spec = elastic_spec(config.robot, joints, "tendon", config.timestep_s)
    add_load(spec, DRAWN_LOAD, robot.load_kg, place_of(robot))
    spec.body("floor").quat = floor_tilt(robot.slope_rad, robot.slope_direction_rad)
    compiled = spec.compile()
    generator = np.random.default_rng(0)
    seen = []
    for model in (plant, compiled):
        model.opt.tolerance = (
            0.0  # else the solver stops by the mean inertia, which is not of the robot
        )
    data = mujoco.MjData(plant)
    other = mujoco.MjData(compiled)
    for _ in range(5):
        data.qpos[:] = env.unwrapped.simulation.qpos[world] + 0.01 * generator.normal(size=plant.nq)
        data.qvel[:] = 0.1 * generator.normal(size=plant.nv)
        other.qpos[:] = data.qpos
        other.qvel[:] = data.qvel
        mujoco.mj_forward(plant, data)
        mujoco.mj_forward(compiled, other)
        seen.append(np.abs(other.qacc).max())
        np.testing.assert_allclose(data.qacc, other.qacc, rtol=0.0, atol=1e-12 * seen[-1])
    assert min(seen) > 1.0
    assert plant.body_mass.sum() == pytest.approx(MASS_KG + robot.load_kg, abs=1e-6)
    assert robot.load_kg > 0.0


def test_springs_sag_by_torque_over_stiffness() -> None:
    """Catches a K or a dead band that is drawn and not used: at rest the servo's torque is that
    of the spring."""
    env = make_walk_vector(
        num_envs=2, **SHORT, scenario=with_ranges(TRAINING_RANGES, ground="ideal")
    )
    env.reset(seed=0)
    truth = env.unwrapped.truth()
    torque = np.array(env.unwrapped.simulation.bind("actuator_force"))
    for world in range(2):
        robot = robot_of(env, world)
        K = 1001.0 * np.array(robot.stiffness)
        np.testing.assert_allclose(truth.stiffness[world], K, rtol=1e-12)
        loaded = np.abs(torque[world]) > 1.0
        sag = static_deflection(torque[world], K, robot.backlash_rad)
        np.testing.assert_allclose(
            (truth.theta - truth.q)[world][loaded], sag[loaded], rtol=0.0, atol=1e-5
        )
        assert loaded.sum() >= 4
    assert len({robot_of(env, world) for world in range(2)}) == 2


def test_the_load_moves_the_center_of_mass_by_its_share_of_the_weight() -> None:
    """Catches a load that sits elsewhere, or weighs nothing, by the center of mass that MuJoCo
    computes."""
    scenario = with_ranges(
        RobotRanges(
            load_kg=(6.0, 8.0), load_x_m=(0.05, 0.1), load_y_m=(-0.1, -0.05), load_z_m=(0.1, 0.15)
        )
    )
    env = make_walk(**SHORT, scenario=scenario)
    env.reset(seed=0)
    robot = robot_of(env)
    simulation = env.simulation
    body = {name: simulation.model.body(name).id for name in ("pelvis", "upper_body", "drawn_load")}
    centers = np.array(simulation.bind("xipos")[0])
    masses = simulation.model.body_mass.copy()
    R = np.array(simulation.bind("ximat")[0, body["upper_body"]]).reshape(
        3, 3
    )  # of the principal axes
    frame = np.array(simulation.bind("xmat")[0, body["upper_body"]]).reshape(3, 3)
    assert np.linalg.det(R) == pytest.approx(1.0)
    load = centers[body["upper_body"]] + frame @ place_of(robot)
    without = masses.copy()
    without[body["drawn_load"]] = 0.0
    bare = without @ centers / without.sum()
    expected = bare + robot.load_kg / (MASS_KG + robot.load_kg) * (load - bare)
    np.testing.assert_allclose(
        simulation.bind("subtree_com")[0, body["pelvis"]], expected, rtol=0.0, atol=1e-9
    )
    assert 6.0 <= robot.load_kg <= 8.0


@pytest.mark.parametrize("ground", ["nominal", "ideal"])
def test_an_episode_of_a_drawn_robot_starts_at_rest(ground: str) -> None:
    """Catches a robot that was settled with another load, ground or friction than it walks with."""
    env = make_walk(
        **SHORT, scenario=with_ranges(TRAINING_RANGES.replace(push_n=(0.0, 0.0)), ground=ground)
    )
    _, info = env.reset(seed=1)
    robot = robot_of(env)
    start = env.truth()
    reference = env.task.assumed_model.plan.q
    weight = (MASS_KG + robot.load_kg) * 9.81
    for k in range(50):
        assert info["force_left"] + info["force_right"] == pytest.approx(weight, abs=0.02)
        *_, info = env.step((reference[0] - reference[k + 1]).astype(np.float32))
    truth = env.truth()
    assert np.abs(truth.q_dot).max() < 1e-3
    for name in ("q", "theta", "pelvis", "ankles"):
        np.testing.assert_allclose(
            getattr(truth, name), getattr(start, name), rtol=0.0, atol=1e-4, err_msg=name
        )


def test_a_drawn_robot_that_cannot_stand_is_an_error_with_its_values() -> None:
    """Catches an error that leaves open which of the ranges is too wide."""
    env = make_walk(
        **SHORT, scenario=with_ranges(RobotRanges(load_kg=(90.0, 91.0), load_x_m=(0.9, 0.91)))
    )
    with pytest.raises(
        ConfigurationError,
        match=r"load_kg=90\..*, load_x_m=0\.90.* does not stand.*narrow the ran",
    ):
        env.reset(seed=0)


def test_fields_follow_the_robot_from_episode_to_episode() -> None:
    """Catches a world that keeps something of the robot that it had before, and one that changes
    another world's."""
    env: Any = make_walk_vector(num_envs=2, **SHORT, scenario="drawn")
    env.reset(seed=[4, 5])
    first = [plant_of(env, world) for world in (0, 1)]
    env.reset(seed=[6, 5], options={"reset_mask": np.array([True, False])})
    second = [plant_of(env, world) for world in (0, 1)]
    env.reset(seed=[4, 5])
    third = [plant_of(env, world) for world in (0, 1)]
    for name in DRAWN_FIELDS:
        values = [[getattr(model, name) for model in models] for models in (first, second, third)]
        np.testing.assert_array_equal(values[1][1], values[0][1], err_msg=name)
        np.testing.assert_array_equal(values[2][0], values[0][0], err_msg=name)
        assert not np.array_equal(values[1][0], values[0][0]), name


def test_signals_know_the_drawn_joints() -> None:
    """Catches a joint torque that is computed with the assumed damping or dead band."""
    env = make_walk(**SHORT, scenario="drawn")
    env.reset(seed=0)
    robot = robot_of(env)
    generator = np.random.default_rng(0)
    for _ in range(20):
        *_, info = env.step(generator.uniform(-0.02, 0.02, 12).astype(np.float32))
    truth = env.truth()
    delta = truth.theta - truth.q
    rate = truth.theta_dot - truth.q_dot
    spring = np.sign(delta) * np.maximum(np.abs(delta) - robot.backlash_rad / 2.0, 0.0)
    torque = 1001.0 * np.array(robot.stiffness) * spring + 10.0 * robot.damping * rate
    assert info["joint_torque"] == pytest.approx(np.abs(torque).max(), rel=1e-12)
    assert robot.backlash_rad > 0.0


# Ground, pushes, sensors.


def test_floor_and_pushes_are_those_of_the_robot() -> None:
    """Catches a slope or a push by the scenario for all robots, or none."""
    ranges = RobotRanges(slope_rad=(0.01, 0.02), push_n=(20.0, 50.0))
    env: Any = make_walk_vector(num_envs=2, **SHORT, scenario=with_ranges(ranges))
    env.reset(seed=0)
    floor = env.unwrapped.task.model.body("floor").id
    torso = env.unwrapped.task.model.body("upper_body").id
    largest = np.zeros(2)
    for _ in range(540):
        env.step(np.zeros((2, 12), np.float32))
        force = np.array(env.unwrapped.simulation.bind("xfrc_applied")[:, torso])
        largest = np.maximum(largest, np.linalg.norm(force[:, :3], axis=1))
    robots = [robot_of(env, world) for world in range(2)]
    np.testing.assert_allclose(largest, [robot.push_n for robot in robots], rtol=1e-12)
    quaternions = np.array([plant_of(env, world).body_quat[floor] for world in range(2)])
    np.testing.assert_allclose(
        2.0 * np.arccos(quaternions[:, 0]), [r.slope_rad for r in robots], rtol=1e-6
    )
    assert len({robot.push_n for robot in robots}) == 2


def test_encoders_and_imu_are_off_by_what_was_drawn() -> None:
    """Catches an error that is drawn and not shown, or shown with the other sign."""
    ranges = RobotRanges(homing_rad=(-2e-3, 2e-3), mounting_rad=(-2e-3, 2e-3))
    env: Any = make_walk_vector(num_envs=2, **SHORT, scenario=with_ranges(ranges, ground="ideal"))
    observation, info = env.reset(seed=0)
    robots = [robot_of(env, world) for world in range(2)]
    encoder = observation[:, :12] - env.unwrapped.truth().theta
    np.testing.assert_allclose(
        encoder, [robot.homing_rad for robot in robots], rtol=0.0, atol=1e-12
    )
    imu = observation[:, 24:26] - np.stack([info["pelvis_roll"], info["pelvis_pitch"]], axis=1)
    np.testing.assert_allclose(imu, [robot.mounting_rad for robot in robots], rtol=0.0, atol=1e-12)


def test_measurements_are_old_in_the_worlds_of_delayed_robots_alone() -> None:
    """Catches an age that is that of all worlds, and one that further sensors do not have."""
    scenario = with_ranges(RobotRanges(delay_share=0.5), ground="ideal")
    env: Any = make_walk_vector(num_envs=6, **SHORT, scenario=scenario, sensors=["link_encoder"])
    observation, _ = env.reset(seed=0)
    is_delayed = np.array([robot_of(env, world).is_delayed for world in range(6)])
    assert 0 < is_delayed.sum() < 6
    generator = np.random.default_rng(0)
    link = env.unwrapped.task.observation_table.group("link_encoder")
    for _ in range(30):
        before = env.unwrapped.truth()
        observation, *_ = env.step(generator.uniform(-0.02, 0.02, (6, 12)).astype(np.float32))
        now = env.unwrapped.truth()
        for column, name in ((slice(0, 12), "theta"), (link, "q")):
            shown = np.where(is_delayed[:, None], getattr(before, name), getattr(now, name))
            np.testing.assert_allclose(observation[:, column], shown, rtol=0.0, atol=1e-12)
    assert np.abs(now.theta - before.theta).max() > 1e-4


ON_A_ROBOT: list[dict[str, float]] = [
    {"inertial_share": 1.0, "delay_share": 1.0},
    {"stiffness": 0.7, "joint_stiffness": 1.1, "damping": 2.0},
    {"backlash_rad": 1e-3, "friction": 1.2},
    {"load_kg": 5.0},
    {"load_kg": 5.0, "load_z_m": -0.1},
]
ON_A_WALK: list[dict[str, float]] = [{"push_n": 50.0}, {"floor_friction": 0.3}]


@pytest.mark.parametrize(
    "numbers",
    [
        {name: value for own in ON_A_ROBOT for name, value in own.items()},
        {name: value for own in ON_A_WALK for name, value in own.items()},
        *(pytest.param(own, marks=pytest.mark.slow) for own in ON_A_ROBOT + ON_A_WALK),
    ],
    ids=lambda numbers: "-".join(numbers),
)
def test_a_robot_that_is_compiled_walks_as_one_that_is_changed(numbers: dict[str, Any]) -> None:
    """Catches a quantity that is compiled into the plant of all robots and that its robots have
    once more, or not at all."""
    nominal = make_scenario("nominal")
    seen = []
    for scenario in (nominal.replace(mixture=[RobotRanges(**numbers)]), nominal.replace(**numbers)):
        env = make_walk(**SHORT, scenario=scenario)
        rows = [env.reset(seed=3)[0]]
        # pushes and slipping come with the walk
        steps = 400 if {"push_n", "floor_friction"} & numbers.keys() else 120
        rows += [env.step(np.full(12, 1e-3, np.float32))[0] for _ in range(steps)]
        seen.append(np.array(rows))
    np.testing.assert_allclose(*seen, rtol=0.0, atol=1e-5)


def test_robots_with_and_without_an_inertial_imu_walk_side_by_side() -> None:
    """Catches an IMU of one robot that shows what another one's does: only one of both has the
    true attitude."""
    scenario = with_ranges(RobotRanges(inertial_share=0.5), ground="ideal")
    env: Any = make_walk_vector(num_envs=6, **SHORT, scenario=scenario)
    observation, info = env.reset(seed=0)
    has = np.array([robot_of(env, world).is_inertial for world in range(6)])
    error = observation[:, 24:26] - np.stack([info["pelvis_roll"], info["pelvis_pitch"]], axis=1)
    assert 0 < has.sum() < 6
    assert (np.abs(error[~has]) < 1e-12).all()
    assert (np.abs(error[has]).max(axis=1) > 1e-4).all()


# Who may know.


def test_a_policy_assumes_the_nominal_robot() -> None:
    """Catches a compensator that knows friction, K or load of the robot that was drawn."""
    nominal, drawn = (configure_walk(**SHORT, scenario=name) for name in ("nominal", "drawn"))
    assert drawn.assumed_joints == nominal.assumed_joints
    env = make_walk(**SHORT, scenario="drawn")
    env.reset(seed=0)
    assert env.assumed_model.rigid.body_mass.sum() == pytest.approx(MASS_KG, abs=1e-6)
    assert env.truth().stiffness[0].tolist() != [1001.0] * 12


# The same everywhere.


@pytest.mark.parametrize("worlds", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_a_seed_has_the_same_robot_in_any_number_of_worlds(worlds: int) -> None:
    """Catches a draw that depends on the other worlds: bits of a scalar environment against
    those of a row."""
    seeds = [7, 8, 9, 10, 11][:worlds]
    env: Any = make_walk_vector(num_envs=worlds, **SHORT, scenario="drawn")
    alone = make_walk(**SHORT, scenario="drawn")
    observation, _ = env.reset(seed=seeds)
    np.testing.assert_array_equal(observation[-1], alone.reset(seed=seeds[-1])[0])
    assert robot_of(env, worlds - 1) == robot_of(alone)
    generator = np.random.default_rng(0)
    for _ in range(60):
        action = generator.uniform(-0.01, 0.01, (worlds, 12)).astype(np.float32)
        many = env.step(action)
        one = alone.step(action[-1])
        np.testing.assert_array_equal(many[0][-1], one[0])
        assert many[1][-1] == one[1]


def test_a_robot_walks_again_under_other_noise() -> None:
    """Catches a robot_seed that draws another robot from the ranges."""
    env = make_walk(**SHORT, scenario="drawn")
    first, _ = env.reset(seed=3)
    robot = robot_of(env)
    again, _ = env.reset(seed=4, options={"robot_seed": 3})
    assert robot_of(env) == robot
    assert not np.array_equal(first, again)


@pytest.mark.slow
def test_checkers_of_gymnasium_and_stable_baselines3_find_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches an environment whose seeding or spaces break where robots are drawn."""
    monkeypatch.setattr(walk_config, "BANK_SIZE", 3)  # a robot takes long to settle
    check_env(make_walk(**SHORT, scenario="drawn"), skip_render_check=True)
    check_sb3_env(make_walk(**SHORT, scenario="drawn"), skip_render_check=True)
    env: Any = make_walk_vector(num_envs=2, **SHORT, scenario="drawn")
    first, second = (env.reset(seed=1) for _ in range(2))
    assert data_equivalence(first[0], second[0])


@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_joint_on_a_fixed_base_is_what_was_drawn(num_envs: int) -> None:
    """Catches a quantity that is drawn and does not reach the physics, and a load or a push of a
    walker's."""
    env: Any = gymnasium.make_vec(
        "elastic_env/Testbed-v0",
        num_envs=num_envs,
        scenario="drawn",
        vectorization_mode="vector_entry_point",
    ).unwrapped
    env.reset(seed=4)
    known = env.assumed_model
    plain = env.task.model
    springs = [plain.tendon("joint_spring").id]
    link = plain.joint("joint").dofadr[0]
    ranges = TRAINING_RANGES.without_walker_fields()
    for world in range(num_envs):
        robot = robot_of(env, world)
        assert is_within(ranges, robot)
        assert (
            env.task.robot_record(world)["robot_load_kg"]
            == env.task.robot_record(world)["robot_push_n"]
            == 0.0
        )
        model = env.simulation.model_of(world)
        stiffness = known.stiffness * robot.stiffness
        np.testing.assert_allclose(model.tendon_stiffness[springs], stiffness, rtol=1e-12)
        np.testing.assert_allclose(env.truth().stiffness[world], stiffness, rtol=1e-12)
        np.testing.assert_allclose(
            model.tendon_damping[springs], known.damping * robot.damping, rtol=1e-12
        )
        dead_band = np.diff(model.tendon_lengthspring[springs], axis=1)[:, 0]
        np.testing.assert_allclose(dead_band, known.backlash + robot.backlash_rad, atol=1e-12)
        friction = known.coulomb_friction[0] * robot.friction
        assert model.dof_frictionloss[link] == pytest.approx(friction, rel=1e-12)


def test_drawn_robots_on_a_fixed_base_begin_at_rest() -> None:
    """Catches a robot that is placed by the K or the dead band of another one, and a homing
    error with another sign."""
    envs = [
        gymnasium.make_vec(
            "elastic_env/Testbed-v0",
            num_envs=4,
            scenario=scenario,
            vectorization_mode="vector_entry_point",
        )
        for scenario in ("ideal+drawn", "ideal+drawn_beyond")
    ]
    for env in envs:
        observation, info = env.reset(seed=1)
        robots = [robot_of(env, world) for world in range(4)]
        truth: Any = env.unwrapped.truth()  # type: ignore[attr-defined]
        bias = [robot.homing_rad[0] for robot in robots]
        np.testing.assert_allclose(observation[:, 0] - truth.theta[:, 0], bias, atol=1e-12)
        for _ in range(25):
            *_, later = env.step(np.zeros((4, 1), np.float32))
        np.testing.assert_allclose(later["link_angle"], info["link_angle"], atol=1e-6)


def test_an_arm_is_drawn_alone_as_among_others() -> None:
    """Catches a robot that depends on the number of worlds, and measurements that are delayed in
    all worlds or none."""
    ARM.register()
    many = gymnasium.make_vec(
        "elastic_env/Arm-v0", num_envs=8, scenario="drawn", vectorization_mode="vector_entry_point"
    )
    alone = gymnasium.make("elastic_env/Arm-v0", scenario="drawn", disable_env_checker=True)
    first, _ = many.reset(seed=3)
    own, _ = alone.reset(seed=8)
    np.testing.assert_array_equal(first[5], own)
    assert {robot_of(many, world).is_delayed for world in range(8)} == {False, True}
    for _ in range(20):
        first, *_ = many.step(np.full((8, 3), 0.01, np.float32))
        own, *_ = alone.step(np.full(3, 0.01, np.float32))
    np.testing.assert_array_equal(first[5], own)


def test_ranges_that_nobody_can_have_are_refused() -> None:
    """Catches intervals of walkers that a robot on a fixed base ignores, and what is no mapping."""
    with pytest.raises(ConfigurationError, match=r"only a walker has load_kg; .* damping"):
        make_scenario("drawn", walks=False, ranges={"load_kg": (0.0, 4.0), "damping": 2.0})
    for wrong in (3, "abc", [3]):
        with pytest.raises(ConfigurationError, match="must be a mapping of intervals, or a list"):
            make_scenario("drawn", ranges=wrong)  # type: ignore[arg-type]
    for nothing in ("x", True, None):
        with pytest.raises(ModelError, match=r"a number or \[lowest, highest\], got"):
            RobotRanges(load_kg=nothing)
