"""Checks before anything moves: firmware, voltage, temperature, errors, delays, rest.

Each has a cure.
"""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from elastic_env.hardware.buses.bus import Condition
from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.errors import FaultError
from elastic_env.hardware.safety.guard import exceeds, explain_heat

_REST_RAD_S = 0.2
"""Speed below which a servo counts as at rest [rad/s].

Torque that goes on in motion stops the servo with a jerk.
"""
_LONGEST_DELAY_US = 20
_DELAY_UNIT_US = 2
_WARM_SHARE = 0.8
_PINGS = 50
_MANY_LOST = 2
"""Lost or damaged replies from which a line counts as bad; a busy computer may cost one."""
_FINE_SPEED = 1 << 2
"""Bit of Feetech's `phase` with which a count of velocity is 1 pulse/s, not 50."""
_DELAY_CURE = (
    "too slow: set the adapter's latency timer to 1 ms, the servos' return delay to 0, "
    "and the bus to 1 Mbit/s or more"
)
_LINE_CURE = (
    "a bad line: look at plugs, cable, ground and termination, and at what else keeps "
    "the computer busy"
)


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    value: str
    is_good: bool = True
    cure: str = ""
    """What to do if the value is not good."""
    is_vital: bool = True
    """True if nothing may move before the value is good."""


def check_bus(bus: ServoBus, ids: Sequence[int]) -> list[Check]:
    """Check the port and every servo, and attach the servos.

    Args:
        bus: Open bus.
        ids: Ids of the servos.

    Raises:
        ReplyError: A servo does not answer.
        HardwareError: Its model is not known.
    """
    bus.attach(ids)
    checks = [Check("baud rate", f"{bus.port.baudrate} bit/s")]
    checks += _check_line(bus, ids[0])
    for servo_id in ids:
        checks += _check_servo(bus, servo_id)
    return checks


def _check_line(bus: ServoBus, servo_id: int) -> list[Check]:
    """Check the latency of the adapter, and the round trips of pings to a servo."""
    latency = bus.port.latency_timer_ms
    unknown = "not an FTDI adapter, or not known; see the round trip"
    timer = unknown if latency is None else f"{latency} ms"
    cure = f"echo 1 | sudo tee {bus.port.latency_timer}"
    times = []
    retries = bus.num_retries
    for _ in range(_PINGS):
        begin = bus.port.clock.monotonic()
        bus.request_ping(servo_id)
        times.append(bus.port.clock.monotonic() - begin)
    lost = bus.num_retries - retries
    median = statistics.median(times)
    trip = f"{1e3 * median:.2f} ms, at most {1e3 * max(times):.2f} ms"
    losses = f"{lost} of {_PINGS} pings"
    return [
        Check("latency timer", timer, (latency or 0) <= 1, cure, is_vital=False),
        Check("round trip of a ping", trip, median < bus.slowest_trip_s, _DELAY_CURE),
        Check("lost replies", losses, lost < _MANY_LOST, _LINE_CURE, is_vital=False),
    ]


def _check_servo(bus: ServoBus, servo_id: int) -> list[Check]:
    """Check state and settings of a servo."""
    checks: list[Check] = []
    model = bus.models[servo_id]
    read = partial(bus.read_register, servo_id)

    def check(name: str, *result: Any, **marks: bool) -> None:
        checks.append(Check(f"{servo_id}: {name}", *result, **marks))

    firmware = read("firmware_version")
    check("model, firmware", f"{model.number} {model.name}, version {firmware}")
    error = model.explain_errors(read("hardware_error_status"))
    cure = "remove the cause, then switch the power off and on"
    check("hardware error", error or "none", not error, cure)
    volts = read("present_input_voltage") / 10.0
    low = read("min_voltage_limit") / 10.0
    high = read("max_voltage_limit") / 10.0
    cure = f"it must be {low:g} to {high:g} V"
    check("input voltage", f"{volts:.1f} V", low < volts < high, cure)
    degrees = read("present_temperature")
    hottest = read("temperature_limit")
    cure = f"let it cool; limit {hottest} °C"
    check("temperature", f"{degrees} °C", degrees < _WARM_SHARE * hottest, cure)
    mode = read("operating_mode")
    cure = f"with torque off, write {bus.position_mode}, position, to operating_mode"
    check("operating mode", str(mode), mode == bus.position_mode, cure)
    delay_us = _DELAY_UNIT_US * read("return_delay_time")
    cure = "with torque off, write 0 to return_delay_time"
    check("return delay", f"{delay_us} µs", delay_us <= _LONGEST_DELAY_US, cure)
    level = read("status_return_level")
    cure = f"write {bus.full_replies} to status_return_level"
    check("status return level", str(level), level == bus.full_replies, cure)
    if model.current_limit:
        amperes = read(model.current_limit) * model.current_unit
        strongest = model.current(model.largest_torque)
        cure = (
            f"with torque off, write {round(strongest / model.current_unit)} to"
            f" {model.current_limit}: more than {model.largest_torque:g} N·m hurts the gear"
        )
        is_weak = amperes <= strongest + 0.1
        check("current limit", f"{amperes:.1f} A", is_weak, cure, is_vital=False)
    if "phase" in model.table:
        phase = read("phase")
        cure = f"with torque off, write {phase | _FINE_SPEED} to phase: its speeds are 50 times off"
        check("phase", str(phase), bool(phase & _FINE_SPEED), cure)
    lowest = model.angle(read("min_position_limit"))
    highest = model.angle(read("max_position_limit"))
    check("homing offset", f"{read('homing_offset') * model.position_unit:+.4f} rad")
    check("position", f"{bus.read_position(servo_id):+.4f} rad")
    check("position limits", f"{lowest:.2f} to {highest:.2f} rad")
    is_on = bool(read("torque_enable"))
    left_on = "a program left it on; it is switched off before anything begins"
    check("torque", "on" if is_on else "off", not is_on, left_on, is_vital=False)
    has_none = "not in this firmware; the supervisor stands in"
    check("bus watchdog", "yes" if model.has_watchdog else has_none)
    return checks


def require_ready(name: str, condition: Condition, limit_c: float) -> None:
    """Check that a servo may get torque: it reports no error, is at rest, and is not too hot.

    Args:
        name: Name of the servo in messages.
        condition: Condition of the servo.
        limit_c: Highest temperature; the servo's own setting holds if that is lower [°C].

    Raises:
        FaultError: It may not get torque, or its speed or temperature is not known.
    """
    if condition.error:
        cure = "remove the cause, then switch its power off and on"
        raise FaultError(f"{name} reports {condition.error}; {cure}")
    speed = abs(condition.velocity)
    if exceeds(speed, _REST_RAD_S):
        moves = f"{name} moves at {speed:.2f} rad/s"
        cure = f"below {_REST_RAD_S:g} rad/s: wait until it hangs still, then try again"
        raise FaultError(f"{moves}; torque goes on at rest, {cure}")
    hottest = min(limit_c, condition.temperature_limit)
    if exceeds(condition.temperature, hottest):
        which = f"{name}: {condition.temperature:g}"
        raise FaultError(explain_heat(which, np.array(hottest)))
