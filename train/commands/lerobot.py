"""`elastic lerobot`: recordings of LeRobot as logs of joints."""

from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from baselines.lerobot import ArmSettings, LeRobotArm
from baselines.lerobot.recordings import joint_logs, log_text, read_recordings, robot_of
from elastic_env.core.config import Locator, Model, Title, read_mapping
from elastic_env.core.files import write_whole
from train.runs.folders import run_folder


class Lerobot(Model):
    """Convert a data set of LeRobot to logs of joints, for elastic identify --log.

    The arm's calibration converts goals and positions to angles of the model. The model gives the
    torque of weight and motion on each joint. Writes JOINT_EPISODE.csv for each joint and episode.

    Example: elastic lerobot recordings/sweep --model so101.urdf --calibration my_arm.json

    Then: elastic identify --log runs/lerobot/elbow_flex_0.csv
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the data set, with meta/info.json and data/ (v2.1 or v3.0)."""
    model: Locator
    """File of MJCF or URDF of the arm, with its masses."""
    calibration: Locator | None = None
    """JSON file that LeRobot wrote for the arm; none for motors in degrees, such as OpenArm's."""
    robot: Title | None = None
    """Type of the robot, as LeRobot names it; default the type in the data set."""
    side: Literal["left", "right"] | None = None
    """The arm, where the robot or the model has two."""
    use_degrees: bool | None = None
    """As in LeRobot's configuration of the robot; default LeRobot's default."""
    places: Path | None = None
    """YAML file with the joint that each motor moves, its direction and zero_rad, see
    docs/lerobot.md; default the joints of the motors' names.
    """
    episodes: list[int] = []
    """Numbers of episodes; default all."""
    output: Path | None = None
    """Folder for the logs, new or empty; default runs/lerobot, numbered if taken."""

    def run(self, console: Console) -> None:
        """Convert the data set and write the logs."""
        settings = ArmSettings(
            robot=self.robot or robot_of(self.dataset),
            side=self.side,
            model=self.model,
            joints={"*": "rigid"},
            calibration=self.calibration or {},
            use_degrees=self.use_degrees,
            places={} if self.places is None else read_mapping(self.places),
        )
        arm = LeRobotArm(settings)
        recordings = read_recordings(self.dataset, self.episodes)
        recorded = self.model_dump(mode="json")
        with run_folder("lerobot", recorded, None, self.output) as folder:
            for recording in recordings:
                for log in joint_logs(recording, arm):
                    write_whole(folder / f"{log.name}.csv", log_text(log))
            rows = sum(len(recording.time) for recording in recordings)
            joints = arm.compensator.joints
            console.print(f"{rows} rows in {len(recordings)} recordings of {', '.join(joints)}")
            console.print(f"elastic identify --log {folder}/{joints[-1].replace('/', '_')}_*.csv")
