"""Named servos against their makers' sheets, in MuJoCo: units at the output shaft."""

import warnings
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware.emulator.joints import Joints
from elastic_env.joint.joint_settings import read_joints
from elastic_env.joint.make_elastic import transform_hinges
from elastic_env.joint.small_servos import SMALL_SERVOS, small_servo
from elastic_env.robots.robot.environment import configure_robot
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.model import Pendulum
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.worlds import SingleWorld
from tests.test_mujoco_friction import rigid_spec

SHEETS = {
    "XL330-M288": (0.52, 103.0),
    "STS3215": (1.91, 45.0),
    "STS3250": (4.90, 75.2),
    "MX-64": (6.0, 63.0),
    "MX-106": (8.4, 45.0),
    "XM430-W350": (4.1, 46.0),
}
"""Stall torque [N·m] and speed without load [rev/min]: ROBOTIS' e-manual at the voltage of the
table, Feetech's 19.5 kg·cm and 50 kg·cm."""


def world(name: str) -> tuple[mujoco.MjModel, SingleWorld]:
    """The servo with a small balanced link."""
    spec = rigid_spec(timestep_s=2e-4)
    model = transform_hinges(spec, {"q": small_servo(name)}).compile()
    return model, SingleWorld(model)


@pytest.mark.parametrize("name", SMALL_SERVOS)
def test_a_named_servo_turns_as_fast_as_its_sheet_says(name: str) -> None:
    """Catches constants of the bare motor, and revolutions in place of radians."""
    model, simulated = world(name)
    simulated.ctrl[0] = 1e4
    simulated.advance(3000)
    sheet = SHEETS[name][1] * 2.0 * np.pi / 60.0
    assert simulated._data.joint("q").qvel[0] == pytest.approx(sheet, rel=0.35)
    assert model.opt.timestep == 2e-4


@pytest.mark.parametrize("name", SMALL_SERVOS)
def test_a_named_servo_lifts_what_its_sheet_says(name: str) -> None:
    """Catches kilograms at a centimetre, and a gear's loss that is counted twice: the load that
    the servo still carries."""
    joint = small_servo(name)
    assert joint.servo is not None
    most = float(joint.servo.largest_torque())
    carried = (1.0 - joint.load_friction) * most - joint.coulomb_friction
    assert carried == pytest.approx(SHEETS[name][0], rel=0.35)


@pytest.mark.parametrize(
    ("name", "gain"),
    [("XL330-M288", 0.84), ("STS3215", 23.9), ("STS3250", 47.6), ("XM430-W350", 22.5)],
)
def test_the_position_gain_is_that_of_the_table(name: str, gain: float) -> None:
    """Catches a register of another unit; k_p grows with register and supply."""
    joint = small_servo(name)
    assert joint.servo is not None
    assert joint.servo.position_gain == pytest.approx(gain, rel=5e-3)
    motor = SMALL_SERVOS[name].motor
    twice = small_servo(name, gain=2.0 * SMALL_SERVOS[name].gain, voltage=0.5 * motor.voltage)
    assert twice.servo is not None
    assert twice.servo.position_gain == pytest.approx(joint.servo.position_gain)
    assert twice.servo.torque_limit == pytest.approx(0.5 * joint.servo.torque_limit)


def test_an_unknown_servo_names_those_that_are_known() -> None:
    """Catches a name that leads nowhere."""
    with pytest.raises(ConfigurationError, match=r"unknown servo 'XL-330'.*XL330-M288"):
        small_servo("XL-330")


def test_a_name_stands_for_the_joint_in_files_and_environments() -> None:
    """Catches a parameter that is lost on the way to Robot-v0, the testbed or a live robot."""
    joint = small_servo("STS3250")
    (own,) = read_joints({"*": "STS3250"}, ["elbow"]).values()
    assert own is not None
    assert (own.stiffness, own.load_friction) == (joint.stiffness, joint.load_friction)
    assert joint.servo is not None
    assert own.servo.motor == joint.servo.motor
    load = {"gravity_torque": 1.33, "mass": 1.13, "gyration_radius": 0.01}
    env = gymnasium.make(
        "elastic_env/Testbed-v0", joint="STS3250", pendulum=load, action_bound_rad=1.2
    )
    config: Any = env.unwrapped
    assert config.task.config.joint == joint
    space: Any = env.action_space
    assert space.high == pytest.approx(1.2)
    env.close()


def test_an_emulated_servo_refuses_a_motor() -> None:
    """Catches a torque that the emulator cannot switch off."""
    config = TestbedConfig(joint=small_servo("STS3250"))
    with pytest.raises(ConfigurationError, match=r"emulated servo controls its current"):
        Joints(config, num_joints=1, start_s=0.0)


def test_a_servo_with_a_motor_is_braked_by_its_back_emf_alone() -> None:
    """Catches an assumed velocity gain that no such servo has, and no compensator knows."""
    motor = SMALL_SERVOS["STS3215"].motor
    text = """<mujoco><worldbody><body name="link"><joint name="q" axis="0 -1 0"/>
      <inertial mass="1" pos="0 0 -0.1" diaginertia="0.001 0.001 0.001"/></body></worldbody>
    </mujoco>"""
    servo = {"position_gain": 20.0, "torque_limit": 3.0, "motor": motor}
    own = {"stiffness": 400.0, "rotor_inertia": 0.02, "servo": servo}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        config = configure_robot(text, {"q": own})
    made = config.joints["q"].servo
    assert made is not None
    assert made.braking == motor.damping


SWUNG = Pendulum(gravity_torque=1.0, mass=1.0, gyration_radius=0.03)


def swung(frequency_hz: float, amplitude: float = 1.2) -> TestbedConfig:
    """A servo that swings a pendulum."""
    motion = {"kind": "sine", "amplitude": amplitude, "frequency_hz": frequency_hz}
    return TestbedConfig(joint=small_servo("STS3215"), pendulum=SWUNG, reference=motion)


def test_a_sine_whose_largest_speed_falls_at_no_torque_is_played() -> None:
    """Catches the largest torque beside what the motor has at the largest speed."""
    config = swung(0.6)
    servo = config.joint.servo
    assert servo is not None
    extent = config.reference.extent()
    inertia = SWUNG.inertia + config.joint.rotor_inertia
    most = SWUNG.gravity_torque * np.sin(1.2) + inertia * extent.q_ddot
    assert most > servo.largest_torque(extent.q_dot)
    assert config.plant().name == "testbed"


@pytest.mark.parametrize(
    ("frequency_hz", "amplitude", "limit"),
    [(0.9, 1.2, "0"), (2.0, 0.35, r"[\d.]+")],  # beyond the no-load speed; too heavy on the way
)
def test_a_sine_that_the_motor_cannot_follow_is_refused(
    frequency_hz: float, amplitude: float, limit: str
) -> None:
    """Catches a check at other moments than those at which the motor is too weak."""
    with pytest.raises(ConfigurationError, match=rf"servo limited to {limit} N·m"):
        swung(frequency_hz, amplitude).plant()


def test_the_demand_of_a_servo_is_the_closed_form() -> None:
    """Up, down, and down so gently that the servo still has to drive; friction is on its way."""
    joint = small_servo("STS3215").replace(viscous_friction=0.02)
    motor, c, F = joint.servo.motor, joint.load_friction, joint.coulomb_friction
    robot = RobotModel({"q": joint}, rigid_spec().compile(), 0.004)
    torque = np.array([[0.5], [-0.8], [-0.01], [0.5]])
    speed = np.array([[3.0], [3.0], [3.0], [0.0]])
    left = motor.stall_torque - 3.0 * motor.damping
    full = joint.servo.largest_torque()
    viscous = 0.02 * 3.0
    needed, limits = robot.demand(torque, speed)
    np.testing.assert_allclose(
        needed[:, 0],
        [
            (0.5 + viscous + F) / (1.0 - c),
            0.8,
            (viscous + F - 0.01) / (1.0 - c),
            (0.5 + F) / (1 - c),
        ],
    )
    np.testing.assert_allclose(limits[:, 0], [left, full, left, full])
    turned, same = robot.demand(-torque, -speed)
    np.testing.assert_allclose(turned, needed)
    np.testing.assert_allclose(same, limits)
