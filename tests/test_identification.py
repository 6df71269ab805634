"""Identification: exact on points of the closed form, honest about noise, and right on the
simulated testbed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines.identification.identify as identification
from baselines.compensation.gravity_torque import GravityModel, make_gravity
from baselines.identification.identify import Identification, fit_points, identify, identify_points
from baselines.identification.static_points import HoldRecorder, StaticPoints, record_points
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.motion.references import Hold
from elastic_env.robots.testbed.model import Pendulum
from elastic_env.world.scenario import make_scenario
from tests.trees import pendulum
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import Evaluation, evaluate

ID = "elastic_env/Testbed-v0"


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the usual ones: enough for an interval."""
    monkeypatch.setattr(identification, "_RESAMPLES", 99)


G = 60.0  # torque of the pendulum at the horizontal [N·m]
SHARES = (-52.5 / G, 34.6 / G)  # the paper's range of torque
REST = pytest.approx


def gravity(*masses: float) -> list[GravityModel]:
    """Gravity torque of pendulums whose mass is scaled."""
    return [make_gravity(pendulum(mass)) for mass in masses or (1.0,)]


def synthetic(
    K: float = 1001.0,
    F: float = 0.0,
    b: float = 0.0,
    c: float = 0.0,
    s: float = 0.0,
    masses: Sequence[float] = (1.0,),
    positions: int = 20,
    shares: tuple[float, float] = SHARES,
    noise: Array | float = 0.0,
) -> StaticPoints:
    """Static points of the closed form: a link at rest under gravity and friction, seen by an IMU
    with errors.

    The transmission carries τ + F d; the IMU reads q − c + s sin q.
    """
    shares_twice = np.linspace(*shares, positions)[np.r_[:positions, positions - 1 : -1 : -1]]
    q = np.arcsin(shares_twice)
    direction = np.repeat([1, -1], positions)
    position = np.r_[:positions, positions - 1 : -1 : -1]
    parts = []
    for mass in masses:
        load = mass * G * np.sin(q) + F * direction
        theta = q + load / K + 0.5 * b * np.sign(load)
        imu = q - c + s * np.sin(q) + noise
        parts.append(
            StaticPoints(theta, imu, direction, position, np.zeros(2 * positions, dtype=np.int64))
        )
    return StaticPoints.join(parts)


def parameters(result: Identification) -> list[float]:
    """K, F, b, c."""
    return [
        result.stiffness_nm_per_rad,
        result.friction_nm,
        result.dead_band_rad,
        result.offset_rad,
    ]


@pytest.mark.parametrize(
    "K",
    [
        pytest.param(300.0, marks=pytest.mark.slow),
        1001.0,
        pytest.param(3000.0, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(("F", "b"), [(0.0, 0.0), (5.4, 0.0), (5.4, 1.75e-3), (0.0, 1.75e-3)])
def test_parameters_of_exact_points_are_recovered_to_rounding(K: float, F: float, b: float) -> None:
    """Catches τ taken at the encoder (+4 % of K), the sign of τ instead of the load's, and half
    a dead band."""
    result = identify_points(synthetic(K, F, b), gravity())
    assert parameters(result) == [
        REST(K, rel=1e-10),
        REST(F, abs=1e-9),
        REST(b, abs=1e-12),
        REST(0.0, abs=1e-12),
    ]
    assert (result.stiffness_low_nm_per_rad, result.stiffness_high_nm_per_rad) == (
        REST(K, rel=1e-8),
    ) * 2
    assert result.residual_rad < 1e-12
    assert result.imu_sine_error_rad is None
    assert (result.points, result.positions) == (40, 20)


@pytest.mark.parametrize("c", [1.7e-3, -5e-3])
def test_offset_of_the_imu_is_recovered_to_rounding(c: float) -> None:
    """Catches τ taken at the IMU's angle, which the offset has shifted, or corrected only once."""
    result = identify_points(synthetic(F=5.4, b=1.75e-3, c=c), gravity())
    assert parameters(result) == [
        REST(1001.0, rel=1e-9),
        REST(5.4, rel=1e-8),
        REST(1.75e-3, rel=1e-8),
        REST(c, rel=1e-8),
    ]


@pytest.mark.parametrize(
    ("K", "c", "s"), [(1001.0, 0.0, 2e-3), (1001.0, 1.7e-3, -2e-3), (300.0, 1.7e-3, 5e-3)]
)
def test_two_masses_separate_the_sine_error_of_the_imu(K: float, c: float, s: float) -> None:
    """Catches a sine error taken for compliance, its sign, and τ taken at an angle with that
    error in it."""
    result = identify_points(synthetic(K, 5.4, 1.75e-3, c, s, masses=(1.0, 0.5)), gravity(1.0, 0.5))
    assert parameters(result) == [
        REST(K, rel=1e-8),
        REST(5.4, rel=1e-7),
        REST(1.75e-3, rel=1e-7),
        REST(c, rel=1e-7, abs=1e-10),
    ]
    assert result.imu_sine_error_rad == REST(s, rel=1e-7)
    assert (result.points, result.positions) == (80, 40)


def test_one_mass_takes_the_sine_error_for_compliance() -> None:
    """Catches a test of two masses that one mass would pass as well: 1/K shifts by −s/G, that is
    K by 3.5 %."""
    result = identify_points(synthetic(s=2e-3), gravity())
    assert 1.0 / result.stiffness_nm_per_rad == REST(1.0 / 1001.0 - 2e-3 / G, rel=3e-3)


def test_two_equal_masses_are_refused() -> None:
    """Catches a singular regression whose answer, K = −2 N·m/rad within a narrow interval, is
    reported in earnest."""
    with pytest.raises(ElasticError, match=r"mass"):
        identify_points(synthetic(F=5.4, s=2e-3, masses=(1.0, 1.0)), gravity(1.0, 1.0))


def test_torques_of_one_sign_are_refused() -> None:
    """Catches an offset of 1.7 mrad that is reported as half of it and a dead band of 1.7 mrad:
    nothing tells them."""
    with pytest.raises(ElasticError, match=r"dead band|offset|sign|determine"):
        identify_points(synthetic(F=5.4, c=1.7e-3, shares=(0.3, 0.8)), gravity())


def test_plain_line_is_biased_by_the_dead_band_by_the_derived_amount() -> None:
    """Catches a line through other points or another torque: its slope is 1/K + b/2 · cov(sign,
    τ)/var τ."""
    points = synthetic(F=5.4, b=1.75e-3)
    tau = G * np.sin(points.q)
    load = G * np.sin(points.q) + 5.4 * points.direction
    slope = 1.0 / 1001.0 + 0.5 * 1.75e-3 * np.cov(np.sign(load), tau, bias=True)[0, 1] / np.var(tau)
    result = identify_points(points, gravity())
    assert 1.0 / result.line_stiffness_nm_per_rad == REST(slope, rel=1e-10)
    assert -0.03 < result.line_stiffness_nm_per_rad / 1001.0 - 1.0 < -0.02
    assert result.pearson_r == REST(np.corrcoef(tau, points.theta - points.q)[0, 1], rel=1e-12)


@pytest.mark.slow
def test_interval_covers_the_truth_as_often_as_it_says() -> None:
    """Catches an interval that resamples visits, whose noise is shared within a position, or
    that is half as wide."""
    generator = np.random.default_rng(1)
    hits = 0
    widths = []
    estimates = []
    for seed in range(100):
        up = generator.normal(0.0, 1e-4, 40)
        result = identify_points(
            synthetic(F=5.4, positions=40, noise=np.r_[up, up[::-1]]), gravity(), seed
        )
        hits += result.stiffness_low_nm_per_rad <= 1001.0 <= result.stiffness_high_nm_per_rad
        widths.append(result.half_width * result.stiffness_nm_per_rad)
        estimates.append(result.stiffness_nm_per_rad)
    assert 0.91 <= hits / 100 <= 0.99
    assert np.mean(widths) == REST(1.96 * np.std(estimates), rel=0.15)
    assert np.mean(estimates) == REST(1001.0, abs=3.0 * np.std(estimates) / np.sqrt(100))


def test_residual_spread_is_that_of_the_noise() -> None:
    """Catches a spread divided by the number of points instead of the degrees of freedom that
    are left."""
    generator = np.random.default_rng(2)
    spreads = [
        fit_points(points, points.q, G * np.sin(points.q), with_sine_error=False)
        for points in (
            synthetic(positions=6, noise=generator.normal(0.0, 1e-4, 12)) for _ in range(300)
        )
    ]
    variance = np.mean([np.sum(fit.residuals**2) / (12 - 4) for fit in spreads])
    assert np.sqrt(variance) == REST(1e-4, rel=0.06)
    points = synthetic(positions=6, noise=generator.normal(0.0, 1e-4, 12))
    fit = fit_points(points, points.q, G * np.sin(points.q), with_sine_error=False)
    result = identify_points(points, gravity())
    assert result.residual_rad == REST(np.sqrt(np.sum(fit.residuals**2) / 8), rel=0.01)


@pytest.mark.parametrize(("F", "differ"), [(0.0, False), (5.4, True), (-5.4, True), (0.02, False)])
def test_hysteresis_is_reported_where_the_directions_differ(F: float, differ: bool) -> None:
    """Catches hysteresis seen in noise or in differences below 0.1 mrad, and one that is missed
    for its sign."""
    noise = np.random.default_rng(3).normal(0.0, 2e-5, 40)
    assert identify_points(synthetic(F=F, noise=noise), gravity()).hysteresis is differ


def test_resampling_repeats_with_its_seed() -> None:
    """Catches global random numbers: the same points and seed give the same interval, another
    seed another."""
    points = synthetic(noise=np.random.default_rng(4).normal(0.0, 1e-4, 40))
    first, again, other = (identify_points(points, gravity(), seed) for seed in (7, 7, 8))
    assert first == again
    assert first.stiffness_low_nm_per_rad != other.stiffness_low_nm_per_rad


@pytest.mark.parametrize("positions", [5, 6, 8, 20])
def test_interval_of_few_positions_is_that_of_their_noise(positions: int) -> None:
    """Catches resamples that determine nothing, of one position over and over, whose K of zero
    widens the interval."""
    noise = np.random.default_rng(6).normal(0.0, 1e-5, 2 * positions)
    result = identify_points(synthetic(positions=positions, noise=noise), gravity())
    torque = np.linspace(*SHARES, positions) * G
    deviation = (
        1001.0 * 1e-5 / np.sqrt(2.0 * np.sum((torque - torque.mean()) ** 2))
    )  # of K, relative, by a plain line
    assert 0.2 * deviation < result.half_width < 20.0 * deviation


def test_too_few_positions_are_refused() -> None:
    """Catches a fit of four unknowns to four positions, whose interval would be made up."""
    with pytest.raises(
        ElasticError, match="at least 5 positions approached from both sides, got 4"
    ):
        identify_points(synthetic(positions=4), gravity())


def test_one_direction_of_approach_is_refused() -> None:
    """Catches friction that a single direction cannot tell from an offset."""
    with pytest.raises(
        ElasticError, match=r"both sides, got 20 positions and the directions \[1\]"
    ):
        identify_points(synthetic().rows(np.arange(20)), gravity())


def test_identification_survives_its_file_and_is_a_stiffness_for_the_environment(
    tmp_path: Path,
) -> None:
    """Catches numbers rounded on the way, and a file that `stiffness=` of the environment does
    not take."""
    path = tmp_path / "identification.json"
    result = identify_points(synthetic(K=777.7, F=5.4, b=1e-3, c=1e-3), gravity())
    result.save(path)
    assert Identification.load(path) == result
    model = gymnasium.make(ID, stiffness=path).unwrapped.assumed_model
    assert model.stiffness[0] == result.stiffness_nm_per_rad


def test_recorder_averages_encoder_and_imu_over_each_window() -> None:
    """Catches windows mixed up, samples outside of them, and positions that do not belong
    together on the way back."""
    directions = Hold(positions=2).visits[1]
    recorder = HoldRecorder(directions, num_worlds=2)
    assert not recorder.is_complete
    for rest, samples in enumerate([[1.0, 3.0], [5.0], [7.0, 8.0, 9.0], [2.0]]):
        recorder.take(np.full(2, 99.0), np.full(2, 99.0), -1)
        for x in samples:
            recorder.take(np.array([x, 10.0 * x]), np.array([-x, x]), rest)
    first, second = recorder.points()
    np.testing.assert_array_equal(first.theta, [2.0, 5.0, 8.0, 2.0])
    np.testing.assert_array_equal(second.theta, 10.0 * first.theta)
    np.testing.assert_array_equal(first.q, -second.q)
    np.testing.assert_array_equal(first.direction, [1, 1, -1, -1])
    np.testing.assert_array_equal(first.position, [0, 1, 1, 0])


def test_a_run_that_ended_early_is_an_error() -> None:
    """Catches averages of windows that were never visited."""
    with pytest.raises(ElasticError, match="before all 4 static positions"):
        HoldRecorder(Hold(positions=2).visits[1]).points()


def test_identification_needs_the_reference_hold() -> None:
    """Catches an identification of a sine, which is nowhere at rest."""
    with pytest.raises(
        ConfigurationError, match="needs the reference 'hold', the environment has 'sine'"
    ):
        record_points(gymnasium.make(ID, reference="sine"))


def test_three_masses_are_refused() -> None:
    """Catches environments beyond the second that are ignored."""
    with pytest.raises(
        ConfigurationError, match="one environment or two with different masses, got 3"
    ):
        identify([gymnasium.make(ID)] * 3)


# From here on the simulated testbed: one rollout each, shared by the tests.

NARROW = {
    "kind": "hold",
    "positions": 5,
    "lower": -0.6,
    "upper": 0.5,
    "rate": 0.4,
    "shortest_move_s": 1.2,
    "settle_s": 0.8,
    "measure_s": 0.1,
}
CALM = H54_200_S500_R.replace(damping=60.0)
"""Comes to rest sooner."""
WIDE = {
    "kind": "hold",
    "positions": 6,
    "rate": 0.2,
    "settle_s": 0.7,
    "measure_s": 0.2,
}
# compensated, the error is the same all over
ENDS = {
    **WIDE,
    "positions": 2,
    "lower": -0.3,
    "upper": 0.3,
    "rate": 0.3,
    "shortest_move_s": 2.0,
    "measure_s": 0.1,
}
RUNS: dict[str, dict[str, Any]] = {
    "backlash": {"reference": WIDE, "scenario": "backlash"},
    "nominal input": {"reference": ENDS, "scenario": "nominal", "policy": "input"},
    "ideal 300": {
        "reference": NARROW,
        "scenario": "ideal",
        "env_options": {"stiffness": 300.0, "joint": CALM},
    },
    "ideal 1001": {"reference": NARROW, "scenario": "ideal", "env_options": {"joint": CALM}},
    "ideal 3000": {
        "reference": NARROW,
        "scenario": "ideal",
        "env_options": {"stiffness": 3000.0, "joint": CALM},
    },
    "ideal input": {
        "reference": {**NARROW, "positions": 2, "lower": -0.3, "upper": 0.3, "rate": 0.6},
        "scenario": "ideal",
        "policy": "input",
        "env_options": {"stiffness": 300.0, "joint": CALM},
    },
}


class Played(dict[str, Evaluation]):
    def __missing__(self, name: str) -> Evaluation:
        policy = PolicySpec(name=RUNS[name].get("policy", "uncompensated"))
        condition = Condition(**{**RUNS[name], "policy": policy})
        self[name] = evaluate(condition, num_threads=1)
        return self[name]


@pytest.fixture(scope="module")
def runs() -> dict[str, Evaluation]:
    """Evaluations by the names of `RUNS`, each played when a test first asks for it."""
    return Played()


@pytest.fixture(scope="module")
def nominal() -> StaticPoints:
    """Static points of the uncompensated testbed, recorded as `identify` does: this scores no
    step."""
    env = gymnasium.make(ID, disable_env_checker=True, reference=WIDE, scenario="nominal")
    (points,) = record_points(env, seed=0)
    return points


def identified(run: Evaluation) -> Identification:
    """Identification of the static points of a run."""
    assert run.points is not None
    return identify_points(run.points, gravity())


def range_at_rest(references: Array, points: StaticPoints) -> tuple[float, float]:
    """Smallest and largest link error by the IMU over the windows at rest [mrad]."""
    error = 1e3 * (references - points.q)
    return float(error.min()), float(error.max())


@pytest.mark.slow  # on every commit: the test of two masses, and the nominal testbed
@pytest.mark.parametrize("K", [300.0, 1001.0, 3000.0])
def test_ideal_testbed_gives_its_stiffness(K: float, runs: dict[str, Evaluation]) -> None:
    """Catches a plant whose spring is not the one it is told, and friction or play that an ideal
    one does not have."""
    result = identified(runs[f"ideal {K:.0f}"])
    assert result.stiffness_nm_per_rad == REST(K, rel=2e-4)
    assert abs(result.friction_nm) < 0.02
    assert abs(result.dead_band_rad) < 1e-5
    assert not result.hysteresis


@pytest.mark.slow
def test_link_of_the_uncompensated_ideal_testbed_is_not(runs: dict[str, Evaluation]) -> None:
    """Catches a link that the test below would find where it should be without compensation."""
    assert runs["ideal 300"].values("link_error_peak_rad")[0] > 0.1


def test_ideal_link_is_where_it_should_be_at_rest(runs: dict[str, Evaluation]) -> None:
    """Catches input compensation with a residue: Fig. 6 in `ideal` stays below 0.2 mrad in every
    sample at rest."""
    assert runs["ideal input"].values("link_error_peak_rad")[0] < 2e-4


def test_nominal_testbed_gives_stiffness_and_friction(nominal: StaticPoints) -> None:
    """Catches friction that creeps away at rest or acts across the spring, an IMU offset with the
    wrong sign, and too little or too much friction: r of the plain line is the paper's 0.9775
    within its neighbourhood (Fig. 5)."""
    result = identify_points(nominal, gravity())
    assert result.stiffness_nm_per_rad == REST(1001.0, rel=0.01)
    assert result.friction_nm == REST(5.4, rel=0.1)
    assert result.offset_rad == REST(1.7e-3, abs=0.1e-3)
    assert abs(result.dead_band_rad) < 0.2e-3
    assert result.half_width < 0.01
    assert result.hysteresis
    assert 0.970 < result.pearson_r < 0.985


def test_nominal_testbed_errs_like_the_papers_figure_6(nominal: StaticPoints) -> None:
    """Catches a range or an offset that is not the paper's, each end within 1.5 mrad."""
    references, _ = Hold(**WIDE).visits
    assert range_at_rest(references, nominal) == (REST(-56.2, abs=1.5), REST(41.7, abs=1.5))


@pytest.mark.slow  # on every commit: the ideal testbed under the same compensation
def test_compensated_testbed_errs_like_the_papers_figure_6(runs: dict[str, Evaluation]) -> None:
    """Catches what friction and the IMU leave of a compensation, if it is not the paper's."""
    run = runs["nominal input"]
    assert run.points is not None
    compensated = range_at_rest(run.rest_references, run.points)
    assert compensated == (REST(-3.7, abs=1.5), REST(7.1, abs=1.5))


@pytest.mark.slow
def test_backlash_biases_the_line_and_not_our_fit(runs: dict[str, Evaluation]) -> None:
    """Catches a dead band that is ignored, by the plant or by the regression."""
    result = identified(runs["backlash"])
    assert -0.03 < result.line_stiffness_nm_per_rad / 1001.0 - 1.0 < -0.02
    assert result.stiffness_nm_per_rad == REST(1001.0, rel=0.01)
    assert result.dead_band_rad == REST(1.75e-3, abs=0.2e-3)


def test_two_masses_find_the_sine_error_of_a_simulated_imu() -> None:
    """Catches loads that are mixed up between recording and regression; a single mass is 3.5 %
    off here."""
    ideal = make_scenario("ideal")
    scenario = ideal.replace(imu=ideal.imu.replace(sine_error_rad=2e-3))
    envs = [
        gymnasium.make(
            ID,
            disable_env_checker=True,
            reference={**NARROW, "positions": positions},
            scenario=scenario,
            pendulum=Pendulum().with_mass_scaled(mass),
            joint=CALM,
        )
        for mass, positions in ((1.0, 5), (0.5, 3))
    ]
    results, points = identify(envs, seed=0)
    assert len(results) == 1
    assert results[0].stiffness_nm_per_rad == REST(1001.0, rel=5e-3)
    assert results[0].imu_sine_error_rad == REST(2e-3, rel=0.05)
    alone = points[0].rows(np.flatnonzero(points[0].load == 0))
    assert identify_points(alone, gravity()).stiffness_nm_per_rad == REST(1036.0, rel=5e-3)
