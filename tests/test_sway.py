"""Sway on the springs: MuJoCo linearised about the stance, and the swing of the simulated robot."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy import linalg

from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.motion.sway import sway_frequencies
from elastic_env.rigid.biped import Biped
from elastic_env.robots.thormang.model import LEG_JOINTS, SIDES, Thormang, biped, elastic_spec
from elastic_env.robots.thormang.standing import settle

ROBOT = Thormang()
BIPED = biped(ROBOT)
UNEQUAL = np.linspace(700.0, 1500.0, 12)


def balanced(robot: Biped, height: float = 0.66) -> Array:
    """Pelvis that brings the center of mass over the middle between the feet."""
    pelvis = np.array([0.0, 0.0, height])
    ankles = np.pad(robot.footholds, ((0, 0), (0, 1)), constant_values=robot.ankle_height)
    for _ in range(50):
        com = robot.chains.center_of_mass(robot.joint_angles(pelvis, ankles)[None])[0]
        pelvis[:2] -= (pelvis + com)[:2]
    return pelvis


def linearised(robot: Biped, pelvis: Array, stiffness: Array) -> Array:
    """Squared angular frequencies of the eighteen coordinates with both feet held, by MuJoCo, (6,)
    [1/s²].

    The forces of the ground stay as they are in the stance; what a small motion along the
    constraints changes in the joint torques, gravity and springs, is the stiffness of the sway.
    """
    model = robot.rigid
    data = mujoco.MjData(model)
    data.qpos[:3] = pelvis
    ankles = np.pad(robot.footholds, ((0, 0), (0, 1)), constant_values=robot.ankle_height)
    at = JointAddresses.of(model, LEG_JOINTS)
    data.qpos[at.q] = robot.joint_angles(pelvis, ankles)
    stance = data.qpos.copy()
    feet = [model.body(f"{side}_foot").id for side in SIDES]
    ground = np.array([0.0, 0.0, model.body_mass.sum() * 9.81 / 2.0])

    def load(qpos: Array) -> tuple[Array, Array]:
        """Generalised force that gravity and ground leave to the springs, and the Jacobian of
        both feet."""
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        jacobians = np.zeros((2, 2, 3, model.nv))
        for foot, body in enumerate(feet):
            mujoco.mj_jacBody(model, data, *jacobians[foot], body)
        force = data.qfrc_bias - jacobians[:, 0].sum(axis=0).T @ ground
        return force, jacobians.reshape(12, model.nv)

    torque, jacobian = load(stance)
    np.testing.assert_allclose(torque[:6], 0.0, atol=1e-8)  # the stance is balanced
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    h = 1e-6
    K = np.zeros((model.nv, model.nv))
    for i in range(model.nv):
        ends = []
        for sign in (1.0, -1.0):
            qpos = stance.copy()
            mujoco.mj_integratePos(model, qpos, sign * h * np.eye(model.nv)[i], 1.0)
            ends.append(load(qpos)[0])
        K[:, i] = (ends[0] - ends[1]) / (2.0 * h)
    K[at.q_dot, at.q_dot] += stiffness
    free = linalg.null_space(jacobian)
    assert free.shape == (18, 6)
    reduced = free.T @ K @ free
    np.testing.assert_allclose(
        reduced, reduced.T, rtol=0.0, atol=1e-3
    )  # a potential's second derivative
    return linalg.eigh((reduced + reduced.T) / 2.0, free.T @ mass @ free, eigvals_only=True)


@pytest.mark.parametrize("stiffness", [np.full(12, 1001.0), UNEQUAL], ids=["equal", "unequal"])
def test_frequencies_are_those_of_mujoco_linearised_about_the_stance(stiffness: Array) -> None:
    """Catches gravity that does not soften, springs of the wrong joints, and a mass matrix
    without the legs."""
    pelvis = balanced(BIPED)
    expected = np.sqrt(linearised(BIPED, pelvis, stiffness))
    np.testing.assert_allclose(sway_frequencies(BIPED, pelvis, stiffness), expected, rtol=1e-5)
    assert expected[0] < 7.0 < 50.0 < expected[-1]


def test_a_stance_elsewhere_sways_alike() -> None:
    """Catches feet that stay under the hips while the pelvis moves on."""
    pelvis = balanced(BIPED)
    stiffness = np.full(12, 1001.0)
    moved = np.array([0.3, -0.2, 0.0])
    there = sway_frequencies(BIPED, pelvis + moved, stiffness, BIPED.ankles + moved)
    np.testing.assert_allclose(there, sway_frequencies(BIPED, pelvis, stiffness), rtol=1e-6)


def test_a_direction_in_which_gravity_wins_has_no_frequency() -> None:
    """Catches the root of a magnitude in place of nan, and an unstable direction that hides the
    stable ones."""
    pelvis = balanced(BIPED)
    soft = np.full(12, 200.0)
    expected = linearised(BIPED, pelvis, soft)
    frequencies = sway_frequencies(BIPED, pelvis, soft)
    np.testing.assert_array_equal(np.isnan(frequencies), expected < 0.0)
    assert np.isnan(frequencies).sum() == 1
    np.testing.assert_allclose(frequencies[1:], np.sqrt(expected[1:]), rtol=1e-5)


def changed(**factors: float) -> Biped:
    """The robot with the masses of its legs or gravity scaled."""
    model = copy.copy(BIPED.rigid)
    links = model.jnt_bodyid[[model.joint(name).id for name in LEG_JOINTS]]
    model.body_mass[links] *= factors.get("legs", 1.0)
    model.body_inertia[links] *= factors.get("legs", 1.0)
    model.opt.gravity[:] *= factors.get("gravity", 1.0)
    return replace(BIPED, rigid=model)


def test_without_gravity_frequencies_grow_with_the_root_of_the_stiffness() -> None:
    """Catches gravity that is built in, and springs that enter other than linearly."""
    weightless = changed(gravity=1e-9)
    pelvis = balanced(BIPED)
    once = sway_frequencies(weightless, pelvis, UNEQUAL)
    np.testing.assert_allclose(
        sway_frequencies(weightless, pelvis, 4.0 * UNEQUAL), 2.0 * once, rtol=1e-6
    )
    assert once[0] > 1.1 * sway_frequencies(BIPED, pelvis, UNEQUAL)[0]


@pytest.mark.parametrize("stiffness", [400.0, 1001.0])
def test_a_trunk_on_massless_legs_sways_sideways_as_an_inverted_pendulum(stiffness: float) -> None:
    r"""Catches a lever or factor that is wrong: ω² = 4K/(m l²) − g/l where only the four roll
    joints give way."""
    robot = changed(legs=1e-7)
    length = 0.66 - 0.1
    springs = np.where(["roll" in name for name in LEG_JOINTS], stiffness, 1e6)
    expected = np.sqrt(4.0 * stiffness / (robot.chains.mass * length**2) - 9.81 / length)
    frequency = sway_frequencies(robot, balanced(robot), springs)[0]
    assert frequency == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("axis", "number", "contact_time_s", "tolerance"),
    [
        pytest.param(0, 0, None, 0.05, marks=pytest.mark.slow),
        (0, 0, 0.002, 0.02),
        (1, 1, 0.002, 0.02),
    ],
    ids=["forwards", "forwards on a hard floor", "sideways on a hard floor"],
)
def test_the_simulated_robot_sways_with_these_frequencies(
    axis: int, number: int, contact_time_s: float | None, tolerance: float
) -> None:
    """Catches a sway of another robot: slow modes of the plant after a small push, its rotors
    too heavy to move."""
    model = elastic_spec(ROBOT, ROBOT.joints).compile()
    pelvis = balanced(BIPED)
    ankles = np.pad(BIPED.footholds, ((0, 0), (0, 1)), constant_values=BIPED.ankle_height)
    q = BIPED.joint_angles(pelvis, ankles)
    rest = settle(model, LEG_JOINTS, pelvis, q, q)
    model.dof_armature[JointAddresses.of(model, LEG_JOINTS).theta_dot] = 1e6
    model.dof_frictionloss[:] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    if contact_time_s is not None:
        model.geom_solref[:, 0] = contact_time_s
    data = mujoco.MjData(model)
    data.qpos[:] = rest.qpos
    data.qvel[axis] = 0.01
    path = np.empty(3000)
    for step in range(len(path)):
        mujoco.mj_step(model, data)
        path[step] = data.qpos[axis]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(path))))
    turns = turns[turns > 100]  # after the feet have taken up the push
    frequency = np.pi / (np.diff(turns).mean() * model.opt.timestep)
    assert len(turns) >= 5
    expected = sway_frequencies(BIPED, pelvis, np.full(12, 1001.0))[number]
    assert frequency == pytest.approx(expected, rel=tolerance)
