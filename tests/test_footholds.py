"""A foothold per step: closed forms of the footholds, the local frame that policies read, walks."""

from functools import cache
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.contact_torque import ContactGravity, planned_feet, shift_plan
from baselines.compensation.policy import WalkView
from baselines.walking.controller import WalkingController
from baselines.walking.flat_feet import FlatFeet
from baselines.walking.zmp_shift import Stances, move_pelvis
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.motion.foot_clearance import sole_gap
from elastic_env.motion.gait import LEFT, RIGHT, Footholds, footholds, make_gait
from elastic_env.motion.trajectory import derivatives
from elastic_env.motion.walk_plan import plan_walk
from elastic_env.rendering.picture import CAMERA
from elastic_env.rigid.leg_kinematics import foot_pose, rotation_z, turn
from elastic_env.robots.thormang.config import WalkConfig
from elastic_env.robots.thormang.model import ANKLE_HEIGHT_M, LEG_JOINTS, SIDES, Thormang, biped
from elastic_env.robots.thormang.picture import Posture, WalkerPicture, enlarge_posture
from elastic_env.robots.thormang.task import WalkTask, heading_error
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.robot_model import WalkerModel
from elastic_env.world.scenario import make_scenario
from tests.played import play_to_the_end

PERIOD_S = 0.004
ROBOT = biped(Thormang())
FEET = ROBOT.footholds
SOLE = ROBOT.sole_half_size
ARC = {"step_length_m": 0.08, "turn_rad": 0.2}


def stepped(num_steps: int, **goes: float) -> Footholds:
    """Footholds of a gait."""
    return footholds(make_gait(3, num_steps=num_steps, **goes), FEET)


@cache
def model() -> WalkerModel:
    """What is assumed of a walker on an arc."""
    gait = make_gait(1.6, num_steps=3, **ARC)
    assumed = WalkTask(WalkConfig(gait=gait, scenario=make_scenario("ideal")), 1).assumed_model
    assert isinstance(assumed, WalkerModel)
    return assumed


def middles_of(feet: Footholds) -> Array:
    """Where the pairs stand to which the feet belong, (num_steps + 1, 2, 2) [m]."""
    return feet.positions - turn(FEET, feet.yaw)


# --------------------------------------------------------------------------------------------------
# Footholds
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_steps", [1, 2, 5])
def test_walking_in_place_has_the_footholds_under_the_hips(num_steps: int) -> None:
    """Catches a bit that changes, and a hips' spacing that is not the default width."""
    feet = stepped(num_steps)
    np.testing.assert_array_equal(feet.positions, np.tile(FEET, (num_steps + 1, 1, 1)))
    np.testing.assert_array_equal(feet.yaw, 0.0)
    same = stepped(num_steps, step_width_m=2.0 * Thormang().hip_half_spacing)
    np.testing.assert_array_equal(same.positions, feet.positions)


def test_a_walk_forward_sets_every_foot_a_step_length_ahead_of_the_other() -> None:
    """Catches a first or last step of full length, a stride where a step is meant, and feet that
    do not close."""
    feet = stepped(6, step_length_m=0.1, step_width_m=0.3)
    np.testing.assert_allclose(feet.positions[..., 1], np.tile([0.15, -0.15], (7, 1)))
    left = [0.0, 0.0, 0.2, 0.2, 0.4, 0.4, 0.5]
    right = [0.0, 0.1, 0.1, 0.3, 0.3, 0.5, 0.5]
    np.testing.assert_allclose(feet.positions[..., 0].T, [left, right], atol=1e-15)
    np.testing.assert_array_equal(feet.yaw, 0.0)


@given(st.integers(1, 12), st.floats(-0.3, 0.3), st.floats(-0.5, 0.5))
def test_one_foot_moves_in_a_step_and_the_last_step_closes_the_feet(
    num_steps: int, length: float, angle: float
) -> None:
    """Catches support feet that slip, the wrong foot in the air, and a turn that ends with feet
    apart."""
    feet = stepped(num_steps, step_length_m=length, turn_rad=angle)
    for step in range(num_steps):
        support = step % 2
        for values in (feet.positions, feet.yaw):
            np.testing.assert_array_equal(values[step + 1, support], values[step, support])
    ends = middles_of(feet)[-1]
    np.testing.assert_allclose(ends[LEFT], ends[RIGHT], rtol=0.0, atol=1e-12)
    assert feet.yaw[-1, LEFT] == feet.yaw[-1, RIGHT] == angle * (num_steps - 1)


def test_a_full_turn_in_place_and_on_a_circle_ends_where_it_began() -> None:
    """Catches a heading that is not that halfway through the turn: the middles lie on a circle of
    radius L / (2 sin(turn / 2)), to the left."""
    num_steps = 41
    angle = 2.0 * np.pi / (num_steps - 1)
    for length in (0.0, 0.1):
        feet = stepped(num_steps, step_length_m=length, turn_rad=angle)
        np.testing.assert_allclose(feet.positions[-1], FEET, rtol=0.0, atol=1e-12)
        radius = 0.5 * length / np.sin(0.5 * angle)
        distance = np.linalg.norm(middles_of(feet) - [0.0, radius], axis=-1)
        np.testing.assert_allclose(distance, radius, rtol=0.0, atol=1e-12)


def test_a_right_turn_is_a_mirrored_left_turn() -> None:
    """Catches a turn that is not the same to both sides: a step later the other foot lands
    likewise beside its support foot."""
    left, right = (stepped(8, step_length_m=0.1, turn_rad=angle) for angle in (0.2, -0.2))
    for step in range(1, 6):
        landed = []
        for feet, number in ((left, step), (right, step + 1)):
            support = number % 2
            after = feet.positions[number + 1]
            aside = after[1 - support] - after[support]
            landed.append(turn(aside, -feet.yaw[number, support]))
        np.testing.assert_allclose(landed[0], landed[1] * [1.0, -1.0], rtol=0.0, atol=1e-12)


def test_a_swing_goes_from_foothold_to_foothold_at_rest_at_both_ends() -> None:
    """Catches a foot that jumps, slides after touch-down, or turns while it stands."""
    plan = model().plan
    timing = plan.timing
    rows = np.arange(len(timing.time))
    stands = plan.footholds.positions[timing.step + (timing.swing == 1.0)]
    rests = ~timing.single
    np.testing.assert_allclose(plan.ankles[rests, :, :2], stands[rests], rtol=0.0, atol=1e-15)
    moved = np.linalg.norm(np.diff(plan.ankles[..., :2], axis=0), axis=-1)
    turned = np.abs(np.diff(plan.foot_yaw, axis=0))
    support = timing.support[1:]
    assert moved[rows[:-1], support].max() < 1e-15
    assert turned[rows[:-1], support].max() < 1e-15
    lift_off = np.flatnonzero(np.diff(timing.single.astype(int)) == 1)
    # minimum jerk: the first period moves it by the third power of its length, 10 s³
    first = moved[lift_off, RIGHT - timing.support[lift_off + 1]]
    way = moved.max() * 8.0 / 15.0 * 150
    assert (first < 20.0 * way / 150**3).all()


# --------------------------------------------------------------------------------------------------
# Feet that keep clear
# --------------------------------------------------------------------------------------------------


def corners(position: Array, yaw: float, size: tuple[float, float]) -> Array:
    """A grid over a sole, (n, 2) [m]."""
    x, y = np.meshgrid(*(np.linspace(-half, half, 15) for half in size))
    return position + turn(np.stack([x.ravel(), y.ravel()], axis=-1), np.array(yaw))


def covers(position: Array, yaw: float, points: Array) -> Any:
    """Points that lie on a sole."""
    return (np.abs(turn(points - position, np.array(-yaw))) <= SOLE).all(axis=-1)


@given(st.floats(-0.3, 0.3), st.floats(-0.1, 0.4), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_soles_that_share_a_point_have_no_gap(
    x: float, y: float, left: float, right: float
) -> None:
    """Catches a side of a sole that is not looked at, and half sizes taken for whole ones."""
    positions = np.array([[x, y], [0.0, 0.0]])
    gap = float(sole_gap(positions, np.array([left, right]), SOLE))
    shared = covers(positions[1], right, corners(positions[0], left, SOLE)).any()
    shared |= covers(positions[0], left, corners(positions[1], right, SOLE)).any()
    if shared:
        assert gap <= 1e-12
    aside = turn(positions[0], np.array(-0.5 * (left + right)))[1]
    if gap < -0.04 and aside > 0.0:  # deeper than the grid is wide
        assert shared


def test_the_gap_of_soles_side_by_side_and_one_behind_the_other() -> None:
    """Closed forms. Catches feet that have changed sides and count as apart."""
    level = np.zeros(2)
    assert sole_gap(FEET, level, SOLE) == pytest.approx(0.21 - 0.16)
    ahead = np.array([[0.5, 0.03], [0.0, 0.0]])
    assert sole_gap(ahead, level, SOLE) == pytest.approx(0.03)  # the left foot is to the left
    assert sole_gap(ahead[::-1], level, SOLE) == pytest.approx(-0.03)
    quarter = np.array([np.pi / 2.0, 0.0])
    assert sole_gap(FEET, quarter, SOLE) == pytest.approx(min(0.21 - 0.08 - 0.13, 0.21))


@pytest.mark.parametrize(
    ("goes", "message"),
    [
        ({"turn_rad": 0.5}, "the soles of 0.26 m x 0.16 m touch or cross in step 1"),
        ({"step_width_m": 0.15}, "touch or cross in step 1.*take a larger step_width_m"),
        ({"step_length_m": 0.5}, "foot is out of reach at .*; lower .*step_length_m"),
        ({"step_length_m": 2.0}, "Gait.step_length_m must be .*<= 1"),
        ({"turn_rad": float("nan")}, "Gait.turn_rad must be"),
    ],
)
def test_what_cannot_be_walked_is_an_error(goes: dict[str, float], message: str) -> None:
    """Catches feet that go through each other, and a foot that is set down beyond its leg."""
    with pytest.raises(ConfigurationError, match=message):
        plan_walk(make_gait(3, num_steps=4, **goes), ROBOT, PERIOD_S)


# --------------------------------------------------------------------------------------------------
# The local frame
# --------------------------------------------------------------------------------------------------


def test_in_place_the_local_frame_is_the_world() -> None:
    """Catches a bit that the detour through the local frame changes."""
    plan = plan_walk(make_gait(1.6, num_steps=2), ROBOT, PERIOD_S)
    for name in ("com", "com_dot", "pelvis", "ankles", "foot_yaw"):
        own = getattr(plan.local, name)
        np.testing.assert_array_equal(own, getattr(plan, name), err_msg=name)


def test_the_local_frame_is_level_between_the_feet_and_along_their_heading() -> None:
    """Catches an origin that stays behind, a frame that turns the other way, and a rate that
    misses the turning."""
    plan = model().plan
    local = plan.local
    middle = local.ankles[..., :2].mean(axis=1)
    np.testing.assert_allclose(middle, 0.0, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(local.foot_yaw.sum(axis=1), 0.0, rtol=0.0, atol=1e-12)
    back = turn(local.com, plan.heading) + plan.ankles[..., :2].mean(axis=1)
    np.testing.assert_allclose(back, plan.com, rtol=0.0, atol=1e-12)
    for support in (LEFT, RIGHT):
        path = local.com - local.ankles[:, support, :2]
        rate, _ = derivatives(path, PERIOD_S)
        own = plan.timing.support == support
        own[1:] &= own[:-1]
        own[:-1] &= own[1:]
        own[[0, -1]] = False
        np.testing.assert_allclose(local.com_dot[own], rate[own], rtol=0.0, atol=3e-4)
    assert np.abs(plan.heading_dot).max() > 0.1


def test_the_plan_of_a_mirrored_walk_is_mirrored() -> None:
    """A step later the other leg does the same, in the middle of a walk: the ZMP to the last
    digits, the rest as far as the masses of the robot are symmetric.

    Catches yaws that add up instead of being mirrored.
    """
    left, right = (
        plan_walk(make_gait(1.1, num_steps=8, turn_rad=angle, step_length_m=0.05), ROBOT, PERIOD_S)
        for angle in (0.2, -0.2)
    )
    step = round(1.1 / PERIOD_S)
    rows = round(1.0 / PERIOD_S) + 3 * step + np.arange(step)
    later = rows + step
    zmp, mirrored_zmp = (
        turn(plan.zmp[own] - plan.origin[own], -plan.heading[own])
        for plan, own in ((left, rows), (right, later))
    )
    mirror = np.array([1.0, -1.0])
    np.testing.assert_allclose(zmp, mirrored_zmp * mirror, rtol=0.0, atol=1e-12)
    com = right.local.com[later] * mirror
    np.testing.assert_allclose(left.local.com[rows], com, rtol=0.0, atol=2e-6)
    signs = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, -1.0])
    own = left.q[rows].reshape(-1, 2, 6)
    other = right.q[later].reshape(-1, 2, 6)[:, ::-1] * signs
    np.testing.assert_allclose(own, other, rtol=0.0, atol=1e-4)
    assert np.abs(own[..., 0]).max() > 0.09


# --------------------------------------------------------------------------------------------------
# Policies
# --------------------------------------------------------------------------------------------------


def observed(row: int, **changed: Any) -> Array:
    """An observation at a row of the plan, (1, m), the rest zeros."""
    walker = model()
    table = walker.observation_table
    rows = np.zeros((1, len(table.names)))
    plan = walker.plan
    rows[:, table.group("clock")] = [row * PERIOD_S, 0.0, plan.timing.support[row]]
    rows[:, table.group("load_share")] = plan.share[row]
    rows[:, table.group("zmp_reference")] = plan.zmp[row]
    for name, values in changed.items():
        rows[:, table.group(name)] = values
    return rows


def row_of(time_s: float) -> int:
    """Row of the plan at a time after the start of the walk."""
    return round((1.0 + time_s) / PERIOD_S)


TIMES = [0.3, 0.8, 1.4, 2.4, 3.5, 4.5]


@pytest.mark.parametrize("time_s", TIMES)
def test_the_torque_of_turned_feet_is_mujocos(time_s: float) -> None:
    """Catches a contact point in the frame of the world or the pelvis instead of the foot's."""
    walker = model()
    plan = walker.plan
    row = row_of(time_s)
    rigid = ROBOT.rigid
    data = mujoco.MjData(rigid)
    at = JointAddresses.of(rigid, LEG_JOINTS)
    half = plan.heading[row] / 2.0
    data.qpos[:7] = [*plan.pelvis[row], np.cos(half), 0.0, 0.0, np.sin(half)]
    data.qpos[at.q] = plan.q[row]
    mujoco.mj_forward(rigid, data)
    effort = data.qfrc_bias.copy()
    weights = np.array([1.0 - plan.share[row], plan.share[row]])
    feet = plan.ankles[row, :, :2]
    rest = plan.zmp[row] - weights @ feet
    for side, prefix in enumerate(SIDES):
        jacobian = np.zeros((3, rigid.nv))
        height = plan.ankles[row, side, 2] - ANKLE_HEIGHT_M
        point = np.array([*(feet[side] + rest), height])
        mujoco.mj_jac(rigid, data, jacobian, None, point, rigid.body(f"{prefix}_foot").id)
        effort -= jacobian.T @ [0.0, 0.0, weights[side] * ROBOT.weight]
    torque = ContactGravity(walker).at(observed(row)).gravity_torque(plan.q[[row]])[0]
    np.testing.assert_allclose(torque, effort[at.q_dot], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("time_s", TIMES)
def test_a_shift_of_the_zmp_turns_with_the_robot(time_s: float) -> None:
    """Catches a shift in the world, and a load share that follows it there."""
    walker = model()
    plan = walker.plan
    row = row_of(time_s)
    shift = np.array([[0.004, -0.006]])
    rows = observed(row)
    view = WalkView(walker.observation_table).fields(rows)
    shift_plan(view, shift, planned_feet(plan), PERIOD_S)
    moved = view["zmp_reference"][0] - plan.zmp[row]
    np.testing.assert_allclose(moved, turn(shift[0], plan.heading[row]), rtol=0.0, atol=1e-15)
    between = plan.ankles[row, LEFT, :2] - plan.ankles[row, RIGHT, :2]
    lever = moved @ between / (between @ between)
    share = plan.share[row]
    expected = np.clip(share - 4.0 * share * (1.0 - share) * lever, 0.0, 1.0)
    np.testing.assert_allclose(view["load_share"][0], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("time_s", TIMES)
def test_the_zmp_error_of_turned_feet_is_in_the_local_frame(time_s: float) -> None:
    """Forces straight up at points of the soles. Catches wrenches and ankles that are not turned,
    and an error in the world."""
    walker = model()
    plan = walker.plan
    row = row_of(time_s)
    sensors = FootSensors.of_biped(ROBOT)
    off = np.array([[0.02, -0.01], [-0.03, 0.015]])  # of the ankles, in the world
    carried = np.array([0.6, 0.4]) * ROBOT.weight
    wrench = np.zeros((2, 2, 3))
    for foot in range(2):
        yaw = plan.foot_yaw[row, foot]
        weight = sensors.weight[foot]
        force = np.array([0.0, 0.0, carried[foot]])
        com = rotation_z(yaw) @ sensors.com[foot]
        moment = np.cross([*off[foot], 0.0], force) + np.cross(com, weight)
        wrench[foot] = turn(np.stack([force + weight, moment]), np.array(-yaw))
    zmp = np.array([0.6, 0.4]) @ (plan.ankles[row, :, :2] + off)
    error = FlatFeet(walker, 50.0).zmp_error(observed(row), wrench.reshape(1, -1))[0]
    expected = turn(zmp - plan.zmp[row], -plan.heading[row])
    np.testing.assert_allclose(error, expected, rtol=0.0, atol=1e-12)


def test_a_pelvis_that_moves_leaves_turned_feet_where_they_were() -> None:
    """By forward kinematics. Catches a shift in the world, and legs whose yaw is lost."""
    walker = model()
    plan = walker.plan
    shift = np.array([0.012, -0.02])
    steps = np.arange(0, len(plan.q), 7)
    offset = np.zeros((len(steps), 12))
    stances = Stances.of(walker)
    move_pelvis(*stances, steps, np.tile(shift, (len(steps), 1)), offset)
    ankle, R = foot_pose(ROBOT.leg, (plan.q[steps] + offset).reshape(-1, 2, 6))
    heading = plan.heading[steps]
    moved = plan.pelvis[steps] + turn(np.append(shift, 0.0), heading)
    places = moved[:, None] + turn(ROBOT.hips + ankle, heading[:, None])
    np.testing.assert_allclose(places, plan.ankles[steps], rtol=0.0, atol=1e-9)
    yaw = plan.foot_yaw[steps] - heading[:, None]
    np.testing.assert_allclose(R, rotation_z(yaw), rtol=0.0, atol=1e-9)


def test_a_robot_on_an_arc_as_planned_is_left_alone() -> None:
    """As in place, where 3e-4 rad are asked of a filter that starts. Catches a controller that takes
    the plan's world for its own frame, and a rate that misses the turning."""
    walker = model()
    plan = walker.plan
    policy = WalkingController(walker, ramp_s=PERIOD_S)
    state = None
    for row in range(row_of(0.3), row_of(4.5)):
        share = plan.share[row]
        feet = [ROBOT.rigid.body(f"{side}_foot").mass[0] * 9.81 for side in "lr"]
        wrench = np.zeros((2, 2, 3))
        wrench[:, 0, 2] = np.array([1.0 - share, share]) * ROBOT.weight - feet
        rows = observed(row + 1, encoder_angle=plan.q[row], wrench=wrench.ravel())
        rows[:, walker.observation_table.group("reference_angle")] = plan.q[row + 1]
        action, state = policy.predict(rows, state, state is None)
        assert np.abs(action).max() < 3e-4


# --------------------------------------------------------------------------------------------------
# The environment
# --------------------------------------------------------------------------------------------------


def test_the_heading_error_stays_within_half_a_turn() -> None:
    """Catches a yaw that is wound up against the plan's full turns, a sign, and a tilt that
    counts."""
    for yaw, planned, expected in ((0.3, 0.1, 0.2), (0.1, 2.0 * np.pi, 0.1), (-3.0, 3.0, 0.283185)):
        w, z = np.cos(yaw / 2.0), np.sin(yaw / 2.0)
        pitch = 0.2
        tilted = np.array([np.cos(pitch / 2.0), 0.0, np.sin(pitch / 2.0), 0.0])
        quaternion = np.zeros(4)
        mujoco.mju_mulQuat(quaternion, np.array([w, 0.0, 0.0, z]), tilted)
        found = heading_error(quaternion[None], np.array([planned]))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6)


def test_the_end_of_a_walk_is_scored_against_the_plan() -> None:
    """Catches a mean over the walk, and a plan that stays at the start."""
    goes = {"step_length_m": 0.05, "turn_rad": 0.1}
    env: Any = gymnasium.make(
        "elastic_env/WalkInPlace-v0", step_period=(0.2, 0.4, 0.2), num_steps=2, gait=goes
    )
    policy = baselines.make("input", env)
    info = play_to_the_end(env, policy, seed=1)
    truth = env.unwrapped.truth()
    feet = env.unwrapped.task.plan.footholds
    off = truth.ankles[0, :, :2].mean(axis=0) - feet.positions[-1].mean(axis=0)
    metrics = info["episode_metrics"]
    np.testing.assert_allclose(metrics["end_position_error_m"], np.hypot(*off), rtol=1e-9)
    R = truth.pelvis_R[0]
    error = np.arctan2(R[1, 0], R[0, 0]) - feet.yaw[-1, LEFT]
    np.testing.assert_allclose(metrics["end_heading_error_rad"], error, rtol=1e-9)
    assert feet.yaw[-1, LEFT] == pytest.approx(0.1)


def test_the_picture_has_the_plans_headings() -> None:
    """Catches a pelvis or feet drawn along x, and a robot on plan that is drawn turned."""
    plan = model().plan
    for row in (0, row_of(1.0), row_of(2.4), plan.num_steps):
        planned = Posture.from_plan(plan, row)
        np.testing.assert_allclose(planned.joint_angles(ROBOT), plan.q[row], rtol=0.0, atol=1e-9)
        drawn, factor = enlarge_posture(planned, planned, plan.share[row], ROBOT)
        assert factor > 1.0
        np.testing.assert_allclose(drawn.R, planned.R, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(drawn.pelvis, planned.pelvis, rtol=0.0, atol=1e-12)


def test_camera_and_light_go_with_the_plan() -> None:
    """Catches a robot that walks out of its picture."""
    env: Any = gymnasium.make(
        "elastic_env/WalkInPlace-v0", step_period=1.6, num_steps=3, scenario="ideal", gait=ARC
    )
    env.reset(seed=0)
    task = env.unwrapped.task
    picture = WalkerPicture(task)
    signals = {name: float(values[0]) for name, values in task.signals().items()}
    eyes = []
    lights = []
    for row in (0, task.num_steps):
        picture._pose({**signals, "time_s": row * PERIOD_S}, 0)
        eyes.append(picture._model.camera(CAMERA).pos.copy())
        lights.append(picture._model.light_pos[0].copy())
    way = np.append(task.plan.footholds.positions[-1].mean(axis=0), 0.0)
    assert np.linalg.norm(way) > 0.1
    for places in (eyes, lights):
        np.testing.assert_allclose(places[1] - places[0], way, rtol=0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["nominal", "soft", "payload"])
@pytest.mark.parametrize("goes", [{"step_length_m": 0.1}, {"turn_rad": 0.1571}, ARC])
def test_the_robot_walks_forward_and_turns(scenario: str, goes: dict[str, float]) -> None:
    """Catches a policy that reads the plan in another frame than its own: the robot falls or
    ends elsewhere."""
    env: Any = gymnasium.make(
        "elastic_env/WalkInPlace-v0", num_steps=12, scenario=scenario, gait=goes
    )
    policy = baselines.make("adaptive_posture", env)
    info = play_to_the_end(env, policy, seed=5)
    metrics = info["episode_metrics"]
    turned = env.unwrapped.task.plan.heading[-1]
    assert metrics["pelvis_error_rms_rad"] < 4e-3
    assert metrics["end_position_error_m"] < 0.06
    assert abs(metrics["end_heading_error_rad"]) < 0.01 + 0.04 * turned
