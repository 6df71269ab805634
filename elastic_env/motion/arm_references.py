"""References of robots of several joints: poses, moves, a line, a circle, a user's file.

Those of `elastic_env.motion.references` move every joint alike. These depend on the robot: on its
joint ranges, its home, and its end effector. All begin with a second of standing.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Field

from elastic_env.core.config import LARGEST_SEED, Locator, quantity
from elastic_env.core.csv_table import read_table
from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.motion import references, trajectory
from elastic_env.motion.inverse_kinematics import joint_path
from elastic_env.motion.references import AnyReference, RepeatableReference
from elastic_env.motion.trajectory import STAND_S, Plan, control_times, quintic
from elastic_env.rigid.tree.end_effector import EndEffector

_TRIES = 1000
_SHORTEST_S = 1e-6
_LARGEST_RAD = 1e4
_MOST_ROWS = 2_000_000
_HALF_TURN = np.pi / 2
_MARGIN = 0.1
"""Share of a joint's range that drawn poses keep from either end."""
_ROUNDS = 200
_NEARBY = 64
_STRIDE = 0.05
"""Search for a pose that servos hold: rounds, poses drawn in each, and their distance as a share of
the range.
"""


class WeakServosError(ConfigurationError):
    """Servos have too little torque for a motion."""


@dataclass(frozen=True)
class Workspace:
    """Properties of a robot that its references depend on.

    Attributes:
        joints: Names of the joints, in order.
        lowest, highest: Ranges of the joints, infinite where there is none, (n,) [rad].
        home: Angles about which the robot moves, (n,) [rad].
        lack: Torque that the servos lack to hold poses at rest, relative to their limits, summed
            over the joints; from (..., n) [rad] to (...) [1].
        end_effector: Tool; None for a robot without one.
    """

    joints: tuple[str, ...]
    lowest: Array
    highest: Array
    home: Array
    lack: Any
    end_effector: EndEffector | None

    def pose_bounds(self, within_rad: float = _HALF_TURN) -> tuple[Array, Array]:
        """Return lowest and highest angles of drawn poses, (n,) each [rad].

        They are a tenth of the range away from its ends, and within an angle of home.
        """
        extent = self.highest - self.lowest
        width = np.where(np.isfinite(extent), _MARGIN * extent, _MARGIN)
        low = np.maximum(self.lowest + width, self.home - within_rad)
        return low, np.minimum(self.highest - width, self.home + within_rad)

    def poses(self, generator: np.random.Generator, count: int, within_rad: float) -> Array:
        """Draw poses that the servos hold, evenly over the joint angles, (count, n) [rad].

        Raises:
            WeakServosError: The servos are too weak for almost all poses.
        """
        low, high = self.pose_bounds(within_rad)
        n = len(self.home)
        poses = np.empty((0, n))
        for _ in range(_TRIES):
            drawn = generator.uniform(low, np.maximum(high, low), (count, n))
            poses = np.concatenate([poses, drawn[self.lack(drawn) == 0.0]])[:count]
            if len(poses) == count:
                return poses
        raise WeakServosError(
            "the servos hold hardly any pose of the workspace; give them a larger torque_limit"
        )

    def held_home(self) -> Array | None:
        """Find a pose at or near home that the servos hold, (n,) [rad]; None if none is found."""
        generator = np.random.default_rng(0)
        low, high = self.pose_bounds()
        stride = _STRIDE * np.maximum(high - low, 0.0)
        pose = self.home
        for _ in range(_ROUNDS):
            if self.lack(pose) == 0.0:
                return self._move_home(pose)
            drawn = pose + stride * generator.standard_normal((_NEARBY, len(pose)))
            nearby = np.vstack([pose, np.clip(drawn, low, high)])
            pose = nearby[self.lack(nearby).argmin()]
        return None

    def _move_home(self, pose: Array) -> Array:
        """Move every joint of a pose home for which the servos still hold it, (n,) [rad]."""
        for joint, angle in enumerate(self.home):
            returned = pose.copy()
            returned[joint] = angle
            if self.lack(returned) == 0.0:
                pose = returned
        return pose


class _RandomPoses(RepeatableReference):
    """References with drawn poses."""

    positions: int = quantity("1", 8, ge=1, le=1000)
    """Number of poses [1]."""
    move_s: float = quantity("s", 2.0, gt=0, le=600)
    """Duration of a move [s]."""
    within_rad: float = quantity("rad", _HALF_TURN, gt=0, le=_HALF_TURN)
    """Largest angle between a joint's home and its poses [rad]."""
    seed: int | None = quantity("1", 0, ge=0, le=LARGEST_SEED)
    """Seed of the poses; None draws new ones per episode [1]."""

    def _motion(self, visits: Array, t: Array, period_s: float) -> tuple[Array, Array, Array]:
        """Return motion between poses, (T, n) each: one move at the beginning of each period."""
        number = _move_numbers(t, period_s, self.positions)
        share = (t - STAND_S - period_s * number) / self.move_s
        blend, blend_dot, blend_ddot = (x[:, None] for x in quintic(share))
        step = np.diff(visits, axis=0)[number]
        q_dot = blend_dot * step / self.move_s
        return visits[number] + blend * step, q_dot, blend_ddot * step / self.move_s**2


class Poses(_RandomPoses):
    """Static poses, drawn over the workspace within limits.

    The robot moves there from home, and is scored at rest.

    Moves are quintic. After each the robot rests: a time to settle, and a time in which it is
    scored.
    """

    kind: Literal["poses"] = "poses"
    settle_s: float = quantity("s", 1.5, ge=0, le=600)
    """Time at rest before the measurement [s]."""
    measure_s: float = quantity("s", 0.25, gt=0, le=600)
    """Time of the measurement [s]."""

    def through(self, visits: Array, period_s: float) -> Plan:
        """A plan of all joints, (T, n), from the first pose through the others."""
        period = self.move_s + self.settle_s + self.measure_s
        t = control_times(STAND_S + self.positions * period, period_s)
        number = _move_numbers(t, period, self.positions)
        since = t - STAND_S - period * number
        settled = self.move_s + self.settle_s
        is_at_rest = (since > settled + 1e-9) & (since <= period + 1e-9)
        rest = np.where(is_at_rest, number, -1)
        return Plan(*self._motion(visits, t, period), is_at_rest, rest)


class Moves(_RandomPoses):
    """Smooth moves from pose to pose, drawn over the workspace within limits, scored throughout."""

    kind: Literal["moves"] = "moves"
    seed: int | None = quantity("1", None, ge=0, le=LARGEST_SEED)
    """Seed of the poses; None draws new ones per episode [1]."""

    def through(self, visits: Array, period_s: float) -> Plan:
        """A plan of all joints, (T, n), from the first pose through the others."""
        t = control_times(STAND_S + self.positions * self.move_s, period_s)
        return _moving_plan(t, *self._motion(visits, t, self.move_s))


class _Path(RepeatableReference):
    """Paths of the end effector."""

    duration_s: float = quantity("s", 4.0, gt=0, le=600)
    """Time of one way, or of one turn [s]."""
    repeats: int = quantity("1", 1, ge=1, le=100)
    """Number of ways there and back, or of turns [1]."""

    def _plan_path(self, workspace: Workspace, place: Any, t: Array, *phase: Array) -> Plan:
        """Make a plan whose tool moves by `place(s)` from its start, for s and its rates."""
        s, s_dot, s_ddot = phase
        tool = workspace.end_effector
        if tool is None:
            raise ConfigurationError(
                f"the reference {getattr(self, 'kind', '')!r} moves an end effector;"
                " name one, end_effector=SITE"
            )
        path = joint_path(tool, workspace.home, place, float(s.max()))
        q = path(s)
        slope = path(s, 1)
        rate = s_dot[:, None]
        q_ddot = slope * s_ddot[:, None] + path(s, 2) * rate**2
        return _moving_plan(t, q, slope * rate, q_ddot)


class Line(_Path):
    """A straight line of the end effector from home, there and back, by inverse kinematics.

    Scored throughout.

    A robot of six joints or more keeps the orientation of the tool.
    """

    kind: Literal["line"] = "line"
    by: tuple[float, float, float] = (0.0, 0.0, -0.1)
    """Way from home, in the axes of the base [m]."""

    def joint_plan(self, workspace: Workspace, period_s: float) -> Plan:
        """A plan of all joints, (T, n)."""
        way_s = self.duration_s
        ways = 2 * self.repeats
        t = control_times(STAND_S + ways * way_s, period_s)
        number = _move_numbers(t, way_s, ways)
        is_back = number % 2 == 1
        phases = np.stack(quintic((t - STAND_S) / way_s - number))
        s, s_dot, s_ddot = np.where(is_back, -phases, phases)
        s = s + is_back

        def place(way: Array) -> Array:
            return way[..., None] * np.array(self.by)

        return self._plan_path(workspace, place, t, s, s_dot / way_s, s_ddot / way_s**2)


class Circle(_Path):
    """A circle of the end effector that starts at home, by inverse kinematics. Scored throughout.

    A robot of six joints or more keeps the orientation of the tool.
    """

    kind: Literal["circle"] = "circle"
    radius: float = quantity("m", 0.05, gt=0, le=10)
    """Radius of the circle [m]."""
    normal: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Axis of the circle in the axes of the base; its length does not matter."""

    def joint_plan(self, workspace: Workspace, period_s: float) -> Plan:
        """A plan of all joints, (T, n)."""
        length = np.linalg.norm(self.normal)
        if not length > 0.0:
            problem = "normal of a circle must have a length > 0, such as [0, 1, 0]"
            raise ConfigurationError(problem)
        axis = np.array(self.normal) / length
        down = np.cross(np.cross(axis, np.eye(3)[np.abs(axis).argmin()]), axis)
        across = np.cross(axis, down)
        n = self.repeats
        total = n * self.duration_s
        t = control_times(STAND_S + total, period_s)
        s, s_dot, s_ddot = quintic((t - STAND_S) / total)
        down = self.radius * down / np.linalg.norm(down)
        across = self.radius * across / np.linalg.norm(across)

        def place(turns: Array) -> Array:
            angle: Any = 2.0 * np.pi * turns[..., None]
            return (np.cos(angle) - 1.0) * down + np.sin(angle) * across

        rate = n * s_dot / total
        return self._plan_path(workspace, place, t, n * s, rate, n * s_ddot / total**2)


class Csv(RepeatableReference):
    """Angles over time from a user's file. Scored throughout.

    The file has a column `time_s` and one for each joint that moves, by its name [rad]. The other
    joints stay at home. Between its rows the motion is a cubic spline that starts and ends at rest.
    """

    kind: Literal["csv"] = "csv"
    file: Locator
    """Path of the file."""

    def joint_plan(self, workspace: Workspace, period_s: float) -> Plan:
        """A plan of all joints, (T, n)."""
        # imported late: it takes long, and few need it
        from scipy.interpolate import CubicSpline

        names, rows = _read_angles(Path(self.file), workspace.joints)
        times = rows[:, 0] - rows[0, 0]
        angles = np.tile(workspace.home, (len(rows), 1))
        angles[:, [workspace.joints.index(name) for name in names]] = rows[:, 1:]
        path = CubicSpline(times, angles, bc_type="clamped")
        t = control_times(STAND_S + float(times[-1]), period_s)
        since = np.clip(t - STAND_S, 0.0, times[-1])
        moving = ((t > STAND_S) & (t < STAND_S + times[-1]))[:, None]
        q_dot = np.where(moving, path(since, 1), 0.0)
        q_ddot = np.where(moving, path(since, 2), 0.0)
        return _moving_plan(t, path(since), q_dot, q_ddot)


OfArm: TypeAlias = Poses | Moves | Line | Circle | Csv
AnyArmReference: TypeAlias = AnyReference | OfArm
ArmReference = Annotated[AnyArmReference, Field(discriminator="kind")]

make_arm_reference = partial(
    references.make_reference, kinds=references.REFERENCES | references.kinds_of(OfArm)
)
"""Make a reference of a robot of several joints; arguments as in `make_reference`."""


def motion_of(reference: AnyArmReference, workspace: Workspace) -> trajectory.Motion:
    """Return the motion of all joints of a robot by a reference."""
    return trajectory.Motion(partial(_plan, reference, workspace), reference.is_random)


def _plan(
    reference: AnyArmReference,
    workspace: Workspace,
    generator: np.random.Generator,
    period_s: float,
) -> Plan:
    if isinstance(reference, Poses | Moves):
        chosen = reference.choose_generator(generator)
        poses = workspace.poses(chosen, reference.positions, reference.within_rad)
        return reference.through(np.vstack([workspace.home, poses]), period_s)
    if isinstance(reference, OfArm):
        return reference.joint_plan(workspace, period_s)
    return reference.plan_about(workspace.home, generator, period_s)


def _read_angles(file: Path, joints: tuple[str, ...]) -> tuple[list[str], Array]:
    """Read the joints and rows of a user's file: time [s], then their angles [rad].

    Raises:
        ConfigurationError: It cannot be read, or a column or value is invalid.
    """
    example = "time_s, then joints"
    names, rows = read_table(
        file, what="file of angles", row="row", most_rows=_MOST_ROWS, example=example
    )
    t = rows[:, 0]
    if names[0] != "time_s":
        needed = f"the first column of {file} must be time_s"
        raise ConfigurationError(f"{needed}, got {quote(names[0])}")
    require_known(f"column of {file}", names[1:], joints)
    if len(rows) < 2 or len(names) < 2:
        raise ConfigurationError(
            f"{file} must have two rows or more, and a column of angles or more beside time_s"
        )
    if (np.diff(t) <= 0.0).any() or t[-1] - t[0] > trajectory.LONGEST_S:
        raise ConfigurationError(
            f"time_s of {file} must increase from row to row, over at most"
            f" {trajectory.LONGEST_S:g} s"
        )
    if np.diff(t).min() < _SHORTEST_S or np.abs(rows[:, 1:]).max() > _LARGEST_RAD:
        raise ConfigurationError(
            f"{file} must have rows at least {_SHORTEST_S:g} s apart, and angles within"
            f" ±{_LARGEST_RAD:g} rad"
        )
    return list(names[1:]), rows


def _move_numbers(t: Array, period_s: float, count: int) -> IntArray:
    """Return the number of the move at each time, (T,); moves follow without pause."""
    past = np.ceil((t - STAND_S - 1e-9) / period_s) - 1.0
    return past.clip(0, count - 1).astype(np.int64)


def _moving_plan(t: Array, q: Array, q_dot: Array, q_ddot: Array) -> Plan:
    """Return a plan that is scored from the end of the standing."""
    scored: BoolArray = t > STAND_S
    return Plan(q, q_dot, q_ddot, scored, np.full(len(t), -1))
