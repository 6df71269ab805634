"""Every comparison of the safety path, given what is no number: none may let the motion go on."""

import math
import operator
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.hardware import imu
from elastic_env.hardware.arm_settings import ArmSettings, ServoPlace
from elastic_env.hardware.buses.bus import Condition
from elastic_env.hardware.emulator.launch import EmulatorConfig
from elastic_env.hardware.errors import FaultError, HardwareError
from elastic_env.hardware.imu import Attitude, AttitudeError, AttitudeStream, PlausibleAttitudes
from elastic_env.hardware.safety.checks import require_ready
from elastic_env.hardware.safety.guard import Guard, exceeds, is_outside
from elastic_env.hardware.safety.realtime import Pace
from elastic_env.hardware.settings import HardwareSettings, SafetyLimits
from elastic_env.robots.testbed.model import Pendulum
from tests.test_hardware_safety import states
from tests.test_hardware_supervisor import ENABLE, attached, served
from tests.test_hardware_testbed import StillBus, make_still, still  # noqa: F401  a fixture
from train.commands.hardware import Emulate

NO_NUMBERS = [math.nan, math.inf, -math.inf]
no_number = pytest.mark.parametrize("value", NO_NUMBERS)


@pytest.mark.parametrize("limit", [-1.0, 0.0, 2.5, *NO_NUMBERS])
@pytest.mark.parametrize("value", [-3.0, -1.0, 0.0, 2.5, 2.6, *NO_NUMBERS])
def test_only_what_is_known_to_be_within_does_not_exceed(value: float, limit: float) -> None:
    """Catches a bound that nan passes, or that a value on it does not."""
    is_known = math.isfinite(value) and math.isfinite(limit)
    assert bool(exceeds(value, limit)) == (not (is_known and operator.le(value, limit)))
    assert bool(is_outside(value, -1.0, limit)) == (not (is_known and -1.0 <= value <= limit))
    assert bool(is_outside(value, limit, 2.5)) == (not (is_known and limit <= value <= 2.5))
    assert exceeds([value, -9.0], [limit, 0.0]).tolist() == [bool(exceeds(value, limit)), False]


@no_number
@pytest.mark.parametrize("what", ["position", "velocity", "torque"])
def test_a_state_that_is_no_number_stops_the_motion_at_once(what: str, value: float) -> None:
    """Catches a measurement that no limit is exceeded by: `abs(nan) > limit` is False."""
    measured = states([0.0, 0.0])
    getattr(measured, what)[1] = value
    said = Guard(SafetyLimits(), np.zeros(2), ["one", "two"]).check(measured)
    assert "of two is not a finite number" in said


@no_number
def test_a_motion_does_not_begin_where_nobody_knows(value: float) -> None:
    """Catches a first goal that is no angle."""
    with pytest.raises(FaultError, match="by hand"):
        Guard(SafetyLimits(), np.array([value]), ["it"])


@no_number
def test_goals_that_are_no_angles_are_not_commanded(value: float) -> None:
    """Catches a count on the wire that was made of nan."""
    with pytest.raises(FaultError, match="finite angles"):
        Guard(SafetyLimits(), np.zeros(1), ["it"]).command(np.array([value]), 0.004)


@pytest.mark.parametrize("value", [*NO_NUMBERS, -0.001])
def test_a_time_since_the_last_command_that_is_none_is_not_taken(value: float) -> None:
    """Catches a limit on the goal's speed that is nan wide, by which the goal becomes nan, or
    infinitely wide."""
    with pytest.raises(FaultError, match=r"at least 0 s and finite"):
        Guard(SafetyLimits(), np.zeros(1), ["it"]).command(np.array([0.5]), value)


@no_number
@pytest.mark.parametrize("what", ["goals", "at"])
def test_a_request_with_what_is_no_number_switches_torque_off(what: str, value: float) -> None:
    """Catches NaN and Infinity, which JSON as Python has it passes on, in a cycle's goals or
    moment."""
    line = attached("one", 1)
    asked: dict[str, Any] = {"goals": [0.0], "at": 0.0} | {
        what: [value] if what == "goals" else value
    }
    _, answer = served([line], ENABLE, ("exchange", asked))
    if what == "at" and value == -math.inf:
        assert "asked for -inf s" in answer["message"]
    assert answer["error"] == "FaultError"
    assert answer["message"].endswith("torque is off")
    assert not line.servos[1].is_on


@no_number
def test_torque_goes_on_where_a_speed_is_known_only(value: float) -> None:
    """Catches a servo at an unknown speed that counts as at rest."""
    condition = Condition(velocity=value, temperature=30.0, temperature_limit=80.0, error="")
    with pytest.raises(FaultError, match="torque goes on at rest"):
        require_ready("servo 1 at one", condition, 80.0)


@no_number
@pytest.mark.parametrize("what", ["q", "theta", "rate", "age"])
def test_a_link_that_is_nowhere_stops_the_motion(still: StillBus, what: str, value: float) -> None:  # noqa: F811
    """Catches the deflection stop that an IMU's nan switches off, and the tolerance that an
    endless age widens."""
    env = make_still()
    testbed = env.unwrapped.task.plant
    at = testbed._at
    testbed.qpos[0, at.theta[0]] = 0.0
    testbed.qvel[0, at.theta_dot[0]] = 0.1
    given = {"q": 0.0, "age": 0.01}
    testbed._require_small_deflection(given["q"], given["age"])
    if what == "theta":
        testbed.qpos[0, at.theta[0]] = value
    elif what == "rate":
        testbed.qvel[0, at.theta_dot[0]] = value
    else:
        given[what] = value
    if what == "age" and value == -math.inf:
        testbed._require_small_deflection(given["q"], given["age"])  # no age widens nothing
        return
    with pytest.raises(HardwareError, match="largest_deflection_rad"):
        testbed._require_small_deflection(given["q"], given["age"])


@no_number
def test_a_period_whose_lateness_is_not_known_is_an_overrun(value: float) -> None:
    """Catches a clock that never gets out of nan."""
    assert Pace(0.004).is_overrun(value)


WORKING = Attitude(10.0, 0.1, 0.2, 0.3)


def after(time_s: float, **angles: float) -> Attitude:
    return Attitude(time_s, **({"roll": 0.1, "pitch": 0.2, "yaw": 0.3} | angles))


@pytest.mark.parametrize("axis", ["roll", "pitch", "yaw"])
@pytest.mark.parametrize("value", [*NO_NUMBERS, 3.2, -3.2, 1e30])
def test_angles_that_no_imu_can_measure_are_named(axis: str, value: float) -> None:
    """Catches what an IMU calls valid: nan, inf, and angles outside ±π or, for the pitch, ±π/2."""
    said = PlausibleAttitudes(0.05).check(after(10.0, **{axis: value}))
    assert f"sends {axis} = {value:g} rad" in said
    assert "must lie between" in said


def test_the_ends_of_the_range_are_angles() -> None:
    """Catches a false alarm at ±π, which 32 bits round to more than π, and a range that is too
    wide for the pitch."""
    for sign in (1, -1):
        end = sign * float(np.float32(np.pi))
        half = sign * float(np.float32(np.pi / 2))
        assert PlausibleAttitudes(0.05).check(after(10.0, roll=end, pitch=half, yaw=end)) == ""
        assert "pitch" in PlausibleAttitudes(0.05).check(after(10.0, pitch=1.001 * half))


def test_an_imu_that_repeats_itself_is_frozen_when_an_attitude_may_be_no_older() -> None:
    """Catches a filter that stands still while its packets go on, and a false alarm at two equal
    samples."""
    plausible = PlausibleAttitudes(oldest_s=0.055)
    found = [plausible.check(after(10.0 + 0.01 * k)) for k in range(7)]
    assert found[:6] == [""] * 6
    assert "the same attitude in all bits for 60 ms, 55 ms are allowed (imu_oldest_s)" in found[6]


@pytest.mark.parametrize("axis", ["roll", "pitch", "yaw"])
def test_one_angle_that_changes_by_a_bit_is_life(axis: str) -> None:
    """Catches a stop while the link hangs still, and one of an axis that is not looked at."""
    plausible = PlausibleAttitudes(oldest_s=0.05)
    angle = np.float32(0.1)
    for k in range(100):
        angle = np.nextafter(angle, np.float32(1.0))
        assert plausible.check(after(10.0 + 0.01 * k, **{axis: float(angle)})) == ""


@pytest.mark.parametrize("time_s", [*NO_NUMBERS, 99.9, 100.1])
def test_an_attitude_whose_age_is_not_known_is_missing(
    time_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an age of nan, which is not above what is allowed, and one of the future, which
    never becomes old."""
    stream = _stream(lambda: after(time_s), monkeypatch)
    with pytest.raises(AttitudeError, match="has sent no attitude"):
        stream.latest()


@no_number
def test_the_stream_gives_nobody_what_is_no_angle(
    value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a check that nobody calls: the very first sample is refused."""
    with pytest.raises(AttitudeError, match="the IMU at here sends roll"):
        _stream(lambda: after(100.0, roll=value), monkeypatch).latest()


def _stream(sample: Callable[[], Attitude], monkeypatch: pytest.MonkeyPatch) -> AttitudeStream:
    """A stream without a process, at 100 s of its clock."""
    monkeypatch.setattr(imu, "time", SimpleNamespace(monotonic=lambda: 100.0))
    stream = AttitudeStream.__new__(AttitudeStream)
    stream.port = "here"
    stream._oldest_s = 0.05
    stream._plausible = PlausibleAttitudes(0.05)
    # type: ignore[assignment]
    stream._shared = SimpleNamespace(get=sample)
    stream._process = SimpleNamespace(poll=lambda: None, stderr=None)  # type: ignore[assignment]
    monkeypatch.setattr(stream, "close", lambda: None)
    return stream


@pytest.mark.parametrize(
    ("angles", "words"),
    [
        (lambda _: {"roll": math.nan}, "roll = nan rad"),
        (lambda _: {"yaw": math.inf}, "yaw = inf rad"),
        (lambda _: {"pitch": -2.0}, "pitch = -2 rad"),
        (lambda _: {"roll": 0.5}, "largest_deflection_rad"),
        (lambda _: {}, "in all bits for 5[0-9] ms"),
    ],
)
def test_the_first_cycle_that_sees_it_stops_the_motion(
    still: StillBus,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    angles: Callable[[float], dict[str, float]],
    words: str,
) -> None:
    """Catches one more command after an attitude that nothing can have measured, or that is as
    old as may be."""
    still.closed_s = math.nan  # type: ignore[attr-defined]
    now = still.monotonic
    plausible = PlausibleAttitudes(0.05)
    monkeypatch.setattr(still, "close", lambda: setattr(still, "closed_s", now()))
    env = make_still()
    env.reset()
    begin_s = now()

    def latest() -> Attitude:
        is_wrong = now() > begin_s + 0.02
        sample = Attitude(
            now(),
            **(
                {"roll": 0.0, "pitch": 0.0, "yaw": 0.0 if is_wrong else now()}
                | (angles(now()) if is_wrong else {})
            ),
        )
        if problem := plausible.check(sample):
            raise AttitudeError(problem)
        return sample

    imu = SimpleNamespace(latest=latest, close=lambda: None)
    monkeypatch.setattr(env.unwrapped.task.plant, "_imu", imu)
    with pytest.raises(HardwareError, match=words):
        _step(env, 40)
    allowed_s = 0.05 if "bits" in words else 0.0
    assert still.closed_s == pytest.approx(begin_s + 0.02 + allowed_s, abs=0.0081)  # type: ignore[attr-defined]


def _step(env: Any, times: int) -> None:
    for _ in range(times):
        env.step(np.zeros(1, dtype=np.float32))


TINY = 5e-324
HUGE = 1e39
ALLOWED_NEAR_ZERO = ("lowest_rad", "highest_rad", "margin_rad", "patience_cycles", "release_s")
LIMITS = [
    (name, info)
    for name, info in SafetyLimits.model_fields.items()
    if name not in ALLOWED_NEAR_ZERO
]
SETTINGS = {
    "baudrate": "[bit/s]",
    "imu_baudrate": "[bit/s]",
    "imu_oldest_s": "[s]",
    "largest_deflection_rad": "[rad]",
    "approach_rad_s": "[rad/s]",
}
LOADS = {"gravity_torque": "[N·m]", "mass": "[kg]", "gyration_radius": "[m]"}


@pytest.mark.parametrize("value", [TINY, 1e-12, -1.0, 0.0, HUGE, *NO_NUMBERS])
@pytest.mark.parametrize(
    ("model", "name", "unit"),
    [
        *((SafetyLimits, name, f"[{info.json_schema_extra['unit']}]") for name, info in LIMITS),  # type: ignore[index]
        *((HardwareSettings, name, unit) for name, unit in SETTINGS.items()),
        *((Pendulum, name, unit) for name, unit in LOADS.items()),
        (EmulatorConfig, "imu_rate_hz", "[Hz]"),
        (EmulatorConfig, "baudrate", "[bit/s]"),
    ],
)
def test_no_setting_takes_what_no_hardware_has(
    model: type[Model], name: str, unit: str, value: float
) -> None:
    """Catches a rate of 1e39 bit/s that ends in the SDK, and limits that stop every motion, or
    none."""
    others = {"port": "/dev/ttyNOTHING"} if model is HardwareSettings else {}
    with pytest.raises(ConfigurationError, match=name) as refused:
        model(**{name: value, **others})
    assert unit in str(refused.value) or "whole number" in str(refused.value)
    assert len(str(refused.value)) < 400


def test_a_range_of_goals_is_more_than_a_rounding_error() -> None:
    """Catches a range in which no servo can stay."""
    with pytest.raises(ConfigurationError, match=r"by at least 0\.01 rad"):
        SafetyLimits(lowest_rad=0.1, highest_rad=math.nextafter(0.1, 1.0))


@pytest.mark.parametrize("after_s", [-1.0, 1e39, *NO_NUMBERS])
def test_a_fault_comes_at_a_time_that_one_can_wait_for(after_s: float) -> None:
    """Catches a traceback of the clock."""
    with pytest.raises(
        ConfigurationError, match=r"fault_after_s must be .*>= 0 and <= 86400 \[s\]"
    ):
        Emulate(fault=["hot"], fault_after_s=after_s)


def test_a_latency_is_refused_in_the_unit_of_its_option() -> None:
    """Catches an error about another number than the one that somebody has typed."""
    with pytest.raises(ConfigurationError, match=r"latency_ms must .* <= 1000 \[ms\], got -1"):
        Emulate(latency_ms=-1.0)


@pytest.mark.parametrize("model", [HardwareSettings, SafetyLimits, ArmSettings, ServoPlace])
def test_every_number_of_a_mounting_file_has_its_unit_and_both_bounds(model: type[Model]) -> None:
    """Catches a setting without a bound, and a meaning with another unit than the errors."""
    for name, info in model.model_fields.items():
        if info.annotation not in (int, float):
            continue
        assert isinstance(info.json_schema_extra, dict), name
        assert f"[{info.json_schema_extra['unit']}]" in str(info.description), name
        for kinds in (("ge", "gt"), ("le", "lt")):
            assert any(hasattr(one, kind) for one in info.metadata for kind in kinds), name
