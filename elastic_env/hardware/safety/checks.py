"""Checks before anything moves: firmware, voltage, temperature, errors, delays.

Each with its cure.
"""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from elastic_env.hardware.buses.servo_bus import ServoBus

_LONGEST_DELAY_US = 20
_DELAY_UNIT_US = 2
_WARM_SHARE = 0.8
_PINGS = 50
_LOST = 2
"""Replies lost or damaged from which a line counts as bad; a busy computer may cost one."""
_FINE_SPEED = 1 << 2
"""Bit of Feetech's `phase` with which a count of velocity is 1 pulse/s, not 50."""
_FASTER = (
    "too slow: set the adapter's latency timer to 1 ms, the servos' return delay to 0, "
    "and the bus to 1 Mbit/s or more"
)
_BETTER_LINE = (
    "a bad line: look at plugs, cable, ground and termination, and at what else keeps the computer "
    "busy"
)


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    what: str
    value: str
    is_good: bool = True
    """True if nothing is to be done."""
    cure: str = ""
    """Cure of what is not good."""
    is_vital: bool = True
    """True if nothing may move before that is done."""


def check_bus(bus: ServoBus, ids: Sequence[int]) -> list[Check]:
    """Look at the port and at every servo.

    Args:
        bus: Open.
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
    """Latency of the adapter, and round trips of pings to a servo."""
    latency = bus.port.latency_timer_ms
    unknown = "not an FTDI adapter, or not told; see the round trip"
    told = unknown if latency is None else f"{latency} ms"
    cure = f"echo 1 | sudo tee {bus.port.latency_timer}"
    times = []
    retries = bus.num_retries
    for _ in range(_PINGS):
        begin = bus.port.clock.monotonic()
        bus.knock(servo_id)
        times.append(bus.port.clock.monotonic() - begin)
    lost = bus.num_retries - retries
    typical = statistics.median(times)
    trip = f"{1e3 * typical:.2f} ms, at most {1e3 * max(times):.2f} ms"
    losses = f"{lost} of {_PINGS} pings"
    return [
        Check("latency timer", told, (latency or 0) <= 1, cure, is_vital=False),
        Check("round trip of a ping", trip, typical < bus.slowest_trip_s, _FASTER),
        Check("lost replies", losses, lost < _LOST, _BETTER_LINE, is_vital=False),
    ]


def _check_servo(bus: ServoBus, servo_id: int) -> list[Check]:
    checks: list[Check] = []
    model = bus.models[servo_id]
    read = partial(bus.read_register, servo_id)

    def check(what: str, *found: Any, **marks: bool) -> None:
        checks.append(Check(f"{servo_id}: {what}", *found, **marks))

    firmware = read("firmware_version")
    check("model, firmware", f"{model.number} {model.name}, version {firmware}")
    error = model.explain_errors(read("hardware_error_status"))
    restart = "remove the cause, then switch the power off and on"
    check("hardware error", error or "none", not error, restart)
    volts = read("present_input_voltage") / 10.0
    low = read("min_voltage_limit") / 10.0
    high = read("max_voltage_limit") / 10.0
    supply = f"it must be {low:g} to {high:g} V"
    check("input voltage", f"{volts:.1f} V", low < volts < high, supply)
    degrees = read("present_temperature")
    hottest = read("temperature_limit")
    cool = f"let it cool; limit {hottest} °C"
    check("temperature", f"{degrees} °C", degrees < _WARM_SHARE * hottest, cool)
    mode = read("operating_mode")
    mend = f"with torque off, write {bus.position_mode}, position, to operating_mode"
    check("operating mode", str(mode), mode == bus.position_mode, mend)
    delay_us = _DELAY_UNIT_US * read("return_delay_time")
    mend = "with torque off, write 0 to return_delay_time"
    check("return delay", f"{delay_us} µs", delay_us <= _LONGEST_DELAY_US, mend)
    level = read("status_return_level")
    mend = f"write {bus.full_replies} to status_return_level"
    check("status return level", str(level), level == bus.full_replies, mend)
    if model.current_limit:
        amperes = read(model.current_limit) * model.current_unit
        strongest = model.current(model.largest_torque)
        mend = (
            f"with torque off, write {round(strongest / model.current_unit)} to"
            f" {model.current_limit}: more than {model.largest_torque:g} N·m hurts the gear"
        )
        is_weak = amperes <= strongest + 0.1
        check("current limit", f"{amperes:.1f} A", is_weak, mend, is_vital=False)
    if "phase" in model.table:
        phase = read("phase")
        mend = f"with torque off, write {phase | _FINE_SPEED} to phase: its speeds are 50 times off"
        check("phase", str(phase), bool(phase & _FINE_SPEED), mend)
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
