"""Records of a control step: one per joint and one per world, with their fields by name.

NumPy's structured types, which Numba compiles as they stand: `joints[world, i].truth.theta` in a
kernel, `joints["truth"]["theta"]` in NumPy. A joint is a record, so the code that is compiled
serves any number of joints. Truth is what the physics did. Measurements are what sensors show of
it. Nothing is in both.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from elastic_env.core.signals import SignalTable
from elastic_env.joint.joint_names import JointAddresses, servo_name

Records: TypeAlias = npt.NDArray[Any]
"""An array of one of these types."""

REAL = np.float64
WHOLE = np.int64


def record_type(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    """A structured type whose records have their fields as attributes, compiled or not.

    Numbers are aligned, as a GPU reads no others.
    """
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def reals(names: str, shape: int | tuple[int, ...] = ()) -> list[tuple[Any, ...]]:
    """Fields of real numbers of one shape."""
    return [(name, REAL, shape) for name in names.split()]


_JOINT_TRUTH = record_type(
    *reals("q_ref theta theta_dot q q_dot"),  # motor and link side [rad], [rad/s]
    # a, θ_cmd = q_ref + a [rad]; change of a [rad/s]
    *reals("offset command command_rate"),
    *reals("stiffness damping"),  # true K [N·m/rad] and D [N·m·s/rad]
    *reals("backlash homing"),  # dead band, and what the encoder shows beyond θ [rad]
)
_JOINT_SHOWN = record_type(*reals("encoder encoder_before"))  # now and a step ago [rad]
JOINT = record_type(("truth", _JOINT_TRUTH), ("shown", _JOINT_SHOWN))
"""A joint in a control step. What is true of its spring and its encoder is drawn per episode."""

COURSE: Any = (
    ("step", WHOLE),  # control steps since the start of the episode
    ("command_rate", REAL),  # rms over the joints [rad/s]
    ("clipped", np.bool_),  # whether the action was beyond its bounds
    ("diverged", np.bool_),  # whether the world has no new state
)
"""Fields that the truth of every world has."""

RULES = record_type(
    ("control_period_s", REAL),
    ("is_delayed", np.bool_),  # whether measurements are shown a step late
    ("count_rad", REAL),  # of the encoders, 0 for none
    ("highest_rad_s", REAL),  # beyond it the simulation has diverged
)
"""Rules of the joints of a world."""

ADDRESS = record_type(
    # in qpos, in qvel, in ctrl
    *((name, WHOLE) for name in ("theta", "q", "theta_dot", "q_dot", "servo"))
)
"""Addresses of a joint in the physics."""

LINK_SCORES = record_type(*reals("link_error command_rate divergence"))
"""Weighted terms of the reward of links on a fixed base, or their weights."""

LINK_WORLD = record_type(
    # as in a `Plan`
    ("truth", record_type(*COURSE, ("scored", np.bool_), ("rest", WHOLE))),
    # link angle now, and as old as the scenario has it [rad]
    ("shown", record_type(*reals("imu visible_imu"))),
    ("scores", LINK_SCORES),
)
"""A control step of a world with links on a fixed base."""

LINK_CONSTANTS = record_type(
    ("weights", LINK_SCORES), *reals("imu_noise_rad imu_bias_rad imu_sine_error_rad")
)
"""Constants of links on a fixed base."""

SCHEDULE = record_type(("scored", np.bool_), ("rest", WHOLE), ("imu_is_due", np.bool_))
"""What is to happen in a control step, as in a `Plan`."""


class Sample(NamedTuple):
    """Control steps as they are scored, one or several, which nothing changes later.

    Attributes:
        joints: Of `JOINT`, (rows, n).
        worlds: Of the task's `WORLD`, (rows,).
    """

    joints: Records
    worlds: Records


def one(kind: np.dtype[Any], **values: Any) -> Records:
    """One record with these values, (1,)."""
    row = np.zeros(1, kind)
    for name in row.dtype.names or ():
        row[name] = values.pop(name)
    assert not values
    row.flags.writeable = False
    return row


def addresses(model: mujoco.MjModel, joints: Sequence[str]) -> Records:
    """Records of `ADDRESS`, (n,)."""
    known = JointAddresses.of(model, joints)
    found = np.zeros(len(joints), ADDRESS)
    for name in ("theta", "q", "theta_dot", "q_dot"):
        found[name] = getattr(known, name)
    found["servo"] = [model.actuator(servo_name(joint)).id for joint in joints]
    return found


def columns_of(table: SignalTable, groups: Sequence[str]) -> Records:
    """First column of each of some groups, one record."""
    kind = record_type(*((group, WHOLE) for group in groups))
    return one(kind, **{group: table.group(group).start for group in groups})
