"""Settings of an arm of LeRobot: which motor moves which joint, its calibration, the model."""

import math
from functools import cache
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import model_validator

from elastic_env.core.config import Model, Title, quantity, read_json
from elastic_env.core.config_problems import ModelError
from elastic_env.core.errors import ConfigurationError, require_known, shorten
from elastic_env.core.files import read_rows

Units = Literal["degrees", "range", "percent"]
"""Degrees, −100 to 100 over the calibrated range, or 0 to 100 over it."""
GRIPPER = "gripper"
"""Motor that keeps its goal, unless `places` gives the joint that it moves."""
_TWO_ARMS = "bi_"
"""Prefix of the types of robots with two arms."""
_LARGEST_COUNT = 2**31
_MOST_BYTES = 1_000_000
"""Largest size of a calibration file."""


class Motor(Model):
    """A motor of an arm in LeRobot."""

    name: Title
    units: Units
    counts_per_turn: int | None = None
    """None for a motor that LeRobot reads in degrees [1]."""
    joint: Title | None = None
    """Joint of the manufacturer's model, with * for the side; default the motor's name."""


class MotorCalibration(Model):
    """LeRobot's calibration of a motor, in counts of its encoder."""

    id: int
    drive_mode: int = quantity("1", ge=0, le=1)
    """1 where LeRobot reverses the sign of values; its values already include this [1]."""
    homing_offset: int = quantity("1", ge=-_LARGEST_COUNT, le=_LARGEST_COUNT)
    """Offset in the motor's register; its counts already include it [1]."""
    range_min: int = quantity("1", ge=-_LARGEST_COUNT, le=_LARGEST_COUNT)
    """Least count of the calibrated range [1]."""
    range_max: int = quantity("1", ge=-_LARGEST_COUNT, le=_LARGEST_COUNT)
    """Largest count of the calibrated range [1]."""

    @model_validator(mode="after")
    def _range_has_a_width(self) -> Self:
        if self.range_min >= self.range_max:
            raise ValueError(
                f"range_min must be below range_max, got {self.range_min} and {self.range_max};"
                " calibrate the arm again"
            )
        return self


class JointPlace(Model):
    """The joint of the model that a motor moves."""

    joint: Title | None = None
    """Name of the joint; default the motor's name."""
    direction: Literal[1, -1] = 1
    """1 where LeRobot's value grows with the joint's angle, -1 where it falls."""
    zero_rad: float = quantity("rad", 0.0, ge=-2.0 * math.pi, le=2.0 * math.pi)
    """LeRobot's angle where the model's joint is at zero, from the middle of the calibrated range
    [rad].
    """


class ArmSettings(Model):
    """An arm of LeRobot and its compensator: the configuration of a processor step, as JSON."""

    robot: Title = "so101_follower"
    """Type of the robot, as LeRobot names it."""
    side: Literal["left", "right"] | None = None
    """The arm, where the robot or the model has two; each needs a separate step."""
    model: str
    """Model of the arm: a file of MJCF or URDF, or the text of one."""
    joints: str | float | dict[str, Any]
    """YAML file of its joints, as `elastic identify` writes it, its content, or one K of all
    [N·m/rad].
    """
    calibration: str | dict[str, MotorCalibration] = {}
    """JSON file that LeRobot wrote for this arm, or its content; none for motors in degrees."""
    use_degrees: bool | None = None
    """As in LeRobot's configuration of the robot; default LeRobot's default."""
    places: dict[Title, JointPlace | None] = {}
    """Joints of motors that do not move the joint of their name; None for a motor that keeps its
    goal.
    """
    position_gain: float | dict[str, float] | None = None
    """k_p of servos that give way under a load; default the value in `joints` [N·m/rad]."""
    limit_rad: float = quantity("rad", 0.2, gt=0)
    """Largest offset between command and desired angle [rad]."""
    ramp_s: float = quantity("s", 1.0, ge=0)
    """Time in which offsets increase from zero after the start [s]."""
    period_s: float = quantity("s", 1.0 / 30.0, gt=0)
    """Time between two actions [s]."""
    friction: bool | None = None
    """True to compensate dry friction; default True if any of it grows with the load."""

    @model_validator(mode="after")
    def _motors_exist(self) -> Self:
        require_known("motor", self.places, [motor.name for motor in self.motors])
        if self.side is None and self.robot.startswith(_TWO_ARMS):
            raise ValueError(f"{self.robot} has two arms; say side: left or right")
        return self

    @property
    def prefix(self) -> str:
        """Prefix of the motors' names in actions and observations of a robot with two arms."""
        return f"{self.side}_" if self.robot.startswith(_TWO_ARMS) else ""

    @property
    def motors(self) -> tuple[Motor, ...]:
        """Motors of the robot, with their units."""
        return motors_of(self.robot, self.use_degrees)

    @property
    def content_of_calibration(self) -> dict[str, MotorCalibration]:
        """Calibration, read from the file if `calibration` is a path."""
        source = self.calibration
        return read_calibration(Path(source)) if isinstance(source, str) else source


@cache
def known_motors() -> dict[str, tuple[Motor, ...]]:
    """Motors of the robots of motors.csv, by the robot's type."""
    motors: dict[str, tuple[Motor, ...]] = {}
    for row in read_rows(Path(__file__).with_name("motors.csv")):
        counts = row["counts_per_turn"]
        motor = Motor(
            name=row["motor"],
            units=row["units"],  # pyright: ignore[reportArgumentType]  checked by the model
            counts_per_turn=int(counts) if counts else None,
            joint=row["joint"] or None,
        )
        motors[row["robot"]] = (*motors.get(row["robot"], ()), motor)
    return motors


def motors_of(robot: str, use_degrees: bool | None = None) -> tuple[Motor, ...]:
    """Motors of a robot in LeRobot's order.

    Args:
        robot: Type of the robot, such as so101_follower.
        use_degrees: As in LeRobot's configuration of the robot; None for its default.

    Raises:
        ConfigurationError: The type is not known, or its motors support degrees only.
    """
    known = known_motors()
    require_known("robot of LeRobot", [robot], known)
    motors = known[robot]
    if use_degrees is None:
        return motors
    if not use_degrees and any(motor.counts_per_turn is None for motor in motors):
        problem = f"the motors of {robot} are in degrees always; leave use_degrees out"
        raise ConfigurationError(problem)
    units: Units = "degrees" if use_degrees else "range"
    return tuple(
        motor.replace(units=motor.units if motor.units == "percent" else units) for motor in motors
    )


class _Calibration(Model):
    """Motors by their names."""

    motors: dict[Title, MotorCalibration]


def read_calibration(path: Path) -> dict[str, MotorCalibration]:
    """Read the calibration of an arm, a JSON file that LeRobot writes.

    Raises:
        ConfigurationError: The file cannot be read, or is no calibration.
    """
    content = read_json(
        path,
        _MOST_BYTES,
        lambda why: (
            f"no calibration at {shorten(path)} ({why}); LeRobot writes it to"
            " calibration/robots/TYPE/ID.json in its folder of the cache"
        ),
    )
    try:
        return _Calibration(motors=content).motors
    except ModelError as error:
        raise ConfigurationError(
            f"{shorten(path)} is no calibration of LeRobot: {error.describe()}"
        ) from None
