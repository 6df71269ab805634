"""Signals and metrics of the walking task, by name."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.files import read_rows
from elastic_env.core.signals import Mirrored, Parameter, Signal, SignalGroup, SignalTable
from elastic_env.robots.thormang.model import LEG_JOINTS
from elastic_env.world.joint_signals import joint_groups
from elastic_env.world.metrics import Metric
from elastic_env.world.scenario import Scenario

_SIDEWAYS = ("_yaw", "_roll")
JOINTS: Mapping[str, Mirrored] = {
    name: "opposite" if name.endswith(_SIDEWAYS) else "same" for name in LEG_JOINTS
}
"""The joints in order, and the sign of each angle in the mirror image."""

_JOINT_GROUPS = joint_groups(JOINTS)


def _group(name: str, rows: list[dict[str, Any]]) -> SignalGroup:
    if name in _JOINT_GROUPS:
        return _JOINT_GROUPS[name]
    signals = tuple(Signal(**row) for row in rows)
    return SignalGroup(name, signals, _SHAPES.get(name, (len(signals),)))


_SHAPES = {"wrench": (2, 2, 3)}
"""Shapes of groups: feet, force and moment, axes."""
_rows_by_group = itertools.groupby(
    read_rows(Path(__file__).with_name("signals.csv")), key=lambda row: row["name"].split(".")[0]
)
GROUPS = tuple(_group(name, list(rows)) for name, rows in _rows_by_group)
"""Groups of the observation, from `signals.csv`."""

MEASURED = ("imu_attitude", "imu_rate", "wrench")
"""Groups with noise by `sensor_noise`."""


def sensor_noise(scenario: Scenario, is_inertial: bool) -> dict[str, Parameter]:
    """Standard deviations of the groups in `MEASURED`; before the filter of an inertial IMU."""
    attitude_rad = scenario.pelvis_imu.noise_rad
    rate_rad_s = scenario.gyro_noise_rad_s
    if is_inertial:
        attitude_rad = scenario.inertial.accelerometer_noise_rad
        rate_rad_s = scenario.inertial.gyro_noise_rad_s
    wrench = np.array([[scenario.force_noise_n] * 3, [scenario.moment_noise_nm] * 3])
    return {"imu_attitude": attitude_rad, "imu_rate": rate_rad_s, "wrench": wrench}


OBSERVATION = SignalTable.of(GROUPS)

FELL = "fell"

PHASES = ("double", "single", "transition")
"""Masks of parts of the walk: double support, single support, ±0.2 s around lift-off and
touch-down.
"""

BLOCKS = ("first_steps", "last_steps")
"""Masks of the first and of the last `BLOCK_STEPS` scored steps of the walk."""
BLOCK_STEPS = 4

METRICS = tuple(
    Metric(**row)  # pyright: ignore[reportArgumentType]  statistics are texts
    for row in read_rows(Path(__file__).with_name("metrics.csv"))
)
