"""Reference trajectories: derivatives against finite differences, bounds over many seeds, the
paper's positions."""

import tracemalloc
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.motion.arm_references import Poses
from elastic_env.motion.references import (
    REFERENCES,
    Hold,
    Multisine,
    Reference,
    Sine,
    Steps,
    make_reference,
)
from elastic_env.motion.trajectory import STAND_S, Motion, Plan, PlanTable, quintic

PERIOD_S = 0.004
ALL = {
    "hold": Hold(),
    "hold, few and quick": Hold(
        positions=3,
        rate=0.5,
        lower=-0.2,
        upper=0.9,
        settle_s=0.0,
        measure_s=0.1,
        shortest_move_s=0.2,
    ),
    "sine": Sine(middle=-0.3),
    "sine, fast": Sine(frequency_hz=1.5, amplitude=0.1, duration_s=3.0, onset_s=0.4),
    "multisine": Multisine(),
    "multisine, raised": Multisine(
        middle=0.5, components=9, highest_hz=3.0, duration_s=4.0, onset_s=0.3
    ),
    "steps": Steps(),
    "steps, raised": Steps(middle=-0.4, move_s=0.3, rest_s=0.0, moves=9),
}


def plan_of(reference: Any, seed: int = 0, period_s: float = PERIOD_S) -> Plan:
    """A plan of a reference for a seed."""
    return reference.plan(np.random.default_rng(seed), period_s)


def central(values: Array, period_s: float) -> Array:
    """Central differences of samples at a constant rate, without the two ends."""
    return (values[2:] - values[:-2]) / (2.0 * period_s)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("period_s", [2e-3, 5e-4])
def test_rate_and_acceleration_are_the_derivatives_of_the_angle(name: str, period_s: float) -> None:
    """Catches a chain rule that lost a factor or the derivatives of the envelope.

    What a central difference may miss follows from how much the acceleration changes within a
    period.
    """
    plan = plan_of(ALL[name], seed=3, period_s=period_s)
    change = np.abs(np.diff(plan.q_ddot)).max()
    assert change < 0.2 * np.abs(plan.q_ddot).max()
    np.testing.assert_allclose(
        central(plan.q_dot, period_s), plan.q_ddot[1:-1], rtol=0.0, atol=0.6 * change
    )
    np.testing.assert_allclose(
        central(plan.q, period_s), plan.q_dot[1:-1], rtol=0.0, atol=0.2 * change * period_s
    )


@pytest.mark.parametrize("name", ALL)
def test_extents_are_bounds_over_all_seeds_and_no_loose_ones(name: str) -> None:
    """Catches a bound that a plan breaks, so that the servo could saturate, and one that forbids
    what is possible."""
    extent = ALL[name].extent()
    reached = np.full(4, -np.inf)
    for seed in range(100 if "hold" not in name and name != "sine" else 1):
        plan = plan_of(ALL[name], seed)
        ends = -plan.q.min(), plan.q.max(), np.abs(plan.q_dot).max(), np.abs(plan.q_ddot).max()
        reached = np.maximum(reached, ends)
    bounds = np.array([-extent.lowest, extent.highest, extent.q_dot, extent.q_ddot])
    assert extent.q == bounds[:2].max()
    assert (reached <= bounds + 1e-9 * np.abs(bounds)).all(), (reached, bounds)
    # lowest and highest together: how far it goes from one end to the other
    together = np.array([[1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    assert (together @ reached > 0.4 * together @ bounds).all(), (reached, bounds)


@settings(max_examples=40)
@given(
    positions=st.integers(2, 30),
    rate=st.floats(0.02, 1.0),
    overrun=st.floats(0.001, 0.3),
    shortest_move_s=st.floats(0.01, 5.0),
    bounds=st.tuples(st.floats(-0.95, -0.05), st.floats(0.0, 0.9)),
)
def test_extent_of_hold_is_a_bound_for_any_sweep(
    positions: int, rate: float, overrun: float, shortest_move_s: float, bounds: tuple[float, float]
) -> None:
    """Catches the shortest move being taken from the positions alone: the first and the last are
    the overrun."""
    hold = Hold(
        positions=positions,
        rate=rate,
        overrun=overrun,
        shortest_move_s=shortest_move_s,
        lower=bounds[0],
        upper=bounds[1],
        settle_s=0.05,
        measure_s=0.01,
    )
    plan = plan_of(hold)
    extent = hold.extent()
    assert extent.lowest - 1e-9 <= plan.q.min() <= plan.q.max() <= extent.highest + 1e-9
    assert np.abs(plan.q_dot).max() <= extent.q_dot * (1 + 1e-9)
    assert np.abs(plan.q_ddot).max() <= extent.q_ddot * (1 + 1e-9)


@settings(max_examples=40)
@given(
    amplitude=st.floats(0.01, 3.0),
    middle=st.floats(-3.0, 3.0),
    onset_s=st.floats(0.05, 5.0),
    hz=st.tuples(st.floats(0.05, 1.0), st.floats(1.1, 5.0)),
    seed=st.integers(0, 1000),
)
def test_extents_of_oscillations_and_steps_are_bounds_for_any_parameters(
    amplitude: float, middle: float, onset_s: float, hz: tuple[float, float], seed: int
) -> None:
    """Catches bounds that forget the onset: there amplitude, rate and acceleration add up."""
    references = [
        Sine(
            amplitude=amplitude, middle=middle, onset_s=onset_s, frequency_hz=hz[1], duration_s=1.0
        ),
        Multisine(
            amplitude=amplitude,
            middle=middle,
            onset_s=onset_s,
            lowest_hz=hz[0],
            highest_hz=hz[1],
            duration_s=2.0,
        ),
        Steps(amplitude=amplitude, middle=middle, move_s=onset_s, rest_s=0.1),
    ]
    for reference in references:
        plan = plan_of(reference, seed)
        extent = reference.extent()
        assert extent.lowest - 1e-9 <= plan.q.min() <= plan.q.max() <= extent.highest + 1e-9, (
            reference
        )
        assert np.abs(plan.q_dot).max() <= extent.q_dot * (1 + 1e-9), reference
        assert np.abs(plan.q_ddot).max() <= extent.q_ddot * (1 + 1e-9), reference


@pytest.mark.parametrize("name", ALL)
def test_every_plan_stands_first_and_starts_and_moves_smoothly(name: str) -> None:
    """Catches a jump of angle or rate, and motion in the second in which policies ramp in."""
    plan = plan_of(ALL[name], seed=1)
    standing = round(STAND_S / PERIOD_S)
    assert plan.num_steps == len(plan.q) - 1 == len(plan.scored) - 1 == len(plan.rest) - 1
    np.testing.assert_array_equal(plan.q[: standing + 1], plan.q[0])
    np.testing.assert_array_equal(plan.q_dot[: standing + 1], 0.0)
    np.testing.assert_array_equal(plan.q_ddot[: standing + 1], 0.0)
    extent = ALL[name].extent()
    assert np.abs(np.diff(plan.q)).max() <= extent.q_dot * PERIOD_S * (1 + 1e-9)
    assert np.abs(np.diff(plan.q_dot)).max() <= extent.q_ddot * PERIOD_S * (1 + 1e-9)
    assert not plan.scored[: standing + 1].any()
    assert plan.scored.any()


def test_quintic_is_the_minimum_jerk_polynomial() -> None:
    """Catches a wrong coefficient: its six boundary conditions determine it, and outside [0, 1]
    it rests."""
    s = np.array([0.0, 1.0])
    for value, expected in zip(quintic(s), ([0, 1], [0, 0], [0, 0]), strict=True):
        np.testing.assert_allclose(value, expected, rtol=0.0, atol=1e-14)
    inside = np.linspace(0.0, 1.0, 11)
    polynomial = np.polynomial.Polynomial.fit(inside, quintic(inside)[0], 5)
    np.testing.assert_allclose(polynomial.deriv()(inside), quintic(inside)[1], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        polynomial.deriv(2)(inside), quintic(inside)[2], rtol=0.0, atol=1e-10
    )
    np.testing.assert_array_equal(
        np.array(quintic(np.array([-1.0, 2.0]))), [[0, 1], [0, 0], [0, 0]]
    )


def uncompensated_rest(hold: Hold, theta: Array) -> Array:
    """Link angles at which the paper's pendulum hangs behind its spring when the motor stands at
    theta."""
    q = theta.copy()
    for _ in range(200):
        q = theta - hold.sag * np.sin(q)
    return q


def test_static_positions_are_evenly_spaced_in_torque_as_the_paper_has_them() -> None:
    """Catches positions even in angle, and a range that is not −52.5 to +34.6 N·m for the link
    of the paper."""
    hold = Hold()
    angles, directions = hold.visits
    torque = 60.0 * np.sin(uncompensated_rest(hold, angles))
    n = hold.positions
    np.testing.assert_allclose(torque[:n], np.linspace(-52.5, 34.6, n), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(torque[n:], torque[:n][::-1], rtol=0.0, atol=1e-12)
    assert directions.tolist() == [1] * n + [-1] * n


def test_without_sag_the_references_themselves_are_evenly_spaced_in_torque() -> None:
    """Catches a sag that is added twice, or to a compensated link's reference as well."""
    torque = 60.0 * np.sin(Hold(sag=0.0).angles)
    np.testing.assert_allclose(
        torque, np.linspace(-52.5, 34.6, Hold().positions), rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize("name", ["hold", "hold, few and quick"])
def test_every_position_is_held_and_approached_from_one_side(name: str) -> None:
    """Catches an approach that overshoots or turns back, which would spoil the hysteresis that
    is to be measured."""
    hold = ALL[name]
    assert isinstance(hold, Hold)
    plan = plan_of(hold)
    angles, directions = hold.visits
    ends = [int(np.flatnonzero(plan.rest == visit)[-1]) for visit in range(len(angles))]
    for visit, (angle, direction) in enumerate(zip(angles, directions, strict=True)):
        window = plan.rest == visit
        assert window.sum() == pytest.approx(hold.measure_s / PERIOD_S, abs=1)
        np.testing.assert_allclose(plan.q[window], angle, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(plan.q_dot[window], 0.0, rtol=0.0, atol=1e-12)
        first = int(np.flatnonzero(window)[0])
        turns_round = visit > 0 and directions[visit - 1] != direction
        since = ends[visit - 1] if visit > 0 else 0
        if turns_round:
            since += int(np.argmax(plan.q[since:first] * -direction)) + 1
        assert (plan.q_dot[since : first + 1] * direction >= -1e-12).all()
        arrived = np.flatnonzero(np.abs(plan.q_dot[:first]) > 1e-9)[-1]
        assert (first - arrived) * PERIOD_S == pytest.approx(hold.settle_s, abs=0.15)
    np.testing.assert_array_equal(plan.scored, plan.rest >= 0)


def test_the_sweep_starts_and_turns_beyond_its_positions() -> None:
    """Catches a first position that is not approached at all."""
    plan = plan_of(Hold())
    angles = Hold().angles
    assert plan.q[0] == pytest.approx(angles[0] - Hold().overrun)
    assert plan.q.max() == pytest.approx(angles[-1] + Hold().overrun)


@pytest.mark.parametrize("name", ["multisine", "steps"])
def test_random_references_follow_the_generator_or_their_own_seed(name: str) -> None:
    """Catches a plan from global randomness, and an own seed that changes with the episode."""
    reference = make_reference(name)
    np.testing.assert_array_equal(plan_of(reference, 1).q, plan_of(reference, 1).q)
    assert not np.array_equal(plan_of(reference, 1).q, plan_of(reference, 2).q)
    seeded = make_reference({"kind": name, "seed": 5})
    np.testing.assert_array_equal(plan_of(seeded, 1).q, plan_of(seeded, 2).q)
    np.testing.assert_array_equal(plan_of(seeded, 1).q, plan_of(reference, 5).q)


def test_sine_is_the_sine_of_its_parameters() -> None:
    """Catches Hz taken for rad/s, and an amplitude from peak to peak."""
    sine = Sine(amplitude=0.4, middle=0.1, frequency_hz=0.5, duration_s=4.0, onset_s=1.0)
    plan = plan_of(sine)
    t = np.arange(len(plan.q)) * PERIOD_S - STAND_S
    scored = t > 1.0
    np.testing.assert_array_equal(plan.scored, scored)
    expected = 0.1 + 0.4 * np.sin(2.0 * np.pi * 0.5 * t[scored])
    np.testing.assert_allclose(plan.q[scored], expected, rtol=0.0, atol=1e-12)
    assert plan.num_steps * PERIOD_S == pytest.approx(6.0)


def test_multisine_has_its_power_at_its_frequencies() -> None:
    """Catches components outside the band; over whole periods the spectrum must be five equal
    lines."""
    multisine = Multisine(
        amplitude=0.5, lowest_hz=0.2, highest_hz=1.0, components=5, duration_s=10.0
    )
    plan = plan_of(multisine, seed=4)
    x = plan.q[plan.scored]
    assert len(x) == 2500
    spectrum = 2.0 * np.abs(np.fft.rfft(x)) / len(x)
    frequencies = np.fft.rfftfreq(len(x), PERIOD_S)
    lines = np.isclose(frequencies[:, None], [0.2, 0.4, 0.6, 0.8, 1.0]).any(axis=1)
    np.testing.assert_allclose(spectrum[lines], 0.1, rtol=1e-9)
    np.testing.assert_allclose(spectrum[~lines], 0.0, rtol=0.0, atol=1e-12)


def test_steps_rest_at_their_levels() -> None:
    """Catches levels beyond the amplitude, moves of the wrong duration and a rest that is cut
    short."""
    steps = Steps(amplitude=0.3, middle=0.2, move_s=0.4, rest_s=0.6, moves=4)
    plan = plan_of(steps, seed=2)
    t = np.arange(len(plan.q)) * PERIOD_S - STAND_S
    for move in range(4):
        resting = (t >= move * 1.0 + 0.4) & (t <= (move + 1) * 1.0)
        level = plan.q[resting][0]
        assert abs(level - 0.2) <= 0.3
        np.testing.assert_allclose(plan.q[resting], level, rtol=0.0, atol=1e-12)
        moving = (t > move * 1.0 + 1e-9) & (t < move * 1.0 + 0.4 - 1e-9)
        assert (plan.q_dot[moving] != 0.0).all()
    assert plan.num_steps * PERIOD_S == pytest.approx(5.0)


def test_make_reference_takes_names_mappings_and_models() -> None:
    """Catches a mapping whose parameters are dropped."""
    for name, kind in REFERENCES.items():
        assert make_reference(name) == kind()
    assert make_reference({"kind": "sine", "amplitude": 0.2}) == Sine(amplitude=0.2)
    assert make_reference(Steps(moves=2)) == Steps(moves=2)


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("circle", r"unknown reference 'circle'; choose one of: hold, sine, multisine, steps"),
        ({}, r"unknown reference None; choose one of: hold"),
        ({"kind": ["sine"]}, r"unknown reference \['sine'\]; choose one of: hold"),
        (
            {"kind": "hold", "lower": 0.5, "upper": 0.1},
            r"upper must exceed lower, got lower 0\.5 and upper 0\.1",
        ),
        ({"kind": "hold", "lower": -1.0}, r"Hold\.lower must be .*> -1.* < 1, got -1"),
        ({"kind": "hold", "positions": 1}, r"Hold\.positions must be .*>= 2 and <= 1000, got 1"),
        (
            {"kind": "multisine", "lowest_hz": 2.0},
            r"highest_hz must exceed lowest_hz, got 2\.0 to 1\.0 Hz",
        ),
        (
            {"kind": "sine", "frequency_hz": float("nan")},
            r"Sine\.frequency_hz must be .*> 0 \[Hz\], got nan",
        ),
        ({"kind": "sine", "onset_s": 0.0}, r"Sine\.onset_s must be .*> 0 and <= 3600 \[s\], got 0"),
        (
            {"kind": "steps", "move_s": -0.1},
            r"Steps\.move_s must be .*> 0 and <= 3600 \[s\], got -0\.1",
        ),
        (
            {"kind": "steps", "move": 1},
            r"unknown parameter of Steps 'move'; choose one of: .*move_s",
        ),
    ],
)
def test_a_wrong_reference_names_itself_and_what_exists(reference: Any, message: str) -> None:
    """Catches parameters without bounds or units, and NaN."""
    with pytest.raises(ConfigurationError, match=message):
        make_reference(reference)


def test_all_kinds_are_in_the_union() -> None:
    """Catches a new reference that YAML files cannot name."""
    members = Reference.__origin__.__args__  # type: ignore[attr-defined]
    assert set(members) == set(REFERENCES.values())
    assert all(kind.model_fields["kind"].default == name for name, kind in REFERENCES.items())


def test_motions_of_many_worlds_that_fill_the_memory_are_refused() -> None:
    """Catches gigabytes of plans, one for each world, where one sentence is due."""
    motion = Motion(partial(Multisine(duration_s=900.0).plan_about, np.zeros(6)), is_random=True)
    assert len(PlanTable(motion, 0.05, 2).motion) == 2
    with pytest.raises(ConfigurationError, match=r"512 motions of .* MB, at most 500 MB; take a"):
        PlanTable(motion, 0.05, 512)


def test_long_references_of_poses_need_memory_for_their_steps_alone() -> None:
    """Catches a table of all steps by all poses, which grows with the square of the poses."""
    poses = Poses(positions=900, move_s=0.5, settle_s=0.2, measure_s=0.1)
    visits = np.random.default_rng(0).uniform(-1.0, 1.0, (901, 2))
    tracemalloc.start()
    plan = poses.through(visits, 0.01)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 40 * plan.q.nbytes
    assert plan.rest.max() == 899
    np.testing.assert_allclose(plan.q[plan.rest >= 0], visits[1:][plan.rest[plan.rest >= 0]])
