"""Contact with the ground: shares by projection, equilibrium of forces, and the ZMP of a robot
standing in MuJoCo."""

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from elastic_env.core.signals import Array
from elastic_env.rigid.contact_force import contact_points, load_share, shares
from elastic_env.robots.thormang.model import LEG_JOINTS, SIDES, Thormang, biped, elastic_spec
from elastic_env.robots.thormang.standing import settle
from elastic_env.world.foot_sensors import FootSensors
from tests.ground_contact import ground_wrench, zero_moment_point
from tests.test_standing import forces_on_the_feet

ROBOT = Thormang()
BIPED = biped(ROBOT)
WEIGHT = 57.0 * 9.81

metres = st.floats(-2.0, 2.0)
points = hnp.arrays(np.float64, 2, elements=metres)
spatial = hnp.arrays(np.float64, 3, elements=st.floats(-100.0, 100.0))


# --------------------------------------------------------------------------------------------------
# Shares of the feet
# --------------------------------------------------------------------------------------------------


@given(points, st.floats(0.1, 2.0), st.floats(-3.0, 3.0), st.floats(-1.5, 2.5), metres)
def test_load_share_is_the_place_between_the_feet(
    left: Array, distance: float, direction: float, place: float, aside: float
) -> None:
    """Catches a share that grows away from the right foot, leaves [0, 1], or feels the offset
    across the feet."""
    along = np.array([np.cos(direction), np.sin(direction)])
    across = np.array([-along[1], along[0]])
    feet = np.stack([left, left + distance * along])
    share = load_share(left + place * distance * along + aside * across, feet)
    np.testing.assert_allclose(share, min(max(place, 0.0), 1.0), rtol=0.0, atol=1e-9)


def test_shares_are_of_the_left_and_of_the_right_foot() -> None:
    """Catches shares in the wrong order, and batches whose feet are mixed up."""
    feet = np.array([[0.0, 0.1], [0.0, -0.1]])
    zmp = np.array([[[0.0, 0.3], [0.0, 0.1], [0.3, 0.05]], [[0.0, 0.0], [0.0, -0.1], [0.0, -0.4]]])
    share = load_share(zmp, feet)
    np.testing.assert_allclose(share, [[0.0, 0.0, 0.25], [0.5, 1.0, 1.0]], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(shares(share)[0, 2], [0.75, 0.25], rtol=0.0, atol=1e-12)
    mirrored = load_share(zmp, np.stack([feet, feet[::-1]])[:, None])
    np.testing.assert_allclose(mirrored, [[0.0, 0.0, 0.25], [0.5, 0.0, 0.0]], rtol=0.0, atol=1e-12)


@given(points, points, points, st.floats(0.0, 1.0), spatial)
def test_forces_at_the_contact_points_act_at_the_zmp(
    left: Array, right: Array, zmp: Array, share: float, force: Array
) -> None:
    """Catches contact points that balance only vertical forces, or only a ZMP between the feet."""
    feet = np.stack([left, right])
    contacts = np.pad(contact_points(zmp, np.array(share), feet), ((0, 0), (0, 1)))
    parts = shares(np.array(share))[:, None] * force
    np.testing.assert_allclose(parts.sum(axis=0), force, rtol=0.0, atol=1e-10)
    expected = np.cross([*zmp, 0.0], force)
    np.testing.assert_allclose(np.cross(contacts, parts).sum(axis=0), expected, rtol=0.0, atol=1e-9)
    # both feet are loaded at the same place of their soles
    np.testing.assert_allclose(
        contacts[0, :2] - left, contacts[1, :2] - right, rtol=0.0, atol=1e-12
    )


@given(points, points, points)
def test_the_foot_that_carries_everything_carries_it_at_the_zmp(
    left: Array, right: Array, zmp: Array
) -> None:
    """Catches a jump at lift-off and touch-down: the contact point of the stance foot is the ZMP
    itself."""
    feet = np.stack([left, right])
    tiny = 1e-9
    for foot in (0, 1):
        there = contact_points(zmp, np.array(float(foot)), feet)[foot]
        np.testing.assert_allclose(there, zmp, rtol=0.0, atol=1e-12)
        nearly = contact_points(zmp, np.array(abs(foot - tiny)), feet)[foot]
        np.testing.assert_allclose(nearly, zmp, rtol=0.0, atol=1e-8)


def test_contact_points_of_a_batch_are_its_rows() -> None:
    """Catches the rest of one world added to the feet of another."""
    generator = np.random.default_rng(0)
    zmp = generator.normal(size=(3, 4, 2))
    feet = generator.normal(size=(3, 4, 2, 2))
    share = generator.random((3, 4))
    whole = contact_points(zmp, share, feet)
    assert whole.shape == (3, 4, 2, 2)
    for row in np.ndindex(3, 4):
        np.testing.assert_array_equal(whole[row], contact_points(zmp[row], share[row], feet[row]))


# --------------------------------------------------------------------------------------------------
# From the sensors to the ZMP
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stance:
    """A robot that stands in MuJoCo on its springs, (2, 3) [N], [N·m], [m] where it is of the feet.

    Attributes:
        data: Its state.
        contact_force, contact_moment: MuJoCo's contact forces on each foot, summed, and their
            moments about the ankles.
        force, moment: The same from the sensors at the ankles.
        ankle: Positions of the ankles.
        foot_R: Orientation of the feet.
        gravity: Acceleration of gravity.
    """

    data: mujoco.MjData
    contact_force: Array
    contact_moment: Array
    force: Array
    moment: Array
    ankle: Array
    foot_R: Array
    gravity: Array


@cache
def stance(slope: float = 0.0, side_gravity: float = 0.0, shift: float = 0.0) -> Stance:
    """Stand at rest, under zero action.

    Args:
        slope: Tilt of the floor about (1, 1, 0) [rad].
        side_gravity: Acceleration of gravity along x; a quarter of it along -y [m/s²].
        shift: Of the pelvis towards the left foot [m].
    """
    model = elastic_spec(ROBOT, ROBOT.joints).compile()
    half = slope / 2.0
    model.body("floor").quat[:] = [
        np.cos(half),
        np.sin(half) / np.sqrt(2.0),
        np.sin(half) / np.sqrt(2.0),
        0.0,
    ]
    model.opt.gravity[:2] = side_gravity * np.array([1.0, -0.25])
    pelvis = np.array([-0.0246, shift, 0.66])
    ankles = np.pad(BIPED.footholds, ((0, 0), (0, 1)), constant_values=BIPED.ankle_height)
    q = BIPED.joint_angles(pelvis, ankles)
    rest = settle(model, LEG_JOINTS, pelvis, q, q)
    model.tendon_damping[:] = 70.0
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = rest.qpos
    data.act[:] = rest.act
    data.ctrl[:] = q
    mujoco.mj_step(model, data, 4000)  # what is left of its sway
    mujoco.mj_forward(model, data)
    feet = [model.body(f"{side}_foot").id for side in SIDES]
    contact_force, contact_moment = forces_on_the_feet(model, data)
    sensors = np.array(
        [[data.sensor(f"{side}_{kind}").data for kind in ("force", "torque")] for side in SIDES]
    )
    foot_R = data.xmat[feet].reshape(2, 3, 3).copy()
    ankle = data.xpos[feet].copy()
    feet_sensors = FootSensors(model.body_mass[feet], model.body_ipos[feet], model.opt.gravity)
    force, moment = ground_wrench(feet_sensors, -sensors, foot_R)
    return Stance(
        data, contact_force, contact_moment, force, moment, ankle, foot_R, model.opt.gravity.copy()
    )


STANCES = {
    "level": {},
    "shifted": {"shift": 0.04},
    "slope": {"slope": 0.03},
    "sideways": {"side_gravity": 0.2},
}


@pytest.mark.parametrize("name", STANCES)
def test_ground_wrench_is_the_sum_of_mujocos_contact_forces(name: str) -> None:
    """Catches the weight of the foot added where it is to be taken off, and a wrench left in the
    frame of the foot."""
    robot = stance(**STANCES[name])
    np.testing.assert_allclose(robot.force, robot.contact_force, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(robot.moment, robot.contact_moment, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(robot.force.sum(axis=0), -57.0 * robot.gravity, rtol=0.0, atol=2e-3)


@pytest.mark.parametrize("name", STANCES)
def test_zmp_at_rest_is_where_gravity_through_the_center_of_mass_meets_the_ground(
    name: str,
) -> None:
    """Catches a ZMP with swapped axes, one of a single foot, and one that forgets the height of
    the ankles."""
    robot = stance(**STANCES[name])
    zmp = zero_moment_point(robot.force, robot.moment, robot.ankle, 0.05 * WEIGHT)
    com = robot.data.body("pelvis").subtree_com
    gravity = robot.gravity
    np.testing.assert_allclose(
        zmp, com[:2] - com[2] * gravity[:2] / gravity[2], rtol=0.0, atol=2e-6
    )


def test_the_stances_differ() -> None:
    """Catches a slope, a shift or a gravity that does not reach the robot, so that the tests
    above are one."""
    robots = {name: stance(**arguments) for name, arguments in STANCES.items()}
    zmp = {name: zero_moment_point(s.force, s.moment, s.ankle, 1.0) for name, s in robots.items()}
    assert zmp["shifted"][1] - zmp["level"][1] > 0.03
    assert np.abs(zmp["slope"] - zmp["level"]).min() > 0.01
    assert np.abs(zmp["sideways"] - zmp["level"]).min() > 0.002
    assert np.abs(robots["slope"].foot_R - np.eye(3)).max() > 0.015


def random_rotation(generator: np.random.Generator) -> Array:
    """An orientation without any preference."""
    R, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    return R * np.sign(np.linalg.det(R))


def test_sensors_in_tilted_feet_give_the_force_that_acts_on_them() -> None:
    """Catches the transposed orientation, the lever of the foot's mass in the wrong frame, and
    mixed-up feet."""
    # what the foot passes on to the leg is the ground's force and its own weight, each with its
    # lever about the ankle
    generator = np.random.default_rng(1)
    foot_R = np.array([[random_rotation(generator) for _ in range(2)] for _ in range(20)])
    mass = np.array([1.6, 2.3])
    com = generator.normal(size=(2, 3))
    gravity = np.array([0.4, -0.8, -9.7])
    ground = 100.0 * generator.normal(size=(20, 2, 3))
    contact = generator.normal(size=(20, 2, 3))
    force, moment = np.empty((2, 20, 2, 3))
    for row, foot in np.ndindex(20, 2):
        R = foot_R[row, foot]
        weight = mass[foot] * gravity
        total = np.cross(contact[row, foot], ground[row, foot]) + np.cross(R @ com[foot], weight)
        force[row, foot] = R.T @ (ground[row, foot] + weight)
        moment[row, foot] = R.T @ total
    f, n = ground_wrench(FootSensors(mass, com, gravity), np.stack([force, moment], axis=2), foot_R)
    np.testing.assert_allclose(f, ground, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(n, np.cross(contact, ground), rtol=0.0, atol=1e-11)


@given(points, points, spatial, spatial, spatial, spatial)
def test_zmp_is_the_center_of_pressure_on_the_ground(
    left: Array, right: Array, ankle: Array, shear: Array, spin: Array, load: Array
) -> None:
    """Catches a ZMP taken at the height of the ankles, and feet that are not weighted by their
    load."""
    # of forces at two points of the ground; horizontal forces there and moments about the vertical
    # do not move it
    vertical = np.abs(load[:2]) + 10.0
    pressed = np.pad(np.stack([left, right]), ((0, 0), (0, 1)))
    force = np.stack([[*shear[:2], vertical[0]], [*spin[:2], vertical[1]]])
    ankles = np.stack([ankle, ankle[::-1]]) / 100.0
    moment = np.cross(pressed - ankles, force) + np.array(
        [[0.0, 0.0, load[2]], [0.0, 0.0, shear[2]]]
    )
    expected = vertical @ pressed[:, :2] / vertical.sum()
    np.testing.assert_allclose(
        zero_moment_point(force, moment, ankles, 5.0), expected, rtol=0.0, atol=1e-9
    )


def test_there_is_no_zmp_without_load() -> None:
    """Catches a division by nothing, a bound for each foot, and a foot in the air that spoils
    the other."""
    force = np.zeros((5, 2, 3))
    moment = np.zeros((5, 2, 3))
    ankle = np.zeros((5, 2, 3))
    ankle[:, 0, 1] = 0.1
    ankle[:, 1, 1] = -0.1
    force[:, :, 2] = [[0.0, 0.0], [15.0, 14.0], [15.0, 15.0], [60.0, 0.0], [-80.0, 20.0]]
    zmp = zero_moment_point(force, moment, ankle, 30.0)
    np.testing.assert_array_equal(np.isnan(zmp[:, 0]), [True, True, False, False, True])
    np.testing.assert_array_equal(np.isnan(zmp[:, 1]), [True, True, False, False, True])
    np.testing.assert_allclose(zmp[2:4], [[0.0, 0.0], [0.0, 0.1]], rtol=0.0, atol=1e-15)
