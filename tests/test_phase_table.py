"""The policy `phase_table`: its harmonics, its mirror, what it adds, and how its table is found."""

import json
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import PolicyInputs, Zero
from baselines.walking.phase_table import (
    CHANNELS,
    MOST_HARMONICS,
    PhaseFeedforward,
    PhaseTable,
    harmonics,
    load_phase_table,
    shipped_tables,
    stride_angle,
)
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.config import robot_bank
from elastic_env.world.robot_model import RobotModel
from elastic_env.world.scenario import make_scenario
from train.learn.phase_table import (
    Harmonics,
    Play,
    Search,
    Walks,
    best_play,
    correct_inputs,
    find_table,
    probe_inputs,
)

PERIOD_S = 1.1
PAIRS = np.random.default_rng(0).uniform(-0.01, 0.01, (4, 3, 2)).round(5)
TABLE = PhaseTable(
    step_period_s=PERIOD_S,
    found_on="nothing",
    **dict(zip(CHANNELS, PAIRS.tolist(), strict=True)),
)


def walker(num_steps: int = 4, num_envs: int = 2, **options: Any) -> Any:
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        num_steps=num_steps,
        **{"step_period": PERIOD_S, **options},
    )


class Recorder(Zero):
    """A policy that notes its inputs."""

    def __init__(self, model: RobotModel) -> None:
        super().__init__(model)
        self.inputs = ("zmp", "hip")
        self.given: list[Array] = []

    def act(self, rows: Array, memory: None, inputs: PolicyInputs) -> tuple[Array, None]:
        assert inputs.zmp is not None
        assert inputs.hip is not None
        self.given.append(np.hstack([inputs.zmp, inputs.hip]))
        return super().act(rows, memory, inputs)


def test_left_and_right_steps_are_mirror_images() -> None:
    """Catches a constant, a harmonic of the wrong parity, and columns that are mixed up."""
    psi = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    values = TABLE.values(psi)
    np.testing.assert_allclose(TABLE.values(psi + np.pi), values * [1.0, -1.0, -1.0, 1.0])
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=1e-15)
    (a, b), *_ = PAIRS[1]
    only = TABLE.replace(zmp_y=[[a, b]])
    expected = a * np.cos(psi) + b * np.sin(psi)
    np.testing.assert_allclose(only.values(psi)[:, 1], expected, atol=1e-15)


def test_the_table_is_added_in_the_phase_of_the_walk() -> None:
    """Catches a row that comes late, a jump at the ends, and inputs that are lost."""
    env = walker()
    model = env.unwrapped.task.assumed_model
    recorder = Recorder(model)
    policy = PhaseFeedforward(recorder, model, TABLE)
    plan = model.plan
    rows = np.zeros((plan.num_steps, len(model.observation_table)))
    rows[:, model.observation_table.group("clock").start] = plan.timing.time[1:]
    own = PolicyInputs(zmp=np.full((len(rows), 2), 1.0), hip=np.full((len(rows), 2), 2.0))
    policy.predict(rows, None, np.ones(len(rows), dtype=np.bool_), inputs=own)
    added = recorder.given[0] - [1.0, 1.0, 2.0, 2.0]
    timing = plan.timing
    assert np.all(added[~timing.walking[1:]] == 0.0)
    steady = (timing.time[1:] > 1.3) & (timing.time[1:] < 1.0 + 4 * PERIOD_S - 0.3)
    psi = np.pi * (timing.time[1:] - 1.0) / PERIOD_S  # the first step swings the right foot
    np.testing.assert_allclose(added[steady], TABLE.values(psi)[steady], atol=1e-15)
    np.testing.assert_allclose(stride_angle(timing, PERIOD_S)[1:], psi, atol=1e-12)
    assert np.abs(np.diff(added, axis=0)).max() < 2e-3


def test_a_gait_without_a_table_is_refused_by_a_sentence(tmp_path: Path) -> None:
    """Catches a table of another gait that is played, and an error that does not teach."""
    known = ", ".join(f"{period:g}" for period in sorted(shipped_tables()))
    with pytest.raises(ConfigurationError, match=re.escape(f"step periods of {known} s")):
        baselines.make("phase_table", walker(1, step_period=[0.8, 0.6, 0.8]))
    other = tmp_path / "other.json"
    other.write_text(TABLE.model_dump_json())
    with pytest.raises(ConfigurationError, match=r"is for a step period of 1\.1 s"):
        load_phase_table(3.0, other)
    assert load_phase_table(PERIOD_S, other) == TABLE
    with pytest.raises(ConfigurationError, match="no phase table at"):
        load_phase_table(3.0, tmp_path / "none.json")


def test_a_table_is_found_on_robots_that_no_evaluation_plays() -> None:
    """Catches a search that sees the robots of the evaluation."""
    walks = Walks(Search(step_period=PERIOD_S, robots=2, strides=1))
    bank = set(walks.env.unwrapped.task._kinds[0].bank)
    assert bank == set(robot_bank(make_scenario("drawn"), 1))
    assert not bank & set(robot_bank(make_scenario("drawn")))
    walks.env.close()


def test_shipped_tables_are_small_and_say_what_they_are_for() -> None:
    """Catches a file with a wrong name, and one that grows."""
    assert set(shipped_tables()) == {24.0, 3.0, 1.6, 1.1}
    for period, file in shipped_tables().items():
        table = load_phase_table(period)
        assert table.step_period_s == period
        assert "bank 1" in table.found_on
        content = json.loads(file.read_text())
        assert all(len(content[name]) <= MOST_HARMONICS for name in CHANNELS)


def test_harmonics_are_orthogonal_over_a_stride() -> None:
    """Catches a frequency that is counted twice."""
    psi = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    basis = np.hstack([harmonics(psi, 4, is_odd) for is_odd in (False, True)])
    np.testing.assert_allclose(basis.T @ basis, 30.0 * np.eye(16), atol=1e-12)


def test_a_linear_plant_is_corrected_to_its_least_error() -> None:
    """Catches a wrong sign, a transposed response, and coefficients that lose their phase."""
    search = Search(damping=1e-9, num_harmonics=3, gain=0.5)
    random = np.random.default_rng(1).normal
    shape = (2, 3, 2)
    response = random(size=(*shape, 2)) + 1j * random(size=(*shape, 2))
    without = random(size=shape) + 1j * random(size=shape)

    def play(inputs: Harmonics) -> Harmonics:
        return Harmonics(without + (response @ inputs.planes[..., None])[..., 0])

    now = Harmonics(np.zeros(shape, dtype=np.complex128))
    for number in range(1, 12):
        now = correct_inputs(now, play(now), response, search)
        left = np.abs(play(now).planes) / np.abs(without)
        np.testing.assert_allclose(left, 0.5**number, rtol=1e-4)
    for channel in range(2):
        known = probe_inputs(3, channel).planes
        found = (play(Harmonics(known)).planes - without) / known[:, :, channel, None]
        np.testing.assert_allclose(found, response[..., channel])


def test_harmonics_become_the_same_signal_as_a_table() -> None:
    """Catches a sign of the sine, and a scale that is forgotten."""
    psi = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    values = TABLE.values(psi)
    columns = {}
    for i, name in enumerate(CHANNELS):
        is_odd = name in ("zmp_y", "hip_roll")
        columns[name] = np.linalg.pinv(harmonics(psi, 3, is_odd)) @ values[:, i]
    again = Harmonics.from_columns(columns).table(Search(step_period=PERIOD_S))
    np.testing.assert_allclose(again.values(psi), values, atol=1e-9)
    assert again.found_on != TABLE.found_on


@pytest.mark.slow
def test_the_table_lowers_the_zmp_deviation_of_robots_that_it_was_not_found_on() -> None:
    """Catches a shipped table that does not fit the policy inside it."""
    left = {}
    for name in ("foothold", "phase_table"):
        env = walker(6, 8, scenario="drawn", bank=1, step_period=1.1)
        policy = baselines.make(name, env)
        observation, _ = env.reset(seed=list(range(500, 508)))
        state = None
        start = np.ones(8, dtype=np.bool_)
        deviations = []
        for _ in range(env.unwrapped.task.num_steps - 1):
            action, state = policy.predict(observation, state, start)
            start = np.zeros(8, dtype=np.bool_)
            observation, *_, info = env.step(action)
            deviations.append(info["zmp_deviation"])
        left[name] = float(np.sqrt(np.nanmean(np.square(deviations[250:]))))
    assert left["phase_table"] < 0.95 * left["foothold"]


def test_the_best_table_counts_and_not_the_last_one() -> None:
    """Catches a search that went too far, weights that forget a unit, and a robot that fell."""
    none = Harmonics(np.zeros((2, 1, 2), dtype=np.complex128))
    still = {"zmp_x": 5e-3, "zmp_y": 5e-3, "hip_roll": 1e-3, "hip_pitch": 1e-3, "fell": 0.0}
    plays = [
        Play(none, none, still),
        Play(none, none, still | {"zmp_y": 4e-3}),
        Play(none, none, still | {"zmp_y": 3e-3, "hip_roll": 1.5e-3}),
        Play(none, none, still | {"zmp_y": 1e-3, "fell": 1.0}),
    ]
    assert plays[0].cost == pytest.approx(4.0)
    assert best_play(plays) is plays[1]


@pytest.mark.slow
def test_a_search_lowers_the_error_of_its_robot() -> None:
    """Catches errors that are read in another phase, or of another step, than they are met in."""
    search = Search(step_period=PERIOD_S, scenario="soft", robots=1, strides=1, plays=2)
    walks = Walks(search)
    none = Harmonics(np.zeros((2, 4, 2), dtype=np.complex128))
    left = [walks.errors(table)[1] for table in (none.table(search), find_table(search))]
    walks.env.close()
    assert left[0]["fell"] == left[1]["fell"] == 0.0
    zmp = [np.hypot(own["zmp_x"], own["zmp_y"]) for own in left]
    assert zmp[1] < 0.8 * zmp[0]
