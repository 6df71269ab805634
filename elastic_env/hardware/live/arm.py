"""An arm on a bus, moved by compensated commands in real time.

target → follower → compensator → servo angles → bus → servos
↑                          │
link estimate  └── motor encoders  ←──────┘
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeAlias

import numpy as np

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.hardware.arm_settings import ArmSettings, ServoMap
from elastic_env.hardware.emulator.virtual import VirtualBus
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live.arm_state import ArmState, Counts
from elastic_env.hardware.live.follower import Follower
from elastic_env.hardware.live.targets import Targets
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.supervised_bus import SupervisedBus

ArmBus: TypeAlias = SupervisedBus | VirtualBus
"""Servos of an arm, real or emulated."""

_SETTLE_S = 0.6
"""Time in which servos come to rest after a small move [s]."""
_AVERAGED_CYCLES = 10
"""Cycles at rest over which measurements are averaged."""


class Compensator(Protocol):
    """Computes commands of servos, as `baselines.PositionCompensator` does."""

    def command(self, q_desired: Any, q_dot: Any = None, q_ddot: Any = None) -> Array:
        """Servo command that brings the links to the desired angles, (n,) [rad]."""
        ...

    def link_angle(self, theta: Any) -> Array:
        """Link angles for motor encoders, (n,) [rad]."""
        ...


class Uncompensated:
    """Sends the targets as commands; estimates the links as another compensator does."""

    def __init__(self, compensator: Compensator) -> None:
        self.link_angle = compensator.link_angle

    def command(self, q_desired: Any, q_dot: Any = None, q_ddot: Any = None) -> Array:
        """Desired angles, (n,) [rad]."""
        del q_dot, q_ddot
        return np.array(q_desired, dtype=np.float64)


class Arm:
    """An arm under torque.

    Args:
        bus: Its servos, in the order of the joints.
        settings: Limits and pace.
        servos: Signs and zeros.
        compensator: Computes commands from desired angles.
        ranges: Lowest and highest angles of the servos, (n, 2) [rad].

    Attributes:
        counts: Cycles, and those in which something went wrong.
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
        """Angles at which torque went on, clipped to the joints' ranges, (n,) [rad]."""
        self._command = self.start
        self.follower = self._follower(self.start)

    def begin(self) -> Array:
        """Switch torque on at the present angles of the joints and return these, (n,) [rad].

        Raises:
            HardwareError: A servo refuses torque, or its port fails.
        """
        with self._name_joints_in_errors():
            positions = self._bus.enable(self.settings.limits, self._ranges)
        # weight may press a joint that rests on a stop beyond its range; no command may lie there
        angles = self.servos.joint_angle(positions)
        self.start = np.clip(angles, self._lowest, self._highest)
        self.follower = self._follower(self.start)
        self._command = self.start
        self._begin_s = self._bus.clock.monotonic()
        self._pace.restart()
        return self.start

    def play(self, targets: Targets) -> Iterator[ArmState]:
        """Follow targets until they end; yield a state for each cycle.

        Raises:
            FaultError: The motion was stopped; the message says why.
        """
        while (target := targets.next(self.follower.q, self.period_s)) is not None:
            self.follower.step(target, self.period_s)
            yield self.cycle(target)

    def go(self, target: Array) -> Iterator[ArmState]:
        """Move slowly to a target, (n,) [rad]."""
        while np.abs(self.follower.q - target).max() > 0.0:
            self.follower.step(target, self.period_s)
            yield self.cycle(target)

    def approach_start(self, ramp_s: float, way_rad: float) -> Iterator[ArmState]:
        """Stay until the compensation has grown; then move all joints away from the start and back.

        After that the compensator knows on which side of its dry friction each joint rests.

        Args:
            ramp_s: Time in which the compensation grows [s].
            way_rad: Distance, at the upper end of a range downwards; 0 to stay [rad].

        Yields:
            A state for each cycle.

        Raises:
            FaultError: The motion was stopped; the message says why.
        """
        for _ in range(round(ramp_s / self.period_s)):
            yield self.cycle(self.start)
        has_room = self.start + way_rad <= self._highest
        away = np.where(has_room, self.start + way_rad, self.start - way_rad)
        yield from self.go(np.maximum(away, self._lowest))
        yield from self.go(self.start)

    def cycle(self, target: Array) -> ArmState:
        """Run one control cycle at the desired angles."""
        desired = self.follower
        command = self._compensator.command(desired.q, desired.q_dot, desired.q_ddot)
        return self._exchange(target, command)

    def hold(self, limit_s: float = 60.0) -> None:
        """Stay while the program does something else, for at most a time [s]."""
        self._bus.keep(self.servos.servo_angle(self._command), limit_s)

    def resume(self) -> None:
        """Go on after `hold`."""
        self._bus.stop_keeping()
        self._pace.restart()

    def close(self) -> None:
        """Let the torque fall, and release the port.

        Raises:
            HardwareError: It is not certain that torque is off.
        """
        self._bus.close()

    def nudge(self, joint: int, way_rad: float) -> tuple[Array, Array]:
        """Move one joint a little from its start, uncompensated, and let it rest.

        Args:
            joint: Index of the joint.
            way_rad: Move from the start [rad].

        Returns:
            Command [rad], encoder [rad] and load [N·m] of the joint at rest, (3,); and all
            encoders, (n,) [rad].
        """
        goal = self.start.copy()
        goal[joint] += way_rad
        mover = self._follower(self._command)
        settle_cycles = round(_SETTLE_S / self.period_s)
        settled: list[ArmState] = []
        while len(settled) < settle_cycles:
            mover.step(goal, self.period_s)
            state = self._exchange(self.start, mover.q)
            if np.abs(mover.q - goal).max() == 0.0:
                settled.append(state)
        last = settled[-_AVERAGED_CYCLES:]
        theta = np.nanmean([state.theta for state in last], axis=0)
        torque = np.nanmean([state.torque for state in last], axis=0)
        return np.array([goal[joint], theta[joint], torque[joint]]), theta

    def displacement_off_stops(self, joint: int, way_rad: float) -> float:
        """Displacement from the start after which a move to both sides meets no stop [rad].

        Args:
            joint: Index of the joint.
            way_rad: Move to either side, and distance kept from the ends of the range [rad].

        Returns:
            The displacement; 0 if the start is far enough from both ends.
        """
        lowest = self._lowest[joint]
        highest = self._highest[joint]
        room = min(2.0 * way_rad, 0.5 * (highest - lowest))
        start = self.start[joint]
        return float(np.clip(start, lowest + room, highest - room) - start)

    def _follower(self, q: Array) -> Follower:
        return Follower(q, self.settings.speed_rad_s, self.settings.acceleration_rad_s2)

    def _exchange(self, target: Array, command: Array) -> ArmState:
        due_s = self._pace.next()
        with self._name_joints_in_errors():
            cycle = self._bus.exchange(self.servos.servo_angle(command), due_s)
        late_s = self._pace.late(due_s + cycle.late_s)
        states = cycle.states
        known = np.isfinite(states.temperature)
        if known.shape:
            self._temperature = np.where(known, states.temperature, self._temperature)
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
            link=self._link_estimate(theta),
            torque=self.servos.direction * states.torque,
            temperature=self._temperature,
            is_limited=cycle.is_limited,
            late_s=late_s,
            is_held=cycle.is_held,
        )

    def _link_estimate(self, theta: Array) -> Array:
        """Estimate of the link angles, (n,) [rad]; nan where none can be computed."""
        if not np.isfinite(theta).all():
            return np.full_like(theta, np.nan)
        try:
            return self._compensator.link_angle(theta)
        except ElasticError:
            return np.full_like(theta, np.nan)

    @contextmanager
    def _name_joints_in_errors(self) -> Iterator[None]:
        """Add the names of the joints to errors that name servos."""
        try:
            yield
        except HardwareError as error:
            names = [
                f"servo {servo_id} is {joint}"
                for servo_id, joint in zip(self.servos.ids, self.servos.joints, strict=True)
                if f"servo {servo_id} at" in str(error)
            ]
            if not names:
                raise
            raise type(error)(f"{error} ({', '.join(names)})") from None
