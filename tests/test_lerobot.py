"""LeRobot's units and calibration against its own rule, and an arm that is compensated in them.

What needs the package lerobot stands in tests/lerobot.
"""

import json
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from baselines import PositionCompensator
from baselines.lerobot import ArmSettings, LeRobotArm, read_calibration
from baselines.lerobot.arm import units_of
from baselines.lerobot.settings import JointPlace, Motor, MotorCalibration, known_motors, motors_of
from elastic_env.core.errors import ActionError, ConfigurationError

FOLDER = Path("docs/hardware")
BODY = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
RANGES = {  # in counts, of widths and middles that differ
    "shoulder_pan": (750, 3400),
    "shoulder_lift": (820, 3210),
    "elbow_flex": (900, 3100),
    "wrist_flex": (880, 3150),
    "wrist_roll": (0, 4095),
    "gripper": (2030, 3500),
}
STIFFNESS = {"*": {"stiffness": 200.0, "servo": {"position_gain": 20.0}}}


def calibration() -> dict[str, dict[str, int]]:
    """A calibration as LeRobot's file has it."""
    return {
        name: {
            "id": number,
            "drive_mode": 0,
            "homing_offset": 37 * number,
            "range_min": low,
            "range_max": high,
        }
        for number, (name, (low, high)) in enumerate(RANGES.items(), 1)
    }


def settings(**changed: Any) -> ArmSettings:
    """An SO-101."""
    known: dict[str, Any] = {
        "model": str(FOLDER / "so101.xml"),
        "joints": STIFFNESS,
        "calibration": calibration(),
        "ramp_s": 0.0,
    }
    return ArmSettings(**(known | changed))


def goals(value: float = 12.5) -> dict[str, Any]:
    """An action of the arm."""
    return {f"{name}.pos": value for name in RANGES}


ELBOW = MotorCalibration(**calibration()["elbow_flex"])
COUNT_RAD = 2.0 * math.pi / 4096


@pytest.mark.parametrize(
    ("units", "value", "counts"),
    [
        # LeRobot's own expressions of a value, turned round by hand
        ("degrees", 30.0, 2000.0 + 30.0 * 4095 / 360),
        ("range", 30.0, 900.0 + 130.0 / 200.0 * 2200),
        ("percent", 30.0, 900.0 + 0.3 * 2200),
    ],
)
@pytest.mark.parametrize(("direction", "zero"), [(1, 0.0), (-1, 0.4), (1, -0.3)])
def test_a_value_is_the_angle_of_its_counts(
    units: Any, value: float, counts: float, direction: Any, zero: float
) -> None:
    """Catches 360/4096 for 360/4095, a middle of the turn for that of the range, and a sign or zero
    of the model on the wrong side."""
    motor = Motor(name="elbow_flex", units=units, counts_per_turn=4096)
    place = JointPlace(direction=direction, zero_rad=zero)
    found = units_of([motor], [place], {"elbow_flex": ELBOW})
    angle = found.angle(np.array([value]))
    # LeRobot's angle is direction q + zero
    np.testing.assert_allclose(direction * angle + zero, (counts - 2000.0) * COUNT_RAD, atol=1e-12)
    np.testing.assert_allclose(found.value(angle), value)


@pytest.mark.parametrize("units", ["degrees", "range", "percent"])
def test_the_calibrated_range_is_the_same_in_all_units(units: Any) -> None:
    """Catches a width of 100 for 200, and a centre of 0 for 50."""
    motor = Motor(name="elbow_flex", units=units, counts_per_turn=4096)
    found = units_of([motor], [JointPlace(direction=-1, zero_rad=0.2)], {"elbow_flex": ELBOW})
    half = 1100 * COUNT_RAD
    np.testing.assert_allclose(np.ravel(found.ends), [0.2 - half, 0.2 + half])


def test_motors_without_counts_are_in_degrees_whatever_their_calibration_says() -> None:
    """OpenArm: its file has −90 to 90, in degrees and not in counts."""
    motors = motors_of("openarm_follower")[:7]
    known = MotorCalibration(id=1, drive_mode=0, homing_offset=0, range_min=-90, range_max=90)
    for given in ({}, {motor.name: known for motor in motors}):
        found = units_of(motors, [JointPlace()] * 7, given)
        np.testing.assert_allclose(found.angle(np.full(7, 90.0)), math.pi / 2)
        assert not np.isfinite(found.highest).any()


def test_every_robot_has_its_own_names_and_default_units() -> None:
    """As lerobot 0.4.4 has them; tests/lerobot compares with the package."""
    assert {name: {motor.units for motor in motors_of(name)} for name in known_motors()} == {
        "so100_follower": {"degrees", "percent"},
        "so101_follower": {"degrees", "percent"},
        "koch_follower": {"range", "percent"},
        "openarm_follower": {"degrees"},
        "bi_so_follower": {"degrees", "percent"},
        "bi_openarm_follower": {"degrees"},
    }
    assert [motor.name for motor in motors_of("so101_follower")] == list(RANGES)
    assert motors_of("so101_follower", use_degrees=False)[0].units == "range"
    assert motors_of("koch_follower", use_degrees=True)[0].units == "degrees"


def openarm(*sides: str) -> str:
    """Arms with the joints of OpenArm's description, side by side; other masses."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    for i, side in enumerate(sides):
        body = spec.worldbody
        for number in range(1, 8):
            place = [0.0, 0.4 * i, 0.0] if number == 1 else [0.0, 0.0, -0.1]
            body = body.add_body(pos=place)
            axis = [[0, 1, 0], [1, 0, 0], [0, 0, 1]][number % 3]
            body.add_joint(name=f"openarm_{side}joint{number}", axis=axis, range=[-2.0, 2.0])
            body.add_geom(size=[0.02, 0.0, 0.0], pos=[0.0, 0.0, -0.05], mass=0.5)
    spec.compile()
    return spec.to_xml()


ARM = tuple(f"joint_{number}" for number in range(1, 8))


@pytest.mark.parametrize(
    ("robot", "side", "sides", "key"),
    [
        ("openarm_follower", None, ("",), ""),
        ("openarm_follower", "right", ("left_", "right_"), ""),
        ("bi_openarm_follower", "left", ("left_", "right_"), "left_"),
        ("bi_openarm_follower", "right", ("left_", "right_"), "right_"),
    ],
)
def test_openarm_moves_the_joints_of_its_description(
    robot: str, side: Any, sides: tuple[str, ...], key: str
) -> None:
    """Names, degrees, signs and zeros as LeRobot's openarm_kinematics.py has them: a joint's angle
    is its value in rad. Catches the other arm's joints, and values of it that change."""
    model = openarm(*sides)
    arm = LeRobotArm(
        settings(robot=robot, side=side, model=model, joints={"*": 300.0}, calibration={})
    )
    assert arm.motors == tuple(f"{key}{name}" for name in ARM)
    values = 10.0 * np.arange(1, 8)
    names = ("left_", "right_") if key else ("",)
    action = {
        f"{arm_key}{name}.pos": value
        for arm_key in names
        for name, value in zip((*ARM, "gripper"), [*values, -30.0], strict=True)
    }
    found = arm.command(action)
    joints = [f"openarm_{f'{side}_' if side else ''}joint{number}" for number in range(1, 8)]
    compensator = PositionCompensator.from_model(model, {"*": 300.0}, joints=joints)
    moved = [f"{key}{name}.pos" for name in ARM]
    expected = np.rad2deg(compensator.command(np.deg2rad(values)))
    np.testing.assert_allclose([found[name] for name in moved], expected)
    assert np.abs(expected - values).max() > 0.1
    assert {name for name in found if found[name] != action[name]} <= set(moved)


@pytest.mark.parametrize("use_degrees", [True, False])
@pytest.mark.parametrize("direction", [1, -1])
def test_an_action_is_compensated_in_rad(use_degrees: bool, direction: Any) -> None:
    """Catches an offset that is added in LeRobot's units, and joints in another order."""
    places = {
        "elbow_flex": {"direction": direction, "zero_rad": 0.1},
        "shoulder_pan": {"direction": direction},
    }
    arm = LeRobotArm(settings(use_degrees=use_degrees, places=places))
    wanted = goals()
    found = arm.command(wanted)
    sign = np.ones(5)
    sign[[0, 2]] = direction
    zero = np.array([0.0, 0.0, 0.1, 0.0, 0.0])
    width = np.array([high - low for low, high in list(RANGES.values())[:5]])
    turn = np.deg2rad(4095 / 4096) if use_degrees else width / 200.0 * COUNT_RAD
    compensator = PositionCompensator.from_model(
        str(FOLDER / "so101.xml"), STIFFNESS, joints=list(BODY)
    )
    q = sign * (12.5 * turn - zero)
    expected = (sign * compensator.command(q) + zero) / turn
    np.testing.assert_allclose([found[f"{name}.pos"] for name in BODY], expected, rtol=1e-12)
    assert found["gripper.pos"] == wanted["gripper.pos"] == 12.5
    # and it leads against gravity: the arm would sag forward and down
    assert found["shoulder_lift.pos"] < 12.5
    q = sign * (12.5 * turn - zero)
    seen = (sign * compensator.link_angle(q) + zero) / turn
    found = arm.link_angles(wanted)
    np.testing.assert_allclose([found[f"{name}.pos"] for name in BODY], seen, rtol=1e-12)


def test_a_goal_stays_within_the_calibrated_range() -> None:
    """Catches a lead beyond the end at which LeRobot or the servo would cut it."""
    arm = LeRobotArm(settings(use_degrees=False, places={"wrist_roll": None}))
    ends = [arm.command(goals(value)) for value in (-100.0, 100.0)]
    values = np.array([[end[f"{name}.pos"] for name in BODY[:4]] for end in ends])
    assert np.abs(values).max() <= 100.0


def test_values_that_the_arm_does_not_have_are_handed_on() -> None:
    """Rates, torques, pictures, and motors that are held."""
    arm = LeRobotArm(settings(joints=STIFFNESS | {"wrist_roll": "held"}))
    assert arm.motors == BODY[:4]
    action = goals() | {"elbow_flex.vel": 3.0, "front": "picture"}
    found = arm.command(action)
    assert set(found) == set(action)
    changed = {key for key in found if found[key] != action[key]}
    assert changed <= {f"{name}.pos" for name in BODY[:4]}
    assert action["elbow_flex.pos"] == 12.5


def test_the_gripper_is_compensated_where_a_place_names_its_joint() -> None:
    arm = LeRobotArm(settings(places={"gripper": {"joint": "gripper", "zero_rad": -0.785}}))
    assert arm.motors == tuple(RANGES)
    middle = arm.units.angle(np.array([0.0] * 5 + [50.0]))
    np.testing.assert_allclose(middle[-1], 0.785)


def test_the_configuration_is_json_and_gives_the_same_arm(tmp_path: Path) -> None:
    """Files of joints and calibration go into it, infinite stiffness too; the arm is the same."""
    (tmp_path / "joints.yaml").write_text(
        "'*': {stiffness: 200.0, servo: {position_gain: 20.0}}\nwrist_roll: .inf\n"
    )
    (tmp_path / "calibration.json").write_text(json.dumps(calibration()))
    arm = LeRobotArm(
        settings(
            joints=str(tmp_path / "joints.yaml"), calibration=str(tmp_path / "calibration.json")
        )
    )
    text = json.dumps(arm.settings.model_dump(mode="json"), allow_nan=False)
    again = LeRobotArm(ArmSettings(**json.loads(text)))
    assert again.settings == arm.settings
    assert again.command(goals()) == arm.command(goals())
    assert again.link_angles(goals()) == arm.link_angles(goals())
    assert str(tmp_path) not in text


def test_a_reset_begins_the_ramp_anew() -> None:
    arm = LeRobotArm(settings(ramp_s=1.0))
    first = arm.command(goals())
    assert arm.command(goals()) != first
    arm.reset()
    assert arm.command(goals()) == first


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"robot": "so10_follower"}, "Did you mean 'so10"),
        ({"robot": "openarm_follower", "use_degrees": False}, "in degrees always"),
        ({"robot": "bi_so_follower"}, "has two arms; say side: left or right"),
        (
            {"robot": "openarm_follower", "model": openarm("left_", "right_")},
            "no joint 'openarm_joint1' .* say side where the model has two arms",
        ),
        ({"calibration": {}}, "lacks the motor 'shoulder_pan'"),
        ({"calibration": "nowhere.json"}, "no calibration at nowhere.json"),
        ({"places": {"elbow": None}}, "unknown motor 'elbow'"),
        ({"places": {"elbow_flex": {"joint": "3"}}}, "no joint '3' for the motor 'elbow_flex'"),
        ({"places": {"elbow_flex": {"joint": "wrist_flex"}}}, "two motors move"),
        ({"places": {"elbow_flex": {"direction": 2}}}, "direction"),
        ({"joints": {"*": "held"}}, "no motor is left"),
        ({"joints": {"elbow_flex": 100.0}}, "stiffness of joint 'shoulder_pan' is missing"),
    ],
)
def test_a_wrong_setting_is_one_sentence(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said) as caught:
        LeRobotArm(settings(**changed))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[]", "is no calibration of LeRobot"),
        ("{", "is not JSON"),
        (
            '{"elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": 0, "range_min": 0}}',
            "needs the parameter 'range_max'",
        ),
        (
            json.dumps({"elbow_flex": calibration()["elbow_flex"] | {"range_min": 4000}}),
            "range_min must be below range_max",
        ),
    ],
)
def test_a_file_that_is_no_calibration_is_one_sentence(
    content: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "arm.json"
    path.write_text(content)
    with pytest.raises(ConfigurationError, match=said) as caught:
        read_calibration(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("action", "said"),
    [
        ({"elbow_flex": 3.0}, "lacks 'shoulder_pan.pos'"),
        (goals() | {"elbow_flex.pos": "up"}, "must hold numbers"),
        (goals() | {"elbow_flex.pos": math.nan}, "must be finite"),
    ],
)
def test_a_value_that_is_none_is_refused_and_changes_nothing(
    action: dict[str, Any], said: str
) -> None:
    arm = LeRobotArm(settings(ramp_s=1.0))
    with pytest.raises(ActionError, match=said):
        arm.command(action)
    assert arm.command(goals()) == LeRobotArm(settings(ramp_s=1.0)).command(goals())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("use_degrees", "ends"), [(False, "-100 to 100"), (True, "-96.7 to 96.7")])
def test_units_that_are_exchanged_are_refused_before_anything_moves(
    use_degrees: bool, ends: str
) -> None:
    """Degrees to a robot in −100 to 100, of an elbow that cannot be at 140; one sentence, and no
    warning beside it. Later values may leave the range, as those of a leader do."""
    arm = LeRobotArm(settings(use_degrees=use_degrees, places={"wrist_roll": None}))
    for what in (arm.command, arm.link_angles):
        with pytest.raises(ActionError, match=rf"is 140, and .* is {ends}: say use_degrees"):
            what(goals(140.0))
    arm.command(goals())
    with pytest.warns(UserWarning, match="beyond its range"):
        arm.command(goals(140.0))


def test_a_zero_that_is_not_in_the_middle_of_the_range_is_said() -> None:
    """A model whose joint begins at zero, as in the URDF of the old calibration."""
    text = (FOLDER / "so101.xml").read_text()
    old = text.replace('range="-1.69 1.69"', 'range="0 3.38"')
    assert old != text
    with pytest.warns(UserWarning, match=r"is zero_rad -1.69 in the place of 0"):
        LeRobotArm(settings(model=old))
    LeRobotArm(settings(model=old, places={"elbow_flex": {"zero_rad": -1.69}}))
