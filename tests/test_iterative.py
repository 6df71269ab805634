"""Iterative learning control: the recursion against its closed form, signs on the real walker,
trials, saved tables."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import save

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.adaptation.iterative import IterativeLearner, Trial
from baselines.adaptation.learned_signals import LearningGains, WalkSignals
from baselines.adaptation.learning_law import (
    ChannelGains,
    lead_error,
    limit_surprise,
    update,
    zero_phase,
)
from baselines.adaptation.offset_folder import DESCRIPTION, OFFSETS
from baselines.policies import Track, track
from baselines.walking.zmp_shift import center_of_mass_shift
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from train.commands.iterate import Iterate
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import evaluate

PERIOD_S = 0.004
SINE = {"kind": "sine", "amplitude": 0.2, "duration_s": 0.4, "onset_s": 0.2}
SHORT = LearningGains(trials=3)
GAIN = ChannelGains(gain=0.5, lead_s=0.0, cutoff_hz=4.0, surprise=1e3, limit=1e3)


def make_testbed(num_envs: int | None = None, **arguments: Any) -> Any:
    """The testbed with a short motion, scalar or vector."""
    given = {"reference": SINE, "scenario": "soft", **arguments}
    if num_envs is None:
        return gymnasium.make("elastic_env/Testbed-v0", **given)
    return gymnasium.make_vec(
        "elastic_env/Testbed-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        **given,
    )


def make_walker(num_envs: int, **arguments: Any) -> Any:
    """The walker with a short walk."""
    given = {"step_period": 1.1, "num_steps": 1, "scenario": "nominal", **arguments}
    return gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        **given,
    )


def wave(frequency_hz: float, shift_s: float = 0.0) -> Array:
    """A long sine in one column, (T, 1)."""
    time = PERIOD_S * np.arange(10_000)
    return np.sin(2.0 * np.pi * frequency_hz * (time + shift_s))[:, None]


def middle(values: Array) -> Array:
    """Far from the ends, where the filter begins."""
    return values[4000:6000, 0]


def errors(disturbance: Array, plant: float, gains: ChannelGains, trials: int) -> list[Array]:
    """Errors of a static plant from trial to trial, e = d − p u."""
    table = np.zeros_like(disturbance)
    found = []
    for trial in range(trials):
        found.append(disturbance - plant * table)
        table = update(table, found[-1], [gains], PERIOD_S, trial)
    return found


@pytest.mark.parametrize("plant", [1.3, 0.4, -0.8])
@pytest.mark.parametrize("frequency_hz", [0.5, 3.0])
def test_errors_follow_the_closed_form_of_the_recursion(plant: float, frequency_hz: float) -> None:
    """Catches a gain that acts twice, a filter beside the sum, and a wrong sign, with which the
    error must grow."""
    disturbance = wave(frequency_hz)
    warped = np.tan(np.pi * PERIOD_S * np.array([frequency_hz, GAIN.cutoff_hz]))
    Q = 1.0 / (1.0 + (warped[0] / warped[1]) ** 4)  # second order, forwards and backwards
    shrink = Q * (1.0 - GAIN.gain * plant)
    for trial, error in enumerate(errors(disturbance, plant, GAIN, 6)):
        learned = Q * GAIN.gain * (1.0 - shrink**trial) / (1.0 - shrink)
        np.testing.assert_allclose(
            middle(error), (1.0 - plant * learned) * middle(disturbance), atol=1e-6
        )


def test_forgetting_leaves_the_share_of_the_closed_form() -> None:
    """Catches forgetting that acts on the correction too: at rest the error is λ / (λ + γ p)."""
    error = errors(np.ones((10_000, 1)), 1.0, GAIN.replace(forgetting=0.1), 40)[-1]
    np.testing.assert_allclose(middle(error), 0.1 / (0.1 + GAIN.gain), atol=1e-6)


def test_a_falling_gain_multiplies_what_each_trial_leaves() -> None:
    """Catches a gain that falls too fast or from the wrong trial: at rest the error is Π (1 − γ
    p / (1 + j/n))."""
    found = errors(np.ones((10_000, 1)), 0.8, GAIN.replace(halved_after=2.0), 6)
    left = np.cumprod([1.0] + [1.0 - GAIN.gain * 0.8 / (1.0 + trial / 2.0) for trial in range(5)])
    for error, share in zip(found, left, strict=True):
        np.testing.assert_allclose(middle(error), share, atol=1e-6)


def test_the_right_sign_converges_and_the_wrong_one_diverges() -> None:
    """Catches a learning law that goes the wrong way."""
    right, wrong = (errors(wave(0.5), plant, GAIN, 10)[-1] for plant in (1.0, -1.0))
    assert np.abs(middle(right)).max() < 0.01
    assert np.abs(middle(wrong)).max() > 10.0


def test_the_filter_shifts_no_phase() -> None:
    """Catches a filter that runs one way only: a pulse would come out late."""
    pulse = np.zeros((2001, 1))
    pulse[1000] = 1.0
    filtered = zero_phase(pulse, 5.0, PERIOD_S)[:, 0]
    np.testing.assert_allclose(filtered, filtered[::-1], atol=1e-9)
    assert filtered.argmax() == 1000
    np.testing.assert_allclose(
        middle(zero_phase(wave(5.0), 5.0, PERIOD_S)), 0.5 * middle(wave(5.0)), atol=1e-6
    )


def test_the_lead_makes_up_for_a_delay() -> None:
    """Catches a lead that looks back: at 3 Hz a delay of 0.12 s is more than a quarter of a
    period."""
    delay = 30
    last = {}
    for lead in (0, delay, -delay):
        table = np.zeros((10_000, 1))
        disturbance = wave(3.0)
        for _ in range(12):
            error = disturbance - np.concatenate([np.zeros((delay, 1)), table[:-delay]])
            wanted = error if lead < 0 else lead_error(error, lead)
            table = zero_phase(table + 0.5 * wanted, 10.0, PERIOD_S)
        last[lead] = np.abs(middle(error)).max()
    assert last[delay] < 0.05
    assert last[0] > 2.0
    gains = ChannelGains(
        gain=1.0, lead_s=delay * PERIOD_S, cutoff_hz=20.0, surprise=1.0, limit=10.0
    )
    table = update(np.zeros((10_000, 1)), wave(1.0), [gains], PERIOD_S)
    np.testing.assert_allclose(
        middle(table), middle(wave(1.0, shift_s=delay * PERIOD_S)), atol=1e-4
    )


def test_an_error_may_shrink_but_not_suddenly_grow() -> None:
    """Catches a push that is learned, and an improvement that is taken for one."""
    before = np.array([5.0, 5.0, 5.0, -5.0, 0.0, 5.0])
    error = np.array([0.1, 9.0, -4.0, -4.0, 0.5, np.nan])
    np.testing.assert_array_equal(
        limit_surprise(error, before, 1.0), [0.1, 6.0, -1.0, -4.0, 0.5, 0.0]
    )


def test_the_center_of_mass_moves_as_a_pendulum_has_to() -> None:
    """Catches a filter of the wrong order or frequency: p = c − c̈/ω², and its gain for a sine."""
    omega = 3.7
    frequency = 1.2
    zmp = np.hstack([wave(frequency), wave(0.3)])
    shift = center_of_mass_shift(zmp, omega, PERIOD_S)
    acceleration = np.diff(shift, 2, axis=0) / PERIOD_S**2
    np.testing.assert_allclose(shift[1:-1] - acceleration / omega**2, zmp[1:-1], atol=1e-9)
    expected = middle(zmp) / (1.0 + (2.0 * np.pi * frequency / omega) ** 2)
    np.testing.assert_allclose(middle(shift), expected, atol=1e-4)


def test_every_offset_of_the_walker_acts_against_its_error() -> None:
    """Catches a handle with the wrong sign, in double and in single support, by playing each on
    a real walk."""
    env = make_walker(5, scenario="ideal", step_period=[0.3, 0.5, 0.3])
    policy = baselines.make("iterative", env)
    size = np.array([5e-3, 5e-3, 0.01, 0.01])
    tables = np.zeros((5, env.unwrapped.task.num_steps + 1, 4))
    for column in range(4):
        tables[1 + column, :, column] = size[column]
    policy.play(tables)
    signals = WalkSignals(env.unwrapped.assumed_model, LearningGains())
    asked, _ = env.reset(seed=[3] * 5)
    state = None
    found = []
    timing = env.unwrapped.task.plan.timing
    for _ in range(np.flatnonzero(timing.walking)[-1]):
        action, state = policy.predict(asked, state=state, episode_start=np.full(5, state is None))
        seen, _, _, _, info = env.step(action)
        found.append(signals.error(asked, seen, info))
        asked = seen
    change = np.array(found)[:, 1:] - np.array(found)[:, :1]
    of_steps = {"double": timing.walking & ~timing.single, "single": timing.single}
    for name, rows in of_steps.items():
        mean = change[rows[1 : len(change) + 1]].mean(axis=0)
        for column in range(4):
            share = -mean[column, column] / size[column]
            assert 0.05 < share < 1.6, (name, column, share)


def test_the_same_robot_walks_again_under_other_noise() -> None:
    """Catches a trial on another robot, which would learn the mean of all robots; and noise that
    repeats."""
    env = make_walker(2, scenario="spread+sensor", sensors=["joint_torque"])
    task = env.unwrapped.task
    first, _ = env.reset(seed=11)
    robot = task.truth().stiffness
    bias = task._bias.copy()
    sensor = {name: offset.copy() for name, offset in task._sensors._offset.items()}
    again, _ = env.reset(seed=99, options={"robot_seed": 11})
    np.testing.assert_array_equal(task.truth().stiffness, robot)
    np.testing.assert_array_equal(task._bias, bias)
    for name, offset in sensor.items():
        np.testing.assert_array_equal(task._sensors._offset[name], offset)
    assert not np.array_equal(first, again)
    other, _ = env.reset(seed=98, options={"robot_seed": [12, None]})
    assert not np.array_equal(again, other)
    np.testing.assert_array_equal(task.truth().stiffness[0], robot[1])
    with pytest.raises(ConfigurationError, match=r"robot_seed.*one per world"):
        env.reset(options={"robot_seed": "eleven"})


def test_a_drawn_motion_repeats_with_its_robot() -> None:
    """Catches trials of another motion than the one that is scored, on scalar and vector
    environments alike."""
    for env in (make_testbed(reference="multisine"), make_testbed(1, reference="multisine")):
        told = []
        for seed, options in ((5, None), (8, {"robot_seed": 5}), (8, None)):
            env.reset(seed=seed, options=options)
            task = env.unwrapped.task
            told.append(task._reference.motion[0].copy())
        assert np.array_equal(told[0], told[1])
        assert not np.array_equal(told[0], told[2])


def test_the_testbed_learns_from_its_imu_whatever_the_worlds() -> None:
    """Catches learning that needs the truth or other worlds, and a scalar environment that
    learns something else."""
    env = make_testbed(2)
    told = []
    policy = baselines.make("iterative", env, learning=SHORT)
    policy.rehearse(env, 4, told.append)
    measured = np.array([trial.error_rms[:, 0] for trial in told])
    assert (measured[-1] < 0.75 * measured[0]).all()
    assert [trial.number for trial in told] == [0, 1, 2]
    alone = make_testbed()
    single = baselines.make("iterative", alone, learning=SHORT)
    single.rehearse(alone, 5)
    np.testing.assert_array_equal(single.tables[0], policy.tables[1])
    with pytest.raises(ElasticError, match="learned in 2 worlds"):
        policy.predict(
            np.zeros((3, env.observation_space.shape[1])), episode_start=np.ones(3, dtype=bool)
        )


def learner() -> IterativeLearner:
    """One that has learned nothing."""
    policy = baselines.make("iterative", make_testbed(1), learning=SHORT)
    assert isinstance(policy, IterativeLearner)
    return policy


def test_a_trial_that_fails_teaches_nothing_and_is_a_reason_to_retreat() -> None:
    """Catches a fall that is learned."""
    table = np.full((1, 50, 1), 0.01)
    trial = Trial(3, np.full((1, 50, 1), 0.2), np.array([True]), [{}])
    before = np.full((1, 50, 1), 0.03)
    following, kept = learner()._learn(table, before, trial)
    np.testing.assert_array_equal(following, 0.5 * table)
    np.testing.assert_array_equal(kept, before)


def test_a_push_in_one_trial_is_forgotten() -> None:
    """Catches a disturbance of one trial that stays in the table."""
    policy = learner()
    tables = np.zeros((1, 1500, 1))
    before = np.full((1, 1500, 1), np.inf)
    pushed = np.zeros((1500, 1))
    worst = 0.0
    pushed[700:750] = 0.1
    disturbance = 0.02 * np.sin(np.linspace(0.0, 4.0 * np.pi, 1500))[:, None]
    for number in range(10):
        error = disturbance - tables[0] + (pushed if number == 4 else 0.0)
        tables, before = policy._learn(
            tables, before, Trial(number, error[None], np.array([False]), [{}])
        )
        if number == 4:
            worst = np.abs(disturbance - tables[0])[300:-300].max()
    assert worst < 0.008  # of 0.1
    assert np.abs(disturbance - tables[0])[300:-300].max() < 1e-3


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `elastic iterate` on the testbed."""
    folder = tmp_path_factory.mktemp("runs") / "iterate"
    options = Iterate(
        env="testbed", scenario="soft", reference=SINE, trials=SHORT.trials, seed=3, output=folder
    )
    options.run(Console(quiet=True))
    return folder


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Offsets of zero, saved as `elastic iterate` saves what it learned."""
    folder = tmp_path_factory.mktemp("untrained")
    options = Iterate(env="testbed", scenario="soft", reference=SINE, seed=3, output=folder)
    env = make_testbed(1)
    policy = baselines.make("iterative", env, learning=SHORT)
    policy.play(np.zeros((1, env.unwrapped.task.num_steps + 1, 1)))
    options._save(env, policy, folder)
    return folder


@pytest.mark.slow
def test_what_was_learned_is_saved_and_played(run: Path) -> None:
    """Catches a table that plays shifted, scaled or around another base than it was learned
    with."""
    assert {path.name for path in run.iterdir()} >= {
        DESCRIPTION,
        OFFSETS,
        "trials.csv",
        "trials.png",
        "config.yaml",
    }
    saved = Condition(
        env="testbed",
        policy=PolicySpec(name=f"iterative:{run}"),
        reference=SINE,
        scenario="soft",
        seed=3,
    )
    rehearsed = saved.replace(policy=PolicySpec(name="iterative", options={"learning": SHORT}))
    base = saved.replace(policy=PolicySpec(name="input"))
    scores = [
        evaluate(condition).values("link_error_rms_rad")[0]
        for condition in (saved, rehearsed, base)
    ]
    assert scores[0] == scores[1] < 0.85 * scores[2]
    assert track("iterative", is_walker=False) is track(f"iterative:{run}") is Track.WALKS


def test_another_motion_or_robot_is_refused(untrained: Path) -> None:
    """Catches offsets that are played in a motion that they are wrong for."""
    for change in ({"amplitude": 0.1}, {"duration_s": 0.3}):
        env = make_testbed(reference={**SINE, **change})
        with pytest.raises(ConfigurationError, match=r"amplitude|number of rows"):
            baselines.make(f"iterative:{untrained}", env)
    with pytest.raises(ConfigurationError, match="robot 'testbed'"):
        baselines.make(f"iterative:{untrained}", make_walker(1))


def damaged(learned: Path, folder: Path, change: Any, offsets: bytes | None = None) -> Path:
    """A copy of a run's policy with its description changed, or its offsets."""
    content = json.loads((learned / DESCRIPTION).read_text())
    change(content)
    (folder / DESCRIPTION).write_text(json.dumps(content))
    (folder / OFFSETS).write_bytes((learned / OFFSETS).read_bytes() if offsets is None else offsets)
    return folder


def test_damaged_files_say_what_is_wrong(untrained: Path, tmp_path: Path) -> None:
    """Catches a table that is played although it is cut short, not finite, or of another shape."""
    env = make_testbed()
    rows = env.unwrapped.task.num_steps + 1

    def problem(change: Any = lambda content: None, offsets: bytes | None = None) -> str:
        with pytest.raises(ConfigurationError) as caught:
            baselines.make(f"iterative:{damaged(untrained, tmp_path, change, offsets)}", env)
        return str(caught.value)

    assert "shape (T, 1)" in problem(offsets=save({"offsets": np.zeros((rows, 2))}))
    assert "finite" in problem(offsets=save({"offsets": np.full((rows, 1), np.nan)}))
    assert "number of rows" in problem(offsets=save({"offsets": np.zeros((rows - 1, 1))}))
    assert "one tensor, 'offsets'" in problem(offsets=save({"other": np.zeros((rows, 1))}))
    assert "cannot be read" in problem(offsets=(untrained / OFFSETS).read_bytes()[:-8])
    assert "must be a baseline" in problem(lambda content: content.update(base="residual:x"))
    assert "describes no table" in problem(lambda content: content.update(colour="red"))
    with pytest.raises(ConfigurationError, match="no learned offsets at"):
        baselines.make(f"iterative:{tmp_path / 'nowhere'}", env)


def test_what_cannot_be_learned_is_refused() -> None:
    """Catches a motion that differs from seed to seed, a base that has learned, and links that
    nothing shows."""
    with pytest.raises(ConfigurationError, match="draws another motion"):
        Iterate(env="testbed", reference="multisine")
    with pytest.raises(ConfigurationError, match="base of iterative"):
        baselines.make("iterative", make_testbed(), learned_base="oracle")
