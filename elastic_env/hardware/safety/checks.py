"""What to look at before anything moves: firmware, voltage, temperature, errors, delays; each with its cure."""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from elastic_env.hardware.servo_bus.bus import Bus
from elastic_env.hardware.servo_bus.control_table import ServoModel, explain_errors
from elastic_env.hardware.servo_bus.torque_line import LARGEST_TORQUE_NM, current_of_torque

_POSITION_MODE = 3
_FULL_REPLIES = 2
_LARGEST_DELAY_S = 20e-6
_DELAY_UNIT_S = 2e-6
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
    """What to do about it; empty where nothing is wrong."""
    is_vital: bool = True
    """Whether nothing may move before that is done."""

    @property
    def is_good(self) -> bool:
        """Whether nothing is to be done."""
        return not self.cure


def check_bus(bus: Bus, ids: Sequence[int]) -> list[Check]:
    """Look at the port and at every servo.

    Args:
        bus: Open.
        ids: Ids of the servos.

    Raises:
        ReplyError: A servo does not answer.
        HardwareError: Its model is not known.
    """
    bus.attach(ids)
    checks = [Check("baud rate", f"{bus.port.baudrate} bit/s"), _latency_timer(bus), *_round_trips(bus, ids[0])]
    for servo_id, model in bus.models.items():
        checks += [replace(one, what=f"{servo_id}: {one.what}") for one in _check_servo(bus, servo_id, model)]
    return checks


def _latency_timer(bus: Bus) -> Check:
    latency = bus.port.latency_timer_ms
    if latency is None:
        return Check("latency timer", "not an FTDI adapter, or not told; see the round trip")
    cure = "" if latency <= 1 else f"echo 1 | sudo tee {bus.port.latency_timer}"
    return Check("latency timer", f"{latency} ms", cure, is_vital=False)


def _round_trips(bus: Bus, servo_id: int) -> list[Check]:
    times, retries = [], bus.num_retries
    for _ in range(_PINGS):
        begin = time.monotonic()
        bus.ping(servo_id)
        times.append(time.monotonic() - begin)
    lost, typical = bus.num_retries - retries, statistics.median(times)
    slow = (
        "too slow for 250 Hz: set the adapter's latency timer to 1 ms, the servos' return delay to 0, and the bus to "
        "1 Mbit/s or more"
    )
    bad = "a bad line: look at plugs, cable, ground and termination, and at what else keeps the computer busy"
    trip = f"{1e3 * typical:.2f} ms, at most {1e3 * max(times):.2f} ms"
    return [
        Check("round trip of a ping", trip, "" if typical < _SLOW_S else slow),
        Check("lost replies", f"{lost} of {_PINGS} pings", "" if lost < _LOST else bad, is_vital=False),
    ]


def _check_servo(bus: Bus, servo_id: int, model: ServoModel) -> list[Check]:
    def get(name: str) -> int:
        return bus.read(servo_id, name)

    def unless(is_good: bool, cure: str) -> str:
        return "" if is_good else cure

    volts, low, high = (get(n) / 10.0 for n in ("present_input_voltage", "min_voltage_limit", "max_voltage_limit"))
    degrees, hottest = get("present_temperature"), get("temperature_limit")
    errors, mode = get("hardware_error_status"), get("operating_mode")
    delay_s = _DELAY_UNIT_S * get("return_delay_time")
    limit_a, needed_a = get(model.current_limit) * model.current_unit, current_of_torque(LARGEST_TORQUE_NM)
    low_rad, high_rad = (get(n) * model.position_unit for n in ("min_position_limit", "max_position_limit"))
    write = "with torque off, write"
    return [
        Check("model, firmware", f"{model.number} {model.name}, version {get('firmware_version')}"),
        Check("hardware error", explain_errors(errors) or str(errors or "none"),
              unless(not errors, "remove the cause, then switch the power off and on")),
        Check("input voltage", f"{volts:.1f} V", unless(low < volts < high, f"it must be {low:g} to {high:g} V")),
        Check("temperature", f"{degrees} °C",
              unless(degrees < _WARM_SHARE * hottest, f"let it cool; limit {hottest} °C")),
        Check("operating mode", str(mode), unless(mode == _POSITION_MODE, f"{write} 3, position, to operating_mode")),
        Check("return delay", f"{1e6 * delay_s:.0f} µs",
              unless(delay_s <= _LARGEST_DELAY_S, f"{write} 0 to return_delay_time")),
        Check("status return level", str(get("status_return_level")),
              unless(get("status_return_level") == _FULL_REPLIES, "write 2 to status_return_level")),
        Check("current limit", f"{limit_a:.1f} A",
              unless(limit_a <= needed_a + 0.1, f"{write} {round(needed_a / model.current_unit)} to "
                     f"{model.current_limit}: more than {LARGEST_TORQUE_NM:g} N·m hurts the gear"), is_vital=False),
        Check("position", f"{get('present_position') * model.position_unit:+.4f} rad"),
        Check("position limits", f"{low_rad:.2f} to {high_rad:.2f} rad"),
        Check("torque", "on" if get("torque_enable") else "off",
              unless(not get("torque_enable"), "a program left it on; it is switched off before anything begins"),
              is_vital=False),
        Check("bus watchdog", "yes" if model.has_watchdog else "not in this firmware; the supervisor stands in"),
    ]  # fmt: skip
