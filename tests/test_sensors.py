"""Encoders and the attitude sensor against their definitions and the statistics of many samples."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.world.noise_stream import NoiseStream
from elastic_env.world.sensors import AttitudeSensor, angle_of_count, attitude, is_due, quantise

COUNTS = 501_923
ONE = np.dtype([("a", np.float64)])
TWO = np.dtype([("a", np.float64), ("b", np.float64)])


@given(angle=st.floats(-10.0, 10.0), counts=st.integers(1, 10**6))
def test_quantised_angles_are_the_nearest_whole_counts(angle: float, counts: int) -> None:
    """Catches truncation in place of rounding, and degrees or radians per count mixed up."""
    step = 2.0 * np.pi / counts
    shown = quantise(np.array([angle]), angle_of_count(counts))[0]
    assert abs(shown - angle) <= step / 2 * (1 + 1e-9)
    assert shown / step == pytest.approx(round(shown / step), abs=1e-6)
    assert quantise(np.array([shown]), angle_of_count(counts))[0] == shown


def test_an_encoder_without_counts_is_continuous() -> None:
    """Catches a default resolution where none was asked for; and the input array must not be
    handed on for writing."""
    angle = np.array([0.1, 0.2])
    np.testing.assert_array_equal(quantise(angle, angle_of_count(None)), angle)


def test_attitude_adds_up_its_errors() -> None:
    """Catches a bias in the wrong direction, and an error of sin q that is one of q."""
    sensor = AttitudeSensor(noise_rad=0.2, bias_rad=-0.03, sine_error_rad=0.05)
    angle = np.array([0.0, np.pi / 2, -0.4])
    drawn = np.array([0.0, 0.001, 0.002])
    noise = np.array([0.0, 1.0, -2.0])
    expected = [
        -0.03,
        np.pi / 2 - 0.03 + 0.001 + 0.05 + 0.2,
        -0.4 - 0.03 + 0.002 - 0.05 * np.sin(0.4) - 0.4,
    ]
    np.testing.assert_allclose(
        attitude(sensor, angle, drawn, noise), expected, rtol=0.0, atol=1e-15
    )


def test_an_ideal_attitude_sensor_shows_the_angle() -> None:
    """Catches an error that acts although every parameter is zero."""
    angle = np.linspace(-1.0, 1.0, 7)
    np.testing.assert_array_equal(attitude(AttitudeSensor(), angle, np.zeros(7), np.ones(7)), angle)


@pytest.mark.parametrize(
    ("rate_hz", "period_s"),
    [
        ("100", "0.004"),
        ("250", "0.004"),
        ("50", "0.004"),
        ("33", "0.004"),
        ("1000", "0.01"),
        ("290", "0.001"),
    ],
)
def test_samples_come_at_their_rate(rate_hz: str, period_s: str) -> None:
    """Catches a sensor that skips or doubles a sample by rounding: an hour of steps against
    exact fractions."""
    due = is_due(np.arange(round(3600.0 / float(period_s)) + 1), float(rate_hz), float(period_s))
    share = Fraction(rate_hz) * Fraction(period_s)
    samples = np.arange(len(due)) * share.numerator // share.denominator
    assert due[0]
    np.testing.assert_array_equal(due[1:], np.diff(samples) > 0)
    if share <= 1:
        assert due[1:].sum() == 3600 * int(rate_hz)


def samples(stream: NoiseStream, mask: Array, count: int) -> Array:
    """Samples one after the other, (count, num_worlds)."""
    return np.array([stream.next(mask)["a"] for _ in range(count)])


def test_noise_is_standard_normal_white_and_independent() -> None:
    """Catches noise of another variance, noise that repeats with its block, and worlds that
    share it."""
    stream = NoiseStream(4, ONE, block=50)
    for world in range(4):
        stream.restart(world, np.random.default_rng(world))
    x = samples(stream, np.ones(4, dtype=bool), 5000)
    assert np.abs(x.mean(axis=0)).max() < 5 / np.sqrt(5000)
    assert np.abs(x.std(axis=0) - 1.0).max() < 5 / np.sqrt(2 * 5000)
    assert np.abs(np.corrcoef(x.T) - np.eye(4)).max() < 5 / np.sqrt(5000)
    for lag in (1, 2, 49, 50, 51):
        assert np.abs((x[lag:] * x[:-lag]).mean(axis=0)).max() < 5 / np.sqrt(5000 - lag)


def test_a_stream_depends_on_its_generator_and_its_use_alone() -> None:
    """Catches a sample that is skipped or shared when other worlds draw, refill or restart."""
    everyone = NoiseStream(3, ONE, block=7)
    alone = NoiseStream(1, ONE, block=7)
    for world in range(3):
        everyone.restart(world, np.random.default_rng(10 + world))
    alone.restart(0, np.random.default_rng(11))
    generator = np.random.default_rng(0)
    for k in range(60):
        mask = generator.random(3) < 0.6
        if k == 20:
            everyone.restart(2, np.random.default_rng(99))
        given = everyone.next(mask)
        if mask[1]:
            assert given[1] == alone.next(np.ones(1, dtype=bool))[0]


def test_samples_that_were_prepared_for_many_steps_follow_one_another() -> None:
    """Catches a refill that drops prepared samples, or draws them anew."""
    stream = NoiseStream(2, ONE, block=7)
    for world in range(2):
        stream.restart(world, np.random.default_rng(20 + world))
    taken: list[list[float]] = [[], []]
    for steps in (7, 3, 1, 6, 2, 5, 7):
        stream.prepare(steps)
        for step in range(steps):
            for world in range(1 + step % 2):  # the second world uses half of them
                taken[world].append(stream.samples["a"][stream.used[world], world])
                stream.used[world] += 1
    for world, numbers in enumerate(taken):
        expected = np.random.default_rng(20 + world).standard_normal(len(numbers))
        np.testing.assert_array_equal(numbers, expected)


def test_a_restarted_stream_begins_anew() -> None:
    """Catches samples of the episode before."""
    stream = NoiseStream(1, TWO, block=5)
    mask = np.ones(1, dtype=bool)
    stream.restart(0, np.random.default_rng(1))
    first = np.array([stream.next(mask)[0].tolist() for _ in range(8)])
    stream.restart(0, np.random.default_rng(1))
    np.testing.assert_array_equal([stream.next(mask)[0].tolist() for _ in range(8)], first)
    assert first.shape == (8, 2)


@pytest.mark.parametrize(
    ("parameter", "value", "requirement"),
    [
        ("noise_rad", -1e-4, r">= 0 \[rad\], got -0\.0001"),
        ("bias_rad", float("nan"), r"finite.*\[rad\], got nan"),
        ("rate_hz", 0.0, r"> 0 \[Hz\], got 0"),
    ],
)
def test_a_wrong_parameter_names_itself_its_unit_and_bound(
    parameter: str, value: float, requirement: str
) -> None:
    """Catches a sensor that never delivers, and noise of negative size."""
    with pytest.raises(
        ConfigurationError, match=rf"AttitudeSensor\.{parameter} must be .*{requirement}"
    ):
        AttitudeSensor(**{parameter: value})
