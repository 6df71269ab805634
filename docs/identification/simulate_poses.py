"""Makes poses.csv: static poses of the arm in arm.xml with elastic joints, as MuJoCo's gravity
bends it.

python docs/identification/simulate_poses.py
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.optimize import root

HERE = Path(__file__).parent
STIFFNESS = {
    "base_yaw": 2000.0,
    "shoulder_pitch": 1800.0,
    "upper_roll": 1100.0,
    "elbow": 900.0,
    "fore_roll": 300.0,
    "wrist_pitch": 250.0,
    "wrist_roll": 180.0,
}
"""True K [N·m/rad]."""
ENCODER_COUNTS = 501_923
TRACKER_NOISE_M = 0.3e-3
TRACKER_ORIGIN_M = (0.4, -1.2, 0.3)


@dataclass(frozen=True)
class Truth:
    """What the simulated arm has and the identification does not know."""

    stiffness: Sequence[float] = tuple(STIFFNESS.values())
    """K [N·m/rad]."""
    offset: Sequence[float] = (0.004, -0.006, 0.003, 0.005, -0.004, 0.006, -0.005)
    """Encoder offsets [rad]."""
    friction: Sequence[float] = (0.0,) * 7
    """Friction on the link side of the springs [N·m]."""


def link_angles(
    model: mujoco.MjModel, theta: np.ndarray, K: np.ndarray, friction: np.ndarray
) -> np.ndarray:
    """Link angles at which the springs balance gravity and a friction torque, (n,) [rad]."""
    data = mujoco.MjData(model)

    def imbalance(q: np.ndarray) -> np.ndarray:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        return (K * (theta - q) - data.qfrc_bias - friction) / K

    return root(imbalance, theta, tol=1e-13).x


def pose_columns(
    model: mujoco.MjModel,
    theta: np.ndarray,
    truth: Truth,
    generator: np.random.Generator,
    sides: bool,
) -> dict[str, np.ndarray]:
    """Columns of a log of poses with motor angles θ, (N, n) [rad]."""
    joints = [model.joint(i).name for i in range(model.njnt)]
    K = np.asarray(truth.stiffness)
    data = mujoco.MjData(model)
    direction = generator.choice([-1.0, 1.0], size=theta.shape)
    count = 2.0 * np.pi / ENCODER_COUNTS
    read = np.round((theta + np.asarray(truth.offset)) / count) * count
    markers = np.empty((len(theta), 3))
    for i, row in enumerate(theta):
        data.qpos[:] = link_angles(model, row, K, direction[i] * np.asarray(truth.friction))
        mujoco.mj_forward(model, data)
        markers[i] = data.site("marker").xpos
    markers += np.asarray(TRACKER_ORIGIN_M) + generator.normal(0.0, TRACKER_NOISE_M, markers.shape)
    columns = {f"theta.{name}": read[:, i] for i, name in enumerate(joints)}
    columns |= {f"end_effector.{axis}": markers[:, i] for i, axis in enumerate("xyz")}
    return columns | (
        {f"direction.{name}": direction[:, i] for i, name in enumerate(joints)} if sides else {}
    )


def random_poses(model: mujoco.MjModel, count: int, generator: np.random.Generator) -> np.ndarray:
    """Motor angles within 90 % of the joint ranges, with the marker above the floor, (count, n)
    [rad].
    """
    data = mujoco.MjData(model)
    poses = []
    while len(poses) < count:
        theta = 0.9 * generator.uniform(model.jnt_range[:, 0], model.jnt_range[:, 1])
        data.qpos[:] = theta
        mujoco.mj_forward(model, data)
        if data.ncon == 0 and data.site("marker").xpos[2] > 0.1:
            poses.append(theta)
    return np.array(poses)


def main() -> None:
    """Write poses.csv."""
    model = mujoco.MjModel.from_xml_path(str(HERE / "arm.xml"))
    generator = np.random.default_rng(0)
    theta = random_poses(model, 40, generator)
    columns = pose_columns(
        model, theta, Truth(friction=(2.0, 2.0, 1.5, 1.0, 0.5, 0.4, 0.3)), generator, sides=True
    )
    units = {"theta": " [rad]", "end_effector": " [m]", "direction": ""}
    with (HERE / "poses.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([name + units[name.split(".")[0]] for name in columns])
        writer.writerows(
            [[f"{value:.7g}" for value in row] for row in zip(*columns.values(), strict=True)]
        )


if __name__ == "__main__":
    main()
