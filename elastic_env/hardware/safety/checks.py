"""Checks before anything moves: firmware, voltage, temperature, errors, delays.

Each with its cure.
"""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.servo_models import (
    LARGEST_TORQUE_NM,
    ServoModel,
    current_of_torque,
    explain_errors,
)

_POSITION_MODE = 3
_FULL_REPLIES = 2
_LONGEST_DELAY_US = 20
_DELAY_UNIT_US = 2
_WARM_SHARE = 0.8
_PINGS = 50
_LOST = 2
"""Replies lost or damaged from which a line counts as bad; a busy computer may cost one."""
_SLOW_S = 2.5e-3


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    what: str
    value: str
    cure: str = ""
    """Cure; empty where nothing is wrong."""
    is_vital: bool = True
    """True if nothing may move before that is done."""

    @property
    def is_good(self) -> bool:
        """True if nothing is to be done."""
        return not self.cure


def check_bus(bus: DynamixelBus, ids: Sequence[int]) -> list[Check]:
    """Look at the port and at every servo.

    Args:
        bus: Open.
        ids: Ids of the servos.

    Raises:
        ReplyError: A servo does not answer.
        HardwareError: Its model is not known.
    """
    bus.attach(ids)
    checks = [
        Check("baud rate", f"{bus.port.baudrate} bit/s"),
        _check_latency(bus),
        *_check_round_trips(bus, ids[0]),
    ]
    for servo_id, model in bus.models.items():
        checks += [
            replace(check, what=f"{servo_id}: {check.what}")
            for check in _check_servo(bus, servo_id, model)
        ]
    return checks


def _check_latency(bus: DynamixelBus) -> Check:
    latency = bus.port.latency_timer_ms
    if latency is None:
        return Check("latency timer", "not an FTDI adapter, or not told; see the round trip")
    cure = "" if latency <= 1 else f"echo 1 | sudo tee {bus.port.latency_timer}"
    return Check("latency timer", f"{latency} ms", cure, is_vital=False)


def _check_round_trips(bus: DynamixelBus, servo_id: int) -> list[Check]:
    times = []
    retries = bus.num_retries
    for _ in range(_PINGS):
        begin = time.monotonic()
        bus.ping(servo_id)
        times.append(time.monotonic() - begin)
    lost = bus.num_retries - retries
    typical = statistics.median(times)
    faster = (
        "too slow for 250 Hz: set the adapter's latency timer to 1 ms, the servos' return delay to "
        "0, and the bus to 1 Mbit/s or more"
    )
    better = (
        "a bad line: look at plugs, cable, ground and termination, and at what else keeps the"
        " computer busy"
    )
    trip = f"{1e3 * typical:.2f} ms, at most {1e3 * max(times):.2f} ms"
    return [
        Check("round trip of a ping", trip, _unless(typical < _SLOW_S, faster)),
        Check(
            "lost replies",
            f"{lost} of {_PINGS} pings",
            _unless(lost < _LOST, better),
            is_vital=False,
        ),
    ]


def _check_servo(bus: DynamixelBus, servo_id: int, model: ServoModel) -> list[Check]:
    read = partial(bus.read, servo_id)
    error = explain_errors(read("hardware_error_status"))
    volts = read("present_input_voltage") / 10.0
    low = read("min_voltage_limit") / 10.0
    high = read("max_voltage_limit") / 10.0
    degrees = read("present_temperature")
    hottest = read("temperature_limit")
    mode = read("operating_mode")
    delay_us = _DELAY_UNIT_US * read("return_delay_time")
    level = read("status_return_level")
    amperes = read(model.current_limit) * model.current_unit
    strongest = current_of_torque(LARGEST_TORQUE_NM)
    counts = round(strongest / model.current_unit)
    lowest = read("min_position_limit") * model.position_unit
    highest = read("max_position_limit") * model.position_unit
    is_on = bool(read("torque_enable"))

    restart = "remove the cause, then switch the power off and on"
    supply = f"it must be {low:g} to {high:g} V"
    cool = f"let it cool; limit {hottest} °C"
    mend_mode = f"with torque off, write {_POSITION_MODE}, position, to operating_mode"
    mend_delay = "with torque off, write 0 to return_delay_time"
    mend_level = f"write {_FULL_REPLIES} to status_return_level"
    hurts = f"more than {LARGEST_TORQUE_NM:g} N·m hurts the gear"
    mend_limit = f"with torque off, write {counts} to {model.current_limit}: {hurts}"
    left_on = "a program left it on; it is switched off before anything begins"
    watchdog = "yes" if model.has_watchdog else "not in this firmware; the supervisor stands in"
    return [
        Check(
            "model, firmware", f"{model.number} {model.name}, version {read('firmware_version')}"
        ),
        Check("hardware error", error or "none", _unless(not error, restart)),
        Check("input voltage", f"{volts:.1f} V", _unless(low < volts < high, supply)),
        Check("temperature", f"{degrees} °C", _unless(degrees < _WARM_SHARE * hottest, cool)),
        Check("operating mode", str(mode), _unless(mode == _POSITION_MODE, mend_mode)),
        Check("return delay", f"{delay_us} µs", _unless(delay_us <= _LONGEST_DELAY_US, mend_delay)),
        Check("status return level", str(level), _unless(level == _FULL_REPLIES, mend_level)),
        Check(
            "current limit",
            f"{amperes:.1f} A",
            _unless(amperes <= strongest + 0.1, mend_limit),
            is_vital=False,
        ),
        Check("position", f"{bus.read_position(servo_id):+.4f} rad"),
        Check("position limits", f"{lowest:.2f} to {highest:.2f} rad"),
        Check("torque", "on" if is_on else "off", _unless(not is_on, left_on), is_vital=False),
        Check("bus watchdog", watchdog),
    ]


def _unless(is_good: bool, cure: str) -> str:
    return "" if is_good else cure
