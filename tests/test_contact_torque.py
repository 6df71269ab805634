"""Joint torques of the standing walker against MuJoCo, Pinocchio, differences, published numbers
and its springs."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.compensators import GravityCompensator, taylor_link_angle
from baselines.compensation.contact_torque import PlannedTorque, WrenchTorque, gravity_in_pelvis
from baselines.compensation.dynamic_compensator import DynamicCompensator
from baselines.compensation.gravity_torque import GravityModel, make_gravity
from baselines.compensation.policy import Motion
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.rigid.floating_body import FloatingBody
from elastic_env.rigid.leg_kinematics import foot_pose
from elastic_env.robots.thormang.config import WalkConfig
from elastic_env.robots.thormang.model import ANKLE_HEIGHT_M, LEG, LEG_JOINTS
from elastic_env.robots.thormang.task import WalkTask
from elastic_env.world.robot_model import WalkerModel
from elastic_env.world.scenario import make_scenario
from elastic_env.world.walk_kernels import attitude_from_vertical
from tests.trees import pendulum

WEIGHT_N = 57.0 * 9.81
METHODS = ("com", "ankle", "lumped")
SIDES = pytest.mark.parametrize("side", [0, 1], ids=["left", "right"])
OF_LEFT = {name.removeprefix("l_"): i for i, name in enumerate(LEG_JOINTS[:6])}


@cache
def task() -> WalkTask:
    """Rules of the walk in the paper's gait of 3 s."""
    return WalkTask(WalkConfig(), 1)


def model() -> WalkerModel:
    """What is assumed of its robot."""
    assumed = task().assumed_model
    assert isinstance(assumed, WalkerModel)
    return assumed


def rows(num_worlds: int, **groups: Any) -> Array:
    """Observations that hold the given groups of signals and zeros elsewhere, (num_worlds, m)."""
    table = model().observation_table
    observation = np.zeros((num_worlds, len(table)))
    for name, values in groups.items():
        observation[:, table.group(name)] = values
    return observation


def rotation(attitude: Array, yaw: float = 0.0) -> Array:
    """Orientation of a pelvis with yaw, pitch and roll, turned in this order."""
    return Rotation.from_euler("ZYX", [yaw, attitude[1], attitude[0]]).as_matrix()


def posed(q: Array, attitude: Array) -> mujoco.MjData:
    """MuJoCo's rigid floating robot at rest."""
    rigid = model().biped.rigid
    data = mujoco.MjData(rigid)
    data.qpos[:3] = [0.3, -0.2, 0.9]
    data.qpos[3:7] = Rotation.from_matrix(rotation(attitude)).as_quat(scalar_first=True)
    for name, angle in zip(LEG_JOINTS, q, strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_forward(rigid, data)
    return data


def torque_of_mujoco(data: mujoco.MjData, points: Array, forces: Array) -> tuple[Array, Array]:
    """What holds the robot at rest under forces on its feet at points, (2, 3) each: on the base
    (6,), joints (12,)."""
    rigid = model().biped.rigid
    effort = data.qfrc_bias.copy()
    for side, point, force in zip("lr", points, forces, strict=True):
        jacobian = np.zeros((3, rigid.nv))
        mujoco.mj_jac(rigid, data, jacobian, None, point, rigid.body(f"{side}_foot").id)
        effort -= jacobian.T @ force
    return effort[:6], effort[[rigid.joint(name).dofadr[0] for name in LEG_JOINTS]]


def center_of_mass(data: mujoco.MjData) -> Array:
    """Center of mass of the robot, (3,) [m]."""
    return data.body("pelvis").subtree_com


def standing_over(point: Array, lift: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Joint angles with level pelvis, hip axes at 0.66 m, that put the COM of the robot over a
    point, (12,) [rad]."""
    biped = model().biped
    ankles = np.column_stack([biped.footholds, ANKLE_HEIGHT_M + np.array(lift)])
    body = FloatingBody(biped.rigid, LEG_JOINTS)
    pelvis = np.array([*point, 0.66])
    for _ in range(60):
        q = biped.joint_angles(pelvis, ankles)
        pelvis[:2] += point - pelvis[:2] - body.center_of_mass(q[None])[0, :2]
    return q


def central_differences(gravity: GravityModel, q: Array, step: float = 1e-5) -> Array:
    """∂τ_i/∂q_j of every row, (N, 12, 12) [N·m/rad]."""
    columns = [
        gravity.gravity_torque(q + step * e) - gravity.gravity_torque(q - step * e)
        for e in np.eye(12)
    ]
    return np.stack(columns, axis=-1) / (2.0 * step)


def random_loads(generator: np.random.Generator, n: int) -> Array:
    """Observations with random shares, ZMPs, attitudes and foot wrenches, (n, m)."""
    return rows(
        n,
        load_share=generator.uniform(0.0, 1.0, (n, 1)),
        zmp_reference=generator.uniform(-0.1, 0.1, (n, 2)),
        imu_attitude=generator.uniform(-0.3, 0.3, (n, 2)),
        wrench=generator.uniform(-1.0, 1.0, (n, 12))
        * np.tile([50.0, 50.0, 500.0, 20.0, 20.0, 5.0], 2),
    )


@SIDES
def test_com_is_the_multibody_torque_in_single_support(side: int) -> None:
    """Catches a wrong sign, lever, frame or share of Eq. 4: MuJoCo's robot on one foot, COM over
    the ZMP, is at rest.

    Any attitude and any posture: the vertical through the COM meets the sole where the force acts.
    """
    generator = np.random.default_rng(1 + side)
    force = np.zeros((2, 3))
    force[side, 2] = WEIGHT_N
    for _ in range(20):
        q = generator.uniform(-0.5, 0.5, 12)
        attitude = generator.uniform(-0.3, 0.3, 2)
        data = posed(q, attitude)
        foot = data.body(f"{'lr'[side]}_foot")
        R = foot.xmat.reshape(3, 3)
        com = R.T @ (center_of_mass(data) - foot.xpos)
        down = -R[2]
        in_sole = com - down * (com[2] + ANKLE_HEIGHT_M) / down[2]
        point = foot.xpos + R @ in_sole
        base, expected = torque_of_mujoco(data, np.tile(point, (2, 1)), force)
        np.testing.assert_allclose(base, 0.0, rtol=0.0, atol=1e-9)
        zmp = model().biped.footholds[side] + in_sole[:2]
        observation = rows(1, load_share=side, zmp_reference=zmp, imu_attitude=attitude)
        torque = (
            make_gravity(model(), "com").at(observation, level=False).gravity_torque(q[None])[0]
        )
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_com_is_the_multibody_torque_in_double_support(share: float) -> None:
    """Catches Eq. 5 with the shares swapped, and a share that is not taken at a point of its own
    foot.

    MuJoCo's robot on both feet, the ZMP between them and 0.03 m ahead: nothing is left over for the
    base.
    """
    footholds = model().biped.footholds
    ahead = np.array([0.03, 0.0])
    weights = np.array([1.0 - share, share])
    zmp = weights @ footholds + ahead
    q = standing_over(zmp)
    data = posed(q, np.zeros(2))
    below = np.array([*ahead, -ANKLE_HEIGHT_M])
    points = np.array([data.body(f"{side}_foot").xpos + below for side in "lr"])
    base, expected = torque_of_mujoco(data, points, weights[:, None] * [0.0, 0.0, WEIGHT_N])
    np.testing.assert_allclose(base, 0.0, rtol=0.0, atol=1e-9)
    gravity = make_gravity(model()).at(
        rows(1, load_share=share, zmp_reference=zmp)
    )  # the default is "com"
    np.testing.assert_allclose(gravity.gravity_torque(q[None])[0], expected, rtol=0.0, atol=1e-9)


def test_com_is_equation_4_with_explicit_jacobians() -> None:
    """Catches J^T F that is not from the COM to the contact points: Pinocchio's COM and the closed
    form of the legs.

    The ground's forces μF and (1 − μ)F act at fixed points of the feet; the Jacobians are central
    differences.
    """
    generator = np.random.default_rng(3)
    biped = model().biped
    body = FloatingBody(biped.rigid, LEG_JOINTS)
    step = 1e-5
    for _ in range(5):
        q = generator.uniform(-0.5, 0.5, 12)
        share = float(generator.uniform())
        weights = np.array([1.0 - share, share])
        ahead = generator.uniform(-0.05, 0.05, 2)

        def arms(angles: Array, in_sole: Array) -> Array:
            """From the COM to the contact point of each foot, (2, 3)."""
            position, R = foot_pose(LEG, angles.reshape(2, 6))
            return biped.hips + position + R @ in_sole - body.center_of_mass(angles[None])

        in_sole = np.array([*ahead, -ANKLE_HEIGHT_M])
        moved = [arms(q + step * e, in_sole) - arms(q - step * e, in_sole) for e in np.eye(12)]
        J = np.stack(moved, axis=-1) / (2.0 * step)  # (2, 3, 12)
        on_ground = weights[:, None] * [0.0, 0.0, -WEIGHT_N]
        expected = np.einsum("fij,fi->j", J, on_ground)
        observation = rows(1, load_share=share, zmp_reference=weights @ biped.footholds + ahead)
        torque = make_gravity(model(), "com").at(observation).gravity_torque(q[None])[0]
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-6)


def test_unloaded_legs_weigh_what_pinocchio_says() -> None:
    """Catches a leg without weight where its foot is not loaded: Pinocchio's gravity torque of a
    robot in the air."""
    q = np.random.default_rng(4).uniform(-0.6, 0.6, (10, 12))
    zero = np.zeros_like(q)
    body = FloatingBody(model().biped.rigid, LEG_JOINTS)
    _, expected = body.inverse_dynamics(q, np.zeros((10, 4)), zero, np.zeros((10, 4)), zero)
    gravity = make_gravity(model(), "com")
    for side in (0, 1):  # the weight on the other foot
        torque = gravity.at(rows(10, load_share=1 - side)).gravity_torque(q)
        leg = slice(6 * side, 6 * side + 6)
        np.testing.assert_allclose(torque[:, leg], expected[:, leg], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("inward", "hip_roll", "ankle_roll", "knee", "hip_pitch"),
    [(0.0, 65.5, 0.0, 36.0, 8.3), (0.02, 64.0, 11.2, 40.0, 8.7), (0.04, 62.5, 22.4, 44.0, 9.0)],
)
def test_com_has_the_published_torques_of_the_stance_leg(
    inward: float, hip_roll: float, ankle_roll: float, knee: float, hip_pitch: float
) -> None:
    """Catches a contact that does not follow the ZMP: left stance, right foot 0.05 m up, ZMP
    inward of the ankle."""
    zmp = model().biped.footholds[0] - [0.0, inward]
    q = standing_over(zmp, (0.0, 0.05))
    torque = make_gravity(model(), "com").at(rows(1, zmp_reference=zmp)).gravity_torque(q[None])[0]
    assert torque[OF_LEFT["hip_roll"]] == pytest.approx(hip_roll, abs=0.1)
    assert torque[OF_LEFT["ankle_roll"]] == pytest.approx(ankle_roll, abs=0.1)
    assert -torque[OF_LEFT["knee"]] == pytest.approx(knee, abs=0.6)
    assert torque[OF_LEFT["hip_pitch"]] == pytest.approx(hip_pitch, abs=0.1)


def test_contact_at_the_ankle_axes_leaves_the_ankles_without_torque() -> None:
    """Catches `ankle` and `lumped` with the force at the ZMP, and legs that weigh something in
    `lumped`.

    Left stance with the ZMP 0.02 m inward: 60.4 N·m at the hip, not 71.5, and nothing but the foot
    on the ankle.
    """
    zmp = model().biped.footholds[0] - [0.0, 0.02]
    q = standing_over(zmp, (0.0, 0.05))
    observation = rows(1, zmp_reference=zmp)
    com, ankle, lumped = (
        make_gravity(model(), m).at(observation).gravity_torque(q[None])[0] for m in METHODS
    )
    left = slice(4, 6)
    hip = OF_LEFT["hip_roll"]
    np.testing.assert_allclose(lumped[left], 0.0, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        lumped[6:], 0.0, rtol=0.0, atol=1e-12
    )  # the right leg: no load, no weight
    assert lumped[hip] == pytest.approx(60.4, abs=0.1)
    assert np.abs(ankle[left]).max() < 0.1
    np.testing.assert_allclose(ankle[6:], com[6:], rtol=0.0, atol=1e-12)
    # the force at the ankle and not at the ZMP: 0.02 m times the weight on every roll axis of the
    # leg
    np.testing.assert_allclose((com - ankle)[[hip, 5]], 0.02 * WEIGHT_N, rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_gradients_of_the_gravity_torque_are_its_derivatives(method: str) -> None:
    """Catches a transposed or incomplete block, legs that couple, a contact point that stays
    when its foot moves."""
    generator = np.random.default_rng(5)
    q = generator.uniform(-0.6, 0.6, (6, 12))
    gravity = make_gravity(model(), method).at(random_loads(generator, 6), level=False)
    expected = central_differences(gravity, q)
    np.testing.assert_allclose(gravity.gravity_gradient(q), expected, rtol=0.0, atol=2e-7)
    assert np.abs(expected).max() > 100.0


def test_gradient_of_the_measured_wrench_turns_with_the_foot() -> None:
    """Catches the Hessian of a fixed force for a wrench that is measured in the foot: its
    gradient is not symmetric."""
    generator = np.random.default_rng(6)
    q = generator.uniform(-0.6, 0.6, (6, 12))
    load = WrenchTorque(model()).at(random_loads(generator, 6))
    expected = central_differences(load, q)
    np.testing.assert_allclose(load.gravity_gradient(q), expected, rtol=0.0, atol=2e-7)
    assert np.abs(expected - expected.swapaxes(-1, -2)).max() > 100.0


@pytest.mark.parametrize("method", [*METHODS, "wrench"])
def test_rows_of_a_batch_are_the_single_walkers_exactly(method: str) -> None:
    """Catches loads of one world that reach another, and results that depend on the size of the
    batch."""
    generator = np.random.default_rng(7)
    q = generator.uniform(-0.6, 0.6, (5, 12))
    observation = random_loads(generator, 5)
    source = WrenchTorque(model()) if method == "wrench" else make_gravity(model(), method)
    together = source.at(observation, level=False)
    torque = together.gravity_torque(q)
    gradient = together.gravity_gradient(q)
    for i in range(5):
        alone = source.at(observation[i : i + 1], level=False)
        np.testing.assert_array_equal(torque[i], alone.gravity_torque(q[i : i + 1])[0])
        np.testing.assert_array_equal(gradient[i], alone.gravity_gradient(q[i : i + 1])[0])


def test_gravity_in_the_pelvis_is_the_turned_vertical() -> None:
    """Catches a flipped roll or pitch, and the rotations in the wrong order: R^T g for any yaw,
    pitch, roll."""
    generator = np.random.default_rng(8)
    attitudes = generator.uniform(-1.2, 1.2, (30, 2))
    yaws = generator.uniform(-3.0, 3.0, 30)
    R = np.stack([rotation(attitude, yaw) for attitude, yaw in zip(attitudes, yaws, strict=True)])
    expected = R.swapaxes(-1, -2) @ [0.0, 0.0, -9.81]
    turned = [gravity_in_pelvis(*attitude, 9.81) for attitude in attitudes]
    np.testing.assert_allclose(turned, expected, rtol=0.0, atol=1e-14)
    turned = [
        gravity_in_pelvis(*attitude_from_vertical(*vertical)[:2], 9.81) for vertical in R[:, 2]
    ]
    np.testing.assert_allclose(turned, expected, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("method", METHODS)
def test_level_ignores_the_imu(method: str) -> None:
    """Catches an input compensation that leans with the robot: the commanded posture has a level
    pelvis."""
    q = np.random.default_rng(9).uniform(-0.5, 0.5, (1, 12))
    gravity = make_gravity(model(), method)
    tilted, upright = (
        rows(1, load_share=0.3, imu_attitude=attitude) for attitude in ([0.1, -0.2], [0.0, 0.0])
    )
    level = gravity.at(tilted).gravity_torque(q)
    np.testing.assert_array_equal(level, gravity.at(upright).gravity_torque(q))
    assert np.abs(gravity.at(tilted, level=False).gravity_torque(q) - level).max() > 5.0


@pytest.mark.parametrize("method", ["symbolic", "hinge", "tree"])
def test_unknown_method_of_a_walker_lists_the_choices(method: str) -> None:
    """Catches a silent fallback to `com`, also for the methods of the robot on a fixed base."""
    with pytest.raises(
        ConfigurationError, match=rf"gravity method of a walker '{method}'.*com, ankle, lumped"
    ):
        make_gravity(model(), method)  # type: ignore[arg-type]


@pytest.mark.parametrize("method", METHODS)
def test_a_robot_without_feet_has_no_contact_method(method: str) -> None:
    """Catches a method of the walker that a pendulum accepts."""
    with pytest.raises(ConfigurationError, match=rf"gravity method '{method}'.*hinge, tree"):
        make_gravity(pendulum(), method)  # type: ignore[arg-type]


def test_a_robot_without_feet_has_no_wrenches() -> None:
    """Catches an output compensator that falls back to gravity where there is no force-torque
    sensor."""
    with pytest.raises(ConfigurationError, match=r"'wrench' needs a walker"):
        GravityCompensator(pendulum(), output="wrench")


@cache
def at_rest(seed: int | None) -> SimpleNamespace:
    """The elastic robot at rest, by MuJoCo alone: its `observation`, `theta`, `q`, and torque `tau`
    of the springs.

    Args:
        seed: Of random offsets of all commands, or None for the commanded posture of the plan.
    """
    plant = WalkConfig(scenario=make_scenario("ideal")).true_model()
    plan = model().plan
    plant.tendon_damping[:] = 50.0  # so that it stands still soon
    at = JointAddresses.of(plant, LEG_JOINTS)
    data = mujoco.MjData(plant)
    offset = np.zeros(12) if seed is None else np.random.default_rng(seed).uniform(-0.02, 0.02, 12)
    data.qpos[:3] = plan.pelvis[0]
    data.ctrl[:] = plan.q[0] + offset
    data.qpos[at.theta] = data.qpos[at.q] = plan.q[0]
    mujoco.mj_step(plant, data, 6000)
    mujoco.mj_forward(plant, data)
    assert np.abs(data.qvel).max() < 1e-3
    theta = data.qpos[at.theta]
    q = data.qpos[at.q]
    _, pitch, roll = Rotation.from_quat(data.qpos[3:7], scalar_first=True).as_euler("ZYX")
    # MuJoCo's sensors give what the leg does to the foot; the robot's, what the foot does to the
    # leg
    observation = rows(1, encoder_angle=theta, imu_attitude=[roll, pitch], wrench=-data.sensordata)
    return SimpleNamespace(
        observation=observation, theta=theta[None], q=q[None], tau=model().stiffness * (theta - q)
    )


RESTING = pytest.mark.parametrize("seed", [None, 1, 2], ids=["planned", "posture 1", "posture 2"])


@RESTING
def test_torque_of_the_measured_wrenches_is_that_of_the_springs(seed: int | None) -> None:
    """Catches a wrench of the wrong sign or frame, and a foot beyond its sensor that is weighed
    twice or not at all."""
    rest = at_rest(seed)
    load = WrenchTorque(model()).at(rest.observation)
    np.testing.assert_allclose(load.gravity_torque(rest.q)[0], rest.tau, rtol=0.0, atol=0.05)


@RESTING
def test_equation_12_with_the_measured_wrenches_finds_the_links(seed: int | None) -> None:
    """Catches a wrong torque or gradient where it matters: the links of a sagging robot within
    0.1 mrad."""
    rest = at_rest(seed)
    load = WrenchTorque(model()).at(rest.observation)
    estimate = taylor_link_angle(rest.theta, model().stiffness, load)
    assert np.abs(rest.theta - rest.q).max() > 0.02
    np.testing.assert_allclose(estimate, rest.q, rtol=0.0, atol=1e-4)


@SIDES
def test_a_hanging_foot_pulls_on_its_sensor_and_is_weighed_once(side: int) -> None:
    """Catches the weight of the foot counted twice: a leg in the air, whose sensor shows −m g of
    its foot.

    MuJoCo's rigid robot gives the torque of the whole leg, the foot included.
    """
    generator = np.random.default_rng(10 + side)
    rigid = model().biped.rigid
    name = f"{'lr'[side]}_foot"
    leg = slice(6 * side, 6 * side + 6)
    for _ in range(5):
        q = generator.uniform(-0.5, 0.5, 12)
        attitude = generator.uniform(-0.3, 0.3, 2)
        data = posed(q, attitude)
        R = data.body(name).xmat.reshape(3, 3)
        pull = R.T @ [0.0, 0.0, -9.81 * rigid.body(name).mass[0]]
        wrench = np.zeros((2, 2, 3))
        wrench[side] = pull, np.cross(rigid.body(name).ipos, pull)
        load = WrenchTorque(model()).at(rows(1, imu_attitude=attitude, wrench=wrench.ravel()))
        _, expected = torque_of_mujoco(data, np.zeros((2, 3)), np.zeros((2, 3)))
        np.testing.assert_allclose(
            load.gravity_torque(q[None])[0, leg], expected[leg], rtol=0.0, atol=1e-9
        )


def planned_rows(steps: Array) -> Array:
    """Observations that show the plan at control steps."""
    plan = model().plan
    observation = rows(
        len(steps),
        reference_angle=plan.q[steps],
        load_share=plan.share[steps][:, None],
        zmp_reference=plan.zmp[steps],
    )
    observation[:, model().observation_table.names.index("clock.time")] = plan.timing.time[steps]
    return observation


def test_planned_torque_is_that_of_the_control_step() -> None:
    """Catches a row of another time, or of another world: on the reference it is the plan's
    inverse dynamics itself."""
    plan = model().plan
    steps = np.array([1, 400, 777, 1500])
    observation = planned_rows(steps)
    planned = PlannedTorque(model(), make_gravity(model())).at(observation)
    torque = planned.inverse_dynamics(plan.q[steps], plan.q_dot[steps], plan.q_ddot[steps])
    np.testing.assert_allclose(torque, plan.torque[steps], rtol=0.0, atol=1e-10)
    assert np.abs(np.diff(torque, axis=0)).max() > 10.0  # and these rows do differ


def test_a_shifted_zmp_loads_the_planned_joints() -> None:
    """Catches a shift that cancels out of the planned torque: ankles carry the weight by the
    shift."""
    steps = np.array([1, 100])
    observation = planned_rows(steps)
    zmp = model().observation_table.group("zmp_reference")
    observation[:, zmp] += [0.02, 0.0]
    gravity = make_gravity(model(), "com")
    q = model().plan.q[steps]
    torque = PlannedTorque(model(), gravity).at(observation).inverse_dynamics(q, q, q)
    change = (torque - model().plan.torque[steps])[:, [4, 10]].sum(axis=1)
    np.testing.assert_allclose(np.abs(change), 0.02 * model().biped.weight, rtol=0.01)


def test_planned_torque_beside_the_reference_differs_by_the_static_torque() -> None:
    """Catches an offset that is ignored, or whose static difference has the wrong sign."""
    plan = model().plan
    steps = np.array([400, 777])
    observation = planned_rows(steps)
    gravity = make_gravity(model(), "com")
    planned = PlannedTorque(model(), gravity).at(observation)
    q = plan.q[steps] + np.random.default_rng(11).uniform(-0.02, 0.02, (2, 12))
    change = planned.inverse_dynamics(q, plan.q_dot[steps], plan.q_ddot[steps]) - plan.torque[steps]
    middle = 0.5 * (q + plan.q[steps])
    gradient = central_differences(gravity.at(observation), middle)
    expected = np.einsum("wij,wj->wi", gradient, q - plan.q[steps])
    np.testing.assert_allclose(change, expected, rtol=0.0, atol=0.005)  # third order of the offset
    assert np.abs(expected).max() > 2.0


def test_a_tilted_pelvis_bends_the_planned_joints_further() -> None:
    """Catches a planned deflection that knows nothing of the attitude, and the other sign of it.

    A robot that leans forward hangs forward in its ankles.
    """
    steps = np.array([1, 777])
    level = planned_rows(steps)
    tilted = level.copy()
    tilted[:, model().observation_table.group("imu_attitude")] = [0.0, 0.05]
    compensator = DynamicCompensator(model(), "taylor")
    theta = model().plan.q[steps]
    memory = compensator.at(level).begin(Motion(theta, theta, theta))
    found = [compensator.at(rows).link_angle(theta, memory) for rows in (level, tilted)]
    np.testing.assert_array_equal(found[0], theta - memory.deflection)
    static = GravityCompensator(model(), "taylor")
    eq_12 = [static.at(rows).link_angle(theta) for rows in (level, tilted)]
    np.testing.assert_allclose(found[1] - found[0], eq_12[1] - eq_12[0], rtol=0.0, atol=1e-15)
    assert np.abs(found[1] - found[0]).max() > 1e-3


def test_output_compensator_finds_the_links_of_the_sagging_robot() -> None:
    """Catches Eq. 12 without the gradient or the attitude: uncompensated, links stand up to 26 mrad
    off their motors.

    Told where the ZMP really is, Eqs. 4 to 6 know all torques in the sagittal plane; across, the
    feet squeeze the legs.
    """
    env: Any = gymnasium.make(
        "elastic_env/WalkInPlace-v0", step_period=24.0, num_steps=1, scenario="ideal"
    )
    observation, info = env.reset(seed=0)
    truth = env.unwrapped.truth()
    observation[model().observation_table.group("zmp_reference")] = info["zmp_x"], info["zmp_y"]
    estimate = (
        GravityCompensator(model(), "taylor")
        .at(observation[None])
        .link_angle(truth.theta, np.zeros((1, 0)))
    )
    error = np.abs(estimate - truth.q)[0]
    sagittal = [2, 3, 4, 8, 9, 10]
    assert np.abs(truth.theta - truth.q).max() > 0.02
    assert error[sagittal].max() < 1e-4
    assert error.max() < 1.5e-3


def test_output_compensator_finds_the_links_of_the_compensated_robot() -> None:
    """Catches an estimate that trusts the encoders: with Eq. 9 on the command they lead the
    links by over 20 mrad."""
    env: Any = gymnasium.make(
        "elastic_env/WalkInPlace-v0", step_period=24.0, num_steps=1, scenario="ideal"
    )
    policy = baselines.make("input_open", env)
    observation, _ = env.reset(seed=0)
    state = None
    for step in range(300):
        action, state = policy.predict(observation, state, step == 0)
        observation, *_ = env.step(action)
    truth = env.unwrapped.truth()
    estimate = (
        GravityCompensator(model(), "taylor")
        .at(observation[None])
        .link_angle(truth.theta, np.zeros((1, 0)))
    )
    assert np.abs(truth.theta - truth.q).max() > 0.02
    np.testing.assert_allclose(estimate, truth.q, rtol=0.0, atol=1e-3)


def test_angles_that_change_in_place_are_new_angles() -> None:
    """Catches a result that is kept by the identity of an array."""
    static = make_gravity(model(), "com").at(rows(2, load_share=0.3))
    q = np.full((2, 12), 0.1)
    static.gravity_torque(q)
    q += 0.2
    fresh = make_gravity(model(), "com").at(rows(2, load_share=0.3))
    np.testing.assert_array_equal(static.gravity_torque(q), fresh.gravity_torque(q.copy()))
