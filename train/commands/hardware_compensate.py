"""`elastic hardware compensate` and `log`: a live arm, with and without compensated commands."""

import sys
from pathlib import Path

import numpy as np
from rich.console import Console

from baselines.identification.pose_log import write_poses
from elastic_env.core.config import quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.hardware.live.arm import Uncompensated
from elastic_env.hardware.live.arm_state import ArmState
from elastic_env.hardware.live.target_streams import Socket, Stream
from elastic_env.hardware.live.targets import Poses, Targets, read_targets
from train.commands.hardware_arm import ArmOptions, ArmSetup
from train.commands.hardware_arm_motion import move_arm


class Compensate(ArmOptions):
    """Move a real arm with compensated commands: its links go where the targets are.

    The arm is checked first: models, ids, limits, and by moving every joint a little its sign and
    load. Then it follows targets, shows its state, and logs every cycle. At the end it goes back to
    its start, and its torque falls slowly.

    Try it without an arm: elastic hardware compensate --robot docs/hardware/so101.xml --joints
    docs/hardware/so101_joints.yaml --mounting docs/hardware/so101_mounting.yaml --targets
    docs/hardware/so101_poses.csv --dry-run

    On the arm: the same with --port /dev/ttyACM0 instead of --dry-run. Once with --plain too, which
    sends the targets as they are, to see what compensation gains.
    """

    joints: Path
    """YAML file of the joints: K, servo, friction, as elastic identify writes it."""
    targets: Path | None = None
    """CSV file of targets: a column for each joint [rad], a row for each pose; or with time_s
    before, angles in time. "-" reads lines from standard input as they come: angles of all
    joints with commas, or JSON such as {"elbow_flex": 0.3}."""
    listen: int | None = quantity("1", None, ge=0, le=65_535)
    """Take such lines from a TCP client on this port of 127.0.0.1, and answer each with the
    state as JSON; 0 for a free port."""
    hold_s: float = quantity("s", 1.0, ge=0.1, le=3600)
    """How long each pose of a file is held [s]."""
    limit_rad: float = quantity("rad", 0.3, gt=0, le=1)
    """Largest offset between command and target [rad]."""
    plain: bool = False
    """Send targets as they are, without compensation."""

    def run(self, console: Console) -> None:
        """Check, move, log."""
        if (self.targets is None) == (self.listen is None):
            raise ConfigurationError(
                "name targets: --targets FILE.csv, --targets - for standard input, or --listen PORT"
            )
        setup = ArmSetup(self, self.joints, self.limit_rad)
        # a bad file or a port in use must fail before anything moves
        self._targets(setup, setup.middle).close()
        compensator = Uncompensated(setup.compensator) if self.plain else setup.compensator
        move_arm(setup, compensator, lambda start: self._targets(setup, start), console)

    def _targets(self, setup: ArmSetup, start: Array) -> Targets:
        """Targets of a client, of standard input, or of a file."""
        ends = (setup.lowest, setup.highest)
        if self.listen is not None:
            return Socket(self.listen, setup.joints, *ends)
        assert self.targets is not None
        if str(self.targets) == "-":
            return Stream(sys.stdin.fileno(), setup.joints, *ends)
        period_s = 1.0 / setup.settings.rate_hz
        return read_targets(
            self.targets, setup.joints, start, *ends, hold_s=self.hold_s, period_s=period_s
        )


class LogPoses(ArmOptions):
    """Log poses of an arm for elastic identify, each approached from both sides.

    The joints need not be identified: targets are sent as they are. Writes log.csv with every
    cycle, servo_JOINT.csv of each servo for elastic identify --log, and poses.csv with the rests. A
    tracker's columns can be added to poses.csv.

    Example: elastic hardware log --robot arm.urdf --mounting mounting.yaml --port /dev/ttyACM0

    Then, where all servos are equal: elastic identify --log runs/hardware/servo_*.csv

    Otherwise for each joint: elastic identify --log runs/hardware/servo_elbow_flex.csv --joints
    elbow_flex
    """

    joints: Path | None = None
    """YAML file of the joints, for the check and a dry run; default typical values of the servos
    that the mounting names."""
    targets: Path | None = None
    """CSV file of poses, such as plan.csv of elastic identify --plan; default random ones."""
    poses: int = quantity("1", 20, ge=1, le=1000)
    """Number of random poses, where no file gives poses [1]."""
    within_rad: float = quantity("rad", 0.5, gt=0, le=3)
    """Largest distance of random poses from the start of the arm, by joint [rad]."""
    apart_rad: float = quantity("rad", 0.15, ge=0.02, le=0.5)
    """Distance from which each pose is approached, from below and from above [rad]."""
    hold_s: float = quantity("s", 1.0, ge=0.2, le=60)
    """How long each pose is held [s]."""
    seed: int = quantity("1", 0, ge=0)
    """Seed of the random poses [1]."""

    def run(self, console: Console) -> None:
        """Check, visit the poses, log."""
        setup = ArmSetup(self, self.joints)
        self._poses(setup, setup.middle)  # a bad file must fail before anything moves

        def make_targets(start: Array) -> Targets:
            poses = self._poses(setup, start)
            return Poses(poses_from_both_sides(poses, self.apart_rad), self.hold_s)

        compensator = Uncompensated(setup.compensator)
        folder, rests = move_arm(setup, compensator, make_targets, console)
        path = write_rests(folder / "poses.csv", rests, setup.joints)
        console.print(f"  {path}")

    def _poses(self, setup: ArmSetup, start: Array) -> Array:
        """Poses of the file or random ones, (N, n) [rad].

        They keep `apart_rad` off the ends of the ranges, so that both approaches stay within.
        """
        lowest = setup.lowest + self.apart_rad
        highest = setup.highest - self.apart_rad
        if self.targets is not None:
            targets = read_targets(
                self.targets, setup.joints, start, lowest, highest, hold_s=1.0, period_s=1.0
            )
            if not isinstance(targets, Poses):
                raise ConfigurationError(f"{self.targets} must hold poses, without time_s")
            return targets.poses
        spread = np.random.default_rng(self.seed).uniform(-1.0, 1.0, (self.poses, len(start)))
        return np.clip(start + self.within_rad * spread, lowest, highest)


def poses_from_both_sides(poses: Array, apart_rad: float) -> Array:
    """Each pose twice, once after a pose below it and once after one above, (4 N, n) [rad]."""
    from_below = np.stack([poses - apart_rad, poses], axis=1)
    from_above = np.stack([poses + apart_rad, poses], axis=1)
    return np.concatenate([from_below, from_above], axis=1).reshape(-1, poses.shape[1])


def write_rests(path: Path, rests: dict[int, ArmState], joints: tuple[str, ...]) -> Path:
    """Write the rests at the poses as a log for `elastic identify --robot`.

    Args:
        path: New file.
        rests: Last states by number, as `poses_from_both_sides` orders them.
        joints: Names of the joints.
    """
    at_poses = [state for number, state in rests.items() if number % 2 == 1]
    direction = np.array([1.0 if n % 4 == 1 else -1.0 for n in rests if n % 2 == 1])
    columns: dict[str, Array] = {}
    for signal in ("theta", "torque"):
        for i, joint in enumerate(joints):
            values = [getattr(state, signal)[i] for state in at_poses]
            columns[f"{signal}.{joint}"] = np.array(values)
    columns |= {f"direction.{joint}": direction for joint in joints}
    return write_poses(path, columns)
