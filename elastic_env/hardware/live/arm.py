"""An arm on a bus, moved by compensated commands in real time.

target → follower → compensator → servo angles → bus → servos
↑                          │
link estimate  └── motor encoders  ←──────┘
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.hardware.arm_settings import ArmSettings, ServoMap
from elastic_env.hardware.clock import Clock
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live.target_sources import Follower, Targets
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.supervised_bus import Cycle
from elastic_env.hardware.settings import SafetyLimits

_SETTLE_S = 0.6
"""Time in which servos come to rest after a small move [s]."""
_AVERAGED = 10
"""Cycles over which a rest is averaged."""
_MOVED_SHARE = 0.2
"""Share of a small move that a servo has to follow; friction and sag take the rest."""
_LEAST_SAG_RAD = 0.01
"""Sag from which a gain is told [rad]."""
_FLIPPED_SHARE = 0.35
"""Left of the misfit of the loads if one sign is turned, from which that sign is wrong."""
_MISFIT = 0.5
"""Misfit of the loads, as a share of them, above which something is wrong."""


class Compensator(Protocol):
    """What a `baselines.PositionCompensator` offers."""

    def command(
        self,
        q_desired: npt.ArrayLike,
        q_dot: npt.ArrayLike | None = None,
        q_ddot: npt.ArrayLike | None = None,
    ) -> Array:
        """Servo command that brings the links to where they should be, (n,) [rad]."""
        ...

    def link_angle(self, theta: npt.ArrayLike) -> Array:
        """Link angles for motor encoders, (n,) [rad]."""
        ...


class ArmBus(Protocol):
    """What an arm needs of its servos, see `SupervisedBus`."""

    @property
    def clock(self) -> Clock:
        """By which they are read."""
        ...

    def enable(self, limits: SafetyLimits | None = None, ranges: Array | None = None) -> Array:
        """Torque on; the servos' angles, (n,) [rad]."""
        ...

    def exchange(self, goals: Array, at: float) -> Cycle:
        """Command, wait for a moment, read."""
        ...

    def keep(self, goals: Array, limit_s: float = 5.0) -> None:
        """Hold goals until the next cycle."""
        ...

    def stop_keeping(self) -> None:
        """End that."""
        ...

    def close(self) -> None:
        """Torque off; ports given back."""
        ...


@dataclass(frozen=True)
class ArmState:
    """An arm in one control cycle, (n,) each; angles are those of the model's joints.

    Attributes:
        time_s: Since the loop began [s].
        target: Where the links are to go [rad].
        desired: Where they should be now [rad].
        command: Goal of the servos, within all limits [rad].
        theta: Motor encoders [rad]; nan where a reply is missing.
        link: Estimate of the links at rest [rad].
        torque: Load of the servos [N·m].
        temperature: Last known ones [°C].
        is_limited: True where a limit changed the command.
        late_s: How late the servos were read [s].
        is_held: True if the last command was repeated, as a reply was missing.
    """

    time_s: float
    target: Array
    desired: Array
    command: Array
    theta: Array
    link: Array
    torque: Array
    temperature: Array
    is_limited: BoolArray
    late_s: float
    is_held: bool


@dataclass
class Counts:
    """What went wrong in a motion, in cycles."""

    cycles: int = 0
    late: int = 0
    """More than half a period late."""
    held: int = 0
    """Without all replies; the last command was repeated."""
    limited: int = 0
    """With a command that a limit changed."""


class Arm:
    """An arm under torque.

    Args:
        bus: Its servos, in the order of the joints.
        settings: Limits and pace.
        servos: Signs and zeros.
        compensator: Makes commands of desired angles.
        ranges: Lowest and highest angles of the servos, (n, 2) [rad].

    Attributes:
        counts: What went wrong.
        follower: The desired angles.
    """

    def __init__(
        self,
        bus: ArmBus,
        settings: ArmSettings,
        servos: ServoMap,
        compensator: Compensator,
        ranges: Array,
    ) -> None:
        n = len(servos.joints)
        self.settings = settings
        self.servos = servos
        self.period_s = 1.0 / settings.rate_hz
        self.counts = Counts()
        self._bus = bus
        self._compensator = compensator
        self._ranges = ranges
        self._lowest, self._highest = np.sort(servos.joint_angle(ranges.T), axis=0)
        self._pace = realtime.Pace(self.period_s, bus.clock)
        self._temperature = np.full(n, np.nan)
        self.start: Array = np.zeros(n)
        """Where the arm stood when its torque went on, within the joints' ranges [rad]."""
        self._command = self.start
        self.follower = self._follower(self.start)

    def begin(self) -> Array:
        """Torque on where the arm stands; these angles of the joints, (n,) [rad].

        Raises:
            HardwareError: Something of the hardware is not as it must be.
        """
        with self._named():
            stands = self._bus.enable(self.settings.limits, self._ranges)
        # weight presses a joint that rests on a stop beyond its range, which no command may be
        self.start = np.clip(self.servos.joint_angle(stands), self._lowest, self._highest)
        self.follower = self._follower(self.start)
        self._command = self.start
        self._begin_s = self._bus.clock.monotonic()
        self._pace.restart()
        return self.start

    def play(self, targets: Targets) -> Iterator[ArmState]:
        """Follow targets until they end, a state for each cycle.

        Raises:
            FaultError: The motion was stopped; the message says why.
        """
        while (target := targets.next(self.follower.q, self.period_s)) is not None:
            self.follower.step(target, self.period_s)
            yield self.cycle(target)

    def go(self, target: Array) -> Iterator[ArmState]:
        """Slowly to a target, (n,) [rad]."""
        while np.abs(self.follower.q - target).max() > 0.0:
            self.follower.step(target, self.period_s)
            yield self.cycle(target)

    def cycle(self, target: Array) -> ArmState:
        """One control cycle at the desired angles."""
        desired = self.follower
        command = self._compensator.command(desired.q, desired.q_dot, desired.q_ddot)
        return self._exchange(target, command)

    def hold(self, limit_s: float = 60.0) -> None:
        """Stay for at most a time in which the program does something else [s]."""
        self._bus.keep(self.servos.servo_angle(self._command), limit_s)

    def resume(self) -> None:
        """Go on after `hold`."""
        self._bus.stop_keeping()
        self._pace.restart()

    def close(self) -> None:
        """Torque falls; the port is given back.

        Raises:
            HardwareError: It is not certain that torque is off.
        """
        self._bus.close()

    def nudge(self, joint: int, way_rad: float) -> tuple[Array, Array]:
        """Move one joint a little from where it stands, by its servo alone, and let it rest.

        Args:
            joint: Its number.
            way_rad: How far, from the command that holds it [rad].

        Returns:
            At rest: command, encoder, both [rad], and load [N·m] of the joint, (3,); and all
            encoders, (n,) [rad].
        """
        goal = self.start.copy()
        goal[joint] += way_rad
        mover = self._follower(self._command)
        rest = round(_SETTLE_S / self.period_s)
        shown: list[ArmState] = []
        while len(shown) < rest:
            mover.step(goal, self.period_s)
            state = self._exchange(self.start, mover.q)
            if np.abs(mover.q - goal).max() == 0.0:
                shown.append(state)
        last = shown[-_AVERAGED:]
        theta = np.nanmean([state.theta for state in last], axis=0)
        torque = np.nanmean([state.torque for state in last], axis=0)
        return np.array([goal[joint], theta[joint], torque[joint]]), theta

    def way_off_stops(self, joint: int, way_rad: float) -> float:
        """How far a joint must go from where it stands for a move to both sides to meet no stop.

        Args:
            joint: Its number.
            way_rad: To either side; as far as that it keeps off the ends of its range [rad].

        Returns:
            The way [rad]; 0 where it stands far enough from both ends.
        """
        lowest = self._lowest[joint]
        highest = self._highest[joint]
        room = min(2.0 * way_rad, 0.5 * (highest - lowest))
        stands = self.start[joint]
        return float(np.clip(stands, lowest + room, highest - room) - stands)

    def _follower(self, q: Array) -> Follower:
        return Follower(q, self.settings.speed_rad_s, self.settings.acceleration_rad_s2)

    def _exchange(self, target: Array, command: Array) -> ArmState:
        due_s = self._pace.next()
        with self._named():
            cycle = self._bus.exchange(self.servos.servo_angle(command), due_s)
        late_s = self._pace.late(due_s + cycle.late_s)
        states = cycle.states
        told = np.isfinite(states.temperature)
        if told.shape:
            self._temperature = np.where(told, states.temperature, self._temperature)
        theta = self.servos.joint_angle(states.position)
        self._command = self.servos.joint_angle(cycle.goals)
        self.counts.cycles += 1
        self.counts.late += self._pace.is_overrun(late_s)
        self.counts.held += not states.is_fresh.all()
        self.counts.limited += bool(cycle.is_limited.any()) and not cycle.is_held
        return ArmState(
            time_s=states.time_s - self._begin_s,
            target=target.copy(),
            desired=self.follower.q.copy(),
            command=self._command,
            theta=theta,
            link=self._link(theta),
            torque=self.servos.direction * states.torque,
            temperature=self._temperature,
            is_limited=cycle.is_limited,
            late_s=late_s,
            is_held=cycle.is_held,
        )

    def _link(self, theta: Array) -> Array:
        """Estimate of the links; nan where the encoders, or the springs, do not tell it."""
        if not np.isfinite(theta).all():
            return np.full_like(theta, np.nan)
        try:
            return self._compensator.link_angle(theta)
        except ElasticError:
            return np.full_like(theta, np.nan)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say of which joint a servo is, in errors that name it."""
        try:
            yield
        except HardwareError as error:
            named = [
                f"servo {servo_id} is {joint}"
                for servo_id, joint in zip(self.servos.ids, self.servos.joints, strict=True)
                if f"servo {servo_id} at" in str(error)
            ]
            if not named:
                raise
            raise type(error)(f"{error} ({', '.join(named)})") from None


@dataclass(frozen=True)
class Weighed:
    """A joint that was moved a little to both sides, and rested there.

    Attributes:
        first: Where it went first, from where it stood [rad].
        moved: Share of the way that it moved [1].
        torque: Load of its servo, mean of both sides [N·m].
        gain: That load over how far the servo gave way, k_p [N·m/rad]; nan where that is little.
        theta: Encoders of all joints, mean of both sides, (n,) [rad].
    """

    first: float
    moved: float
    torque: float
    gain: float
    theta: Array


def weigh(arm: Arm, joint: int, way_rad: float) -> Weighed:
    """Move a joint a little to both sides, away from a stop that is near.

    Friction holds it back on either side, so that the mean tells the load. A stop would carry it.

    Args:
        arm: Under torque.
        joint: Number of the joint.
        way_rad: To either side [rad].

    Raises:
        HardwareError: It hardly moves.
    """
    off_stops = arm.way_off_stops(joint, way_rad)
    side = -way_rad if off_stops < 0.0 else way_rad
    far, at_far = arm.nudge(joint, off_stops + side)
    near, at_near = arm.nudge(joint, off_stops - side)
    arm.nudge(joint, 0.0)
    moved = float((far - near)[1] / (far - near)[0])
    name = arm.servos.joints[joint]
    if not moved > _MOVED_SHARE:
        stands = arm.start[joint]
        near_end = (
            f"; it stands at {stands:+.4g} rad, near an end of its range" if off_stops else ""
        )
        raise HardwareError(
            f"joint {name!r} follows {100.0 * moved:.0f} % of a move by ±{way_rad:g} rad about"
            f" {stands + off_stops:+.3g} rad: it is blocked, or its servo has no strength; look at"
            f" torque limit, gain and supply{near_end}"
        )
    command, theta, torque = 0.5 * (far + near)
    sag = command - theta
    gain = torque / sag if abs(sag) > _LEAST_SAG_RAD else np.nan
    return Weighed(
        first=off_stops + side,
        moved=moved,
        torque=float(torque),
        gain=float(gain),
        theta=0.5 * (at_far + at_near),
    )


def wrong_sign(
    measured: Array, theta: Array, torque: Callable[[Array], Array], tolerance: Array
) -> int | None:
    """Joint whose direction is wrong, by the loads that the servos hold; None if none is.

    With a direction that is wrong, angle and load of that joint have the other sign. The model's
    loads of all joints then are others, too. So every joint is turned in turn, and the loads of
    the model are compared with the measured ones.

    Args:
        measured: Loads, (n,) [N·m]; nan where a servo does not tell.
        theta: Angles of the joints, (n,) [rad].
        torque: Loads that the model says for angles, (n,) [rad] to (n,) [N·m].
        tolerance: What friction may hide, (n,) [N·m].
    """

    def misfit(turned: int | None) -> tuple[float, float]:
        sign = np.ones(len(theta))
        if turned is not None:
            sign[turned] = -1.0
        known = np.asarray(torque(sign * theta))
        off = np.maximum(np.abs(sign * measured - known) - tolerance, 0.0)
        told = np.isfinite(measured)
        return float(np.sum(off[told] ** 2)), float(np.sum(known[told] ** 2))

    left, size = misfit(None)
    if left <= _MISFIT**2 * size or size == 0.0:
        return None
    turned = [misfit(joint)[0] for joint in range(len(theta))]
    best = int(np.argmin(turned))
    return best if turned[best] < _FLIPPED_SHARE * left else None
