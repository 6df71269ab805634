"""Arms that LeRobot commands: its units and calibration, its processor steps, its recordings.

`baselines.lerobot.steps` needs the package lerobot, and registers its steps when it is imported.
The other modules need neither lerobot nor torch.
"""

from baselines.lerobot.arm import JointUnits, LeRobotArm
from baselines.lerobot.settings import ArmSettings, JointPlace, MotorCalibration, read_calibration

__all__ = [
    "ArmSettings",
    "JointPlace",
    "JointUnits",
    "LeRobotArm",
    "MotorCalibration",
    "read_calibration",
]
