"""The processor steps within LeRobot itself: `make test-lerobot`, in an environment of their own.

Nothing moves: LeRobot's buses are asked for the conversion alone, without a port.
"""

import inspect
import json
import time
import timeit
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.motors import MotorCalibration, MotorNormMode
from lerobot.motors.dynamixel import DynamixelMotorsBus
from lerobot.motors.dynamixel.tables import MODEL_RESOLUTION as DYNAMIXEL_COUNTS
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot.motors.feetech.tables import MODEL_RESOLUTION as FEETECH_COUNTS
from lerobot.processor import ProcessorStepRegistry, RobotProcessorPipeline
from lerobot.processor.converters import (
    observation_to_transition,
    robot_action_observation_to_transition,
    transition_to_observation,
    transition_to_robot_action,
)
from lerobot.robots import koch_follower, openarm_follower, so_follower

from baselines.lerobot import ArmSettings, JointPlace, LeRobotArm
from baselines.lerobot.arm import units_of
from baselines.lerobot.settings import motors_of
from baselines.lerobot.steps import CompensateActionStep, CorrectObservationStep
from tests.test_lerobot import FOLDER, STIFFNESS, calibration, goals, settings

NORMS = {
    "degrees": MotorNormMode.DEGREES,
    "range": MotorNormMode.RANGE_M100_100,
    "percent": MotorNormMode.RANGE_0_100,
}
COUNTS = np.array([1200, 1999, 2000, 2731])


def robot_of(name: str, folder: Path, **options: Any) -> Any:
    """A robot of LeRobot on no port."""
    kinds = {
        "so101_follower": (so_follower.SO101Follower, so_follower.SO101FollowerConfig),
        "so100_follower": (so_follower.SO100Follower, so_follower.SO100FollowerConfig),
        "koch_follower": (koch_follower.KochFollower, koch_follower.KochFollowerConfig),
        "openarm_follower": (
            openarm_follower.OpenArmFollower,
            openarm_follower.OpenArmFollowerConfig,
        ),
    }
    robot, config = kinds[name]
    return robot(config(port="nowhere", calibration_dir=folder, id="arm", **options))


@pytest.mark.parametrize("name", ["so101_follower", "so100_follower", "koch_follower"])
@pytest.mark.parametrize("use_degrees", [None, True, False])
@pytest.mark.parametrize("drive_mode", [0, 1])
def test_the_angle_is_that_of_the_counts_behind_lerobots_value(
    name: str, use_degrees: bool | None, drive_mode: int, tmp_path: Path
) -> None:
    """LeRobot makes values of counts by its own calibration file; the angle must be that of the
    counts, with the sign that drive_mode gives. Catches another default of use_degrees, too."""
    known = {key: own | {"drive_mode": drive_mode} for key, own in calibration().items()}
    (tmp_path / "arm.json").write_text(json.dumps(known))
    options = {} if use_degrees is None else {"use_degrees": use_degrees}
    bus = robot_of(name, tmp_path, **options).bus
    motors = motors_of(name, use_degrees)
    assert [motor.name for motor in motors] == list(bus.motors)
    assert [NORMS[motor.units] for motor in motors] == [m.norm_mode for m in bus.motors.values()]
    counts_of = FEETECH_COUNTS if isinstance(bus, FeetechMotorsBus) else DYNAMIXEL_COUNTS
    assert [m.counts_per_turn for m in motors] == [counts_of[m.model] for m in bus.motors.values()]
    found = ArmSettings(
        robot=name, model="", joints=1.0, calibration=str(tmp_path / "arm.json")
    ).content_of_calibration
    units = units_of(motors, [JointPlace()] * len(motors), found)
    for at, (motor, own) in enumerate(zip(motors, known.values(), strict=True)):
        turned = drive_mode and bus.apply_drive_mode and motor.units != "degrees"
        inside = np.clip(COUNTS, own["range_min"], own["range_max"])
        values = [bus._normalize({own["id"]: int(count)})[own["id"]] for count in inside]
        angle = units.slope[at] * (np.array(values) - units.centre[at]) + units.offset[at]
        middle = 0.5 * (own["range_min"] + own["range_max"])
        expected = (inside - middle) * 2.0 * np.pi / 4096
        np.testing.assert_allclose(angle, -expected if turned else expected, atol=1e-12)


def test_openarm_has_our_names_and_degrees(tmp_path: Path) -> None:
    """Its bus needs a package of its own, so that the names come from its configuration."""
    config = openarm_follower.OpenArmFollowerConfig(port="nowhere", calibration_dir=tmp_path)
    assert [motor.name for motor in motors_of("openarm_follower")] == list(config.motor_config)
    assert "MotorNormMode.DEGREES" in inspect.getsource(openarm_follower.OpenArmFollower)


def pipelines(**changed: Any) -> tuple[Any, Any]:
    """The pipelines of LeRobot's loops with our steps."""
    known = settings(**changed).model_dump(mode="json")
    act = RobotProcessorPipeline(
        steps=[CompensateActionStep(**known)],
        name="compensate",
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    see = RobotProcessorPipeline(
        steps=[CorrectObservationStep(**known)],
        name="correct",
        to_transition=observation_to_transition,
        to_output=transition_to_observation,
    )
    return act, see


def test_the_steps_do_what_the_arm_does() -> None:
    act, see = pipelines()
    assert act((goals(), goals())) == LeRobotArm(settings()).command(goals())
    seen = see(goals() | {"front": np.zeros((2, 2, 3))})
    assert {k: seen[k] for k in goals()} == LeRobotArm(settings()).link_angles(goals())


def test_pipelines_are_saved_and_loaded_as_json(tmp_path: Path) -> None:
    """LeRobot's own save and load, by the registered names; what comes back acts the same."""
    act, see = pipelines()
    act.save_pretrained(tmp_path)
    see.save_pretrained(tmp_path)
    text = json.loads((tmp_path / "compensate.json").read_text())
    assert text["steps"][0]["registry_name"] == "elastic_env_compensate_action"
    assert {file.suffix for file in tmp_path.iterdir()} == {".json"}
    again = RobotProcessorPipeline.from_pretrained(
        tmp_path,
        config_filename="compensate.json",
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    seen = RobotProcessorPipeline.from_pretrained(
        tmp_path,
        config_filename="correct.json",
        to_transition=observation_to_transition,
        to_output=transition_to_observation,
    )
    for value in (-20.0, 3.0, 12.5):
        assert again((goals(value), goals())) == act((goals(value), goals()))
        assert seen(goals(value)) == see(goals(value))


def test_a_setting_may_be_changed_when_a_pipeline_is_loaded(tmp_path: Path) -> None:
    act, _ = pipelines()
    act.save_pretrained(tmp_path)
    rigid = {"elastic_env_compensate_action": {"joints": {"*": "rigid"}}}
    again = RobotProcessorPipeline.from_pretrained(
        tmp_path,
        config_filename="compensate.json",
        overrides=rigid,
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    found = again((goals(), goals()))
    np.testing.assert_allclose([found[key] for key in goals()], 12.5)


@pytest.mark.parametrize("joints", [STIFFNESS, str(FOLDER / "so101_joints.yaml")])
def test_a_step_takes_at_most_200_microseconds(joints: Any) -> None:
    """Without friction, and with one that grows with the load. Processor time of the fastest runs,
    so that a busy machine does not count."""
    act, see = pipelines(joints=joints, limit_rad=0.3)
    action = goals()
    for what in (lambda: act((action, action)), lambda: see(action)):
        best = min(timeit.repeat(what, timer=time.thread_time, number=50, repeat=60)) / 50
        print(f"{1e6 * best:.0f} µs")
        assert best <= 200e-6


def test_the_steps_are_registered_by_name() -> None:
    assert ProcessorStepRegistry.get("elastic_env_compensate_action") is CompensateActionStep
    assert ProcessorStepRegistry.get("elastic_env_correct_observation") is CorrectObservationStep


def test_our_calibration_is_lerobots(tmp_path: Path) -> None:
    """Written by LeRobot, read by us."""
    robot = robot_of("so101_follower", tmp_path)
    robot.calibration = {key: MotorCalibration(**own) for key, own in calibration().items()}
    robot._save_calibration()
    found = settings(calibration=str(tmp_path / "arm.json")).content_of_calibration
    assert {key: own.model_dump() for key, own in found.items()} == calibration()
    assert isinstance(robot_of("koch_follower", tmp_path).bus, DynamixelMotorsBus)
