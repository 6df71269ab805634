"""Statics of the legs: MuJoCo's kinematics, bias forces and contact Jacobians, Pinocchio, finite
differences."""

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from elastic_env.core.signals import Array
from elastic_env.rigid.floating_body import FloatingBody
from elastic_env.rigid.leg_chains import LegChains, LegTorque
from elastic_env.rigid.tree import kernels
from elastic_env.robots.thormang.model import LEG_JOINTS, Thormang, biped
from tests.legs import foot_frames, gradient_of, holding_torque, torque_of

ROBOT = biped(Thormang())
AXES = (1, 0, 2, 1)  # y, x, z, y
SPIDER = [[f"leg{leg}_joint{j}" for j in range(len(AXES))] for leg in range(3)]


def spider_spec() -> mujoco.MjSpec:
    """A trunk in the air, tilted gravity, three legs of four hinges, all of them different."""
    generator = np.random.default_rng(5)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.gravity = [1.3, -0.7, -9.2]
    trunk = spec.worldbody.add_body(name="trunk", pos=[0.4, -0.3, 0.9], quat=[0.8, 0.1, -0.5, 0.3])
    trunk.add_freejoint(name="base")
    add_inertia(trunk, generator)
    head = trunk.add_body(name="head", pos=[0.1, 0.2, 0.3], quat=[0.9, 0.3, 0.1, 0.2])
    add_inertia(head, generator)
    for names in SPIDER:
        body = trunk
        for name, axis in zip(names, AXES, strict=True):
            body = body.add_body(name=f"{name}_link", pos=generator.uniform(-0.4, 0.4, 3))
            body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=np.eye(3)[axis])
            add_inertia(body, generator)
    return spec


def add_inertia(body: Any, generator: np.random.Generator) -> None:
    """A random mass with a turned inertia off the origin."""
    body.mass = generator.uniform(0.5, 4.0)
    body.ipos = generator.uniform(-0.2, 0.2, 3)
    body.iquat = [0.7, 0.1, 0.5, 0.5]
    body.inertia = generator.uniform(0.02, 0.03, 3)
    body.explicitinertial = True


def crooked_spec() -> mujoco.MjSpec:
    """That spider with a turned link, hinges off their link's origin and a slanted axis."""
    spec = spider_spec()
    spec.body("leg1_joint2_link").quat = [0.99, 0.1, 0.0, 0.0]
    spec.joint("leg0_joint1").pos = [0.0, 0.0, 0.01]
    spec.joint("leg0_joint3").pos = [0.02, 0.0, 0.01]
    spec.joint("leg2_joint0").axis = [0.0, 1.0, 0.1]
    spec.joint("leg1_joint0").axis = [0.0, -1.0, 0.0]
    return spec


SPIDER_MODEL = spider_spec().compile()
MODELS = {
    "thormang": (ROBOT.rigid, [list(LEG_JOINTS[:6]), list(LEG_JOINTS[6:])]),
    "loaded thormang": (
        biped(Thormang(torso_load_kg=5.0)).rigid,
        [list(LEG_JOINTS[:6]), list(LEG_JOINTS[6:])],
    ),
    "spider": (SPIDER_MODEL, SPIDER),
    "crooked spider": (crooked_spec().compile(), SPIDER),
}


class Posed:
    """A robot of MuJoCo in a random attitude, as the pelvis sees it."""

    def __init__(self, name: str, seed: int) -> None:
        generator = np.random.default_rng(seed)
        self.model, self.legs = MODELS[name]
        self.data = mujoco.MjData(self.model)
        self.q = generator.uniform(-1.2, 1.2, (len(self.legs), len(self.legs[0])))
        self.data.qpos[:3] = generator.normal(size=3)
        self.data.qpos[3:7] = generator.normal(size=4)
        self.data.qpos[3:7] /= np.linalg.norm(self.data.qpos[3:7])
        self.joints = np.array([[self.model.joint(joint).id for joint in leg] for leg in self.legs])
        self.feet = self.model.jnt_bodyid[self.joints[:, -1]]
        self.set(self.q)
        self.pelvis = self.data.qpos[:3].copy()
        self.R = self.data.xmat[1].reshape(3, 3).copy()
        self.gravity = self.model.opt.gravity @ self.R
        self.force, self.point_of_foot, self.moment = generator.normal(size=(3, len(self.legs), 3))
        self.force = 300.0 * self.force
        self.moment = 20.0 * self.moment

    def set(self, q: Array) -> None:
        """Move the legs."""
        self.data.qpos[self.model.jnt_qposadr[self.joints]] = q
        mujoco.mj_forward(self.model, self.data)

    def seen(self, vectors: Array) -> Array:
        """Vectors of the world in the pelvis frame."""
        return vectors @ self.R

    def point(self, chains: LegChains) -> Array:
        """The points fixed in the feet, in the pelvis frame."""
        ankle, R = foot_frames(chains, self.q)
        return ankle + (R @ self.point_of_foot[..., None])[..., 0]

    def torque(self, q: Array, moment: bool = False) -> Array:
        """Bias force of the rigid robot less JᵀF of forces that are fixed to the pelvis frame,
        (L, J)."""
        self.set(q)
        torque = self.data.qfrc_bias.copy()
        for leg, foot in enumerate(self.feet):
            point = (
                self.data.xpos[foot] + self.data.xmat[foot].reshape(3, 3) @ self.point_of_foot[leg]
            )
            translation, rotation = np.zeros((2, 3, self.model.nv))
            mujoco.mj_jac(self.model, self.data, translation, rotation, point, foot)
            torque -= translation.T @ self.R @ self.force[leg]
            if moment:
                torque -= rotation.T @ self.R @ self.moment[leg]
        return torque[self.model.jnt_dofadr[self.joints]]


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("seed", range(3))
def test_feet_are_where_mujoco_has_them(name: str, seed: int) -> None:
    """Catches a link that turns about the wrong axis or sense, or whose offset is lost."""
    posed = Posed(name, seed)
    ankle, R = foot_frames(LegChains(posed.model, posed.legs), posed.q)
    np.testing.assert_allclose(
        ankle, posed.seen(posed.data.xpos[posed.feet] - posed.pelvis), rtol=0.0, atol=1e-12
    )
    np.testing.assert_allclose(
        R, posed.R.T @ posed.data.xmat[posed.feet].reshape(-1, 3, 3), rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize("name", MODELS)
def test_center_of_mass_is_that_of_mujoco_and_of_pinocchio(name: str) -> None:
    """Catches a body of the trunk that is left out, counted twice, or not turned into the pelvis
    frame."""
    for seed in range(5):
        posed = Posed(name, seed)
        chains = LegChains(posed.model, posed.legs)
        com = chains.center_of_mass(posed.q.reshape(1, -1))[0]
        np.testing.assert_allclose(
            com, posed.seen(posed.data.subtree_com[0] - posed.pelvis), rtol=0.0, atol=1e-12
        )
        assert chains.mass == pytest.approx(mujoco.mj_getTotalmass(posed.model), rel=1e-14)
        names = [joint for leg in posed.legs for joint in leg]
        level = FloatingBody(posed.model, names).center_of_mass(posed.q.reshape(1, -1))[0]
        np.testing.assert_allclose(com, level, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_holding_torque_is_the_bias_force_less_the_contact_forces(name: str) -> None:
    """Catches a sign or lever of Eq. 4, a leg without its own weight, and a moment that is lost."""
    for seed in range(10):
        posed = Posed(name, seed)
        chains = LegChains(posed.model, posed.legs)
        torque = holding_torque(chains, posed.q, posed.gravity, posed.force, posed.point(chains))
        np.testing.assert_allclose(torque, posed.torque(posed.q), rtol=0.0, atol=1e-9)
        torque = holding_torque(
            chains, posed.q, posed.gravity, posed.force, posed.point(chains), posed.moment
        )
        np.testing.assert_allclose(torque, posed.torque(posed.q, moment=True), rtol=0.0, atol=1e-9)
        bias = posed.data.qfrc_bias[posed.model.jnt_dofadr[posed.joints]]
        unloaded = torque_of(chains, posed.q, posed.gravity)
        np.testing.assert_allclose(unloaded, bias, rtol=0.0, atol=1e-9)


def test_holding_torque_is_that_of_pinocchio() -> None:
    """Catches a slip that MuJoCo's conventions would share: gravity torques of the other engine,
    pelvis level."""
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (20, 12))
    still = np.zeros((20, 4))
    rest = np.zeros((20, 12))
    _, expected = FloatingBody(ROBOT.rigid, LEG_JOINTS).inverse_dynamics(
        q, still, rest, still, rest
    )
    torque = ROBOT.chains.torque(ROBOT.chains.loads(1, ROBOT.rigid.opt.gravity), q)
    np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("legs_weigh", [True, False])
def test_a_mass_in_the_foot_is_a_force_that_gravity_directs(name: str, legs_weigh: bool) -> None:
    """Catches a mass whose lever, sign or carrying links are wrong, and weightless legs that
    still weigh."""
    for seed in range(5):
        posed = Posed(name, seed)
        chains = LegChains(posed.model, posed.legs)
        weightless = [] if legs_weigh else posed.model.jnt_bodyid[posed.joints].ravel().tolist()
        loaded = LegChains(posed.model, posed.legs, weightless)
        mass = np.array([-30.0, 12.0, -7.0][: len(posed.legs)])
        posed.force = mass[:, None] * posed.gravity
        expected = holding_torque(chains, posed.q, posed.gravity, posed.force, posed.point(chains))
        if not legs_weigh:
            expected -= torque_of(chains, posed.q, posed.gravity)
        torque = torque_of(loaded, posed.q, posed.gravity, mass=mass, point=posed.point_of_foot)
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-9)
        assert np.abs(expected).max() > 50.0


@pytest.mark.parametrize("name", MODELS)
def test_feet_that_a_sensor_weighs_weigh_nothing(name: str) -> None:
    """Catches feet that still count in the center of mass, the torques or the mass, and links
    that count no more."""
    model, legs = MODELS[name]
    footless = copy.copy(model)
    feet = [int(model.jnt_bodyid[model.joint(leg[-1]).id]) for leg in legs]
    footless.body_mass[feet] = 0.0
    chains = LegChains(model, legs, weightless=feet)
    expected = LegChains(footless, legs)
    q = np.random.default_rng(4).uniform(-1.0, 1.0, (5, len(legs) * len(legs[0])))
    assert chains.mass == pytest.approx(mujoco.mj_getTotalmass(footless), rel=1e-12)
    assert chains.mass < mujoco.mj_getTotalmass(model) - 1.0
    np.testing.assert_allclose(
        chains.center_of_mass(q), expected.center_of_mass(q), rtol=0.0, atol=1e-12
    )
    one, other = (legs.torque(legs.loads(1, model.opt.gravity), q) for legs in (chains, expected))
    np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)
    assert ROBOT.chains_above_feet.mass == pytest.approx(57.0 - 2.0 * 1.616, abs=1e-9)


@pytest.mark.parametrize("name", ["thormang", "spider", "crooked spider"])
def test_gradient_of_weights_is_the_difference_quotient_of_mujocos_torque(name: str) -> None:
    """Catches a force that turns with the foot, a point that stays behind, and a term of j < i
    that is not mirrored."""
    h = 1e-5
    for seed in range(3):
        posed = Posed(name, seed)
        chains = LegChains(posed.model, posed.legs)
        mass = np.array([-30.0, 12.0, -7.0][: len(posed.legs)])
        posed.force = mass[:, None] * posed.gravity
        gradient = gradient_of(chains, posed.q, posed.gravity, mass=mass, point=posed.point_of_foot)
        legs, joints = posed.q.shape
        for j in range(joints):
            step = np.zeros((legs, joints))
            step[:, j] = h
            quotient = (posed.torque(posed.q + step) - posed.torque(posed.q - step)) / (2.0 * h)
            np.testing.assert_allclose(gradient[:, :, j], quotient, rtol=0.0, atol=1e-6)
        np.testing.assert_array_equal(gradient, gradient.swapaxes(-1, -2))
        assert np.abs(gradient).max() > 50.0


@pytest.mark.parametrize("name", ["thormang", "spider", "crooked spider"])
def test_gradient_of_wrenches_is_the_difference_quotient_of_jacobians(name: str) -> None:
    """Catches a wrench that keeps its direction while the foot turns, and a term on or below the
    diagonal.

    The torque of the quotient is MuJoCo's −JᵀF with the wrench turned into the world by MuJoCo's
    foot.
    """
    h = 1e-6

    def torque(posed: Posed, q: Array) -> Array:
        posed.set(q)
        found = np.zeros(posed.model.nv)
        for leg, foot in enumerate(posed.feet):
            R, translation, rotation = (
                posed.data.xmat[foot].reshape(3, 3),
                *np.zeros((2, 3, posed.model.nv)),
            )
            mujoco.mj_jac(
                posed.model, posed.data, translation, rotation, posed.data.xpos[foot], foot
            )
            found -= translation.T @ R @ posed.force[leg] + rotation.T @ R @ posed.moment[leg]
        return found[posed.model.jnt_dofadr[posed.joints]]

    for seed in range(3):
        posed = Posed(name, seed)
        chains = LegChains(posed.model, posed.legs)
        wrench = (posed.force, posed.moment)
        found = torque_of(chains, posed.q, wrench=wrench)
        np.testing.assert_allclose(found, torque(posed, posed.q), rtol=0.0, atol=1e-9)
        gradient = gradient_of(chains, posed.q, wrench=wrench)
        for j in range(posed.q.shape[1]):
            step = np.zeros(posed.q.shape)
            step[:, j] = h
            quotient = (torque(posed, posed.q + step) - torque(posed, posed.q - step)) / (2.0 * h)
            np.testing.assert_allclose(gradient[:, :, j], quotient, rtol=0.0, atol=1e-5)
        np.testing.assert_array_equal(np.tril(gradient), 0.0)
        assert np.abs(gradient).max() > 50.0


def torques_of_figure_1(inward: float) -> dict[str, float]:
    """Left stance, right foot lifted 0.05 m, hip axis at 0.66 m, the center of mass over the
    ZMP."""
    ankles = np.array([[0.0, 0.105, 0.1], [0.0, -0.105, 0.15]])
    zmp = np.array([0.0, 0.105 - inward, 0.0])
    pelvis = np.array([0.0, 0.0, 0.66])
    for _ in range(50):
        q = ROBOT.joint_angles(pelvis, ankles).reshape(2, 6)
        com = ROBOT.chains.center_of_mass(q.reshape(1, -1))[0]
        pelvis[:2] += (zmp - pelvis - com)[:2]
    np.testing.assert_allclose((pelvis + com)[:2], zmp[:2], rtol=0.0, atol=1e-12)
    force = np.array([[0.0, 0.0, 57.0 * 9.81], [0.0, 0.0, 0.0]])
    points = np.tile(zmp - pelvis, (2, 1))
    torque = holding_torque(ROBOT.chains, q, np.array([0.0, 0.0, -9.81]), force, points)
    return dict(zip(LEG_JOINTS, torque.ravel().tolist(), strict=True))


@pytest.mark.parametrize(
    ("inward", "hip_roll", "ankle_roll", "knee", "hip_pitch"),
    [(0.0, 65.5, 0.0, 36.0, 8.3), (0.02, 64.0, 11.2, 40.0, 8.7), (0.04, 62.5, 22.4, 44.0, 9.0)],
)
def test_stance_leg_of_figure_1_holds_what_the_facts_say(
    inward: float, hip_roll: float, ankle_roll: float, knee: float, hip_pitch: float
) -> None:
    """Catches the force at the ankle axis in place of the ZMP: hip roll 60.4 and ankle roll 0
    N·m in the middle row."""
    torque = torques_of_figure_1(inward)
    assert abs(torque["l_hip_roll"]) == pytest.approx(hip_roll, abs=0.1)
    assert abs(torque["l_ankle_roll"]) == pytest.approx(ankle_roll, abs=0.1)
    assert abs(torque["l_knee"]) == pytest.approx(knee, abs=0.5)
    assert abs(torque["l_hip_pitch"]) == pytest.approx(hip_pitch, abs=0.1)


def test_swing_leg_of_figure_1_holds_its_own_weight() -> None:
    """Catches a swing leg without mass: hip roll -5, hip pitch -9, knee 5 N·m."""
    torque = torques_of_figure_1(0.02)
    assert torque["r_hip_roll"] == pytest.approx(-5.0, abs=0.5)
    assert torque["r_hip_pitch"] == pytest.approx(-9.0, abs=0.5)
    assert torque["r_knee"] == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize("rows", [0, 1, 7, kernels.BLOCK, 2 * kernels.BLOCK + 5])
def test_a_row_of_a_batch_is_the_row_alone_bit_for_bit(rows: int) -> None:
    """Catches worlds that are mixed up, and a world whose result depends on how many there are."""
    generator = np.random.default_rng(6)
    chains = LegChains(SPIDER_MODEL, SPIDER)
    q = generator.uniform(-1.0, 1.0, (rows, 12))
    gravity = generator.normal(size=(rows, 3))
    force, offset, moment = generator.normal(size=(3, rows, 3, 3))
    mass = generator.normal(size=(rows, 3))
    stiffness = np.full(12, 200.0)

    def everything(part: slice) -> list[Array]:
        count = len(q[part])
        weights = chains.loads(count, gravity[part], mass[part], offset[part])
        wrenches = chains.loads(count, wrench=(force[part], moment[part]))
        return [
            *chains.com_and_feet(q[part], np.array([0.1, -0.2, 0.3]), gravity[part, :2]),
            *chains.sole_tilts(q[part], gravity[part, :2], q[part]),
            *(chains.torque(loads, q[part]) for loads in (weights, wrenches)),
            *(LegTorque(chains, own).gravity_gradient(q[part]) for own in (weights, wrenches)),
            LegTorque(chains, weights).solve(q[part], stiffness),
            LegTorque(chains, wrenches).solve(q[part], stiffness, q[part]),
        ]

    whole = everything(slice(rows))
    assert [len(result) for result in whole] == [rows] * len(whole)
    for row in range(rows):
        for result, alone in zip(whole, everything(slice(row, row + 1)), strict=True):
            np.testing.assert_array_equal(result[row], alone[0])


def test_a_solution_solves_the_matrix_equation_of_each_leg() -> None:
    """Catches a stiffness of another joint, an elimination that swaps rows wrongly, and a torque
    that is not the given one."""
    generator = np.random.default_rng(8)
    q = generator.uniform(-1.0, 1.0, (5, 12))
    loads = ROBOT.chains.loads(
        5, ROBOT.rigid.opt.gravity, wrench=tuple(generator.normal(0.0, 200.0, (2, 5, 2, 3)))
    )
    stiffness = generator.uniform(50.0, 1500.0, 12)
    for torque in (None, generator.normal(0.0, 30.0, (5, 12))):
        legs = LegTorque(ROBOT.chains, loads)
        x = legs.solve(q, stiffness, torque)
        A = np.diag(stiffness) + legs.gravity_gradient(q)
        expected = legs.gravity_torque(q) if torque is None else torque
        np.testing.assert_allclose((A @ x[..., None])[..., 0], expected, rtol=0.0, atol=1e-9)


def test_one_gravity_serves_a_batch() -> None:
    """Catches a gravity that is needed for each world although it is the same in all of them."""
    q = np.random.default_rng(7).normal(size=(4, 12))
    gravity = np.array([0.1, 0.2, -9.8])
    loads = (ROBOT.chains.loads(count, gravity) for count in (1, 4))
    one, each = (LegTorque(ROBOT.chains, own) for own in loads)
    np.testing.assert_array_equal(one.gravity_torque(q), each.gravity_torque(q))
    np.testing.assert_array_equal(one.gravity_gradient(q), each.gravity_gradient(q))
