"""Training of residuals: resumed against uninterrupted to the last bit, states, mixtures, and
what is refused."""

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from gymnasium.vector import AutoresetMode
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import baselines
from baselines.residual.residual_folder import load_residual
from baselines.residual_env import ResidualVectorWrapper
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.robots.thormang.config import BANK_SIZE
from elastic_env.world.vector_env import ElasticVectorEnv
from train.commands.bench import BenchCase
from train.commands.cli import main
from train.evaluate.episodes import evaluate
from train.evaluate.learning_curves import read_progress
from train.evaluate.rollout import make_vector_env
from train.learn.constant_search import ConstantSearch
from train.learn.mixed_env import MixedVectorEnv, thread_counts
from train.learn.run_training import Run, _name_resumption, _score_table, resume
from train.learn.run_training import _change_text as change_in_words
from train.learn.run_training import _warn_of_cut_episodes as warn_of_cut_episodes
from train.learn.sb3_env import SB3VecEnv
from train.learn.tensorboard_curves import RewardLogger
from train.learn.train_config import TrainConfig, training_worlds
from train.learn.trainer import play_scenarios
from train.learn.training import Training
from train.runs.folders import lock_run
from train.workers.executors import Executors

ROOT = Path(__file__).parents[1]
SINE = {"kind": "sine", "duration_s": 0.3, "onset_s": 0.2, "amplitude": 0.1}
SMALL: dict[str, Any] = {
    "env": "testbed",
    "reference": SINE,
    "base": "input",
    "worlds": 4,
    "decisions": 64,
    "evaluate_every": 48,
    "checkpoint_every": 32,
    "evaluation_episodes": 1,
    "settings": {"decision_period": 40, "history": 1},
}
"""Eight decisions reach behind the second in which all stands, where there is nothing to learn."""
PPO = {"algorithm_options": {"n_steps": 4, "batch_size": 8, "n_epochs": 2}, "anneal": True}
SAC = {
    "algorithm": "SAC",
    "algorithm_options": {"learning_starts": 16, "batch_size": 16, "gradient_steps": 1},
}


def options(**given: Any) -> dict[str, Any]:
    """A configuration's options of its algorithm."""
    return {"algorithm_options": given}


def network(**given: Any) -> dict[str, Any]:
    """The same, of its network."""
    return options(policy_kwargs=given)


def some_worlds(
    robot: str = "testbed", n: int = 3, scenario: str = "nominal", **options: Any
) -> Any:
    """A few worlds that nobody restarts."""
    name = "elastic_env/Testbed-v0" if robot == "testbed" else "elastic_env/WalkInPlace-v0"
    motion = (
        {"reference": SINE}
        if robot == "testbed"
        else {"step_period": [0.3, 0.4, 0.3], "num_steps": 1}
    )
    return gymnasium.make_vec(
        name,
        num_envs=n,
        vectorization_mode="vector_entry_point",
        scenario=scenario,
        **{"autoreset_mode": AutoresetMode.DISABLED, **motion, **options},
    )


def under_residuals(env: Any, base: str = "input") -> ResidualVectorWrapper:
    """Residuals in worlds that restart in the step in which they end."""
    return ResidualVectorWrapper(
        env, base, history=1, decision_period=10, autoreset_mode=AutoresetMode.SAME_STEP
    )


def wrapped(
    robot: str = "testbed", n: int = 3, scenario: str = "nominal", base: str = "input"
) -> ResidualVectorWrapper:
    """Residuals in a few worlds."""
    return under_residuals(some_worlds(robot, n, scenario), base)


def weights(folder: Path) -> dict[str, Array]:
    """Tensors of a residual."""
    from safetensors.numpy import load_file

    return load_file(folder / "weights.safetensors")


def interrupted_after(decisions: int) -> Callable[[int], None]:
    """Progress that ends in Ctrl-C."""

    def progress(done: int) -> None:
        if done >= decisions:
            raise KeyboardInterrupt

    return progress


BEGUN = TrainConfig(**{**SMALL, **PPO})


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training that was interrupted behind its first checkpoint, before any evaluation but that
    of the base."""
    folder = tmp_path_factory.mktemp("begun")
    with pytest.raises(KeyboardInterrupt):
        Training(BEGUN, 1, folder).run(interrupted_after(32))
    return folder


def require_same_end(whole: TrainConfig, tmp_path: Path) -> None:
    """Require that the training in `part`, which was interrupted, ends as an uninterrupted one."""
    Training(whole, 1, tmp_path / "whole").run()
    resumed = Training(whole, 1, tmp_path / "part")
    assert 0 < resumed.done < whole.decisions
    resumed.run()
    one = weights(tmp_path / "whole" / "last")
    other = weights(tmp_path / "part" / "last")
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        np.testing.assert_array_equal(tensor, other[name], err_msg=name)
    events = EventAccumulator(str(tmp_path / "whole" / "tensorboard")).Reload()
    assert {"rollout/reward_per_decision", "train/learning_rate"} <= set(events.Tags()["scalars"])
    assert "rollout/ep_rew_mean" not in events.Tags()["scalars"]
    assert (tmp_path / "whole" / "progress.csv").read_bytes() == (
        tmp_path / "part" / "progress.csv"
    ).read_bytes()


def test_a_resumed_training_ends_with_the_weights_of_an_uninterrupted_one(
    begun: Path, tmp_path: Path
) -> None:
    """Catches a random state, a world, a memory or an optimiser that does not go on where it
    was."""
    shutil.copytree(begun, tmp_path / "part")
    require_same_end(BEGUN, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("options", [PPO, SAC], ids=["PPO", "SAC"])
def test_a_training_that_was_interrupted_behind_an_evaluation_ends_as_an_uninterrupted_one(
    options: dict[str, Any], tmp_path: Path
) -> None:
    """Catches also a buffer that does not go on where it was, and scores that are lost or stand
    twice."""
    config = TrainConfig(**{**SMALL, **options})
    with pytest.raises(KeyboardInterrupt):
        Training(config, 1, tmp_path / "part").run(interrupted_after(48))
    require_same_end(config, tmp_path)


@pytest.mark.slow
def test_curves_say_how_much_better_than_the_base_a_policy_is(tmp_path: Path) -> None:
    """Catches a curve that falls while the error does, and one of another figure than
    progress.csv has."""
    Training(TrainConfig(**{**SMALL, **PPO}), 1, tmp_path).run()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    shown = {event.step: event.value for event in events.Scalars("eval/link_error_rms_rad_change")}
    rows = read_progress(tmp_path)
    assert shown == {
        row["decisions"]: pytest.approx(
            row["link_error_rms_rad"] / row["base_link_error_rms_rad"] - 1.0, abs=1e-7
        )
        for row in rows
    }
    assert [event.value for event in events.Scalars("eval/failed")] == [0.0] * len(rows)


def test_the_reward_per_decision_counts_whole_episodes(tmp_path: Path) -> None:
    """Catches a mean over the sums of episodes, which is the better the shorter they are."""
    model = SimpleNamespace(ep_info_buffer=[{"r": -100.0, "l": 10}, {"r": -20.0, "l": 5}])
    curves = RewardLogger(str(tmp_path), model, SB3VecEnv(wrapped()))
    curves.record("rollout/ep_rew_mean", -60.0)
    curves.dump(7)
    curves.close()
    events = EventAccumulator(str(tmp_path)).Reload()
    assert events.Tags()["scalars"] == ["rollout/reward_per_decision"]
    ((step, value),) = [
        (event.step, event.value) for event in events.Scalars("rollout/reward_per_decision")
    ]
    assert (step, value) == (7, -8.0)


def test_episodes_that_checkpoints_end_have_their_reward_per_decision(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a curve without a point, as every checkpoint ends the episodes before one is whole,
    and a last point of fewer decisions than the others."""
    settings = {"decision_period": 44, "history": 1}
    sizes = {"worlds": 2, "decisions": 40, "checkpoint_every": 16, "evaluate_every": 40}
    training = Training(TrainConfig(**{**SMALL, **PPO, **sizes, "settings": settings}), 1, tmp_path)
    rewards = []
    step = training._worlds.env.step

    def kept(actions: Any) -> Any:
        result = step(actions)
        rewards.append(result[1].mean())
        return result

    monkeypatch.setattr(training._worlds.env, "step", kept)
    training.run()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    shown = [(event.step, event.value) for event in events.Scalars("rollout/reward_per_decision")]
    assert shown == [
        (16, pytest.approx(np.mean(rewards[:8]), rel=1e-6)),
        (32, pytest.approx(np.mean(rewards[8:16]), rel=1e-6)),
    ]
    assert shown[0][1] < 0.0


def test_an_episode_that_is_cut_short_has_no_statistics() -> None:
    """Catches first episodes, which are cut and of the beginning of the motion, in a mean with
    whole ones."""
    worlds = SB3VecEnv(wrapped(n=4), np.random.default_rng(0))
    worlds.reset()
    lengths = []
    for _ in range(75):
        worlds.step_async(np.zeros((4, 1)))
        infos = worlds.step_wait()[3]
        lengths += [(info.get("episode") or {}).get("l") for info in infos if info]
    assert lengths[:3] == [None, None, None]
    assert set(lengths[3:]) == {max(length for length in lengths if length)}


def spoilt(worlds: SB3VecEnv, after: int, part: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a step after some others return nan as its observation (0) or its reward (1)."""
    step = worlds.env.step
    count = itertools.count()

    def spoil(actions: Any) -> Any:
        result = list(step(actions))
        if next(count) == after:
            result[part] = np.full_like(result[part], np.nan)
        return tuple(result)

    monkeypatch.setattr(worlds.env, "step", spoil)


@pytest.mark.parametrize(
    ("part", "quantity"),
    [(0, "the observation"), pytest.param(1, "the reward", marks=pytest.mark.slow)],
)
def test_nan_ends_a_training_with_one_sentence(
    part: int, quantity: str, begun: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a traceback of torch, a checkpoint that holds nan, and one that is lost."""
    folder = Path(shutil.copytree(begun, tmp_path / "run"))
    training = Training(BEGUN, 1, folder)
    spoilt(training._worlds, 1, part, monkeypatch)
    message = (
        rf"{quantity} is not a finite number at decision [34]\d of training seed 1; the checkpoint of"
        r" decision 32 is"
    )
    with pytest.raises(ElasticError, match=message):
        training.run()
    assert Training(BEGUN, 1, folder).done == 32


@pytest.mark.parametrize(
    ("base", "mine", "said"),
    [
        (0.002, 0.001, "2.00 → 1.00 (-50 %)"),
        (0.002, np.nan, "2.00 → -"),
        (np.nan, 0.001, "- → 1.00"),
        (np.nan, np.nan, "- → -"),
        (0.0, 0.001, "0.00 → 1.00"),
    ],
)
def test_scores_without_an_episode_are_a_dash(base: float, mine: float, said: str) -> None:
    """Catches nan → nan (+nan %)."""
    assert change_in_words(base, mine, 1e3) == said


def test_checkpoints_within_half_an_episode_are_warned_of() -> None:
    """Catches worlds that only ever see the begin of an episode; one has 13 decisions here."""
    settings = {"decision_period": 30}
    config = TrainConfig(**{**SMALL, "settings": settings, "checkpoint_every": 25})
    with pytest.warns(UserWarning, match="4 worlds after about 6 of 13 decisions; .* set 26 or"):
        warn_of_cut_episodes(config)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_cut_episodes(config.replace(checkpoint_every=26))
        warn_of_cut_episodes(config.replace(decisions=25))  # no checkpoint before the end


def test_a_policy_that_is_worse_than_its_base_is_named(tmp_path: Path) -> None:
    head = "decisions,scenario,link_error_rms_rad,base_link_error_rms_rad,failed\n"
    for seed, score in ((3, 0.003), (4, 0.001)):
        (tmp_path / f"seed_{seed}").mkdir()
        text = f"{head}8,nominal,{score},0.002,0\n"
        (tmp_path / f"seed_{seed}" / "progress.csv").write_text(text)
    table = _score_table(TrainConfig(**SMALL, seeds=[3, 4]), tmp_path)
    assert table.caption == "on average worse than input: seed 3"


def test_ctrl_c_names_the_command_that_continues(tmp_path: Path) -> None:
    runs = [Run(TrainConfig(**SMALL), tmp_path)]
    (tmp_path / "seed_0").mkdir()
    with pytest.raises(KeyboardInterrupt) as caught, _name_resumption(runs):
        raise KeyboardInterrupt
    assert caught.value.__notes__ == [f"go on with: elastic train --resume {tmp_path}"]


def test_weights_that_are_nan_are_named(tmp_path: Path) -> None:
    """Catches hours of a training whose network is nan."""
    training = Training(TrainConfig(**{**SMALL, **PPO}), 1, tmp_path)
    with torch.no_grad():
        training.model.policy.log_std.fill_(np.nan)
    with pytest.raises(
        ElasticError, match=r"log_std of the network is not a finite number.*no checkpoint was due"
    ):
        training.run()


def test_a_search_whose_reward_is_nan_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a search that is told nan and goes anywhere."""
    search = ConstantSearch(TrainConfig(**SEARCH), 0, tmp_path)
    step = search._worlds.step
    monkeypatch.setattr(
        search._worlds, "step", lambda given: (lambda r: (r[0], r[1] * np.nan, *r[2:]))(step(given))
    )
    with pytest.raises(ElasticError, match="the reward is not a finite number"):
        search.run()


def test_a_damaged_checkpoint_is_named(begun: Path, tmp_path: Path) -> None:
    """Catches errors of libraries in the place of one that says which files, and what to do."""
    for file, size in (("model.pt", None), ("state.json", 0), ("state.npz", 100)):
        folder = Path(shutil.copytree(begun, tmp_path / file))
        damaged = folder / "checkpoint" / file
        if size is None:
            damaged.unlink()
        else:
            damaged.write_bytes(damaged.read_bytes()[:size])
        with pytest.raises(
            ElasticError, match=r"checkpoint is damaged or incomplete .*; remove it"
        ):
            Training(BEGUN, 1, folder)


@pytest.mark.slow
def test_a_killed_training_goes_on(tmp_path: Path) -> None:
    """Catches a checkpoint that is half written, and a kill that loses or repeats an evaluation."""
    code = (
        "from pathlib import Path; import sys; from tests.test_training import SMALL, PPO;from"
        " train.learn.training import Training; from train.learn.train_config import"
        " TrainConfig;Training(TrainConfig(**{**SMALL, **PPO}), 1, Path(sys.argv[1])).run()"
    )
    killed = tmp_path / "killed"
    whole = tmp_path / "whole"
    process = subprocess.Popen([sys.executable, "-c", code, str(killed)], cwd=ROOT)
    while not (killed / "checkpoint").exists():
        time.sleep(0.02)
        assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    for folder in (killed, whole):
        Training(TrainConfig(**{**SMALL, **PPO}), 1, folder).run()
    for name, tensor in weights(whole / "last").items():
        np.testing.assert_array_equal(tensor, weights(killed / "last")[name], err_msg=name)
    assert read_progress(killed) == read_progress(whole)


def test_before_its_first_decision_a_residual_is_scored_as_what_it_is(begun: Path) -> None:
    """Catches a beginning that is far from the base, whose score is taken for it without
    playing."""
    (row,) = read_progress(begun)
    assert row["decisions"] == 0
    metric = "link_error_rms_rad"
    ((found,),), failed = play_scenarios(BEGUN, f"residual:{begun / 'best'}", [metric])
    assert not failed.any()
    assert row[metric] == row[f"base_{metric}"] == pytest.approx(found, rel=2e-5)
    assert found != row[metric]


SEARCH: dict[str, Any] = {
    **SMALL,
    "base": "input",
    "algorithm": "CMA-ES",
    "worlds": 8,
    "decisions": 1200,
    "evaluate_every": 600,
    "checkpoint_every": 200,
    "algorithm_options": {"population_size": 8, "sigma": 0.3},
    "scenarios": ["ideal+soft"],
    "settings": {"decision_period": 10},
}


@pytest.mark.slow
def test_the_search_finds_the_stiffness_that_is_wrong(tmp_path: Path) -> None:
    """Catches a search up the hill, candidates mixed up among worlds, and constants that are
    exported wrongly.

    With the true K at 0.7 of the assumed one, slow motion is compensated at 1 + r = 1 / 0.7.
    """
    slow = {
        "kind": "sine",
        "duration_s": 2.0,
        "onset_s": 1.5,
        "amplitude": 0.6,
        "frequency_hz": 0.1,
    }
    given = {
        "reference": slow,
        "base": "dynamic",
        "decisions": 3000,
        "evaluate_every": 3000,
        "checkpoint_every": 3000,
    }
    search = ConstantSearch(
        TrainConfig(**{**SEARCH, **given, "settings": {"decision_period": 25}}), 0, tmp_path
    )
    search.run()
    _, network = load_residual(tmp_path / "last")
    found = network(np.random.default_rng(0).normal(size=(3, network.num_features)))
    np.testing.assert_allclose(0.6 * found, 1.0 / 0.7 - 1.0, atol=0.02)
    assert (
        read_progress(tmp_path)[-1]["link_error_rms_rad"]
        < 0.1 * read_progress(tmp_path)[0]["link_error_rms_rad"]
    )


@pytest.mark.slow
def test_a_resumed_search_ends_as_an_uninterrupted_one(tmp_path: Path) -> None:
    """Catches a search that begins anew, and one that forgets what it was told."""
    config = TrainConfig(**SEARCH)
    ConstantSearch(config, 1, tmp_path / "whole").run()
    search = ConstantSearch(config, 1, tmp_path / "part")
    with pytest.raises(KeyboardInterrupt):
        search.run(interrupted_after(400))
    resumed = ConstantSearch(config, 1, tmp_path / "part")
    assert 0 < resumed.done < config.decisions
    resumed.run()
    np.testing.assert_array_equal(
        weights(tmp_path / "whole" / "last")["bias0"], weights(tmp_path / "part" / "last")["bias0"]
    )
    assert read_progress(tmp_path / "whole") == read_progress(tmp_path / "part")


def test_a_mixture_is_its_parts() -> None:
    """Catches worlds that get another's action, seed or end."""
    parts = [wrapped(n=2), wrapped(n=1, scenario="soft")]
    whole = under_residuals(MixedVectorEnv([some_worlds(n=2), some_worlds(n=1, scenario="soft")]))
    observation, _ = whole.reset(seed=7)
    alone = np.concatenate([parts[0].reset(seed=7)[0], parts[1].reset(seed=9)[0]])
    np.testing.assert_array_equal(observation, alone)
    generator = np.random.default_rng(2)
    ends = 0
    for _ in range(42):  # an episode has 38 decisions
        residual = generator.uniform(-1.0, 1.0, (3, 1))
        observation, reward, terminated, truncated, info = whole.step(residual)
        results = [parts[0].step(residual[:2]), parts[1].step(residual[2:])]
        for i, mine in enumerate((observation, reward, terminated, truncated)):
            np.testing.assert_array_equal(mine, np.concatenate([result[i] for result in results]))
        if truncated.any():
            ends += 1
            for world, (part, row) in enumerate([(0, 0), (0, 1), (1, 0)]):
                if truncated[world]:
                    final = results[part][4]
                    np.testing.assert_array_equal(info["final_obs"][world], final["final_obs"][row])
                    metrics = final["final_info"]["episode_metrics"]["link_error_rms_rad"]
                    assert (
                        info["final_info"]["episode_metrics"]["link_error_rms_rad"][world]
                        == metrics[row]
                    )
    assert ends > 0
    observation, _ = whole.reset(
        seed=[1, 2, 3], options={"reset_mask": np.array([False, True, False])}
    )
    again, _ = parts[0].reset(seed=[1, 2], options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(observation[:2], again)


@pytest.mark.parametrize(
    ("cores", "environments", "threads"),
    [
        (2, 5, [1, 1, 1, 1, 2]),
        (2, 1, [2]),
        (8, 5, [1, 1, 1, 1, 1]),
        (8, 3, [2, 2, 2]),
        (1, 3, [1, 1, 1]),
        (4, 4, [1] * 4),
    ],
)
def test_the_last_environments_share_what_cores_are_left(
    cores: int, environments: int, threads: list[int]
) -> None:
    """Catches a core that waits while the last of five scenarios steps, and more threads than
    cores."""
    assert thread_counts(cores, environments) == threads


@pytest.mark.slow
def test_rewards_of_a_scenario_count_by_its_weight() -> None:
    """Catches weights that nothing reads, or of another scenario."""
    config = TrainConfig(**{**SMALL, "scenarios": ["nominal", "soft"], "worlds": 4})
    rewards = []
    for weights in ({}, {"soft": 0.25}):
        weighted = config.replace(weights=weights)
        worlds = training_worlds(weighted, weighted.shares, 1)
        worlds.reset(seed=3)
        residual = np.full(worlds.action_space.shape, 0.5)
        rewards.append(np.sum([worlds.step(residual)[1] for _ in range(40)], axis=0))
    np.testing.assert_allclose(rewards[1], rewards[0] * [1.0, 1.0, 0.25, 0.25], rtol=1e-12)
    assert np.abs(rewards[0]).min() > 0.0
    with pytest.raises(ConfigurationError, match=r"one per world, 2, got 3"):
        MixedVectorEnv([some_worlds(n=2)], weights=[1.0, 2.0, 3.0])


def test_worlds_that_one_policy_cannot_play_are_no_mixture() -> None:
    """Catches worlds whose observation, length or assumed robot differs from what the policy was
    made for."""
    one = some_worlds(n=1)
    with pytest.raises(ConfigurationError, match=r"at least one environment"):
        MixedVectorEnv([])
    with pytest.raises(ConfigurationError, match=r"autoreset_mode Disabled, got NextStep"):
        MixedVectorEnv([one, some_worlds(n=1, autoreset_mode=AutoresetMode.NEXT_STEP)])
    for other, problem in (
        (some_worlds("walker", 1), "observation"),
        (some_worlds(n=1, observe_link=True), "observation"),
        (some_worlds(n=1, reference={**SINE, "duration_s": 2.0}), "task and motion"),
    ):
        with pytest.raises(ConfigurationError, match=f"must have the same {problem}"):
            MixedVectorEnv([one, other])
    for pair in (
        [one, some_worlds(n=1, stiffness=900.0)],
        [some_worlds("walker", 1, x) for x in ("ideal", "soft")],
    ):
        with pytest.raises(
            ConfigurationError, match=r"assume the same joints: .* apart from the others"
        ):
            MixedVectorEnv(pair)
    with pytest.raises(ConfigurationError, match=r"oracle .* which MixedVectorEnv does not have"):
        baselines.make("oracle", MixedVectorEnv([one]))


@pytest.mark.slow
@pytest.mark.parametrize("env", ["testbed", "walker"])
def test_scenarios_played_together_score_as_alone(env: str) -> None:
    """Catches scores of another scenario or policy, and a fall that counts as a score."""
    motion: Any = SINE if env == "testbed" else {"step_period": [0.3, 0.4, 0.3], "num_steps": 1}
    base = "input" if env == "testbed" else "uncompensated"
    metric = "link_error_rms_rad" if env == "testbed" else "pelvis_error_rms_rad"
    scenarios = ["soft", "ideal", "nominal", "sensor"]
    config = TrainConfig(env=env, reference=motion, scenarios=scenarios, base=base)
    for scenario, values, failed in zip(
        scenarios, *play_scenarios(config, base, [metric]), strict=True
    ):
        alone = evaluate(config.condition(scenario, base), num_threads=1)
        assert failed == alone.num_failed
        own = alone.values(metric)
        np.testing.assert_array_equal(values, [own.mean() if len(own) else np.nan])


def test_staggered_worlds_stand_all_over_the_walk() -> None:
    """Catches worlds that begin together for good, so that every batch shows one phase, and a
    cut that is an end."""
    env = wrapped("walker", 5, base="input")
    env.reset(seed=0)
    env.stagger(np.random.default_rng(0))
    clock = env.unwrapped.task.observation_table.names.index("clock.time")  # type: ignore[attr-defined]
    length = env.unwrapped.task.num_steps * 0.004  # type: ignore[attr-defined]
    ends = np.zeros(5, dtype=np.int64)
    features = np.zeros(())
    for decision in range(1, int(length / 0.04) + 1):
        features, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        assert not terminated.any()
        ends += truncated
        for world in np.flatnonzero(truncated):
            assert info["final_obs"][world][clock] == pytest.approx(0.04 * decision, abs=0.005)
            # the last of them ends by itself
            assert ("episode_metrics" in info["final_info"]) == (0.04 * decision >= length)
    assert ends.tolist().count(1) >= 4
    times = np.sort(features[:, clock])
    assert np.diff(times).min() > 0.1 * length
    assert times[-1] - times[0] > 0.6 * length


def test_training_seeds_and_evaluation_seeds_are_disjoint(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a policy that is scored on episodes that it learned from."""
    seen: list[Any] = []
    reset = ElasticVectorEnv.reset

    def spied(self: ElasticVectorEnv, *, seed: Any = None, options: Any = None) -> Any:
        seen.append(seed)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(ElasticVectorEnv, "reset", spied)
    config = TrainConfig(**{**SMALL, **PPO, "worlds": 2, "decisions": 8})
    for seed in (0, 1):
        Training(config, seed, tmp_path / str(seed)).run()
    evaluated = config.condition("nominal", "input").seed
    trained = {one for seeds in seen if seeds is not None for one in seeds} - {evaluated}
    assert len(trained) == 8  # two worlds begin twice, at first and behind the checkpoint
    assert [evaluated] in seen
    assert evaluated + 1_000 < min(trained)


@pytest.mark.parametrize("key", ["env_options", "training_options"])
def test_options_of_an_environment_are_refused_by_the_key_they_stand_in(key: str) -> None:
    """Catches an argument that is found late, and one of trainings named as of all worlds."""
    with pytest.raises(ConfigurationError, match=rf"^{key}: scenario cannot be given here"):
        TrainConfig(**{key: {"scenario": "ideal"}})


def test_residuals_learn_from_other_robots_than_they_are_evaluated_with() -> None:
    """Catches a score on robots that training has seen."""
    config = TrainConfig(env="walker", scenarios=["spread"], worlds=2)
    learned_from: Any = training_worlds(config, config.shares, 1).unwrapped.envs[0]
    evaluated: Any = make_vector_env(config.condition("spread", config.base), 2, 1).unwrapped
    trained, scored = (set(env.task._kinds[0].bank) for env in (learned_from, evaluated))
    assert len(trained) == len(scored) == BANK_SIZE
    assert not trained & scored


def test_walks_that_are_learned_from_have_other_lengths_than_those_of_evaluations() -> None:
    """Catches a drawn length or a coarse physics step in an evaluation, and a training without."""
    config = TrainConfig(
        env="walker",
        reference=[0.3, 0.4, 0.3],
        scenarios=["nominal", "soft"],
        worlds=40,
        training_options={"num_steps": 8, "fewest_steps": 4, "timestep_s": 2e-3},
    )
    worlds: Any = training_worlds(config, config.shares, 1)
    worlds.reset(seed=0)
    for env in worlds.unwrapped.envs:
        numbers = 8 - env.task._bias["skipped"] // 250
        assert set(numbers.tolist()) == {4, 6, 8}
        assert env.task.num_substeps == 2
    evaluated: Any = make_vector_env(config.condition("soft", config.base), 2, 1).unwrapped
    assert evaluated.task.num_steps == 500 + 4 * 250 == evaluated.task.fewest_control_steps
    assert evaluated.task.num_substeps == 4
    walk = {"step_period": 3, "num_steps": 4}
    with pytest.raises(
        ConfigurationError, match=r"must not repeat keys of the reference: num_steps"
    ):
        TrainConfig(reference=walk, training_options={"num_steps": 20})


@pytest.mark.parametrize("jobs", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_train_command_trains_every_seed_and_resumes(
    jobs: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Catches a seed left out or trained twice, policies without a player, a resume that begins
    anew."""
    monkeypatch.chdir(tmp_path)
    given = {"name": "mine", **SMALL, **PPO, "seeds": [3, 4], "worlds": 2, "decisions": 16}
    Path("c.yaml").write_text(yaml.safe_dump(given))
    main(["train", "c.yaml", "--jobs", jobs])
    assert "elastic train --resume runs/mine" in capsys.readouterr().out
    for seed in (3, 4):
        description, _ = load_residual(Path(f"runs/mine/seed_{seed}/last"))
        assert description.training["seed"] == seed
        assert {row["scenario"] for row in read_progress(Path(f"runs/mine/seed_{seed}"))} == {
            "nominal"
        }
    before = (Path("runs/mine/seed_3/last/weights.safetensors")).read_bytes()
    assert Path("runs/mine/seed_4/last/weights.safetensors").read_bytes() != before
    main(["train", "--resume", "runs/mine"])
    assert "runs/mine is complete" in capsys.readouterr().out
    assert Path("runs/mine/seed_3/last/weights.safetensors").read_bytes() == before
    policy = "residual:runs/mine/seed_3/last"
    played = evaluate(TrainConfig(**given).condition("nominal", policy), num_threads=1)
    assert played.values("link_error_rms_rad")[0] > 0.0


@pytest.mark.slow
def test_several_configurations_are_trained_in_one_pool(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches configurations that wait for one another, a seed in the folder of another or that
    differs side by side, a resume of one alone."""
    monkeypatch.chdir(tmp_path)
    pools = list[int]()
    opened = Executors.open_pool
    monkeypatch.setattr(
        Executors,
        "open_pool",
        lambda self, calls, folder: pools.append(calls) or opened(self, calls, folder),
    )
    configs = {
        name: {"name": name, **SMALL, **PPO, "base": base}
        for name, base in (("a", "input"), ("b", "dynamic"))
    }
    for name, config in configs.items():
        Path(f"{name}.yaml").write_text(yaml.safe_dump(config))
    main(
        [
            "train",
            "a.yaml",
            "b.yaml",
            "--seeds",
            "3",
            "--decisions",
            "64",
            "--jobs",
            "2",
            "--output",
            "both",
        ]
    )
    assert pools == [2]
    for name in configs:
        description, _ = load_residual(Path(f"both/{name}/seed_3/last"))
        assert description.base == configs[name]["base"]
    Training(TrainConfig(**configs["b"]), 3, tmp_path / "alone").run()
    for name, tensor in weights(tmp_path / "alone" / "last").items():
        np.testing.assert_array_equal(
            tensor, weights(Path("both/b/seed_3/last"))[name], err_msg=name
        )
    capsys.readouterr()
    main(["train", "--resume", "both/a", "both/b"])
    said = capsys.readouterr().out
    assert "both/a is complete" in said
    assert "both/b is complete" in said
    shutil.copytree("both/a", "again/a")
    main(["train", "--resume", "both/a", "again/a"])
    assert "again/a is complete" in capsys.readouterr().out


def test_a_training_seed_that_another_program_trains_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches two programs that write into one folder, where a lock of the whole run does not
    reach."""
    config = TrainConfig(**{**SMALL, **PPO, "seeds": [3]})
    monkeypatch.setattr("train.learn.run_training._LOCK_TIMEOUT_S", 0.0)
    monkeypatch.chdir(tmp_path)
    Path("c.yaml").write_text(yaml.safe_dump(config.model_dump(mode="json")))
    (tmp_path / "run" / "seed_3").mkdir(parents=True)
    (tmp_path / "run" / "config.yaml").write_text(Path("c.yaml").read_text())
    with (
        lock_run(tmp_path / "run" / "seed_3"),
        pytest.raises(
            ConfigurationError, match=rf"process {os.getpid()} of .* works on .*run/seed_3"
        ),
    ):
        resume([tmp_path / "run"], Console(quiet=True))
    assert {path.name for path in (tmp_path / "run" / "seed_3").iterdir()} == {".lock"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "PPOO"}, "'PPOO'.*SAC"),
        ({"algorithm": "nowhere:Class"}, "nowhere"),
        ({"worlds": 3, "scenarios": ["nominal", "soft"]}, "two per scenario, 4, got 3"),
        ({"base": "inptu"}, "'inptu'.*input"),
        ({"scenarios": ["sotf"]}, "'sotf'.*soft"),
        (
            {"weights": {"soft": 2.0}},
            r"unknown scenario with a weight 'soft'; choose one of: nominal",
        ),
        ({"weights": {"nominal": -1.0}}, "weights.nominal must be > 0, got -1"),
        ({"base": "residual:x"}, "no residual itself, got 'residual:x'"),
        ({"base": "zero"}, "acts on deflection, which Zero does not have.*command"),
        (
            {"weights": {"nominal": 1e200}},
            "weights.nominal must be <= 1e\\+06, got 1e\\+200",
        ),
        (
            {"env_options": {"reward": {"link_error": 1e200}}},
            r"link_error must be .* <= 1e\+06 \[1/rad\], got 1e\+200",
        ),
        (
            {"algorithm_options": {"foo": 1}},
            "unknown parameter of algorithm_options 'foo'; choose one of: .*n_steps",
        ),
        (
            network(activation_fn="Foo"),
            "policy_kwargs.activation_fn must be 'Tanh' or 'ReLU', got 'Foo'",
        ),
        (
            network(log_std_init=1e9),
            r"policy_kwargs.log_std_init must be .*>= -20 and <= 2, got 1000000000.0 \(log",
        ),
        (
            network(net_arch=[64, 10**9]),
            r"net_arch.1 must be <= 4096, got 1000000000",
        ),
        (
            options(learning_rate="x"),
            "algorithm_options.learning_rate must be .*> 0 and <= 1, got 'x' .step",
        ),
        (
            options(learning_rate=1e30),
            r"algorithm_options.learning_rate must be .*<= 1, got 1e\+30 \(step",
        ),
        (options(device="cuda"), "leave out 'device': training runs on the CPU"),
        (options(policy="MlpPolicy"), "leave out 'policy': .*policy_kwargs"),
        (options(env="walker"), "leave out 'env': "),
        (options(seed=3), "leave out 'seed': .*seeds"),
        (options(verbose=1), "leave out 'verbose': "),
        (
            options(tensorboard_log="x"),
            "leave out 'tensorboard_log': .*folder of the training seed",
        ),
        ({"algorithm": "m:C", **options(device="cuda")}, "leave out 'device'"),
        (
            {"algorithm": "SAC", **options(ent_coef="auot")},
            "ent_coef must be as follows: Weight of the entropy, .* Got 'auot'",
        ),
        (
            {"algorithm": "A2C", **options(batch_size=8)},
            "unknown parameter of algorithm_options 'batch_size'",
        ),
        ({"seeds": [0, 1, 0]}, "seeds: 0 stands twice"),
    ],
)
def test_a_training_that_cannot_be_says_why(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """Catches a traceback, or hours of training of something else."""
    with pytest.raises(ConfigurationError, match=message):
        Training(TrainConfig(**{**SMALL, **PPO, **changes}), 0, tmp_path / "x")


def test_a_motion_that_is_left_out_stays_the_default() -> None:
    """Catches a configuration that is refused when one of its values is replaced, or when it is
    read back."""
    for config in (
        TrainConfig(env="testbed"),
        BenchCase(env="testbed", policy="input", figures={"link_max_rad": None}),
    ):
        assert config.replace(env="walker").reference is None
        assert type(config).model_validate(config.model_dump(mode="json")) == config


def test_a_training_that_cannot_begin_leaves_no_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a run that could be resumed for ever, and numbers that are used up."""
    monkeypatch.chdir(tmp_path)
    Path("c.yaml").write_text(yaml.safe_dump({**SMALL, **PPO, "base": "inptu"}))
    with pytest.raises(SystemExit):
        main(["train", "c.yaml"])
    assert not Path("runs").exists()


def test_a_candidate_that_falls_comes_last(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Catches an early end that pays: it spares the penalties of the rest of the episode."""
    search = ConstantSearch(TrainConfig(**SEARCH), 0, tmp_path)
    step = search._worlds.step

    def falling(residuals: Array) -> Any:
        observation, reward, terminated, truncated, info = step(residuals)
        return observation, reward, terminated | (np.arange(8) == 3), truncated, info

    monkeypatch.setattr(search._worlds, "step", falling)
    costs = search._play(np.zeros((8, 1)))
    assert costs[3] > 10.0 * np.delete(costs, 3).max()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"worlds": 7}, "each of 8 candidates in each scenario, 8, got worlds: 7"),
        ({"algorithm_options": {"popsize": 8}}, "'popsize'.*population_size"),
        (
            options(population_size=0),
            "population_size must be a whole number >= 2 and <= 100000, got 0",
        ),
        (options(sigma=0), "sigma must be a finite number > 0 and <= 2, got 0"),
        (options(sigma="wide"), "sigma must be a finite number > 0 and <= 2, got 'wide'"),
    ],
)
def test_a_search_that_cannot_be_says_why(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """Catches a candidate without a world, and an option that is silently left out."""
    with pytest.raises(ConfigurationError, match=message):
        ConstantSearch(TrainConfig(**{**SEARCH, **changes}), 0, tmp_path)


def test_the_right_model_is_rewarded() -> None:
    """Catches a reward of the wrong sign, and a residual that does not arrive."""
    env = wrapped(n=2, scenario="ideal", base="dynamic")
    rewards = []
    for residual in (-0.5, 0.0, 0.5):
        env.reset(seed=0)
        total = 0.0
        for _ in range(37):
            _, reward, _, _, _ = env.step(np.full((2, 1), residual))
            total += float(reward.sum())
        rewards.append(total)
    assert rewards[1] > max(rewards[0], rewards[2])  # the model is right
