"""The compensators against closed forms, MuJoCo's equilibrium, finite differences and the
simulated plant."""

import re
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import baselines
from baselines.compensation.compensators import (
    GravityCompensator,
    Motion,
    input_offset,
    newton_link_angle,
    taylor_link_angle,
)
from baselines.compensation.dry_friction import FrictionMemory
from baselines.compensation.dynamic_compensator import DriveMemory, DynamicCompensator
from baselines.compensation.gravity_torque import RigidBody, make_gravity
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.robots.testbed.model import JOINT, Pendulum, elastic_spec, rigid_spec
from elastic_env.world.robot_model import RobotModel
from tests.trees import bias_of_mujoco, pendulum, robot, tree
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import evaluate

G = 60.0  # torque of the pendulum at the horizontal [N·m]
STIFFNESSES = pytest.mark.parametrize("K", [1001.0, 300.0])
ANGLES = np.linspace(-2.5, 2.5, 101)[:, None]
PERIOD_S = 0.004
SERVO = Servo(
    position_gain=18_000.0,
    velocity_gain=250.0,
    integral_gain=180_000.0,
    torque_limit=84.0,
    speed_limit=3.5,
)
SERVO_WITHOUT_INTEGRATOR = SERVO.replace(integral_gain=0.0)


def newton(theta: Array, K: float) -> Array:
    """Eq. 10 for the pendulum."""
    return newton_link_angle(theta, np.array([K]), make_gravity(pendulum()))


def taylor(theta: Array, K: float) -> Array:
    """Eq. 12 for the pendulum."""
    return taylor_link_angle(theta, np.array([K]), make_gravity(pendulum()))


def moving(gravity: float = 9.81, servo: Servo = SERVO, **joint: float) -> RobotModel:
    """The testbed's model for the dynamic compensator."""
    values: dict[str, Any] = {"stiffness": 1001.0, "damping": 10.0, "rotor_inertia": 0.839} | joint
    return RobotModel(
        {JOINT: ElasticJoint(servo=servo, **values)},
        rigid_spec(Pendulum(), gravity).compile(),
        PERIOD_S,
    )


def chain(K: list[float]) -> RobotModel:
    """A hanging chain of equal links with the given stiffnesses, each hinge turned against the
    last."""
    links = "".join(
        f'<body name="b{i}" pos="0.01 0 -0.1" euler="0.1 0.2 0.3"><joint name="j{i}" axis="0.2 1'
        ' 0.1"/><inertial mass="0.5" pos="0.02 0.01 -0.05" diaginertia="0.001 0.001 0.001"/>'
        for i in range(len(K))
    )
    xml = f"<mujoco><worldbody>{links}{'</body>' * len(K)}</worldbody></mujoco>"
    return robot(xml, [f"j{i}" for i in range(len(K))]).with_stiffness(K)


def at(q: float, q_dot: float = 0.0, q_ddot: float = 0.0) -> Motion:
    """A motion of one joint in one world."""
    return Motion(*(np.array([[value]]) for value in (q, q_dot, q_ddot)))


@STIFFNESSES
@pytest.mark.parametrize("q_desired", [-1.3, -0.4, 0.0, 0.7, 2.0])
def test_commanded_pendulum_is_in_equilibrium_where_it_should_be(
    K: float, q_desired: float
) -> None:
    """Catches a flipped sign of Eq. 9 and τ_g taken at the command: MuJoCo must feel no force on
    the link at rest."""
    offset = input_offset(np.array([q_desired]), np.array([K]), make_gravity(pendulum()))
    model = elastic_spec(Pendulum(), ElasticJoint(stiffness=K, rotor_inertia=0.8)).compile()
    data = mujoco.MjData(model)
    data.joint(f"{JOINT}_motor").qpos = q_desired + offset
    data.joint(JOINT).qpos = q_desired
    mujoco.mj_forward(model, data)
    assert data.joint(JOINT).qfrc_passive - data.joint(JOINT).qfrc_bias == pytest.approx(
        0.0, abs=1e-12
    )


@STIFFNESSES
def test_output_compensation_undoes_input_compensation(K: float) -> None:
    """Catches Eqs. 9 and 10 with different signs or stiffnesses: Newton finds the posture that
    was commanded."""
    theta = ANGLES + input_offset(ANGLES, np.array([K]), make_gravity(pendulum()))
    np.testing.assert_allclose(newton(theta, K), ANGLES, rtol=0.0, atol=2e-12)


@STIFFNESSES
def test_taylor_is_one_newton_step_in_closed_form(K: float) -> None:
    """Catches Eq. 12 with K − τ_g′, without τ_g′, or with a wrong sign in front."""
    expected = ANGLES - G * np.sin(ANGLES) / (K + G * np.cos(ANGLES))
    np.testing.assert_allclose(taylor(ANGLES, K), expected, rtol=0.0, atol=1e-15)


@STIFFNESSES
def test_newton_solves_equation_10(K: float) -> None:
    """Catches an iteration that stops early or solves for the torque at the encoder: the issue
    asks for 1e-10 rad."""
    q = newton(ANGLES, K)
    residual = ANGLES - G / K * np.sin(q) - q
    assert np.abs(residual).max() < 2e-12
    assert np.abs(q - ANGLES).max() > 0.9 * G / K  # and it is not the encoder that comes back


@pytest.mark.parametrize("K", [1001.0, 300.0, 3e4])
def test_error_of_taylor_is_of_second_order_in_the_deflection(K: float) -> None:
    """Catches a wrong torque gradient: Eq. 12 then errs in first order. The bound is Taylor's
    remainder, G |δ|³/6."""
    q = newton(ANGLES, K)
    deflection = ANGLES - q
    total = K + G * np.cos(ANGLES)
    second_order = -G * np.sin(ANGLES) * deflection**2 / 2.0
    remainder = total * (taylor(ANGLES, K) - q) - second_order
    np.testing.assert_array_less(
        np.abs(remainder), G * np.abs(deflection) ** 3 / 6.0 + 1e-12 * total
    )
    assert np.abs(second_order).max() > 5.0 * np.abs(remainder).max()


def test_error_of_taylor_shows_on_a_soft_joint() -> None:
    """Catches a Taylor step that is Newton in disguise: 0.1 mrad at 1001 N·m/rad, some mrad at
    300."""
    largest = [np.abs(taylor(ANGLES, K) - newton(ANGLES, K)).max() for K in (1001.0, 300.0)]
    assert 0.5e-4 < largest[0] < 1.5e-4
    assert 2e-3 < largest[1] < 6e-3


@STIFFNESSES
def test_link_rate_is_the_derivative_of_the_link_angle(K: float) -> None:
    """Catches a gradient taken at the encoder instead of the link, 0.4 % wrong at 1001 N·m/rad
    and 4 % at 300."""
    compensator = GravityCompensator(pendulum().with_stiffness(K), output="newton")
    theta_dot = np.full_like(ANGLES, 0.7)
    h = 1e-5
    expected = (newton(ANGLES + h * theta_dot, K) - newton(ANGLES - h * theta_dot, K)) / (2.0 * h)
    np.testing.assert_allclose(
        compensator.link_rate(ANGLES, theta_dot), expected, rtol=0.0, atol=1e-6
    )


def test_link_rate_of_taylor_is_that_of_newton_but_for_second_order() -> None:
    """Catches a link rate that Eq. 12 makes wrong in first order."""
    theta_dot = np.full_like(ANGLES, 1.0)
    rates = [
        GravityCompensator(pendulum().with_stiffness(1001.0), output=output).link_rate(
            ANGLES, theta_dot
        )
        for output in ("taylor", "newton")
    ]
    np.testing.assert_allclose(rates[0], rates[1], rtol=0.0, atol=2e-5)


def test_taylor_solves_the_matrix_equation_of_a_tree() -> None:
    """Catches Eq. 12 joint by joint: (K + ∂τ_g/∂q) δ = τ_g(θ), with both sides from MuJoCo and
    differences."""
    K = np.array([120.0, 300.0, 90.0, 60.0, 500.0, 200.0])
    model = tree().with_stiffness(K)
    h = 1e-5
    gravity = make_gravity(model, "tree")
    for theta in np.random.default_rng(3).uniform(-1.0, 1.0, (10, 6)):
        columns = [
            bias_of_mujoco(model, theta + h * e) - bias_of_mujoco(model, theta - h * e)
            for e in np.eye(6)
        ]
        gradient = np.stack(columns, axis=1) / (2.0 * h)
        deflection = theta - taylor_link_angle(theta, K, gravity)
        torque = bias_of_mujoco(model, theta)
        np.testing.assert_allclose(
            (np.diag(K) + gradient) @ deflection, torque, rtol=0.0, atol=1e-7
        )
        assert (
            np.abs(torque / (K + np.diag(gradient)) - deflection).max() > 1e-3
        )  # the coupling matters


def test_newton_balances_the_springs_of_a_tree_against_mujoco() -> None:
    """Catches a solver that leaves out the coupling of the joints: K (θ − q) must be MuJoCo's
    gravity torque at q."""
    K = np.array([120.0, 300.0, 90.0, 60.0, 500.0, 200.0])
    model = tree().with_stiffness(K)
    theta = np.random.default_rng(4).uniform(-1.0, 1.0, (10, 6))
    q = newton_link_angle(theta, K, make_gravity(model))
    torque = np.stack([bias_of_mujoco(model, row) for row in q])
    np.testing.assert_allclose(K * (theta - q), torque, rtol=0.0, atol=1e-9)


def test_singular_stiffness_is_an_error() -> None:
    """Catches an infinite deflection where gravity cancels the spring: K = −τ_g′ for the upright
    pendulum."""
    with pytest.raises(ElasticError, match=r"singular.*60 N·m/rad"):
        taylor(np.array([np.pi]), G)


def test_stiff_and_soft_joints_together_are_not_singular() -> None:
    """Catches a determinant scaled by the stiffest joint, which underflows for a dozen joints of
    mixed stiffness."""
    model = chain([3000.0] + [100.0] * 12)
    theta = np.full(13, 0.1)
    gravity = make_gravity(model)
    deflection = theta - taylor_link_angle(theta, model.stiffness, gravity)
    left = (np.diag(model.stiffness) + gravity.gravity_gradient(theta)) @ deflection
    np.testing.assert_allclose(left, gravity.gravity_torque(theta), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("stiffness", [[900.0, 1100.0], []])
def test_wrong_number_of_stiffnesses_says_required_and_given(stiffness: list[float]) -> None:
    """Catches a stiffness that is broadcast over the joints, or cut, instead of refused."""
    env = gymnasium.make("elastic_env/Testbed-v0", reference="sine")
    got = re.escape(str(stiffness))
    with pytest.raises(ConfigurationError, match=rf"a list of 1 \[N·m/rad\].*joint.*got {got}"):
        baselines.make("input", env, stiffness=stiffness)


def test_unknown_output_method_names_itself_and_the_choices() -> None:
    """Catches a silent fallback to Newton."""
    with pytest.raises(
        ConfigurationError, match=r"unknown output compensator 'tailor'.*taylor, newton"
    ):
        GravityCompensator(pendulum(), output="tailor")


def arrays_of(memory: Any) -> list[Array]:
    """All arrays of a memory."""
    if isinstance(memory, np.ndarray):
        return [memory]
    return [array for part in memory for array in arrays_of(part)]


@pytest.mark.parametrize("compensator", [GravityCompensator, DynamicCompensator])
def test_memory_has_a_row_for_every_world(compensator: type) -> None:
    """Catches a compensator whose rows do not fit the state that `Compensated` keeps for it."""
    made = compensator(moving())
    motion = Motion(*np.zeros((3, 5, 1)))
    memory = made.begin(motion)
    offset, kept = made.offset(motion, memory)
    rows = [arrays_of(one) for one in (memory, kept)]
    assert [part.shape for part in rows[0]] == [part.shape for part in rows[1]]
    assert all(len(part) == 5 for part in rows[0])
    assert offset.shape == (5, 1)


@pytest.mark.parametrize("q", [-1.2, 0.3, 1.5])
def test_dynamic_compensator_at_rest_is_the_static_one(q: float) -> None:
    """Catches a start out of balance: at rest the offset is Eq. 9 from the first step on,
    without servo error."""
    compensator = DynamicCompensator(moving())
    static = GravityCompensator(moving())
    memory = compensator.begin(at(q))
    expected = static.offset(at(q), np.zeros((1, 0)))[0]
    for _ in range(100):
        offset, memory = compensator.offset(at(q), memory)
        np.testing.assert_allclose(offset, expected, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(
        compensator.link_angle(q + expected, memory), [[q]], rtol=0.0, atol=1e-15
    )


@pytest.mark.parametrize("q", [-0.9, 0.9])
def test_dynamic_compensator_adds_servo_error_and_half_the_dead_band_at_rest(q: float) -> None:
    """Catches a servo without integrator taken for one with, and a dead band added against the
    load or in full."""
    compensator = DynamicCompensator(moving(servo=SERVO_WITHOUT_INTEGRATOR, backlash=0.01))
    offset, _ = compensator.offset(at(q), compensator.begin(at(q)))
    torque = G * np.sin(q)
    expected = torque / 1001.0 + np.sign(torque) * 0.005 + torque / 18_000.0
    np.testing.assert_allclose(offset, [[expected]], rtol=0.0, atol=1e-15)


def test_dynamic_compensator_accelerates_link_and_rotor() -> None:
    """Catches a forgotten I, B or k_v: without gravity, constant acceleration has a closed form
    of every share."""
    model = moving(gravity=0.0, servo=SERVO_WITHOUT_INTEGRATOR)
    compensator = DynamicCompensator(model)
    acceleration = 0.8
    memory = compensator.begin(at(0.0))
    for step in range(200):
        offset, memory = compensator.offset(
            at(0.0, acceleration * step * PERIOD_S, acceleration), memory
        )
    rate = acceleration * 199 * PERIOD_S
    I = Pendulum().inertia  # noqa: E741
    deflection = I * acceleration / 1001.0
    servo_error = ((I + 0.839) * acceleration + 250.0 * rate) / 18_000.0
    expected = deflection + servo_error - 0.5 * PERIOD_S * rate
    np.testing.assert_allclose(offset, [[expected]], rtol=0.0, atol=1e-12)


def test_dynamic_compensator_lets_the_deflection_lag_by_the_damping() -> None:
    """Catches D left out: under a torque that grows steadily the deflection lags by D/K, but for
    half a step."""
    rates = {}
    for damping in (0.0, 40.0):
        model = moving(
            gravity=0.0, servo=SERVO_WITHOUT_INTEGRATOR, viscous_friction=300.0, damping=damping
        )
        compensator = DynamicCompensator(model)
        acceleration = 0.5
        memory = compensator.begin(at(0.0))
        for step in range(400):
            offset, memory = compensator.offset(
                at(0.0, acceleration * step * PERIOD_S, acceleration), memory
            )
        rates[damping] = float(offset[0, 0])
    growth = 300.0 * 0.5 / 1001.0  # of the deflection [rad/s]
    assert rates[0.0] - rates[40.0] == pytest.approx(
        growth * (40.0 / 1001.0 - PERIOD_S / 2.0), rel=0.01
    )


def test_friction_turns_round_with_the_motion_and_stays_at_rest() -> None:
    """Catches friction that pushes along the motion, jumps at a turn, or vanishes when the
    motion stops."""
    model = moving(gravity=0.0, coulomb_friction=5.4)
    compensator = DynamicCompensator(model, friction=True)
    memory = compensator.begin(at(0.0))
    frictions = []
    for rate in [0.5] * 20 + [0.0] * 5 + [-0.5] * 20:
        _, memory = compensator.offset(at(0.0, rate), memory)
        frictions.append(float(memory.friction.coulomb[0, 0]))
    assert frictions[19] == pytest.approx(5.4, abs=1e-6)
    assert frictions[20:25] == frictions[19:20] * 5
    assert -5.4 < frictions[25] < 0.0  # 2 mrad after the turn: past zero, not yet turned round
    assert frictions[-1] == pytest.approx(-5.4, abs=1e-6)


def test_without_friction_the_compensator_ignores_the_friction_of_the_model() -> None:
    """Catches friction that the `dynamic` policy is not meant to know."""
    memory = DriveMemory(*np.zeros((3, 1, 1)), FrictionMemory(*np.zeros((3, 1, 1))))
    offsets = []
    for friction in (0.0, 5.4):
        offsets.append(
            DynamicCompensator(moving(coulomb_friction=friction)).offset(at(0.2, 0.5, 0.1), memory)[
                0
            ]
        )
    np.testing.assert_array_equal(offsets[0], offsets[1])


def test_dynamic_compensator_follows_a_sine_that_gravity_alone_does_not() -> None:
    """Catches a wrong share of D, B, servo or timing: on the ideal plant `dynamic` is ten times
    better than `input`."""
    reference = {"kind": "sine", "frequency_hz": 0.25, "duration_s": 1.0, "onset_s": 1.0}
    rms = {
        name: (
            evaluate(
                Condition(policy=PolicySpec(name=name), reference=reference, scenario="ideal"),
                num_threads=1,
            ).values("link_error_rms_rad")[0]
        )
        for name in ("input", "dynamic")
    }
    assert rms["dynamic"] < 2e-4
    assert rms["input"] > 2e-3


def test_inverse_dynamics_of_the_pendulum_in_closed_form() -> None:
    """Catches rates or accelerations in the wrong order, which static tests do not see: τ = I q̈
    + G sin q."""
    q, q_dot, q_ddot = np.random.default_rng(5).uniform(-2.0, 2.0, (3, 20, 1))
    model = pendulum()
    torque = RigidBody(model.rigid, model.joint_names).inverse_dynamics(q, q_dot, q_ddot)
    np.testing.assert_allclose(
        torque, Pendulum().inertia * q_ddot + G * np.sin(q), rtol=0.0, atol=1e-12
    )
