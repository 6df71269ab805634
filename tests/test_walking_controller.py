"""The walking controller on observations made by hand: signs, limits, time constants, its local
frame, its memory."""

from dataclasses import replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from baselines.walking.controller import WalkingController, WalkingGains, local_frame
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.motion.gait import make_gait
from elastic_env.rigid.floating_body import FloatingBody
from elastic_env.rigid.leg_kinematics import LegGeometry, foot_pose
from elastic_env.robots.thormang.config import WalkConfig
from elastic_env.robots.thormang.model import ANKLE_HEIGHT_M, LEG, LEG_JOINTS
from elastic_env.robots.thormang.task import WalkTask
from elastic_env.world.robot_model import WalkerModel
from elastic_env.world.scenario import make_scenario
from tests.legs import holding_torque

PERIOD_S = 0.004
WEIGHT_N = 57.0 * 9.81
GAINS = WalkingGains()
FORGETFUL = GAINS.replace(force_difference_decay_s=0.1)
"""Gains with which a force difference settles within a second."""
AT_ONCE = {"ramp_s": PERIOD_S}
"""Argument with which the feedback acts in full from the first step on."""
KNEE = [3, 9]
ANKLES = [4, 5, 10, 11]


@cache
def model(step_period: float = 3.0, scenario: str = "ideal") -> WalkerModel:
    """What is assumed of the walker in a gait of two steps, the first on the left foot."""
    gait = make_gait(step_period, num_steps=2)
    assumed = WalkTask(WalkConfig(gait=gait, scenario=make_scenario(scenario)), 1).assumed_model
    assert isinstance(assumed, WalkerModel)
    return assumed


def sensed(walker: WalkerModel, row: int) -> Array:
    """Foot wrenches on plan at the end of a control period, (12,): the ground's force less the
    weight of the foot."""
    share = walker.plan.share[row]
    feet = [walker.biped.rigid.body(f"{side}_foot").mass[0] * 9.81 for side in "lr"]
    wrench = np.zeros((2, 2, 3))
    wrench[:, 0, 2] = np.array([1.0 - share, share]) * WEIGHT_N - feet
    return wrench.ravel()


def observed(walker: WalkerModel, row: int, **changed: Any) -> Array:
    """What a rigid robot exactly on plan observes at the end of control period `row`, (m,), some
    groups changed."""
    plan = walker.plan
    table = walker.observation_table
    coming = row + 1
    groups = {
        "encoder_angle": plan.q[row],
        "wrench": sensed(walker, row),
        "reference_angle": plan.q[coming],
        "reference_rate": plan.q_dot[coming],
        "clock": [plan.timing.time[coming], plan.timing.swing[coming], plan.timing.support[coming]],
        "load_share": plan.share[coming],
        "zmp_reference": plan.zmp[coming],
        "last_command": plan.q[row],
        **changed,
    }
    observation = np.zeros(len(table))
    for name, values in groups.items():
        observation[table.group(name)] = values
    return observation


def lacking(left_n: float, walker: WalkerModel) -> Array:
    """Wrenches of a standing robot whose left foot carries too little, and whose right foot as
    much too much."""
    wrench = sensed(walker, 0)
    wrench[[2, 8]] += [-0.5 * left_n, 0.5 * left_n]
    return wrench


def held(policy: Any, observation: Array, steps: int) -> tuple[Array, Any]:
    """Action and state after an observation, (m,) or (num_worlds, m), has been shown for a
    number of steps."""
    state = None
    action = np.zeros(0)
    for step in range(steps):
        action, state = policy.predict(observation, state, step == 0)
    return action.astype(np.float64), state


def shifted_pelvis(
    walker: WalkerModel, row: int, shift: Array, swing_foot: Array | None = None
) -> tuple[Array, Array]:
    """Joint angles with the pelvis moved off the plan while the feet stay, the swing foot elsewhere
    if asked.

    Returns:
        q, (12,) [rad], and the center of mass by Pinocchio with the support foot where it is
        planned, (2,) [m].
    """
    plan = walker.plan
    pelvis = plan.pelvis[row] + shift
    ankles = plan.ankles[row].copy()
    if swing_foot is not None:
        ankles[1 - plan.timing.support[row]] += swing_foot
    q = walker.biped.joint_angles(pelvis, ankles)
    com = pelvis + FloatingBody(walker.biped.rigid, LEG_JOINTS).center_of_mass(q[None])[0]
    return q, com[:2]


def single_support(walker: WalkerModel, side: int) -> int:
    """A row in the middle of the swing of the other foot."""
    timing = walker.plan.timing
    return int(np.flatnonzero(timing.single & (timing.support == side)).mean())


def zmp_shift(action: Array, walker: WalkerModel, row: int) -> Array:
    """The ZMP shift that ankle offsets stand for, (..., 2) [m]: K a over the load, (p_x f_z,
    −p_y f_z)."""
    share = walker.plan.share[row + 1]
    load = np.array([1.0 - share, share]) * WEIGHT_N
    stance = int(np.argmax(load))
    torque = 1001.0 * action[..., 6 * stance + 4 : 6 * stance + 6]
    return torque * [1.0, -1.0] / load[stance]


# --------------------------------------------------------------------------------------------------
# local frame


def test_local_frame_is_the_kinematics_of_mujoco() -> None:
    """Catches a transposed attitude, roll and pitch in the wrong order, a sole that is not below
    its tilted ankle."""
    generator = np.random.default_rng(1)
    biped = model().biped
    q = generator.uniform(-0.6, 0.6, (20, 12))
    attitude = generator.uniform(-0.4, 0.4, (20, 2))
    frame = local_frame(biped, q, attitude)
    data = mujoco.MjData(biped.rigid)
    for i in range(20):
        data.qpos[:3] = 0.0
        data.qpos[3:7] = Rotation.from_euler("YX", attitude[i, ::-1]).as_quat(scalar_first=True)
        for name, angle in zip(LEG_JOINTS, q[i], strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(biped.rigid, data)
        mujoco.mj_comPos(biped.rigid, data)
        com = data.body("pelvis").subtree_com
        feet = [data.body(f"{side}_foot") for side in "lr"]
        soles = np.array(
            [foot.xpos - ANKLE_HEIGHT_M * foot.xmat.reshape(3, 3)[:, 2] for foot in feet]
        )
        np.testing.assert_allclose(frame.soles[i], soles, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(frame.com[i], com, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(
            (frame.com[:, None] - frame.soles)[i], com - soles, rtol=0.0, atol=1e-12
        )


@pytest.mark.parametrize("side", [0, 1], ids=["left", "right"])
def test_error_of_the_local_frame_is_equation_1(side: int) -> None:
    """Catches a local frame that does not follow the joints: e = (0, 2L sin θ/2 cos θ/2, 2L sin²
    θ/2).

    The straight leg hangs down, L from hip to sole; its motor shows a hip roll of θ that the link
    does not have. e leads from the support foot to where the motor's angles put it; y is left, and
    θ > 0 puts the foot to the left.
    """
    length = LEG.reach + ANKLE_HEIGHT_M
    zero = np.zeros((1, 2))
    for theta in (-0.09, -0.03, 0.02, 0.06):
        q = np.zeros((1, 12))
        encoder = q.copy()
        encoder[0, 6 * side + 1] = theta
        true, shown = (local_frame(model().biped, angles, zero).soles[0] for angles in (q, encoder))
        half = theta / 2.0
        e = [0.0, 2.0 * length * np.sin(half) * np.cos(half), 2.0 * length * np.sin(half) ** 2]
        np.testing.assert_allclose(shown[side] - true[side], e, rtol=0.0, atol=1e-15)
        np.testing.assert_array_equal(shown[1 - side], true[1 - side])


# -------------------------------------------------------------------------------------------------
# nothing to correct


def test_a_robot_that_stands_as_planned_is_left_alone() -> None:
    """Catches a bias of the forces, of the local frame or of the world's origin: no offset while
    it stands."""
    walker = model()
    action, _ = held(WalkingController(walker, **AT_ONCE), observed(walker, 0), 400)
    np.testing.assert_allclose(action, 0.0, rtol=0.0, atol=1e-9)


def test_forces_that_follow_the_plan_ask_for_no_leg_difference() -> None:
    """Catches forces of one control step compared with the load share of another, which looks
    like a lack of force."""
    walker = model(1.1)
    state = None
    hips = []
    controller = WalkingController(walker, **AT_ONCE)
    for row in range(walker.plan.num_steps - 1):
        action, state = controller.predict(observed(walker, row), state, row == 0)
        hips.append(action[[2, 3, 8, 9]])
    assert np.abs(hips).max() < 1e-6


def test_on_plan_only_half_a_sample_of_lag_is_fed_back() -> None:
    """Catches a COM in the wrong frame or of another row, a wrong ω, filters of other time
    constants.

    Closed form from the plan alone: first-order filters on the velocity's deviation and on the ZMP
    shift.
    """
    walker = model(1.1)
    plan = walker.plan
    last = walker.plan.num_steps - 1
    com = plan.com[:last, 1]
    com_dot = plan.com_dot[:last, 1]
    omega = np.sqrt(9.81 / plan.com_height)
    velocity = low_pass(np.diff(com, prepend=com[0]) / PERIOD_S - com_dot, GAINS.velocity_filter_s)
    shift = low_pass(GAINS.dcm * velocity / omega, GAINS.zmp_filter_s)
    share = plan.share[1 : last + 1]
    expected = -np.stack([1.0 - share, share], axis=1) * shift[:, None] * WEIGHT_N / 1001.0
    controller = WalkingController(walker, **AT_ONCE)
    state = None
    rolls = []
    for row in range(last):
        action, state = controller.predict(observed(walker, row), state, row == 0)
        rolls.append(action[[5, 11]])
    np.testing.assert_allclose(rolls, expected, rtol=0.0, atol=1e-9)
    assert 1e-5 < np.abs(expected).max() < 1e-3


def low_pass(values: Array, time_constant_s: float) -> Array:
    """First-order filter at the control rate, from rest at zero."""
    a = 1.0 - np.exp(-PERIOD_S / time_constant_s)
    return lfilter([a], [1.0, a - 1.0], values)


# -------------------------------------------------------------------------------------------------
# force difference


@pytest.mark.parametrize("lack", [60.0, -60.0])
def test_the_leg_that_carries_too_little_grows(lack: float) -> None:
    """Catches the sign of force difference control: a left foot that lacks force gets a
    straighter knee."""
    walker = model()
    action, _ = held(
        WalkingController(walker, **AT_ONCE), observed(walker, 0, wrench=lacking(lack, walker)), 100
    )
    left, right = action[KNEE]
    assert np.sign(lack) * left < -1e-3
    assert np.sign(lack) * right > 1e-3


@pytest.mark.parametrize(
    "leg", [LEG, LegGeometry(thigh=0.36, shank=0.24)], ids=["equal links", "long thigh"]
)
@pytest.mark.parametrize("side", [None, 0, 1], ids=["standing", "left", "right"])
def test_half_the_difference_goes_to_each_leg_along_hip_and_ankle(
    side: int | None, leg: LegGeometry
) -> None:
    """Catches a leg that tilts its sole or moves its ankle aside, and a length other than z/2, also
    of a bent leg.

    A small lack of 1 N for long makes z = k T 1 N; the lengths follow from forward kinematics.
    """
    walker = model()
    lack = 1.0
    row = 0 if side is None else single_support(walker, side)
    observation = observed(walker, row, wrench=sensed(walker, row) + np.eye(12)[2] * -lack)
    built_so = replace(walker, biped=replace(walker.biped, leg=leg))
    controller = WalkingController(built_so, com_feedback=False, gains=FORGETFUL, **AT_ONCE)
    action, _ = held(controller, observation, 300)
    z = FORGETFUL.force_difference * FORGETFUL.force_difference_decay_s * lack
    q_ref = walker.plan.q[row + 1]
    before, R_before = foot_pose(leg, q_ref.reshape(2, 6))
    after, R_after = foot_pose(leg, (q_ref + action).reshape(2, 6))
    grown = np.linalg.norm(after, axis=1) - np.linalg.norm(before, axis=1)
    np.testing.assert_allclose(grown, [0.5 * z, -0.5 * z], rtol=2e-3)
    np.testing.assert_allclose(R_after, R_before, rtol=0.0, atol=1e-9)
    aside = np.cross(before, after) / np.linalg.norm(before, axis=1, keepdims=True)
    assert np.abs(aside).max() < 1e-3 * z


def test_the_difference_grows_and_leaks_with_its_time_constant() -> None:
    """Catches a gain per step instead of per second, and a leak that is missing or of another
    time constant."""
    walker = model()
    controller = WalkingController(model(), com_feedback=False, **AT_ONCE)
    steps = round(GAINS.force_difference_decay_s / PERIOD_S)
    lack, right = (
        observed(walker, 0, wrench=wrench) for wrench in (lacking(30.0, walker), sensed(walker, 0))
    )
    after_t, _ = held(controller, lack, steps)
    settled, state = held(controller, lack, 8 * steps)
    for _ in range(steps):
        leaked, state = controller.predict(right, state)
    np.testing.assert_allclose(after_t[KNEE], (1.0 - np.exp(-1.0)) * settled[KNEE], rtol=0.01)
    np.testing.assert_allclose(leaked[KNEE], np.exp(-1.0) * settled[KNEE], rtol=0.01)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_difference_stays_within_its_limit(sign: float) -> None:
    """Catches a leg that grows without bound, and an integrator that winds up behind the limit."""
    walker = model()
    controller = WalkingController(walker, com_feedback=False, gains=FORGETFUL, **AT_ONCE)
    small, _ = held(controller, observed(walker, 0, wrench=lacking(30.0, walker)), 300)
    z = FORGETFUL.force_difference * FORGETFUL.force_difference_decay_s * 30.0
    largest, state = held(
        controller, observed(walker, 0, wrench=lacking(sign * 2000.0, walker)), 300
    )
    np.testing.assert_allclose(
        largest, sign * GAINS.force_difference_limit_m / z * small, rtol=1e-4, atol=1e-9
    )
    leaked, _ = controller.predict(observed(walker, 0), state)
    np.testing.assert_allclose(
        leaked[KNEE],
        (1.0 - PERIOD_S / FORGETFUL.force_difference_decay_s) * largest[KNEE],
        rtol=1e-5,
    )


# ---------------------------------------------------------------------------------- feedback of the
# center of mass


@pytest.mark.parametrize("side", [0, 1], ids=["left", "right"])
@pytest.mark.parametrize(
    "swing_foot", [None, [0.03, 0.04, 0.02]], ids=["foot on plan", "foot elsewhere"]
)
def test_zmp_shift_is_proportional_to_the_dcm_error_over_the_support_foot(
    side: int, swing_foot: list[float] | None
) -> None:
    """Catches a sign or gain of Δp = k (ξ − ξ_ref), and a local frame that hangs on the swing foot.

    The robot is frozen off its plan, so that ξ is the COM, here by Pinocchio and with the support
    foot on its place.
    """
    walker = model()
    row = single_support(model(), side)
    plan = walker.plan
    q, com = shifted_pelvis(walker, row, np.array([0.02, -0.01, 0.0]), swing_foot)
    observation = observed(walker, row, encoder_angle=q)
    action, _ = held(WalkingController(walker, **AT_ONCE), observation, 400)
    error = com - plan.com[row] - plan.com_dot[row] / np.sqrt(9.81 / plan.com_height)
    np.testing.assert_allclose(
        zmp_shift(action, walker, row), GAINS.dcm * error, rtol=0.0, atol=1e-7
    )
    assert error[0] > 0.01
    others = np.delete(np.arange(12), ANKLES[2 * side : 2 * side + 2])
    np.testing.assert_allclose(
        action[others], 0.0, rtol=0.0, atol=1e-9
    )  # only the ankle that carries


def test_ankles_wind_by_the_torque_that_moves_the_force() -> None:
    """Catches a sign or a lever: K a must be the static torque of the force at the shifted point
    less that before.

    The COM stands ahead of its plan and to its left, and the feet carry alike.
    """
    walker = model()
    q, com = shifted_pelvis(walker, 0, np.array([0.015, 0.01, 0.0]))
    action, _ = held(
        WalkingController(walker, **AT_ONCE), observed(walker, 0, encoder_angle=q), 400
    )
    shift = [*GAINS.dcm * (com - walker.plan.com[0]), 0.0]
    chains = walker.biped.chains
    legs = walker.plan.q[1].reshape(2, 6)
    force = np.tile([0.0, 0.0, WEIGHT_N / 2.0], (2, 1))
    gravity = np.array([0.0, 0.0, -9.81])
    _, points = chains.com_and_feet(walker.plan.q[[1]], np.array([0.0, 0.0, -ANKLE_HEIGHT_M]))
    moved = holding_torque(chains, legs, gravity, force, points[0] + np.array(shift))
    change = (moved - holding_torque(chains, legs, gravity, force, points[0])).ravel()
    np.testing.assert_allclose(1001.0 * action[ANKLES], change[ANKLES], rtol=0.0, atol=1e-3)
    assert (change[[4, 10]] > 1.0).all()  # forward
    assert (change[[5, 11]] < -0.5).all()  # to the left


def test_zmp_shift_stays_within_its_limit() -> None:
    """Catches a limit that is left out or that one axis lacks: a robot that leans forward and to
    its right."""
    walker = model()
    row = single_support(model(), 0)
    limit = GAINS.zmp_limit_m
    observation = observed(walker, row, imu_attitude=[0.35, 0.4])
    action, _ = held(WalkingController(walker, **AT_ONCE), observation, 400)
    np.testing.assert_allclose(zmp_shift(action, walker, row), [limit, -limit], rtol=0.0, atol=1e-8)


def test_velocity_of_the_center_of_mass_is_fed_back() -> None:
    """Catches a velocity left out, of the wrong sign, or not over ω: the COM drifts steadily, its
    plan stands still.

    The filter of the ZMP shift lags behind the drift by its time constant.
    """
    walker = model()
    controller = WalkingController(model(), **AT_ONCE)
    drift = 2e-4  # of the pelvis in a control period [m]
    state = None
    action = np.zeros(12)
    path = []
    for step in range(100):
        q, com = shifted_pelvis(walker, 0, np.array([drift * step, 0.0, 0.0]))
        action, state = controller.predict(observed(walker, 0, encoder_angle=q), state, step == 0)
        path.append(com[0] - walker.plan.com[0, 0])
    speed = (path[-1] - path[-11]) / (10 * PERIOD_S)
    wanted = path[-1] + speed / walker.plan.omega
    shift = 1001.0 * float(action[4]) / (WEIGHT_N / 2.0)
    assert shift / GAINS.dcm == pytest.approx(wanted - speed * GAINS.zmp_filter_s, rel=0.01)
    assert speed / walker.plan.omega > 0.3 * wanted


def test_a_change_of_the_support_foot_is_no_velocity() -> None:
    """Catches a COM velocity across two local frames: feet 0.02 m too far apart shift the frame,
    and nothing moves."""
    walker = model()
    plan = walker.plan
    q = walker.biped.joint_angles(
        plan.pelvis[0], plan.ankles[0] + [[0.0, 0.01, 0.0], [0.0, -0.01, 0.0]]
    )
    coming = [plan.timing.time[1], 0.0]
    left, right = (
        observed(walker, 0, encoder_angle=q, clock=[*coming, support]) for support in (0, 1)
    )
    controller = WalkingController(walker, **AT_ONCE)
    before, state = held(controller, left, 400)
    shifts = []
    for _ in range(400):
        action, state = controller.predict(right, state)
        shifts.append(-1001.0 * (action[5] - before[5]) / (WEIGHT_N / 2.0))
    jump = (
        GAINS.dcm * 0.02
    )  # the COM is 0.01 m left of the plan over the right foot, 0.01 m right of it over the left one
    assert shifts[0] == pytest.approx(
        jump * (1.0 - np.exp(-PERIOD_S / GAINS.zmp_filter_s)), rel=1e-4
    )
    assert shifts[-1] == pytest.approx(jump, rel=1e-4)
    assert np.max(shifts) <= shifts[-1] + 1e-9


def test_com_feedback_switches_the_ankles_off_and_nothing_else() -> None:
    """Catches a switch that also stops force difference control or friction, or that leaves some
    of the feedback."""
    walker = model(scenario="nominal")
    row = single_support(walker, 0)
    q, _ = shifted_pelvis(walker, row, np.array([0.02, -0.01, 0.0]))
    wrench = sensed(walker, row) + np.eye(12)[8] * 50.0
    observation = observed(walker, row, encoder_angle=q, wrench=wrench)
    without_gain = WalkingGains(dcm=0.0)
    on, off, zero = (
        held(WalkingController(walker, **arguments, **AT_ONCE), observation, 100)[0]
        for arguments in ({}, {"com_feedback": False}, {"gains": without_gain})
    )
    np.testing.assert_array_equal(off, zero)
    changed = np.flatnonzero(on != off)
    np.testing.assert_array_equal(changed, [4, 5])  # of the leg that carries
    assert np.abs(off[KNEE]).min() > 1e-3


def test_feedback_grows_over_the_ramp() -> None:
    """Catches feedback that starts with a jump: by half of it after half the time, in full after
    all of it."""
    walker = model()
    q, _ = shifted_pelvis(walker, 0, np.array([0.02, -0.01, 0.0]))
    observation = observed(walker, 0, encoder_angle=q, wrench=lacking(50.0, walker))
    for steps, share in ((1, 0.0), (50, 0.5), (100, 1.0), (150, 1.0)):
        slow, fast = (
            held(WalkingController(walker, ramp_s=ramp), observation, steps)[0]
            for ramp in (0.4, PERIOD_S)
        )
        np.testing.assert_allclose(slow, share * fast, rtol=1e-6, atol=1e-7)


# --------------------------------------------------------------------------------------------------
# friction


def test_friction_is_wound_against_in_the_direction_of_the_plan() -> None:
    """Catches a sign, a rate of the encoder for that of the plan, a ramp: F/K tanh(rate / 0.01
    rad/s) at once."""
    rates = np.linspace(-0.05, 0.05, 12)
    walker = model(scenario="nominal")
    action, _ = held(
        WalkingController(walker), observed(walker, 0, reference_rate=rates, encoder_rate=-rates), 1
    )
    np.testing.assert_allclose(action, 5.4 / 1001.0 * np.tanh(rates / 0.01), rtol=0.0, atol=1e-9)


def test_a_robot_without_friction_needs_no_feedforward() -> None:
    """Catches friction of the paper's servo where the scenario has none."""
    walker = model()
    action, _ = held(
        WalkingController(walker),
        observed(walker, 0, reference_rate=np.linspace(-0.05, 0.05, 12)),
        1,
    )
    np.testing.assert_allclose(action, 0.0, rtol=0.0, atol=1e-12)


# --------------------------------------------------------------------------------------------------
# memory


def episodes(walker: WalkerModel, num_worlds: int, steps: int) -> Array:
    """Observations of worlds in different phases and off their plans in different ways, (steps,
    num_worlds, m)."""
    generator = np.random.default_rng(3)
    begin = generator.integers(0, 800, num_worlds)
    rows = [[observed(walker, int(row) + step) for row in begin] for step in range(steps)]
    observations = np.array(rows)
    table = walker.observation_table
    observations[..., table.group("encoder_angle")] += generator.uniform(
        -0.02, 0.02, (num_worlds, 12)
    )
    observations[..., table.group("wrench")] += generator.uniform(-50.0, 50.0, (num_worlds, 12))
    return observations


def test_rows_are_the_single_worlds_exactly() -> None:
    """Catches memory that leaks between worlds, and formulas that depend on the size of the
    batch."""
    walker = model(scenario="nominal")
    controller = WalkingController(walker, ramp_s=0.1)
    observations = episodes(walker, 3, 40)
    state = None
    actions = []
    for step, rows in enumerate(observations):
        action, state = controller.predict(rows, state, np.full(3, step == 0))
        actions.append(action)
    for world in range(3):
        alone = None
        for step in range(40):
            action, alone = controller.predict(observations[step, world], alone, step == 0)
            assert (action.dtype, action.shape) == (np.float32, (12,))
            np.testing.assert_array_equal(action, actions[step][world])


def test_episode_start_clears_its_rows_and_no_others() -> None:
    """Catches memory that survives a new episode, and a new episode that clears the memory of
    its neighbours."""
    walker = model(scenario="nominal")
    controller = WalkingController(walker, ramp_s=0.1)
    observations = episodes(walker, 3, 30)
    state: Any = None
    for step, rows in enumerate(observations):
        _, state = controller.predict(rows, state, np.full(3, step == 0))
    on, _ = controller.predict(observations[-1], state)
    fresh, _ = controller.predict(observations[-1], None, np.ones(3, dtype=np.bool_))
    mixed, _ = controller.predict(observations[-1], state, np.array([False, True, False]))
    np.testing.assert_array_equal(mixed, [on[0], fresh[1], on[2]])
    assert np.abs(on - fresh).max(axis=1).min() > 1e-4


def test_predict_changes_neither_state_nor_observation() -> None:
    """Catches memory written in place: the same state must give the same action again."""
    walker = model(scenario="nominal")
    controller = WalkingController(walker, **AT_ONCE)
    observations = episodes(walker, 2, 2)
    _, state = controller.predict(observations[0], None, np.ones(2, dtype=np.bool_))
    kept = state.copy()
    before = observations[1].copy()
    again = [controller.predict(observations[1], state)[0] for _ in range(2)]
    np.testing.assert_array_equal(again[0], again[1])
    np.testing.assert_array_equal(state, kept)
    np.testing.assert_array_equal(observations[1], before)


@pytest.mark.parametrize("row", [1, 300, 700])
def test_predict_without_state_in_mid_episode_is_an_error(row: int) -> None:
    """Catches feedback that silently starts anew because the caller forgot the state."""
    walker = model()
    with pytest.raises(ElasticError, match="without `state`"):
        WalkingController(walker).predict(observed(walker, row))


def test_state_of_another_number_of_worlds_is_an_error() -> None:
    """Catches a state that is broadcast over the worlds."""
    walker = model()
    rows = np.tile(observed(walker, 0), (2, 1))
    _, state = WalkingController(walker).predict(rows[:1], None, True)
    with pytest.raises(ElasticError, match="2, got 1"):
        WalkingController(walker).predict(rows, state)


def test_the_controller_takes_motors_for_links() -> None:
    """Catches an uncompensated policy that is credited with an estimate it does not make."""
    walker = model()
    observation = observed(walker, 500, encoder_angle=np.arange(12.0))
    np.testing.assert_array_equal(
        WalkingController(walker).link_estimate(observation, None), np.arange(12.0)
    )
