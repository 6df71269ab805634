"""Signals and metrics of links on a fixed base.

The signals of one joint have plain names, those of several joints are `name.<joint>`. With several
joints there are figures of all joints together under the plain names: rms of the link errors,
deflections, servo errors and rates of the offsets, and the largest joint torque.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.files import read_rows
from elastic_env.core.signals import Array, Signal, Signals
from elastic_env.world.metrics import Metric
from elastic_env.world.records import Records, spring_torque

LINK_IMU = Signal("link_angle_imu", "rad", "IMU on the link", kind="measured")
LINK_IMU_SENSOR = "link_imu"
"""Its name in `sensors=[...]`, on a robot of one joint; its errors are the errors of the
scenario's IMU.
"""

_METRIC_ROWS = read_rows(Path(__file__).with_name("joint_metrics.csv"))


def _metrics_for(robots: str) -> tuple[Metric, ...]:
    rows = [dict[str, Any](row) for row in _METRIC_ROWS]
    return tuple(Metric(**row) for row in rows if row.pop("robots") == robots)


METRICS_OF_ONE = _metrics_for("one")
_METRICS_OF_SEVERAL = _metrics_for("several")
_METRICS_OF_TOOL = _metrics_for("end_effector")


def metrics_of(num_joints: int, has_end_effector: bool) -> tuple[Metric, ...]:
    """Figures of an episode of links on a fixed base."""
    of_joints = METRICS_OF_ONE if num_joints == 1 else _METRICS_OF_SEVERAL
    return (*of_joints, *_METRICS_OF_TOOL) if has_end_effector else of_joints


def link_signals(joints: Records, worlds: Records, names: Sequence[str]) -> Signals:
    """Signals of links and joints by name, one value per row.

    Args:
        joints: Truth of the joints, (rows, n).
        worlds: Records of `LINK_WORLD`, (rows,).
        names: Names of the joints.
    """
    q_ref = joints["q_ref"]
    q = joints["q"]
    of_joints = {
        "reference_angle": q_ref,
        "link_angle": q,
        "link_error": q_ref - q,
        "deflection": joints["theta"] - q,
        "joint_torque": spring_torque(joints),
        "servo_error": joints["command"] - joints["homing"] - joints["theta"],
        "command_rate": joints["command_rate"],
    }
    if len(names) > 1:
        return _signals_of_several(of_joints, names)
    imu = worlds["measured"]["visible_imu"]
    signals = {name: rows[:, 0].copy() for name, rows in of_joints.items()}
    return {**signals, "link_angle_imu": imu.copy(), "link_error_imu": q_ref[:, 0] - imu}


def _signals_of_several(of_joints: dict[str, Array], names: Sequence[str]) -> Signals:
    """Signals of each joint, and of all joints together."""
    each = {
        f"{name}.{joint}": values[:, column].copy()
        for name, values in of_joints.items()
        for column, joint in enumerate(names)
    }
    error = of_joints["link_error"]
    rms_names = ("link_error", "deflection", "servo_error", "command_rate")
    squares = {name: np.square(of_joints[name]) for name in rms_names}
    return {
        **each,
        **{name: np.sqrt(square.mean(axis=1)) for name, square in squares.items()},
        "link_error_lowest": error.min(axis=1),
        "link_error_highest": error.max(axis=1),
        "link_error_largest": np.abs(error).max(axis=1),
        "joint_torque": np.abs(of_joints["joint_torque"]).max(axis=1),
    }
