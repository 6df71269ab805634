"""Logs of an arm's servos for `elastic identify --log`, made from the log of its motion."""

from pathlib import Path

import numpy as np
import pandas as pd

from baselines.identification.servo_log import known_loads
from elastic_env.hardware.live.joint_check import LEAST_LOAD_NM
from train.commands.hardware_arm import ArmSetup

_MAX_ROWS = 200_000
_MIN_ROWS = 10
"""Fewest rows from which a servo can be identified."""


def write_servo_logs(log: Path, setup: ArmSetup) -> list[Path]:
    """Write a log of each servo: time, goal, position, inertia and known torque.

    Servos that carry no weight are left out: their torque is not known. The known torque is that of
    the weight and of the other joints' motion, by the model at the encoders' angles.

    Args:
        log: Log of the motion; the new files go into its folder.
        setup: The arm.

    Returns:
        Paths of the new files.
    """
    table = pd.read_csv(log, nrows=_MAX_ROWS)
    columns = [f"theta.{joint} [rad]" for joint in setup.joints]
    theta = table[columns].to_numpy(dtype=np.float64)
    is_complete = np.isfinite(theta).all(axis=1)
    if is_complete.sum() < _MIN_ROWS:
        return []
    table = table.loc[is_complete]
    angles = np.ascontiguousarray(theta[is_complete])
    time_s = table["time [s]"].to_numpy()
    inertia, load = known_loads(setup.links, time_s, angles)
    weight = setup.links.gravity_torque(angles)
    files = []
    for column, joint in enumerate(setup.joints):
        if np.abs(weight[:, column]).max() < LEAST_LOAD_NM:
            continue
        content = {
            "time [s]": time_s,
            "goal [rad]": table[f"command.{joint} [rad]"],
            "position [rad]": angles[:, column],
            "inertia [kg·m²]": inertia[column],
            f"tau_known.{joint} [N·m]": load[:, column],
        }
        files.append(log.with_name(f"servo_{joint}.csv"))
        pd.DataFrame(content).to_csv(files[-1], index=False, float_format="%.9g")
    return files
