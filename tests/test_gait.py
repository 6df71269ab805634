"""Gait: phases against a walk counted out step by step, the ZMP's path against its boundary
conditions."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.motion.gait import (
    Gait,
    Timing,
    footholds,
    make_gait,
    step_timing,
    zmp_reference,
)

PERIOD_S = 0.004
STAND = 250  # control steps of standing before and after the walk
FEET = np.array([[0.03, 0.105], [0.01, -0.095]])
NAMED = [
    (24.0, (7.0, 10.0, 7.0)),
    (3.0, (1.1, 0.8, 1.1)),
    (1.6, (0.5, 0.6, 0.5)),
    (1.1, (0.3, 0.5, 0.3)),
]

double_steps = st.integers(
    1, 120
)  # also so short that a transition reaches into the neighbouring step
single_steps = st.integers(1, 150)


def timed(gait: Gait) -> Timing:
    """Phases at the control rate of the robot."""
    return step_timing(gait, PERIOD_S)


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """First and last row of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


@pytest.mark.parametrize(("step_period", "durations"), NAMED)
def test_named_gaits_have_the_phases_of_the_paper(
    step_period: float, durations: tuple[float, float, float]
) -> None:
    """Catches durations in another order, and a foot that lifts off or touches down a control
    step too early."""
    gait = make_gait(step_period)
    assert gait == make_gait(durations) == make_gait(list(durations)) == make_gait(gait)
    assert gait.step_period_s == pytest.approx(step_period, abs=1e-12)
    assert gait.duration_s == pytest.approx(4 * step_period + 2.0, abs=1e-12)
    timing = timed(gait)
    assert timing.time[-1] == pytest.approx(gait.duration_s, abs=1e-9)
    np.testing.assert_allclose(np.diff(timing.time), PERIOD_S, rtol=0.0, atol=1e-12)
    swings = runs(timing.single)
    assert len(swings) == 4
    for number, (first, last) in enumerate(swings):
        lift_off = 1.0 + number * step_period + durations[0]
        assert timing.time[first] == pytest.approx(lift_off + PERIOD_S, abs=1e-9)
        assert timing.time[last] == pytest.approx(lift_off + durations[1] - PERIOD_S, abs=1e-9)
    [(first, last)] = runs(timing.walking)
    assert timing.time[first] == pytest.approx(1.0 + PERIOD_S, abs=1e-9)
    assert timing.time[last] == pytest.approx(gait.duration_s - 1.0, abs=1e-9)


def counted(first: int, single: int, last: int, num_steps: int) -> dict[str, Array]:
    """The walk counted out, row by row, in control steps."""
    rows: dict[str, list[float]] = {
        name: [] for name in ("support", "single", "swing", "transition", "walking")
    }

    def add(step: int, swing: int, near: bool, walking: bool) -> None:
        support = min(max(step, 0), num_steps - 1) % 2
        values = (support, 0 < swing < single, swing / single, near, walking)
        for row, value in zip(rows.values(), values, strict=True):
            row.append(value)

    period = first + single + last
    lift_offs = [step * period + first for step in range(num_steps)]
    events = np.array([lift_off + swing for lift_off in lift_offs for swing in (0, single)])
    for _ in range(STAND + 1):
        add(-1, 0, near=False, walking=False)
    for step in range(num_steps):
        for count in range(1, period + 1):  # a row is the end of a control period
            near = bool((np.abs(step * period + count - events) <= 50).any())
            add(step, min(max(count - first, 0), single), near, walking=True)
    for _ in range(STAND):
        add(num_steps, single, near=False, walking=False)
    return {name: np.array(values) for name, values in rows.items()}


@given(double_steps, single_steps, double_steps, st.integers(1, 5))
def test_phases_are_those_of_a_walk_counted_out(
    first: int, single: int, last: int, num_steps: int
) -> None:
    """Catches a phase shifted by a row, a swing foot that supports, and a transition of another
    width than ±0.2 s."""
    timing = timed(
        make_gait((first * PERIOD_S, single * PERIOD_S, last * PERIOD_S), num_steps=num_steps)
    )
    expected = counted(first, single, last, num_steps)
    for name, values in expected.items():
        np.testing.assert_allclose(
            getattr(timing, name), values, rtol=0.0, atol=1e-12, err_msg=name
        )


def test_the_right_foot_swings_first_and_then_they_take_turns() -> None:
    """Catches a walk that begins on the other foot than Fig. 1, and one that hops on one leg."""
    timing = timed(make_gait(1.1, num_steps=5))
    supports = [
        set(timing.support[first : last + 1].tolist()) for first, last in runs(timing.single)
    ]
    assert supports == [{0}, {1}, {0}, {1}, {0}]
    assert timing.support[0] == 0
    assert timing.support[-1] == 0


def test_transitions_are_a_fifth_of_a_second_to_both_sides() -> None:
    """Catches a whole width of 0.2 s, one counted in control steps, and one that forgets the
    touch-down."""
    for period_s in (0.004, 0.01):
        timing = step_timing(make_gait(24, num_steps=1), period_s)
        spans = [(timing.time[first], timing.time[last]) for first, last in runs(timing.transition)]
        np.testing.assert_allclose(spans, [(7.8, 8.2), (17.8, 18.2)], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["double_support_s", "single_support_s", "last_double_support_s"])
def test_a_duration_between_control_steps_is_an_error(name: str) -> None:
    """Catches a duration that is rounded silently, and a message that does not say which one and
    what would fit."""
    gait = make_gait(1.6).replace(**{name: 0.501})
    with pytest.raises(
        ConfigurationError,
        match=rf"^{name} must be a multiple of the control period of 0\.004 s, got 0\.501 s; "
        r"the nearest are 0\.5 s and 0\.504 s$",
    ):
        timed(gait)
    with pytest.raises(
        ConfigurationError,
        match=rf"^{name} must be a multiple .* got 0\.001 s; the nearest is 0\.004 s$",
    ):
        timed(gait.replace(**{name: 0.001}))
    with pytest.raises(ConfigurationError, match=r"the nearest are 2000 s and 2000\.004 s$"):
        timed(gait.replace(**{name: 2000.001}))


@pytest.mark.parametrize(
    "given", [2, 2.0, "fast", None, float("nan"), (), (0.5, 0.6), [0.5, 0.6, 0.5, 0.6], True, "3"]
)
def test_a_gait_without_a_name_is_an_error_that_lists_the_names(given: object) -> None:
    """Catches the nearest gait taken for the one that was meant, and a tuple of another length."""
    with pytest.raises(ConfigurationError) as caught:
        make_gait(given)  # pyright: ignore[reportArgumentType]
    assert "must be one of 24, 3, 1.6, 1.1 [s], or the three durations" in str(caught.value)
    assert str(caught.value).endswith(f"got {given!r}")


@pytest.mark.parametrize(
    "given",
    [
        np.float32(1.6),
        np.float64(1.6),
        np.array(1.6),
        np.array([0.5, 0.6, 0.5]),
        np.float32([0.5, 0.6, 0.5]),
    ],
)
def test_durations_may_be_numbers_of_numpy(given: Any) -> None:
    """Catches a gait that an array cannot name, and a period that single precision moves off its
    name."""
    gait = make_gait(given, num_steps=np.int64(2))
    assert gait == make_gait(1.6, num_steps=2)
    assert len(timed(gait).time) == len(timed(make_gait(1.6, num_steps=2)).time)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            {"step_period": (0.5, -0.1, 0.5)},
            r"Gait.single_support_s must be a finite number > 0 and <= 3600 \[s\], got -0.1",
        ),
        (
            {"step_period": 3, "num_steps": 0},
            "Gait.num_steps must be a whole number >= 1 and <= 1000, got 0",
        ),
        (
            {"step_period": 3, "lift_m": 0.0},
            r"Gait.lift_m must be a finite number > 0 \[m\], got 0.0",
        ),
        (
            {"step_period": ["0.5", "0.6", "0.5"]},
            r"Gait.double_support_s must be a finite number > 0 and <= 3600 \[s\], got '0.5'",
        ),
        (
            {"step_period": [True] * 3},
            r"Gait.double_support_s must be a finite number > 0 and <= 3600 \[s\], got True",
        ),
        (
            {"step_period": 3, "num_steps": "2"},
            "Gait.num_steps must be a whole number >= 1 and <= 1000, got '2'",
        ),
        (
            {"step_period": 3, "num_steps": True},
            "Gait.num_steps must be a whole number >= 1 and <= 1000, got True",
        ),
        (
            {"step_period": 3, "lift": 0.1},
            "unknown parameter of Gait 'lift'.*Did you mean 'lift_m'",
        ),
        (
            {"step_period": (0.3, 0.5, 0.08), "transfer": "ramp"},
            "the transfer 'ramp' shifts the ZMP in 0.1 s; a double support of 0.08 s is shorter",
        ),
    ],
)
def test_parameters_that_make_no_walk_are_errors(
    parameters: dict[str, object], message: str
) -> None:
    """Catches a walk without steps or lift, and a ramp that begins before its double support."""
    with pytest.raises(ConfigurationError, match=message):
        make_gait(**parameters)  # pyright: ignore[reportArgumentType]


def test_parameters_of_a_named_gait_are_kept() -> None:
    """Catches parameters that a gait given as such ignores, and a gait that is changed in place."""
    gait = make_gait(3, lift_m=0.04, num_steps=2)
    assert (gait.lift_m, gait.num_steps, gait.single_support_s) == (0.04, 2, 0.8)
    assert make_gait(gait, num_steps=6) == make_gait(3, lift_m=0.04, num_steps=6)
    assert gait.num_steps == 2


@pytest.mark.parametrize("transfer", ["smooth", "ramp"])
@pytest.mark.parametrize("step_period", [24, 3, 1.6, 1.1])
def test_zmp_is_under_the_support_foot_in_single_support(step_period: float, transfer: str) -> None:
    """Catches the ZMP under the swing foot, and one still on its way at lift-off or gone before
    touch-down."""
    gait = make_gait(step_period, num_steps=3, transfer=transfer)
    timing = timed(gait)
    zmp = zmp_reference(gait, timing, footholds(gait, FEET))
    middle = (FEET[0] + FEET[1]) / 2.0
    assert zmp.shape == (len(timing.time), 2)
    standing = (timing.time <= 1.0) | (timing.time >= gait.duration_s - 1.0)
    np.testing.assert_allclose(
        zmp[standing], np.tile(middle, (standing.sum(), 1)), rtol=0.0, atol=1e-15
    )
    inward = {"smooth": 0.0, "ramp": 0.02}[transfer]
    for first, last in runs(timing.single):
        foot = FEET[timing.support[first]]
        support = foot + inward * (middle - foot) / np.hypot(*(middle - foot))
        # lift-off and touch-down themselves included
        np.testing.assert_allclose(
            zmp[first - 1 : last + 2], np.tile(support, (last - first + 3, 1)), atol=1e-13
        )


def minimum_jerk(s: Array) -> Array:
    """The quintic from 0 to 1 without speed and acceleration at both ends, by its six
    conditions."""
    powers = np.arange(6)
    at_0 = np.eye(6)[:3] * [[1], [1], [2]]
    at_1 = np.stack([np.ones(6), powers, powers * (powers - 1)])
    coefficients = np.linalg.solve(np.vstack([at_0, at_1]), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    return np.clip(s, 0.0, 1.0)[..., None] ** powers @ coefficients


def test_smooth_zmp_moves_from_foot_to_foot_over_both_double_supports() -> None:
    """Catches a stop halfway between the feet, another blend, and a transfer that begins or ends
    at the wrong time."""
    gait = make_gait((0.4, 0.6, 0.8), num_steps=2)
    timing = timed(gait)
    zmp = zmp_reference(gait, timing, footholds(gait, FEET))
    middle = FEET.mean(axis=0)
    time = timing.time
    path = [(1.0, 1.4, middle, FEET[0]), (2.0, 3.2, FEET[0], FEET[1]), (3.8, 4.6, FEET[1], middle)]
    for begin, end, start, target in path:
        during = (time > begin - 1e-9) & (time < end + 1e-9)
        blend = minimum_jerk((time[during] - begin) / (end - begin))
        np.testing.assert_allclose(
            zmp[during], start + blend[:, None] * (target - start), rtol=0.0, atol=1e-12
        )
    resting = np.ones(len(time), dtype=bool)
    for begin, end, _, _ in path:
        resting &= (time < begin + 1e-9) | (time > end - 1e-9)
    for first, last in runs(resting):
        np.testing.assert_allclose(
            zmp[first : last + 1], np.tile(zmp[first], (last - first + 1, 1)), atol=1e-13
        )


@pytest.mark.parametrize("step_period", [24, 3, 1.6, 1.1])
def test_smooth_zmp_has_no_speed_at_lift_off_and_touch_down(step_period: float) -> None:
    """Catches a linear or cubic transfer: the last control period before lift-off moves as the
    cube of its length."""
    gait = make_gait(step_period, num_steps=3)
    timing = timed(gait)
    zmp = zmp_reference(gait, timing, footholds(gait, FEET))
    shortest = gait.double_support_s
    width = np.hypot(*(FEET[0] - FEET[1]))
    bound = 10.0 * (PERIOD_S / shortest) ** 3 * width
    for first, last in runs(timing.single):
        assert 0.0 < np.hypot(*(zmp[first - 1] - zmp[first - 2])) <= bound
        assert 0.0 < np.hypot(*(zmp[last + 2] - zmp[last + 1])) <= bound
    assert np.hypot(*np.diff(zmp, axis=0).T).max() > 1.5 * width * PERIOD_S / (2.0 * shortest)


def test_ramp_shifts_linearly_within_a_tenth_of_a_second() -> None:
    """Catches the published controller's shift at another time, over another time, or outward of
    the ankle."""
    gait = make_gait(3, num_steps=2, transfer="ramp")
    timing = timed(gait)
    feet = np.array([[0.0, 0.105], [0.0, -0.105]])
    zmp = zmp_reference(gait, timing, footholds(gait, feet))
    corners = [0.0, 2.0, 2.1, 2.9, 3.0, 5.0, 5.1, 5.9, 6.0, 8.0]
    heights = [0.0, 0.0, 0.085, 0.085, 0.0, 0.0, -0.085, -0.085, 0.0, 0.0]
    np.testing.assert_allclose(
        zmp[:, 1], np.interp(timing.time, corners, heights), rtol=0.0, atol=1e-12
    )
    np.testing.assert_array_equal(zmp[:, 0], 0.0)


def test_zmp_stays_on_the_line_between_the_feet() -> None:
    """Catches shifts that add up to more than the way between the feet."""
    for transfer in ("smooth", "ramp"):
        gait = make_gait(1.1, num_steps=5, transfer=transfer)
        zmp = zmp_reference(gait, timed(gait), footholds(gait, FEET))
        between = FEET[1] - FEET[0]
        along = (zmp - FEET[0]) @ between / (between @ between)
        np.testing.assert_allclose(zmp, FEET[0] + along[:, None] * between, rtol=0.0, atol=1e-14)
        assert along.min() >= -1e-12
        assert along.max() <= 1.0 + 1e-12
        turns = [float(along[last]) for _, last in runs(timed(gait).single)]
        assert all(abs(a - b) > 0.7 for a, b in pairwise(turns))
