"""Measurements against an emulated bus through the real SDKs."""

import contextlib
import math
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import elastic_env  # noqa: F401  registers the environments
from baselines.identification.identify import identify
from elastic_env.hardware.buses.bus import States
from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.servo_models import ServoModel, servo_model
from elastic_env.hardware.emulator.launch import EmulatorConfig, Faults, RunningEmulator
from elastic_env.hardware.errors import BusGoneError, FaultError, HardwareError, PortError
from elastic_env.hardware.safety.processes import child_command, child_environment
from elastic_env.hardware.safety.realtime import (
    Pace,
    Priority,
    give_up_realtime,
    prefer_realtime,
    sleep_until,
)
from elastic_env.hardware.safety.supervised_bus import SupervisedBus
from elastic_env.hardware.settings import PATIENT_LIMITS, SafetyLimits
from elastic_env.robots.testbed.config import TestbedConfig
from tests.emulators import wait_until_free, wait_until_rest
from tests.hardware_trials.wave import PERIOD_S, goal

_USB_LATENCY = Faults(latency_s=1e-3)
_TORQUE_OFF_S = 0.1
_REPLY_TIMEOUT_S = 0.003
_SWING_S = 2.0
_CLOCK_S = 1e-3  # for a packet on its way between two processes
_CYCLES_BETWEEN = 6
_AROUND_S = 0.2
_PATIENT = SafetyLimits().replace(**PATIENT_LIMITS)
"""Where missing replies are counted, or are beside the point: a busy computer delays
pseudo-terminals."""
_COARSE = TestbedConfig(timestep_s=2e-3)
"""Twelve joints in real time at 0.5 ms would fill a third of a core, and it is the bus that is
measured."""
_FAST = 4_000_000
"""For twelve servos on one bus [bit/s]: the fastest of their rates that the SDK can set; not
every adapter can."""
_PAIR = (1, 2)
_MODEL = servo_model(54024)
_UNIT = _MODEL.position_unit
_OFF = ("torque_enable", 0)

Event = tuple[float, int, str, int]


@dataclass
class Trial:
    """What was measured.

    Attributes:
        name: What it is called on the command line.
        required: What must hold.
        measured: What was found, in words.
        is_met: Whether it holds.
        figures: Everything that was measured.
    """

    name: str
    required: str
    measured: str
    is_met: bool
    figures: dict[str, Any] = field(default_factory=dict)


def _times(number: int, share: float, least: int = 2) -> int:
    return max(round(number * share), least)


def identification(share: float) -> Trial:
    """K of the emulated joint over the bus, against its true one and against the environment in
    this process."""
    hold: dict[str, Any] = {"kind": "hold"}
    if share < 1.0:
        hold["positions"] = (
            5  # fewest; not quicker moves, which ring: at 0.4 rad/s the joint seems 3.6 % too soft
        )
    with RunningEmulator(EmulatorConfig(faults=_USB_LATENCY)) as emulator:
        real = gymnasium.make(
            "elastic_env/HardwareTestbed-v0",
            disable_env_checker=True,
            port=emulator.port,
            imu_port=emulator.imu_port,
            reference=hold,
            confirm=False,
            approach_rad_s=1.0,
            limits=_PATIENT,
            imu_oldest_s=0.2,
        )
        try:
            (over_bus,), _ = identify([real], seed=0)
        finally:
            real.close()
    simulated: Any = gymnasium.make(
        "elastic_env/Testbed-v0", disable_env_checker=True, reference=hold
    )
    (in_process,), _ = identify([simulated], seed=0)
    true = float(simulated.unwrapped.truth().model.stiffness[0])
    found = over_bus.stiffness_nm_per_rad
    beside = in_process.stiffness_nm_per_rad
    off_true = found / true - 1.0
    off_beside = found / beside - 1.0
    return Trial(
        "identification",
        "K within 1 % of the joint's, 0.5 % of the environment's in this process",
        f"{found:.1f} N·m/rad: {100 * off_true:+.2f} %, {100 * off_beside:+.2f} %",
        abs(off_true) <= 0.01 and abs(off_beside) <= 0.005,
        {"over_bus": over_bus.model_dump(), "in_process": in_process.model_dump()},
    )


def loop(share: float) -> Trial:
    """250 Hz with 12 servos, in blocks that alternate with a loop that only sleeps."""
    blocks = _times(12, share, 1)
    block_s = max(min(60.0 * share, 5.0), 1.0)
    ids = tuple(range(1, 13))
    late: dict[str, list[float]] = {"bus": [], "sleep": []}
    missed = 0
    took_s = 0.0
    stolen_s = 0.0
    config = EmulatorConfig(ids=ids, faults=_USB_LATENCY, testbed=_COARSE, baudrate=_FAST)
    with _beside_the_program(config) as emulator, SupervisedBus({emulator.port: ids}, _FAST) as bus:
        for _ in range(blocks):
            late["sleep"] += _sleep_loop(block_s)
            bus.enable(_PATIENT)
            begin = time.monotonic()
            stolen_before = _stolen_s()
            lateness, misses = _bus_loop(bus, len(ids), block_s)
            took_s = took_s + time.monotonic() - begin
            stolen_s = stolen_s + _stolen_s() - stolen_before
            late["bus"] += lateness
            missed += misses
            bus.disable()
    is_overrun = Pace(PERIOD_S).is_overrun
    overruns = {name: [x for x in values if is_overrun(x)] for name, values in late.items()}
    shares = {name: len(overruns[name]) / len(late[name]) for name in late}
    return Trial(
        "loop",
        "12 servos, 250 Hz, 4 Mbit/s, 1 ms USB latency: at most 0.1 % overruns beyond a loop that"
        " only sleeps",
        f"{100 * shares['bus']:.3f} % and {100 * shares['sleep']:.3f} % of {len(late['bus'])}"
        f" cycles, {missed} cycles with a missing reply; of {took_s:.0f} s the host took"
        f" {1e3 * stolen_s:.0f} ms away",
        shares["bus"] - shares["sleep"] <= 1e-3,
        {
            "overruns_s": overruns,
            "missed": missed,
            "share": shares,
            "stolen_s": stolen_s,
            "took_s": took_s,
            "jitter_rms_s": {
                name: float(np.sqrt(np.mean(np.square(values)))) for name, values in late.items()
            },
        },
    )


def _stolen_s() -> float:
    """Time for which a virtual machine's host has left it waiting for a processor so far, of all
    of them [s]."""
    ticks = Path("/proc/stat").read_text().splitlines()[0].split()[8]
    return int(ticks) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def _beside_the_program(config: EmulatorConfig) -> Iterator[RunningEmulator]:
    """An emulator with a core of its own, as servos have, and this program in real time on the
    others.

    Linux takes 5 % of a core from real-time processes that fill it.
    """
    cores = sorted(os.sched_getaffinity(0))
    try:
        os.sched_setaffinity(0, cores[-1:])  # which the emulator inherits
        with RunningEmulator(config) as emulator:
            os.sched_setaffinity(0, cores[:-1] or cores)
            prefer_realtime(Priority.LOOP)
            yield emulator
    finally:
        give_up_realtime()
        os.sched_setaffinity(0, cores)


def _sleep_loop(duration_s: float) -> list[float]:
    late = []
    pace = Pace(PERIOD_S)
    for _ in range(round(duration_s / PERIOD_S)):
        sleep_until(pace.next())
        late.append(pace.late(time.monotonic()))
    return late


def _bus_loop(bus: SupervisedBus, servos: int, duration_s: float) -> tuple[list[float], int]:
    """How late each period was, and how many had no reply from a servo."""
    late = []
    missed = 0
    begin = time.monotonic()
    pace = Pace(PERIOD_S)
    for _ in range(round(duration_s / PERIOD_S)):
        due = pace.next()
        cycle = bus.exchange(np.full(servos, 0.3 * goal(due - begin)), due)
        late.append(pace.late(due + cycle.late_s))
        missed += not cycle.states.is_fresh.all()
    return late, missed


def faults(share: float) -> Trial:
    """Random faults during a motion that also asks for what it must not have."""
    number = _times(1000, share)
    generator = np.random.default_rng(0)
    limits = SafetyLimits(lowest_rad=-0.5, highest_rad=0.5, slew_rad_s=1.5)
    tally = Counter[str]()
    reasons = Counter[str]()
    off_s: list[float] = []
    beyond: list[float] = []
    wrong: list[dict[str, Any]] = []
    left = number
    while left > 0:
        with (
            RunningEmulator(EmulatorConfig(ids=_PAIR)) as emulator,
            SupervisedBus({emulator.port: _PAIR}) as bus,
        ):
            begin = time.monotonic()
            _enable(bus, limits)
            emulator.events()
            is_moving = True
            while left > 0 and (is_moving or _is_enabled_again(bus, limits, emulator)):
                fault, cycles = _random_fault(generator)
                emulator.faults(**fault)
                seen, message = _cycles(bus, begin, cycles, generator)
                emulator.faults(**dict.fromkeys(fault, 0))
                if not message:
                    more, message = _cycles(bus, begin, _CYCLES_BETWEEN, generator)
                    seen += more
                events = emulator.events()
                is_moving = not message
                left = left - 1
                counts, some_wrong = compare_replies(events, seen)
                tally.update(counts)
                wrong += some_wrong
                beyond += _beyond(events, limits)
                if message:
                    reasons[message.split(";")[0].split(":")[0]] += 1
                    off_s += _off_after_fault(events, emulator)
    stops = reasons.total()
    held_up = (
        f" ({stops - len(off_s)} because this program was held up)" if stops > len(off_s) else ""
    )
    slow = sum(not t <= PERIOD_S + _CLOCK_S for t in off_s)
    longest = max(off_s, default=0.0)
    return Trial(
        "faults",
        "1000 faults: no wrong value taken, no goal beyond the limits, torque off within a cycle of"
        " a fault",
        f"{number} faults: {tally['wrong']} wrong of {tally['accepted']} replies taken,"
        f" {tally['missing']} missing, {len(beyond)} goals beyond, {stops} stops{held_up}, torque"
        f" off after at most {1e3 * longest:.1f} ms",
        not (tally["wrong"] or beyond or slow),
        {
            **tally,
            "beyond_rad": beyond,
            "reasons": dict(reasons),
            "off_s": off_s,
            "wrong_replies": wrong,
        },
    )


def _enable(bus: SupervisedBus, limits: SafetyLimits) -> None:
    """Torque on again; for a while, since a busy computer delays replies, and what was let go
    swings at first."""
    end_s = time.monotonic() + _SWING_S
    while time.monotonic() < end_s:
        with contextlib.suppress(HardwareError):
            bus.enable(limits)
            return
    bus.enable(limits)


def _is_enabled_again(bus: SupervisedBus, limits: SafetyLimits, emulator: RunningEmulator) -> bool:
    """Torque on again after a stop; not where joints have swung beyond the limits and a hand
    must set them back."""
    with contextlib.suppress(HardwareError):
        _enable(bus, limits)
        emulator.events()
        return True
    return False


def _random_fault(generator: np.random.Generator) -> tuple[dict[str, Any], int]:
    """A fault and for how many cycles."""
    kind = str(generator.choice(["lost", "late", "corrupted", "truncated", "silent", "overload"]))
    if kind in ("silent", "overload"):
        return {kind: True}, int(generator.integers(1, 6))
    fault: dict[str, Any] = {kind: float(generator.uniform(0.2, 1.0))}
    if kind == "late":
        fault["late_s"] = float(generator.uniform(0.001, 0.02))
    return fault, int(generator.integers(1, 6))


def _cycles(
    bus: SupervisedBus, begin: float, number: int, generator: np.random.Generator
) -> tuple[list[tuple[float, States]], str]:
    """Cycles with now and then a wild goal: when each was read, what came, and what stopped
    them, "" if nothing."""
    seen = []
    for _ in range(number):
        due = time.monotonic() + PERIOD_S
        wild = generator.normal(size=2) * 2.0 if generator.random() < 0.1 else 0.0
        try:
            cycle = bus.exchange(np.full(2, goal(due - begin)) + wild, due)
        except FaultError as error:
            return seen, str(error)
        seen.append((due + cycle.late_s, cycle.states))
    return seen, ""


def compare_replies(
    events: Sequence[Event],
    seen: Sequence[tuple[float, States]],
    ids: Sequence[int] = _PAIR,
    model: ServoModel = _MODEL,
) -> tuple[dict[str, int], list[dict[str, Any]]]:
    """Compare each position that was taken with what the servo had to say to that very request.

    Args:
        events: Of the emulator.
        seen: When each cycle was read [s], and what came.
        ids: Of the servos.
        model: Of them all.

    Returns:
        Counts, and what there is to know of the wrong ones: a figure that is not 0 must be
            explained.
    """
    wrong = []
    accepted = 0
    missing = 0
    for read_s, states in seen:
        for column, servo in enumerate(ids):
            if not states.is_fresh[column]:
                missing += 1
                continue
            asked = [
                value
                for t, who, name, value in events
                if who == servo
                and name == "present_position"
                and read_s - _CLOCK_S <= t <= states.time_s
            ]
            accepted += 1
            taken = round(states.position[column] / model.position_unit) + model.zero_count
            if not asked or taken != asked[-1]:
                around = [event for event in events if abs(event[0] - read_s) < _AROUND_S]
                wrong.append(
                    {
                        "servo": servo,
                        "taken": taken,
                        "read_s": read_s,
                        "time_s": states.time_s,
                        "events": around,
                    }
                )
    return {"wrong": len(wrong), "accepted": accepted, "missing": missing}, wrong


def _beyond(events: Sequence[Event], limits: SafetyLimits) -> list[float]:
    """Goals [rad] that arrived at a servo beyond its limits, or farther from the last one than
    any cycle allows."""
    reach = limits.slew_rad_s * 0.02 + _UNIT
    found = []
    for servo in _PAIR:
        goals = [
            value * _UNIT
            for _, who, name, value in events
            if who == servo and name == "goal_position"
        ]
        found += [after for before, after in pairwise(goals) if abs(after - before) > reach]
        found += [
            angle
            for angle in goals
            if not limits.lowest_rad - _UNIT <= angle <= limits.highest_rad + _UNIT
        ]
    return found


def _off_after_fault(events: Sequence[Event], emulator: RunningEmulator) -> list[float]:
    """Time from the end of the wait for the last reply to torque off at the servos [s].

    Nothing where no servo was asked: this program was held up between two cycles until it counted
    as one that hangs.
    """
    asked = max((t for t, _, name, _ in events if name == "present_position"), default=None)
    if asked is None:
        return [math.inf] if any(emulator.state()["torque_on"]) else []
    off = [t for t, *_, name, value in events if (name, value) == _OFF and t >= asked]
    return [max(min(off, default=math.inf) - asked - _REPLY_TIMEOUT_S, 0.0)]


def _signal_program(number: signal.Signals) -> Callable[[Any, int], None]:
    return lambda program, _: program.send_signal(number)


def _signal_supervisor(number: signal.Signals) -> Callable[[Any, int], None]:
    return lambda _, supervisor: os.kill(supervisor, number)


def _ended(name: str, required: str, end: Callable[[Any, int], None], share: float) -> Trial:
    """Start a motion, end it in some way at a random moment, and see when torque goes off."""
    number = _times(50, share)
    generator = np.random.default_rng(0)
    took: list[float] = []
    spoiled = 0
    with RunningEmulator(EmulatorConfig(faults=_USB_LATENCY)) as emulator:
        while len(took) < number and spoiled < number:
            one = _end_once(emulator, generator, end)
            if one is None:
                spoiled += 1
            else:
                took.append(one)
    return _ending(name, required, number, took, spoiled)


def _ending(name: str, required: str, number: int, took: list[float], spoiled: int) -> Trial:
    """What came of tries to end a motion, some of which had ended before."""
    figures = {"took_s": took, "spoiled": spoiled}
    if not took:
        said = f"nothing: all {spoiled} tries had stopped before by themselves"
        return Trial(name, f"{required}, {number} of {number}", said, False, figures)
    within = sum(t <= _TORQUE_OFF_S for t in took)
    return Trial(
        name,
        f"{required}, {number} of {number}",
        f"{within} of {number}; median {1e3 * float(np.median(took)):.1f} ms, at most"
        f" {1e3 * max(took):.1f} ms" + _stopped_before(spoiled),
        within == number,
        figures,
    )


def _stopped_before(spoiled: int) -> str:
    return f"; {spoiled} more had stopped before by themselves" if spoiled else ""


def _end_once(
    emulator: RunningEmulator, generator: np.random.Generator, end: Callable[[Any, int], None]
) -> float | None:
    """Time from the end of the program to torque off [s]; None if the motion had ended before."""
    wait_until_rest(emulator)
    program = subprocess.Popen(
        child_command("tests.hardware_trials.wave", emulator.port, "1"),
        env=child_environment(),
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert program.stdout is not None
        said = program.stdout.readline()
        if not said.strip().isdigit():
            return None
        supervisor = int(said)
        time.sleep(float(generator.uniform(0.05, 0.1)))
        emulator.events()
        if not all(emulator.state()["torque_on"]):
            return None
        begin = time.monotonic()
        end(program, supervisor)
        time.sleep(_TORQUE_OFF_S)
        for _ in range(21):  # a program that was itself to switch torque off is slower
            time.sleep(_TORQUE_OFF_S)
            events = emulator.events()
            if off := [t for t, *_, name, value in events if (name, value) == _OFF]:
                return min(off) - begin
        return math.inf
    finally:
        program.kill()
        program.communicate()
        wait_until_free(emulator.port)


def unplugged(share: float) -> Trial:
    """The adapter is pulled out in the middle of cycles."""
    number = _times(50, share)
    generator = np.random.default_rng(0)
    told: list[bool] = []
    spoiled = 0
    with RunningEmulator(EmulatorConfig(faults=_USB_LATENCY)) as emulator:
        while len(told) < number and spoiled < number:
            with SupervisedBus({emulator.port: [1]}) as bus:
                _enable(bus, SafetyLimits())
                one = _unplug(emulator, bus, generator)
            emulator.faults(unplugged=False)
            if one is None:
                spoiled += 1
            else:
                told.append(one)
    return Trial(
        "unplugged",
        f"unplug during a write: a clear statement that the bus is gone, {number} of {number}",
        f"{sum(told)} of {number}{_stopped_before(spoiled)}",
        sum(told) == number,
        {"spoiled": spoiled},
    )


def _unplug(
    emulator: RunningEmulator, bus: SupervisedBus, generator: np.random.Generator
) -> bool | None:
    """Whether the program is told that its bus, by name, is gone; None if the motion had ended
    before."""
    port = emulator.port
    when = int(generator.integers(5, 15))
    for cycle in range(40):
        try:
            bus.exchange(np.zeros(1), time.monotonic() + float(generator.uniform(0.001, PERIOD_S)))
        except BusGoneError as error:
            return cycle > when and port in str(error) and "gone" in str(error)
        except FaultError:
            return None if cycle <= when else False
        if cycle == when:
            emulator.faults(unplugged=True)
    return False


def header_positions(share: float) -> Trial:
    """Positions whose bytes look like a header, and their neighbours, written alone and to all,
    and read back."""
    wrong = tried = 0
    for number in (54024, 54025, 2020):
        with (
            RunningEmulator(EmulatorConfig(model_number=number, ids=(1, 2, 0xFC))) as emulator,
            DynamixelBus(emulator.port) as bus,
        ):
            bus.attach([1, 2, 0xFC])
            for value in (-131073, -131072, -131074, -3, -1, -513, 0xFDFF, 0xFFFF, -65537, 131071):
                bus.write_register(1, "goal_position", value)
                bus.write_all("goal_position", {2: value, 0xFC: value})
                wrong += [bus.read_register(i, "goal_position") for i in bus.ids] != [value] * 3
                tried += 1
    return Trial(
        "header-positions",
        "legal positions that look like a header are written and read back exactly",
        f"{tried - wrong} of {tried}",
        wrong == 0,
        {},
    )


def second_program(share: float) -> Trial:
    """Another program on a port that is taken."""
    with RunningEmulator() as emulator, SupervisedBus({emulator.port: [1]}):
        try:
            SupervisedBus({emulator.port: [1]}).close()
            said = "it was let in"
        except PortError as error:
            said = str(error)
        is_refused = "another program uses" in said and emulator.port in said
    return Trial(
        "second-program", "a second program is refused, and told which port", said, is_refused, {}
    )


_ENDINGS = {
    "killed": (
        "SIGKILL of the program: torque off within 100 ms",
        _signal_program(signal.SIGKILL),
    ),
    "hangs": (
        "the program hangs: torque off within 100 ms",
        _signal_program(signal.SIGSTOP),
    ),
    "interrupted": (
        "SIGINT during a read: torque off",
        _signal_program(signal.SIGINT),
    ),
    "supervisor-ended": (
        "SIGTERM of the supervisor: torque off within 100 ms",
        _signal_supervisor(signal.SIGTERM),
    ),
    "supervisor-killed": (
        "SIGKILL of the supervisor: torque off within 100 ms",
        _signal_supervisor(signal.SIGKILL),
    ),
    "supervisor-hangs": (
        "the supervisor hangs: torque off within 100 ms",
        _signal_supervisor(signal.SIGSTOP),
    ),
}
"""Ends of a motion at a random moment: what is required, and how it ends."""
TRIALS: dict[str, Callable[[float], Trial]] = {
    "second-program": second_program,
    "header-positions": header_positions,
    **{name: partial(_ended, name, *ending) for name, ending in _ENDINGS.items()},
    "unplugged": unplugged,
    "faults": faults,
    "loop": loop,
    "identification": identification,
}
"""By name, the quick ones first."""
