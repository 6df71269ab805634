"""The walk as a table: kinematics and inverse dynamics by MuJoCo, the ZMP of the cart-table,
statics, errors."""

import copy
import re
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.dynamixel import SERVO
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.motion.gait import make_gait
from elastic_env.motion.preview_control import PreviewConfig, follow_zmp
from elastic_env.motion.trajectory import derivatives
from elastic_env.motion.walk_plan import (
    WalkPlan,
    plan_walk,
    refine_plan,
    require_feasible,
    swing_height,
    with_torque,
)
from elastic_env.rigid.biped import Biped
from elastic_env.rigid.contact_force import contact_points, load_share, shares
from elastic_env.rigid.leg_kinematics import rotation_z
from elastic_env.robots.thormang.model import (
    ANKLE_HEIGHT_M,
    LEG_JOINTS,
    SIDES,
    SOLE_HALF_SIZE_M,
    Thormang,
    biped,
)
from tests.legs import holding_torque

PERIOD_S = 0.004
ROBOT = biped(Thormang())
NAMED = (24.0, 3.0, 1.6, 1.1)
SERVOS = (SERVO,) * 12


@cache
def planned(step_period: float, transfer: str = "smooth") -> WalkPlan:
    """Two steps of a named gait, one of the slow one."""
    num_steps = 1 if step_period == 24.0 else 2
    return plan_walk(
        make_gait(step_period, num_steps=num_steps, transfer=transfer), ROBOT, PERIOD_S
    )


ELSEWHERE = [
    pytest.param("smooth", {"step_length_m": 0.1}, marks=pytest.mark.slow),
    ("smooth", {"turn_rad": -0.3, "step_width_m": 0.24}),
    pytest.param("smooth", {"step_length_m": 0.08, "turn_rad": 0.2}, marks=pytest.mark.slow),
    ("ramp", {"step_length_m": -0.08, "turn_rad": 0.2}),
]


STRAIGHT = {"step_length_m": 0.1}
ROUND = {"step_length_m": 0.1, "turn_rad": 0.1}


def walked_to(transfer: str, goes: dict[str, float]) -> WalkPlan:
    """Two steps of 1.6 s to somewhere else."""
    gait = make_gait(1.6, num_steps=2, transfer=transfer, **goes)
    return plan_walk(gait, ROBOT, PERIOD_S)


def place_pelvis(data: mujoco.MjData, plan: WalkPlan, row: int) -> None:
    """Bring MuJoCo's level pelvis to where a row of a plan has it."""
    half = plan.heading[row] / 2.0
    data.qpos[:7] = [*plan.pelvis[row], np.cos(half), 0.0, 0.0, np.sin(half)]


def some_rows(plan: WalkPlan, count: int = 30) -> list[int]:
    """Rows all over the walk, and those around lift-off and touch-down."""
    edges = np.flatnonzero(np.diff(plan.timing.single.astype(int)))
    spread = np.linspace(0, plan.num_steps, count).astype(int)
    return sorted({*spread.tolist(), *(edges[:, None] + [-1, 0, 1, 2]).ravel().tolist()})


# --------------------------------------------------------------------------------------------------
# Kinematics
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step_period", NAMED)
def test_feet_and_center_of_mass_are_where_the_plan_says(step_period: float) -> None:
    """Catches soles that are not flat or not in their place, and a pelvis that follows the
    pendulum's path itself."""
    plan = planned(step_period)
    model = ROBOT.rigid
    data = mujoco.MjData(model)
    at = JointAddresses.of(model, LEG_JOINTS)
    preview = PreviewConfig(com_height_m=plan.com_height, period_s=PERIOD_S)
    com = follow_zmp(preview, plan.zmp, np.zeros(2)).com
    np.testing.assert_array_equal(plan.com, com)
    for row in some_rows(plan):
        data.qpos[:3] = plan.pelvis[row]
        data.qpos[at.q] = plan.q[row]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(
            data.body("pelvis").subtree_com[:2], com[row], rtol=0.0, atol=1e-9
        )
        for side, prefix in enumerate(SIDES):
            foot = data.body(f"{prefix}_foot")
            sole = data.geom(f"{prefix}_sole")
            np.testing.assert_allclose(foot.xpos, plan.ankles[row, side], rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(foot.xmat, np.eye(3).ravel(), rtol=0.0, atol=1e-9)
            height = sole.xpos[2] - model.geom(f"{prefix}_sole").size[2]
            assert height == pytest.approx(plan.ankles[row, side, 2] - ANKLE_HEIGHT_M, abs=1e-9)
    data.qpos[:3] = plan.pelvis[0]
    data.qpos[at.q] = plan.q[0]
    mujoco.mj_forward(model, data)
    assert plan.com_height == pytest.approx(data.body("pelvis").subtree_com[2], abs=1e-9)
    assert plan.omega == pytest.approx(np.sqrt(9.81 / plan.com_height), rel=1e-12)
    assert 3.6 < plan.omega < 3.75


@pytest.mark.parametrize(("transfer", "goes"), ELSEWHERE)
def test_turned_feet_and_center_of_mass_are_where_the_plan_says(
    transfer: str, goes: dict[str, float]
) -> None:
    """Catches a hip yaw of the wrong sign, a pelvis that keeps its heading, and a center of mass
    in the frame of the pelvis."""
    plan = walked_to(transfer, goes)
    data = mujoco.MjData(ROBOT.rigid)
    at = JointAddresses.of(ROBOT.rigid, LEG_JOINTS)
    for row in some_rows(plan):
        place_pelvis(data, plan, row)
        data.qpos[at.q] = plan.q[row]
        mujoco.mj_forward(ROBOT.rigid, data)
        com = data.body("pelvis").subtree_com
        np.testing.assert_allclose(com[:2], plan.com[row], rtol=0.0, atol=1e-9)
        for side, prefix in enumerate(SIDES):
            foot = data.body(f"{prefix}_foot")
            R = rotation_z(plan.foot_yaw[row, side])
            np.testing.assert_allclose(foot.xpos, plan.ankles[row, side], rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(foot.xmat.reshape(3, 3), R, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(plan.heading, plan.foot_yaw.mean(axis=1), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("step_period", NAMED)
def test_the_pelvis_keeps_its_height_and_the_stance_foot_its_place(step_period: float) -> None:
    """Catches a pelvis that bobs, feet that are set down elsewhere, and the wrong foot in the
    air."""
    plan = planned(step_period)
    np.testing.assert_array_equal(plan.pelvis[:, 2], 0.66)
    np.testing.assert_array_equal(plan.ankles[..., 0], 0.0)
    np.testing.assert_array_equal(
        plan.ankles[..., 1], np.tile([0.105, -0.105], (plan.num_steps + 1, 1))
    )
    rows = np.arange(plan.num_steps + 1)
    timing = plan.timing
    lift = plan.ankles[..., 2] - ANKLE_HEIGHT_M
    np.testing.assert_allclose(lift[rows, timing.support], 0.0, rtol=0.0, atol=1e-15)
    swinging = lift[rows, 1 - timing.support]
    np.testing.assert_array_equal(swinging > 1e-15, timing.single)


@pytest.mark.parametrize("step_period", NAMED)
def test_the_swing_foot_is_lifted_without_speed_at_both_ends(step_period: float) -> None:
    """Catches another height than the gait's, a foot that is thrown up or stamps, and a late
    apex."""
    plan = planned(step_period)
    single = round(plan.gait.single_support_s / PERIOD_S)
    begin = round((1.0 + plan.gait.double_support_s) / PERIOD_S)
    lift = plan.ankles[begin : begin + single + 1, 1, 2] - ANKLE_HEIGHT_M
    assert plan.timing.single[begin + 1]
    assert not plan.timing.single[begin]
    np.testing.assert_allclose(lift.max(), plan.gait.lift_m, rtol=1e-3)
    np.testing.assert_allclose(lift, lift[::-1], rtol=0.0, atol=1e-12)
    # from rest, with no acceleration: the first period moves it by the third power of its length
    np.testing.assert_allclose(lift[1], 64.0 * plan.gait.lift_m / single**3, rtol=0.1)
    assert (np.diff(lift[: single // 2]) > 0.0).all()


def test_swing_height_has_a_smooth_start_and_end() -> None:
    """Catches a lift whose speed or acceleration jumps, or that does not reach its height
    halfway."""
    h = 1e-3
    ends = swing_height(np.array([0.0, h, 2.0 * h, 1.0 - 2.0 * h, 1.0 - h, 1.0, 0.5]))
    np.testing.assert_array_equal(ends[[0, 5, 6]], [0.0, 0.0, 1.0])
    for zero, one, two in (ends[[0, 1, 2]], ends[[5, 4, 3]]):
        assert abs(one - zero) / h < 1e-4
        assert abs(two - 2.0 * one + zero) / h**2 < 0.5
        assert two / one == pytest.approx(8.0, rel=0.01)


@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3), st.sampled_from([0.004, 0.01]))
def test_derivatives_are_exact_for_parabolas(coefficients: list[float], period_s: float) -> None:
    """Catches one-sided differences, a missing square of the period, and a time axis that is not
    the first."""
    path = np.polynomial.Polynomial(coefficients)
    time = np.arange(40) * period_s
    first, second = derivatives(np.stack([path(time), time], axis=1), period_s)
    np.testing.assert_allclose(first[1:-1, 0], path.deriv()(time[1:-1]), rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(second[1:-1, 0], 2.0 * coefficients[2], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(first[1:-1, 1], 1.0, rtol=0.0, atol=1e-10)
    for derivative in (first, second):
        np.testing.assert_array_equal(derivative[[0, -1]], 0.0)


@pytest.mark.parametrize("step_period", NAMED)
def test_rates_integrate_to_the_path(step_period: float) -> None:
    """Catches rates of another period, and columns of rate and acceleration that are swapped."""
    plan = planned(step_period)
    for path, rate in ((plan.q, plan.q_dot), (plan.q_dot, plan.q_ddot), (plan.com, plan.com_dot)):
        moved = np.cumsum((rate[1:] + rate[:-1]) / 2.0 * PERIOD_S, axis=0)
        np.testing.assert_allclose(
            moved, path[1:] - path[0], rtol=0.0, atol=2e-3 * np.abs(rate).max()
        )


# --------------------------------------------------------------------------------------------------
# ZMP
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step_period", NAMED)
def test_the_cart_table_keeps_its_zmp_within_a_millimetre(step_period: float) -> None:
    """Catches a preview that comes late or has a wrong unit: below 1 mm rms, the acceleration by
    differences."""
    plan = planned(step_period)
    acceleration = np.gradient(plan.com_dot, PERIOD_S, axis=0)
    error = (plan.com - plan.com_height / 9.81 * acceleration - plan.zmp)[plan.timing.walking]
    assert np.sqrt((error**2).mean(axis=0)).max() < 1e-3
    np.testing.assert_array_equal(plan.com[0], plan.zmp[0])
    np.testing.assert_allclose(plan.com[-1], plan.zmp[-1], rtol=0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("step_period", "bound", "goes"),
    [
        (1.6, 2.5e-3, STRAIGHT),
        (1.1, 4e-3, ROUND),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                (3.0, 1.2e-3, STRAIGHT),
                (3.0, 1.2e-3, ROUND),
                (1.6, 2.5e-3, ROUND),
                (1.1, 4e-3, STRAIGHT),
            )
        ),
    ],
)
def test_the_zmp_of_a_walk_forward_is_near_its_reference(
    step_period: float, bound: float, goes: dict[str, float]
) -> None:
    """Catches legs that swing forward as if they weighed nothing: 5, 12 and 18 mm rms."""
    plan = plan_walk(make_gait(step_period, num_steps=4, **goes), ROBOT, PERIOD_S)
    error = (plan.zmp_of_motion - plan.zmp)[plan.timing.walking]
    assert np.sqrt((error**2).sum(axis=1).mean()) < bound


@pytest.mark.parametrize("step_period", [3.0, 1.6, 1.1])
def test_a_refined_plan_has_a_fifth_of_the_error_and_the_same_feet(step_period: float) -> None:
    """Catches a correction of the wrong sign, which doubles the error, and feet that move.

    The motion is one: its center of mass follows from its joints, its rates from its angles.
    """
    plan = planned(step_period)
    refined = refine_plan(plan, ROBOT, PERIOD_S)
    rms = [np.sqrt(((own.zmp_of_motion - own.zmp) ** 2).mean()) for own in (plan, refined)]
    assert rms[1] < rms[0] / 5.0
    np.testing.assert_array_equal(refined.ankles, plan.ankles)
    np.testing.assert_array_equal(refined.zmp, plan.zmp)
    com = refined.pelvis + ROBOT.chains.center_of_mass(refined.q)
    np.testing.assert_allclose(com[:, :2], refined.com, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(refined.q_dot, derivatives(refined.q, PERIOD_S)[0])
    moved = ROBOT.joint_angles(refined.pelvis, refined.ankles, refined.heading, refined.foot_yaw)
    np.testing.assert_array_equal(refined.q, moved)


@pytest.mark.parametrize(
    ("step_period", "bound"), [(24.0, 2e-4), (3.0, 0.003), (1.6, 0.007), (1.1, 0.01)]
)
def test_the_zmp_of_the_motion_is_near_its_reference_and_in_the_sole(
    step_period: float, bound: float
) -> None:
    """Catches legs whose mass the plan forgets, and a walk that a rigid robot could not do."""
    plan = planned(step_period)
    error = (plan.zmp_of_motion - plan.zmp)[plan.timing.walking]
    rms = np.sqrt((error**2).sum(axis=1).mean())
    assert bound / 20.0 < rms < bound
    single = plan.timing.single
    from_ankle = (
        plan.zmp_of_motion - plan.ankles[np.arange(plan.num_steps + 1), plan.timing.support, :2]
    )
    assert (np.abs(from_ankle[single]) < SOLE_HALF_SIZE_M).all()


# --------------------------------------------------------------------------------------------------
# Torques
# --------------------------------------------------------------------------------------------------


def balance(plan: WalkPlan, robot: Biped, row: int) -> tuple[Array, Array, Array]:
    """Joint torques of a row by MuJoCo's inverse dynamics, what is left of its balance, and the ZMP
    of the motion.

    The force that the free pelvis lacks comes from the ground, shared by the planned share.
    """
    model = copy.copy(robot.rigid)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    at = JointAddresses.of(model, LEG_JOINTS)
    h = PERIOD_S
    before, now, after = (plan.pelvis[np.clip(row + i, 0, plan.num_steps)] for i in (-1, 0, 1))
    place_pelvis(data, plan, row)
    data.qvel[:3] = (after - before) / (2 * h)
    data.qacc[:3] = (after - 2 * now + before) / h**2
    turned = plan.heading[np.clip([row - 1, row, row + 1], 0, plan.num_steps)]
    data.qvel[5] = (turned[2] - turned[0]) / (2 * h)
    data.qacc[5] = (turned[2] - 2 * turned[1] + turned[0]) / h**2
    data.qpos[at.q] = plan.q[row]
    data.qvel[at.q_dot] = plan.q_dot[row]
    data.qacc[at.q_dot] = plan.q_ddot[row]
    mujoco.mj_inverse(model, data)
    force = data.qfrc_inverse[:3].copy()
    moment = rotation_z(plan.heading[row]) @ data.qfrc_inverse[3:6]  # MuJoCo's: in its own frame
    about_origin = moment + np.cross(now, force)
    zmp = np.array([-about_origin[1], about_origin[0]]) / force[2]
    spin = about_origin[2] - np.cross([*zmp, 0.0], force)[2]
    share = plan.share[row]
    points = np.pad(contact_points(zmp, share, plan.ankles[row, :, :2]), ((0, 0), (0, 1)))
    rest = data.qfrc_inverse.copy()
    for prefix, weight, point in zip(SIDES, shares(share), points, strict=True):
        translation, rotation = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, translation, rotation, point, model.body(f"{prefix}_foot").id)
        rest -= weight * (translation.T @ force + rotation.T @ [0.0, 0.0, spin])
    return rest[at.q_dot], rest[:6], zmp


WALKS = [*((step_period, "smooth") for step_period in NAMED), (3.0, "ramp")]


@pytest.mark.parametrize(("step_period", "transfer"), WALKS)
def test_torques_are_those_of_mujocos_inverse_dynamics(step_period: float, transfer: str) -> None:
    """Catches a lost Coriolis or inertia term, forces on the wrong foot, and ones that do not
    balance the pelvis."""
    plan = planned(step_period, transfer)
    for row in some_rows(plan)[1:-1]:
        torque, unbalanced, zmp = balance(plan, ROBOT, row)
        np.testing.assert_allclose(plan.torque[row], torque, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(unbalanced, 0.0, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(plan.zmp_of_motion[row], zmp, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize(("transfer", "goes"), ELSEWHERE)
def test_torques_of_a_walk_to_elsewhere_are_those_of_mujocos_inverse_dynamics(
    transfer: str, goes: dict[str, float]
) -> None:
    """Catches forces of the ground in the frame of a foot that has turned, and a base that turns
    without Coriolis forces."""
    plan = walked_to(transfer, goes)
    for row in some_rows(plan)[1:-1]:
        torque, unbalanced, zmp = balance(plan, ROBOT, row)
        np.testing.assert_allclose(plan.torque[row], torque, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(unbalanced, 0.0, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(plan.zmp_of_motion[row], zmp, rtol=0.0, atol=1e-10)
    same = with_torque(plan, ROBOT, PERIOD_S)
    np.testing.assert_array_equal(same.torque, plan.torque)


def test_the_same_motion_of_a_heavier_robot_needs_its_torques() -> None:
    """Catches a payload that changes the motion, or whose torques are those of the robot without
    it."""
    plan = planned(1.6)
    loaded = biped(Thormang(torso_load_kg=5.0))
    heavier = with_torque(plan, loaded, PERIOD_S)
    for name in ("q", "q_dot", "q_ddot", "zmp", "com", "pelvis", "ankles", "share"):
        np.testing.assert_array_equal(getattr(heavier, name), getattr(plan, name), err_msg=name)
    for row in some_rows(plan, 20)[1:-1]:
        torque, unbalanced, zmp = balance(plan, loaded, row)
        np.testing.assert_allclose(heavier.torque[row], torque, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(unbalanced, 0.0, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(heavier.zmp_of_motion[row], zmp, rtol=0.0, atol=1e-11)
    assert np.abs(heavier.torque - plan.torque).max() > 3.0
    same = with_torque(plan, ROBOT, PERIOD_S)
    np.testing.assert_array_equal(same.torque, plan.torque)
    np.testing.assert_array_equal(same.zmp_of_motion, plan.zmp_of_motion)


@pytest.mark.parametrize(("step_period", "transfer"), WALKS)
def test_the_load_goes_from_foot_to_foot_with_the_zmp(step_period: float, transfer: str) -> None:
    """Catches a foot in the air that still carries, and a share that is measured along another
    way than the ZMP's."""
    plan = planned(step_period, transfer)
    timing = planned(step_period, transfer).timing
    left = plan.zmp[timing.single & (timing.support == 0)][0]
    between = np.stack([left, left * [1.0, -1.0]])  # where the ZMP is in single support
    np.testing.assert_allclose(plan.share, load_share(plan.zmp, between), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        plan.share[timing.single], timing.support[timing.single], rtol=0.0, atol=1e-12
    )
    np.testing.assert_allclose(plan.share[[0, -1]], 0.5, rtol=0.0, atol=1e-12)


def holding(plan: WalkPlan, row: int) -> Array:
    """Torque that would hold a row at rest, the weight at the ZMP of the motion, shared as
    planned."""
    feet = plan.ankles[row, :, :2]
    points = np.pad(
        contact_points(plan.zmp_of_motion[row], plan.share[row], feet), ((0, 0), (0, 1))
    )
    force = shares(plan.share[row])[:, None] * [0.0, 0.0, 57.0 * 9.81]
    gravity = np.array([0.0, 0.0, -9.81])
    legs = plan.q[row].reshape(2, 6)
    return holding_torque(ROBOT.chains, legs, gravity, force, points - plan.pelvis[row]).ravel()


def test_at_rest_the_torque_is_the_holding_torque() -> None:
    """Catches a static part that is another one than the compensators': standing exactly, slowly
    walking nearly."""
    plan = planned(24.0)
    for row in (0, plan.num_steps):
        np.testing.assert_allclose(plan.torque[row], holding(plan, row), rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(plan.zmp_of_motion[row], plan.com[row], rtol=0.0, atol=1e-9)
    middle = round(13.0 / PERIOD_S)  # of the first single support
    assert plan.timing.swing[middle] == pytest.approx(0.5)
    np.testing.assert_allclose(plan.torque[middle], holding(plan, middle), rtol=0.0, atol=0.02)
    assert plan.torque[middle].max() > 60.0


@pytest.mark.parametrize(("step_period", "transfer"), WALKS)
def test_no_torque_jumps(step_period: float, transfer: str) -> None:
    """Catches a load that changes feet at once: at most 2 N·m a control period on any joint, 4
    with the ramp."""
    plan = planned(step_period, transfer)
    jumps = np.abs(np.diff(plan.torque, axis=0))
    assert jumps.max() <= {"smooth": 2.0, "ramp": 4.0}[transfer]
    assert jumps.max() > 0.05


# --------------------------------------------------------------------------------------------------
# What cannot be walked
# --------------------------------------------------------------------------------------------------


def feasible(plan: WalkPlan, **limits: float) -> None:
    """The check with servos of other limits."""
    require_feasible(plan, ROBOT, (SERVO.replace(**limits),) * 12)


@pytest.mark.parametrize("step_period", NAMED)
def test_the_named_gaits_can_be_walked(step_period: float) -> None:
    """Catches limits of another unit or sign, which refuse what the paper's robot did."""
    feasible(planned(step_period))


def complaint(
    values: Array, plan: WalkPlan, limit: str, needs: str, bound: float, decimals: int = 3
) -> str:
    """The message about the largest of some values, (T, 12)."""
    row, joint = np.unravel_index(int(np.argmax(values)), values.shape)
    return re.escape(
        f"the walk asks too much of joint '{LEG_JOINTS[joint]}' at {row * PERIOD_S:.3f} s: it"
        f" allows {limit}, the plan needs {bound:.{decimals}f} {needs}; use longer durations"
    )


def test_too_little_torque_is_an_error_that_names_joint_and_time() -> None:
    """Catches a walk that lets the stance hip fall, and the message of another joint or of the
    first excess."""
    plan = planned(3.0)
    needed = np.abs(plan.torque)
    message = complaint(needed, plan, "at most 60.000 N·m", "N·m", needed.max())
    assert "hip_roll" in message
    with pytest.raises(ConfigurationError, match=message):
        feasible(plan, torque_limit=60.0)
    feasible(plan, torque_limit=float(needed.max()) + 1e-6)


def test_too_slow_servos_are_an_error_that_names_joint_and_time() -> None:
    """Catches a limit on the speed in one direction only: here every joint turns backwards."""
    needed = np.abs(planned(1.1).q_dot)
    plan = replace(planned(1.1), q_dot=-needed)
    message = complaint(needed, plan, "a speed of at most 1.000 rad/s", "rad/s", needed.max())
    assert "knee" in message
    with pytest.raises(ConfigurationError, match=message):
        feasible(plan, speed_limit=1.0)
    feasible(plan, speed_limit=float(needed.max()) + 1e-6)


@pytest.mark.parametrize(
    ("parameters", "joint", "limit", "sign"),
    [
        ({"lift_m": 0.3}, "knee", "an angle of at most 1.885 rad", 1.0),
        ({"hip_height_m": 0.3}, "hip_pitch", "an angle of at least -1.257 rad", -1.0),
    ],
)
def test_an_angle_out_of_range_is_an_error_that_names_joint_and_time(
    parameters: dict[str, float], joint: str, limit: str, sign: float
) -> None:
    """Catches a range that is checked at one end only, or with the sign of the other end."""
    plan = plan_walk(make_gait(3, num_steps=2, **parameters), ROBOT, PERIOD_S)
    low, high = np.array([ROBOT.rigid.joint(name).range for name in LEG_JOINTS]).T
    excess = plan.q - high if sign > 0.0 else low - plan.q
    row, column = np.unravel_index(int(np.argmax(excess)), excess.shape)
    message = complaint(excess, plan, limit, "rad", plan.q[row, column])
    assert joint in message
    with pytest.raises(ConfigurationError, match=message):
        feasible(plan)


def test_durations_that_are_too_short_are_an_error() -> None:
    """Catches a step within the blink of an eye that is planned and only fails on the robot."""
    plan = plan_walk(make_gait((0.02, 0.04, 0.02), num_steps=2), ROBOT, PERIOD_S)
    with pytest.raises(
        ConfigurationError,
        match=r"knee' at .* a speed of at most 3\.470 rad/s, the plan needs 15\.6",
    ):
        feasible(plan)


@pytest.mark.parametrize(
    ("hip_height", "message"),
    [
        (
            0.75,
            (
                r"the left foot is out of reach at 0\.000 s: 0\.6500 m from the hip to the ankle,"
                r" at most 0\.6 m"
            ),
        ),
        (
            0.69,
            (
                r"the right foot is out of reach at \d\.\d{3} s: 0\.60\d\d m from the hip to the"
                r" ankle, at most 0\.6 m"
            ),
        ),
    ],
)
def test_a_foot_out_of_reach_is_an_error_that_says_when(hip_height: float, message: str) -> None:
    """Catches straight knees that pull the pelvis down, and a message about a foot that does
    reach the ground."""
    with pytest.raises(ConfigurationError, match=message + "; lower hip_height_m"):
        plan_walk(make_gait(3, num_steps=4, hip_height_m=hip_height), ROBOT, PERIOD_S)


@pytest.mark.parametrize(
    ("gait", "hip_half_spacing", "advice"),
    [
        ({"hip_height_m": 0.75}, 0.105, "hip_height_m"),
        ({"hip_height_m": 0.69}, 0.105, "hip_height_m or hip_half_spacing"),
        ({"lift_m": 5.0}, 0.105, "lift_m"),
        ({}, 5.0, "hip_half_spacing"),
        ({"step_width_m": 1.0}, 0.105, "hip_height_m or step_width_m"),
    ],
)
def test_advice_for_a_foot_out_of_reach_names_what_helps(
    gait: dict[str, float], hip_half_spacing: float, advice: str
) -> None:
    """Catches advice to lower the hips of a robot whose foot is lifted above them, or whose hips
    are far apart, and advice to change the robot where its gait is too wide."""
    robot = biped(Thormang(hip_half_spacing=hip_half_spacing))
    with pytest.raises(ConfigurationError, match=f"; lower {advice}$"):
        plan_walk(make_gait(3, num_steps=4, **gait), robot, PERIOD_S)


def test_a_foot_just_out_of_reach_is_seen_to_be() -> None:
    """Catches a distance that reads as the reach itself: "0.6000 m, at most 0.6 m"."""
    with pytest.raises(ConfigurationError, match="out of reach") as error:
        plan_walk(make_gait(3, num_steps=1, hip_height_m=0.7), ROBOT, PERIOD_S)
    distance, reach = re.findall(r"([\d.]+) m\b", str(error.value))
    assert float(distance) > float(reach) == 0.6


def test_a_plan_is_computed_once() -> None:
    """Catches a plan for every environment, and one that is shared although gait, robot or
    period differ."""
    plan = planned(1.1)
    assert plan_walk(make_gait(1.1, num_steps=2), biped(Thormang()), PERIOD_S) is plan
    assert plan_walk(make_gait(1.1, num_steps=1), ROBOT, PERIOD_S) is not plan
    other = plan_walk(
        make_gait(1.1, num_steps=2), biped(Thormang(hip_half_spacing=0.072)), PERIOD_S
    )
    np.testing.assert_array_equal(other.ankles[:, 0, 1], 0.072)
    coarse = plan_walk(make_gait(1.1, num_steps=2), ROBOT, 0.01)
    assert coarse.num_steps == 420
    with pytest.raises(
        ConfigurationError,
        match=r"double_support_s must be a multiple of the control period of 0\.007",
    ):
        plan_walk(make_gait(1.1, num_steps=2), ROBOT, 0.007)
