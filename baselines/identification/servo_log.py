"""Logs in time of one position servo: read, with their load and gain, and checked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from baselines.identification.servo_file import AngleUnit, read_content
from baselines.identification.servo_load import NO_LOAD, Load
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.rigid.rigid_body import RigidBody

FEWEST_ROWS = 50
"""Rows that a fit needs."""

_LONGEST_ROW_S = 0.2
"""Longest median time between rows."""
_LONGEST_GAP_S = 0.3
"""Longest time between two rows."""
_LARGEST_ANGLE = 4.0 * math.pi
_LARGEST_JUMP = 3.0
"""Largest change of the position between two rows [rad]."""
_LARGEST_GOAL_JUMP = 5.5
"""Largest change of the goal between two rows, which may be a step [rad]."""
_LEAST_MOTION = 0.01
"""Least motion of position and goal [rad]."""
_WINDOW_S = 0.06
"""Window of the moving parabola."""
_RELATIVE_TOLERANCE = 1e-6
"""Relative difference within which option and file agree."""
_LARGEST_SPAN_RATIO = 8.0
"""Ratio of the spans of goal and position from which their units differ."""
_CONTRADICTING_CORRELATION = 0.5
"""Correlation of the error with the torque of the load, from which a log contradicts itself."""
SLOW = (0.02, 0.5)
"""Speeds of slow motion; below the first one the joint is at rest [rad/s]."""
_STEADY_SHARE = 0.05
"""Inertial torque over the largest torque of the load below which motion is steady."""


@dataclass(frozen=True)
class ServoLog:
    """One motion of one servo.

    Attributes:
        name: Name of the log, for tables.
        time: Clock, growing, (N,) [s].
        goal: Commanded angle, (N,) [rad].
        position: Measured angle, (N,) [rad].
        enabled: True while the servo's torque is on, (N,).
        gain: Value of the servo's gain register [1]; None if it is not known.
        load: Load of the joint.
        pwm: Duty of the motor's voltage in any unit, (N,); None if not logged.
        known_torque: Known further torque on the joint, (N,) [N·m]; None if there is none.
        supply: Voltage of the supply [V]; 1 if it is not known.
    """

    name: str
    time: Array
    goal: Array
    position: Array
    enabled: BoolArray
    gain: float | None = None
    load: Load = NO_LOAD
    pwm: Array | None = None
    known_torque: Array | None = None
    supply: float = 1.0

    def __len__(self) -> int:
        return len(self.time)

    @property
    def register(self) -> float:
        """Value of the gain register; 1 if it is not known."""
        return 1.0 if self.gain is None else self.gain

    def part(self, rows: slice) -> "ServoLog":
        """Log of some of the rows."""
        arrays = {k: v[rows] for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)

    def external_torque(self, q: Array) -> Array:
        """Torque of weight and known torque on the joint, (N,) [N·m]."""
        weight = self.load.pull(q)
        return weight if self.known_torque is None else weight + self.known_torque

    def torque_per_gain(self, limit: float | None) -> Array:
        """Torque of the motor at standstill over its gain k, as in `Replay`, (N,) [V·rad].

        The register's error is limited before the supply's voltage scales it.

        Args:
            limit: Torque limit over the gain, T/k [rad]; None for no limit.
        """
        error = self.register * (self.goal - self.position)
        if limit is not None:
            error = np.clip(error, -limit, limit)
        return error * self.supply * self.enabled

    def derivatives(self) -> tuple[Array, Array]:
        """Speed and acceleration, (N,) [rad/s], [rad/s²]."""
        return derivatives(self.time, self.position)


def derivatives(time: Array, position: Array) -> tuple[Array, Array]:
    """Speed and acceleration by a moving parabola over 60 ms, (N,) [rad/s], [rad/s²]."""
    step = float(np.median(np.diff(time)))
    window = max(5, 2 * int(0.5 * _WINDOW_S / step) + 1)
    grid = np.arange(time[0], time[-1] + step, step)
    q = np.interp(grid, time, position)
    window = min(window, 2 * ((len(grid) - 1) // 2) + 1)
    slopes = [np.asarray(savgol_filter(q, window, 2, deriv=n, delta=step)) for n in (1, 2)]
    return np.interp(time, grid, slopes[0]), np.interp(time, grid, slopes[1])


def known_loads(body: RigidBody, time: Array, position: Array) -> tuple[Array, Array]:
    """Inertia and torque that each joint of an arm carries by its model.

    Args:
        body: The model.
        time: Clock, (N,) [s].
        position: Angles of its joints, (N, n) [rad].

    Returns:
        Inertia about the joint, mean over the rows, (n,) [kg·m²]; and the torque of weight and of
        the other joints' motion, positive where it turns the joint forward, (N, n) [N·m].
    """
    rates = np.array([derivatives(time, q) for q in position.T])
    q_dot, q_ddot = np.moveaxis(rates, 0, -1)
    weight = body.gravity_torque(position)
    inertia = np.empty(position.shape[1])
    for joint, unit in enumerate(np.eye(len(inertia))):
        acceleration = np.broadcast_to(unit, position.shape)
        torque = body.inverse_dynamics(position, np.zeros_like(position), acceleration)
        inertia[joint] = np.mean((torque - weight)[:, joint])
    return inertia, inertia * q_ddot - body.inverse_dynamics(position, q_dot, q_ddot)


def slow_rows(log: ServoLog) -> BoolArray:
    """Rows in which the torque is on and the joint moves slowly and steadily, (N,)."""
    w, a = log.derivatives()
    inertia = log.load.inertia or 0.0
    weight = max(float(np.abs(log.external_torque(log.position)).max()), 1e-12)
    steady = np.abs(inertia * a) < _STEADY_SHARE * weight
    return log.enabled & (np.abs(w) > SLOW[0]) & (np.abs(w) < SLOW[1]) & steady


def read_servo_log(
    path: Path,
    load: Load | None = None,
    gain: float | None = None,
    unit: AngleUnit | None = None,
    joint: str | None = None,
) -> ServoLog:
    """Read and check a log.

    Args:
        path: CSV file, JSON file of a recorder of servos, or parquet file of LeRobot.
        load: Load of the joint; None for the load in the file.
        gain: Value of the gain register; None for the value in the file.
        unit: Unit of the angles; None for the unit in the file, or radians.
        joint: Joint to read, where the file has several.

    Raises:
        ConfigurationError: The log cannot be used; the message says what to change.
    """
    columns, facts, file_unit = read_content(path, joint)
    if unit is not None and file_unit not in (None, unit):
        raise ConfigurationError(
            f"{path}: its header says [{file_unit}], and --angles {unit}; leave --angles out"
        )
    scale = math.pi / 180.0 if "deg" in (unit, file_unit) else 1.0
    load = _consistent_load(path, load, facts)
    if load is None and "inertia" in columns:
        load = Load(inertia=float(np.mean(columns["inertia"])))
    gain = _consistent_gain(path, gain, columns, facts)
    if "voltage" in columns and not columns["voltage"].min() > 0.0:
        raise ConfigurationError(
            f"{path}, column voltage: a supply must be above 0 V, got"
            f" {columns['voltage'].min():g}; leave the column out if it is not known"
        )
    enabled = columns.get("torque_enable", np.ones(len(columns["time"]))) > 0.5
    pwm = columns.get("pwm")
    log = ServoLog(
        name=path.stem,
        time=columns["time"],
        goal=scale * columns["goal"],
        position=scale * columns["position"],
        enabled=enabled,
        gain=gain,
        load=load or NO_LOAD,
        pwm=None if pwm is None or not pwm.any() else _sign_extend(pwm),
        known_torque=columns.get("known_torque"),
        supply=float(np.median(columns["voltage"]))
        if "voltage" in columns
        else facts.get("vin", 1.0),
    )
    if load is None and log.known_torque is None:
        raise ConfigurationError(
            f"{path} does not say what hangs on the joint; give --mass-kg and --lever-m of a"
            " pendulum, --robot with --joints, or a column tau_known [N·m]"
        )
    require_usable(path, log)
    return log


def _consistent_load(path: Path, load: Load | None, facts: Mapping[str, float]) -> Load | None:
    """Load of the joint by options and file.

    Raises:
        ConfigurationError: Options and file contradict each other.
    """
    if not {"mass", "length"} <= set(facts):
        return load
    rod = facts.get("arm_mass", 0.0)
    file_load = Load.pendulum(facts["mass"], facts["length"], rod)
    if load is not None and not _is_same_load(load, file_load):
        arm = f" and an arm of {rod:g} kg" if rod else ""
        raise ConfigurationError(
            f"{path} says that {facts['mass']:g} kg hang at {facts['length']:g} m{arm}, and the"
            " options say another load; leave --mass-kg, --lever-m and --robot out, or correct"
            " the file"
        )
    return file_load


def _is_same_load(load: Load, other: Load) -> bool:
    if load.inertia is None or other.inertia is None:
        return load == other
    return (
        math.isclose(load.torque, other.torque, rel_tol=_RELATIVE_TOLERANCE)
        and math.isclose(load.inertia, other.inertia, rel_tol=_RELATIVE_TOLERANCE)
        and abs(load.rest - other.rest) < _RELATIVE_TOLERANCE
    )


def _consistent_gain(
    path: Path, gain: float | None, columns: Mapping[str, Array], facts: Mapping[str, float]
) -> float | None:
    """Value of the gain register by option and file; None where neither gives one.

    Raises:
        ConfigurationError: Both contradict each other, or the gain changes, or is not positive.
    """
    file_gain = facts.get("kp")
    if "gain" in columns:
        file_gain = float(columns["gain"][0])
        if np.ptp(columns["gain"]) > 0.0:
            raise ConfigurationError(
                f"{path}: the gain changes within the log; give each gain a file of its own"
            )
    if (
        file_gain is not None
        and gain is not None
        and not math.isclose(file_gain, gain, rel_tol=_RELATIVE_TOLERANCE)
    ):
        raise ConfigurationError(
            f"{path} says that the gain is {file_gain:g}, and --gain {gain:g}; leave --gain out, or"
            " correct the file"
        )
    value = gain if file_gain is None else file_gain
    if value is not None and not value > 0.0:
        raise ConfigurationError(f"{path}: the gain must be positive, got {value:g}")
    return value


def require_usable(path: Path, log: ServoLog) -> None:
    """Refuse a log that no servo can have produced.

    Raises:
        ConfigurationError: Too few rows, a clock that stops, goes back or jumps, angles in another
            unit or wrapped, a goal that never moves, or goal and position exchanged.
    """
    if len(log) < FEWEST_ROWS:
        raise ConfigurationError(
            f"{path} has {len(log)} rows, and at least {FEWEST_ROWS} are needed; log the whole"
            " motion, some ten rows or more a second"
        )
    _require_clock(path, log)
    _require_angles(path, log)
    if log.enabled.any():
        _require_plausible_goal(path, log)


def _require_clock(path: Path, log: ServoLog) -> None:
    step = np.diff(log.time)
    if step.min() <= 0.0:
        row = int(np.argmax(step <= 0.0)) + 2
        raise ConfigurationError(
            f"{path}: the time must grow, and in row {row} it goes from {log.time[row - 2]:g} to"
            f" {log.time[row - 1]:g} s; sort the rows, and give each clock a file of its own"
        )
    if np.median(step) > _LONGEST_ROW_S:
        raise ConfigurationError(
            f"{path}: rows are {np.median(step):g} s apart, at most {_LONGEST_ROW_S} are usable;"
            " convert a time in milliseconds to seconds, or log faster"
        )
    if step.max() > _LONGEST_GAP_S:
        row = int(np.argmax(step)) + 1
        raise ConfigurationError(
            f"{path} has a gap of {step.max():.2g} s after row {row}, at most {_LONGEST_GAP_S} are"
            " bridged; cut the log there and give both parts"
        )


def _require_angles(path: Path, log: ServoLog) -> None:
    for name, angles in (("goal", log.goal), ("position", log.position)):
        if np.abs(angles).max() > _LARGEST_ANGLE:
            raise ConfigurationError(
                f"{path}, column {name}: {np.abs(angles).max():.4g} rad is beyond two turns;"
                " convert degrees or counts to radians, or say --angles deg"
            )
        jump = np.abs(np.diff(angles))
        if jump.max() > (_LARGEST_JUMP if name == "position" else _LARGEST_GOAL_JUMP):
            row = int(np.argmax(jump)) + 1
            raise ConfigurationError(
                f"{path}, column {name}: the angle jumps by {jump.max():.3g} rad after row {row};"
                " unwrap angles that wrap at ±π or 2π"
            )
    if np.ptp(log.position) < _LEAST_MOTION:
        raise ConfigurationError(
            f"{path}: the position moves by {np.ptp(log.position):.2g} rad only; log a motion of"
            " some tenths of a radian"
        )


def _require_plausible_goal(path: Path, log: ServoLog) -> None:
    goal = log.goal[log.enabled]
    position = log.position[log.enabled]
    if np.ptp(goal) < _LEAST_MOTION and log.enabled.all():
        raise ConfigurationError(
            f"{path}: the goal is constant at {goal[0]:.3g} rad and tells nothing of the servo;"
            " command a slow motion up and down"
        )
    spans = np.ptp(goal), np.ptp(position)
    if max(spans) > _LARGEST_SPAN_RATIO * max(min(spans), 0.1):
        raise ConfigurationError(
            f"{path}: the goal spans {np.ptp(goal):.3g} and the position {np.ptp(position):.3g};"
            " give both in radians"
        )
    torque = log.external_torque(log.position)[log.enabled]
    error = goal - position
    varies = min(np.ptp(torque), np.ptp(error)) > 0.0
    if varies and np.corrcoef(error, torque)[0, 1] > _CONTRADICTING_CORRELATION:
        raise ConfigurationError(
            f"{path}: the joint goes beyond its goal against the load; are goal and position"
            " exchanged, or is a sign or the zero (hanging down) wrong?"
        )


def _sign_extend(register: Array) -> Array:
    """Correct a register of 16 bits that was read without its sign; other values are unchanged."""
    is_register = register.max() > 2**15 and register.max() < 2**16
    return np.where(register > 2**15, register - 2**16, register) if is_register else register
