"""Records of a control step with named fields: one per joint and one per world.

They are NumPy's structured types, which Numba compiles: `joints[world, i].truth.theta` in a kernel,
`joints["truth"]["theta"]` in NumPy. A joint is a record, so the compiled code serves any number of
joints. `truth` is the state of the physics, `measured` are the readings of the sensors. No quantity
is in both.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from elastic_env.core.signals import Array, SignalTable
from elastic_env.joint.elasticity import joint_torque
from elastic_env.joint.joint_names import JointAddresses, servo_name
from elastic_env.world.physics import DIVERGED_RAD_S
from elastic_env.world.sensors import angle_of_count

Records: TypeAlias = npt.NDArray[Any]
"""An array of one of these types."""

REAL = np.float64
WHOLE = np.int64


def record_type(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    """Return a structured type whose records have attributes, in NumPy and in compiled code.

    Numbers are aligned, because a GPU cannot read others.
    """
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def floats(names: str, shape: int | tuple[int, ...] = ()) -> list[tuple[Any, ...]]:
    """Fields of real numbers, all of one shape."""
    return [(name, REAL, shape) for name in names.split()]


_JOINT_TRUTH = record_type(
    *floats("q_ref theta theta_dot q q_dot"),  # motor and link side [rad], [rad/s]
    # a, θ_cmd = q_ref + a [rad]; change of a [rad/s]
    *floats("offset command command_rate"),
    *floats("stiffness damping"),  # true K [N·m/rad] and D [N·m·s/rad]
    *floats("backlash homing"),  # dead band, and the encoder's offset from θ [rad]
)
# now, and a step ago [rad]
_JOINT_MEASUREMENTS = record_type(*floats("encoder last_encoder"))
JOINT = record_type(("truth", _JOINT_TRUTH), ("measured", _JOINT_MEASUREMENTS))
"""A joint in a control step. Spring, backlash and homing error are drawn per episode."""

COMMON_TRUTH: Any = (
    ("step", WHOLE),  # control steps since the start of the episode
    ("command_rate", REAL),  # rms over the joints [rad/s]
    ("clipped", np.bool_),  # the action was beyond its bounds
    ("diverged", np.bool_),  # the world has no new state
)
"""Fields in the truth of every world."""

RULES = record_type(
    ("control_period_s", REAL),
    ("is_delayed", np.bool_),  # measurements are observed a step late
    ("count_rad", REAL),  # angle of an encoder count, 0 for continuous encoders
    ("highest_rad_s", REAL),  # beyond this speed the simulation has diverged
)
"""Rules of the joints of a world."""

ADDRESS = record_type(
    # theta and q in qpos, theta_dot and q_dot in qvel, servo in ctrl
    *((name, WHOLE) for name in ("theta", "q", "theta_dot", "q_dot", "servo"))
)
"""Indices of a joint in the physics."""

LINK_SCORES = record_type(*floats("link_error command_rate divergence"))
"""Weighted terms of the reward of links on a fixed base, or their weights."""

LINK_WORLD = record_type(
    # scored and rest as in a `Plan`
    ("truth", record_type(*COMMON_TRUTH, ("scored", np.bool_), ("rest", WHOLE))),
    # link angle now, and with the scenario's delay [rad]
    ("measured", record_type(*floats("imu visible_imu"))),
    ("scores", LINK_SCORES),
)
"""A control step of a world with links on a fixed base."""

LINK_CONSTANTS = record_type(
    ("weights", LINK_SCORES), *floats("imu_noise_rad imu_bias_rad imu_sine_error_rad")
)
"""Constants of links on a fixed base."""

SCHEDULE = record_type(("scored", np.bool_), ("rest", WHOLE), ("imu_is_due", np.bool_))
"""Schedule of a control step; scored and rest as in a `Plan`."""


class Sample(NamedTuple):
    """One or several control steps to be scored; nothing changes them later.

    Attributes:
        joints: Records of `JOINT`, (rows, n).
        worlds: Records of the task's `world_type`, (rows,).
    """

    joints: Records
    worlds: Records


def single_record(record: np.dtype[Any], **values: Any) -> Records:
    """Return an array of one record with these values, (1,)."""
    row = np.zeros(1, record)
    for name in row.dtype.names or ():
        row[name] = values.pop(name)
    assert not values
    row.flags.writeable = False
    return row


def joint_addresses(model: mujoco.MjModel, joints: Sequence[str]) -> Records:
    """Records of `ADDRESS`, (n,)."""
    in_state = JointAddresses.of(model, joints)
    rows = np.zeros(len(joints), ADDRESS)
    for name in ("theta", "q", "theta_dot", "q_dot"):
        rows[name] = getattr(in_state, name)
    rows["servo"] = [model.actuator(servo_name(joint)).id for joint in joints]
    return rows


def first_columns(table: SignalTable, groups: Sequence[str]) -> Records:
    """First column of each group in a table, as one record, (1,)."""
    record = record_type(*((group, WHOLE) for group in groups))
    columns = {group: table.group(group).start for group in groups}
    return single_record(record, **columns)


def joint_rules(period_s: float, kinds: Sequence[tuple[int | None, bool]]) -> Records:
    """Records of `RULES`, one per kind of world.

    Args:
        period_s: Control period [s].
        kinds: Encoder counts per turn, None for continuous encoders, and True if measurements are
            delayed.
    """
    rules = np.zeros(len(kinds), RULES)
    rules["control_period_s"] = period_s
    rules["count_rad"] = [angle_of_count(counts) for counts, _ in kinds]
    rules["is_delayed"] = [is_delayed for _, is_delayed in kinds]
    rules["highest_rad_s"] = DIVERGED_RAD_S
    return rules


def spring_torque(truth: Records) -> Array:
    """Torque of spring and damper on the links, from the truth of joints, (rows, n) [N·m]."""
    deflection = truth["theta"] - truth["q"]
    rate = truth["theta_dot"] - truth["q_dot"]
    spring = (truth["stiffness"], truth["damping"], truth["backlash"])
    return joint_torque(deflection, rate, *spring)
