"""Servo and IMU instead of the physics: one control cycle is one advance of a `Simulation`."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, NoReturn

import mujoco
import numpy as np

from elastic_env.core.signals import Array, BoolArray
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.imu import AttitudeStream
from elastic_env.hardware.live.consent import require_consent
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.guard import exceeds
from elastic_env.hardware.safety.supervised_bus import Cycle, SupervisedBus
from elastic_env.hardware.settings import HardwareSettings
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.motion.trajectory import QUINTIC_PEAK_RATE, minimum_jerk

_SHORTEST_MOVE_S = 0.5
_SETTLE_S = 0.5


class CycleRecord(NamedTuple):
    """Torque and timing of the last control period; counts are of the episode."""

    joint_torque: float = np.nan
    """Torque from the motor current [N·m]."""
    jitter: float = 0.0
    """Delay of the reading, or of its command [s]."""
    period: float = 0.0
    """Time since the previous reading [s]."""
    overruns: int = 0
    """Periods that were more than half a period late, see `Pace`."""
    missed_replies: int = 0
    """Cycles without a usable reply; the last command was held and the cycle repeated."""
    limited: int = 0
    """Cycles in which the safety limits changed the command."""


class ServoPlant:
    """A servo on a bus and an IMU on its link, used like `elastic_env.world.physics.Simulation`.

    No port is opened before the first `begin`. Quantities without a measurement are nan: the link's
    rate, and without an IMU its angle.

    Args:
        model: Model of the testbed, which defines the state vectors.
        at: Addresses of motor and link angle in them.
        settings: Wiring, mounting and limits.
        period_s: Control period [s].
        pendulum_nm: Torque of the pendulum at the horizontal, for the question before the first
            motion [N·m].
    """

    num_worlds = 1

    def __init__(
        self,
        model: mujoco.MjModel,
        at: JointAddresses,
        settings: HardwareSettings,
        period_s: float,
        pendulum_nm: float,
    ) -> None:
        self.model = model
        self.settings = settings
        self.qpos: Array = np.full((1, model.nq), np.nan)
        self.qvel: Array = np.full((1, model.nv), np.nan)
        self.act: Array = np.zeros((1, model.na))
        self.ctrl: Array = np.zeros((1, model.nu))
        self.record = CycleRecord()
        self._at = at
        self._period_s = period_s
        self._pendulum_nm = pendulum_nm
        self._bus: SupervisedBus | None = None
        self._imu: AttitudeStream | None = None
        self._is_agreed = not settings.confirm
        self._pace = realtime.Pace(period_s)
        self._goal = 0.0
        self._read_s = 0.0
        self._is_kept = False

    def __getstate__(self) -> dict[str, object]:
        """Refuse copies: there is one joint at a port.

        Raises:
            HardwareError: Always.
        """
        raise HardwareError(
            "an environment on hardware cannot be copied or pickled: there is one joint at its port"
        )

    def __del__(self) -> None:
        """Release the ports of a testbed that is no longer used."""
        with suppress(Exception):
            self.close()

    def begin(self, angle: float) -> None:
        """Switch torque on, move slowly to an angle, and wait there.

        Args:
            angle: Angle of the joint's motor side [rad].

        Raises:
            HardwareError: Nobody agreed, or servo, IMU or port fail.
        """
        if not self._is_agreed:
            limits = self.settings.limits
            question = (
                f"The servo at {self.settings.port} will move to {angle:.3f} rad, then anywhere"
                f" between its limits, {limits.lowest_rad:g} and {limits.highest_rad:g} rad, with"
                f" a pendulum of {self._pendulum_nm:.1f} N·m. Is its way free, and the power switch"
                " in reach?"
            )
            require_consent(question, self.settings.port)
            self._is_agreed = True
        with self._closing_on_error():
            bus = self._open_bus()
            bus.disable()
            positions = bus.enable(self.settings.servo_limits)
            self._restart_clock()
            self._move(self.settings.joint_angle(float(positions[0])), angle)
            for _ in range(round(_SETTLE_S / self._period_s)):
                self._cycle(angle)
            self.record = CycleRecord(self.record.joint_torque)
            bus.keep(self._servo_goal(angle))
            self._is_kept = True

    def advance(self, num_substeps: int) -> None:  # noqa: ARG002
        """Command `ctrl`, wait for the end of the control period, read.

        Raises:
            HardwareError: No episode is under way, or servo, IMU or port fail.
        """
        if self._bus is None:
            raise HardwareError(
                f"no episode is under way at {self.settings.port}: begin one with reset()"
            )
        with self._closing_on_error():
            if self._is_kept:  # the first step may come any time after the reset
                self._bus.stop_keeping()
                self._restart_clock()
                self._is_kept = False
            self._cycle(float(self.ctrl[0, 0]))

    def finish(self) -> None:
        """Move slowly back to the hanging pendulum, then switch torque off and close the ports."""
        try:
            self._move(self._goal, 0.0)
        finally:
            self.close()

    def close(self) -> None:
        """Switch torque off and close the ports."""
        bus = self._bus
        imu = self._imu
        self._bus = None
        self._imu = None
        try:
            if bus is not None:
                bus.close()
        finally:
            if imu is not None:
                imu.close()
            if bus is not None:
                realtime.give_up_realtime()

    def restart(self, worlds: BoolArray) -> None:
        """Do nothing: an episode begins with `begin`."""

    def refresh(self, worlds: BoolArray) -> None:
        """Do nothing: hardware has nothing to compute."""

    def divergence(self) -> BoolArray:
        """Return False: hardware does not diverge; its faults are errors."""
        return np.zeros(1, dtype=np.bool_)

    def bind(self, field: object, *_: object) -> NoReturn:
        """Refuse: hardware has no fields of MuJoCo.

        Raises:
            HardwareError: Always.
        """
        raise HardwareError(f"hardware has no {field!r} that could be read or varied")

    views: Any = bind
    vary: Any = bind
    set_model: Any = bind

    def _open_bus(self) -> SupervisedBus:
        """Return the bus; open servo and IMU if they are closed."""
        settings = self.settings
        if self._bus is None:
            ports = {settings.port: [settings.servo_id]}
            self._bus = SupervisedBus(ports, settings.baudrate)
            if settings.imu_port is not None:
                stream = (settings.imu_baudrate, settings.imu_oldest_s)
                self._imu = AttitudeStream(settings.imu_port, *stream)
            realtime.prefer_realtime(realtime.Priority.LOOP)
        return self._bus

    @contextmanager
    def _closing_on_error(self) -> Iterator[None]:
        """Switch torque off and close the ports if the block fails."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def _move(self, start: float, end: float) -> None:
        """Move slowly from one angle to another [rad]."""
        way_s = QUINTIC_PEAK_RATE * abs(end - start) / self.settings.approach_rad_s
        steps = int(np.ceil(max(way_s, _SHORTEST_MOVE_S) / self._period_s))
        for share in minimum_jerk(np.arange(1, steps + 1) / steps):
            self._cycle(start + (end - start) * float(share))

    def _servo_goal(self, angle: float) -> Array:
        return np.array([self.settings.servo_angle(angle)])

    def _restart_clock(self) -> None:
        self._pace.restart()
        self._read_s = time.monotonic()

    def _cycle(self, angle: float) -> None:
        """Run one control period; while a reply is missing, hold the command and repeat."""
        bus = self._open_bus()
        missed = self.record.missed_replies
        overruns = self.record.overruns
        is_limited = False
        while True:
            due_s = self._pace.next()
            cycle = bus.exchange(self._servo_goal(angle), due_s)
            is_limited |= bool(cycle.is_limited.any()) and not cycle.is_held
            late_s = self._pace.late(due_s + cycle.late_s)
            overruns += self._pace.is_overrun(late_s)
            if cycle.states.is_fresh.all():
                break
            missed += 1
        self._store_measurements(cycle)
        torque = self.settings.direction * float(cycle.states.torque[0])
        period_s = cycle.states.time_s - self._read_s
        timing = (late_s, period_s, overruns, missed, self.record.limited + is_limited)
        self.record = CycleRecord(torque, *timing)
        self._read_s = cycle.states.time_s

    def _store_measurements(self, cycle: Cycle) -> None:
        """Write the measurements of a cycle into the state vectors."""
        settings = self.settings
        states = cycle.states
        at = self._at
        self._goal = settings.joint_angle(float(cycle.goals[0]))
        self.qpos[0, at.theta[0]] = settings.joint_angle(float(states.position[0]))
        self.qvel[0, at.theta_dot[0]] = settings.direction * float(states.velocity[0])
        if self._imu is not None:
            sample = self._imu.latest()
            mounting = (settings.imu_axis, settings.imu_sign, settings.imu_offset_rad)
            q = sample.link_angle(*mounting)
            self._require_small_deflection(q, states.time_s - sample.time_s)
            self.qpos[0, at.q[0]] = q

    def _require_small_deflection(self, q: float, age_s: float) -> None:
        """Check that link and motor angle differ by no more than a gear can bend.

        Args:
            q: Link angle by the IMU [rad].
            age_s: Time from its measurement to that of the motor, which has moved on [s].

        Raises:
            HardwareError: They differ by more.
        """
        settings = self.settings
        deflection = q - float(self.qpos[0, self._at.theta[0]])
        # other values have no remainder, and exceed the limit anyway
        if math.isfinite(deflection):
            deflection = math.remainder(deflection, 2.0 * math.pi)
        moved = abs(float(self.qvel[0, self._at.theta_dot[0]])) * max(age_s, 0.0)
        if exceeds(abs(deflection), settings.largest_deflection_rad + moved):
            raise HardwareError(
                f"the link, by the IMU at {settings.imu_port}, is {deflection:+.2f} "
                "rad from the servo's angle, more than largest_deflection_rad "
                f"{settings.largest_deflection_rad:g}: correct imu_sign, imu_axis and "
                "imu_offset_rad of the mounting, or check what has come loose"
            )
