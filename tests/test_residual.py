"""Residuals: zero against the base to the last bit, scalar against vector, SB3 against NumPy,
the checkers of both."""

import json
import math
import os
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from safetensors.numpy import load_file, save_file
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

import baselines
from baselines.compensation.inputs import input_signals
from baselines.estimation.model_error import BendingObserver
from baselines.residual.correction import Channels, Corrected
from baselines.residual.features import Features
from baselines.residual.network import Network
from baselines.residual.residual_folder import (
    load_residual,
    read_description,
    save_residual,
    shipped_names,
)
from baselines.residual.residual_policy import ResidualPolicy
from baselines.residual.settings import ResidualDescription, ResidualSettings
from baselines.residual_env import ResidualVectorWrapper, ResidualWrapper
from elastic_env.core.errors import ActionError, ConfigurationError
from elastic_env.core.signals import Array
from train.commands.cli import main
from train.learn.export import network_of
from train.learn.sb3_env import SB3VecEnv

ROOT = Path(__file__).parents[1]
WALKER = "elastic_env/WalkInPlace-v0"
TESTBED = "elastic_env/Testbed-v0"
QUICK = {"step_period": [0.3, 0.4, 0.3], "num_steps": 1}
SINE = {"reference": {"kind": "sine", "duration_s": 1.0, "onset_s": 0.5, "amplitude": 0.1}}
BASES = [
    ("walker", "input_open", "deflection"),
    ("walker", "input_output", "deflection"),
    ("walker", "input_wrench", "deflection"),
    ("walker", "dynamic", "deflection"),
    ("walker", "uncompensated", "command"),
    ("walker", "input_output", "command"),
    ("testbed", "input", "deflection"),
    ("testbed", "dynamic", "deflection"),
    ("testbed", "zero", "command"),
]


def scalar(robot: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """A short episode of one world."""
    name, short = (WALKER, QUICK) if robot == "walker" else (TESTBED, SINE)
    return gymnasium.make(name, **{**short, **options})


def vector(
    robot: str, n: int, mode: AutoresetMode = AutoresetMode.SAME_STEP, **options: Any
) -> Any:
    """Short episodes of many worlds."""
    name, short = (WALKER, QUICK) if robot == "walker" else (TESTBED, SINE)
    kind = {"vectorization_mode": "vector_entry_point", "num_envs": n, "autoreset_mode": mode}
    return gymnasium.make_vec(name, **kind, **{**short, **options})


def played(env: gymnasium.Env[Any, Any], policy: Any, steps: int) -> list[Array]:
    """Observations of a policy's control steps."""
    observation, _ = env.reset(seed=3)
    seen = [observation]
    state = None
    for _ in range(steps):
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, _ = env.step(action)
        seen.append(observation)
        if terminated or truncated:
            break
    return seen


class Deciding:
    """A residual policy whose residuals are given, by corrected joint and decision."""

    def __init__(self, corrected: Corrected, residuals: Array) -> None:
        self.corrected = corrected
        self.residuals = residuals
        self.steps = 0

    def predict(self, observation: Array, state: Any = None) -> tuple[Any, Any]:
        """The correction of the present decision."""
        decision = self.steps // self.corrected.settings.decision_period
        self.steps += 1
        action, state = self.corrected.act(observation, self.residuals[None, decision], state)
        return action[0] if action.ndim > 1 else action, state


def around(env: Any, base: str, **settings: Any) -> Corrected:
    """A base under a residual."""
    return Corrected(
        baselines.make(base, env), env.unwrapped.assumed_model, ResidualSettings(**settings)
    )


@cache
def quick_world(robot: str) -> gymnasium.Env[Any, Any]:
    """One for several tests, which restart it."""
    return scalar(robot)


@pytest.mark.parametrize(("robot", "base", "acts_on"), BASES)
def test_a_zero_residual_is_the_base_to_the_last_bit(robot: str, base: str, acts_on: str) -> None:
    """Catches a correction that rounds, a filter that starts elsewhere, and a base that sees it
    normalised."""
    env = quick_world(robot)
    expected = played(env, baselines.make(base, env), 60)
    corrected = around(env, base, acts_on={acts_on: None})
    for seen in (
        played(env, Deciding(corrected, np.zeros((20, corrected.num_residuals))), 60),
        played(env, ResidualPolicy(corrected, nothing(corrected)), 60),
    ):
        assert len(seen) == len(expected) == 61
        for one, other in zip(seen, expected, strict=True):
            np.testing.assert_array_equal(one, other)


def nothing(corrected: Corrected) -> Network:
    """A network that always gives zero."""
    return random_network(corrected, 0.0)


def random_network(corrected: Corrected, size: float, seed: int = 0) -> Network:
    """A network of random weights."""
    features = Features(corrected).width
    generator = np.random.default_rng(seed)
    widths = [features, 8, corrected.num_residuals]
    tensors = {
        "mean": generator.normal(size=features),
        "std": generator.uniform(0.5, 2.0, features),
    }
    for i in range(2):
        tensors |= {
            f"weight{i}": size * generator.normal(size=(widths[i + 1], widths[i])),
            f"bias{i}": np.zeros(widths[i + 1]),
        }
    return Network(
        ResidualDescription(robot="walker", base="", settings=corrected.settings), tensors
    )


def test_model_space_compensates_another_deflection() -> None:
    """Catches a correction of the command alone: after the low-pass, r means K / (1 + r) in Eq.
    9 and in Eq. 12."""
    env = scalar("walker")
    r = 0.25
    corrected = around(env, "input_output", acts_on={"deflection": 1.0}, cutoff_hz=1e6)
    softer = baselines.make("input_output", env, stiffness_scale=1.0 / (1.0 + r))
    observation, _ = env.reset(seed=1)
    wanted, state = corrected.act(observation, np.full((1, 12), r))
    action, softer_state = softer.predict(observation)
    ramp = (
        3.0 * np.abs(action).max() + 1e-6
    )  # the first step of the ramp: the controller's own K differs
    np.testing.assert_allclose(wanted, action, rtol=0.0, atol=ramp)
    plain = baselines.make("input_output", env)
    _, plain_state = plain.predict(observation)
    # type: ignore[attr-defined]
    theta = observation[:12]
    q = plain.link_estimate(observation, plain_state)
    np.testing.assert_allclose(
        corrected.link_estimate(observation, state), theta - (1.0 + r) * (theta - q), atol=1e-15
    )
    exact = softer.link_estimate(observation, softer_state)  # type: ignore[attr-defined]
    np.testing.assert_allclose(
        corrected.link_estimate(observation, state), exact, rtol=0.0, atol=2e-3
    )
    assert np.abs(theta - q).max() > 0.01


def test_the_correction_passes_a_first_order_low_pass() -> None:
    """Catches a cut-off in rad/s, a filter that runs once per decision, and a scale of the wrong
    joint."""
    env = scalar("testbed")
    corrected = around(env, "zero", acts_on={"command": 0.05}, cutoff_hz=3.0)
    observation, _ = env.reset(seed=0)
    state = None
    found = []
    for _ in range(100):
        action, state = corrected.act(observation, np.ones((1, 1)), state)
        found.append(action[0] if action.ndim == 1 else action[0, 0])
    expected = 0.05 * (1.0 - np.exp(-2.0 * math.pi * 3.0 * 0.004 * np.arange(1, 101)))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8)


def test_joints_and_bounds_are_chosen_by_name() -> None:
    """Catches an order of joints that is not the robot's, and a bound that goes to another joint
    or axis."""
    model = scalar("walker").unwrapped.assumed_model  # type: ignore[attr-defined]
    bounds = {"ankle_roll": 0.01, "knee": 0.03}

    def acting(**settings: Any) -> dict[str, float]:
        channels = Channels(model, ResidualSettings(**settings))
        all_of_it = channels.approach(
            np.zeros((1, len(channels.bounds))), np.ones((1, len(channels.signals))), 1.0
        )
        assert all_of_it.tolist() == [channels.bounds.tolist()]
        columns = [
            signal.name for name in settings["acts_on"] for signal in input_signals(name, model)
        ]
        return {
            name: bound
            for name, bound in zip(columns, channels.bounds.tolist(), strict=True)
            if bound
        }

    joints = ("ankle_roll", "l_knee")
    assert acting(acts_on={"command": bounds}, joints=joints) == {
        "command.l_knee": 0.03,
        "command.l_ankle_roll": 0.01,
        "command.r_ankle_roll": 0.01,
    }
    assert acting(acts_on={"deflection": {"r_knee": 0.5}, "zmp": {"y": 0.01}, "hip": None}) == {
        "deflection.r_knee": 0.5,
        "zmp.y": 0.01,
        "hip.roll": 0.02,
        "hip.pitch": 0.02,
    }
    with pytest.raises(ConfigurationError, match=r"'elbow'.*l_hip_yaw"):
        acting(acts_on={"deflection": None}, joints=("elbow",))
    with pytest.raises(ConfigurationError, match=r"every joint of `joints`.*l_ankle_roll"):
        acting(acts_on={"deflection": {"knee": 0.1}}, joints=joints)
    with pytest.raises(ConfigurationError, match=r"unknown axis of an input 'z'.*x, y"):
        acting(acts_on={"zmp": {"z": 0.01}})


@pytest.mark.parametrize(
    ("robot", "base", "acts_on", "mode"),
    [  # each mode on both robots, and each space on the walker
        pytest.param(*BASES[1], AutoresetMode.SAME_STEP, marks=pytest.mark.slow),
        (*BASES[4], AutoresetMode.NEXT_STEP),
        (*BASES[6], AutoresetMode.SAME_STEP),
        pytest.param(*BASES[6], AutoresetMode.NEXT_STEP, marks=pytest.mark.slow),
    ],
)
def test_a_vector_of_worlds_is_the_scalar_wrapper(
    robot: str, base: str, acts_on: str, mode: AutoresetMode
) -> None:
    """Catches rewards that go on after an end, worlds that begin inside a decision, and memories
    that are mixed up."""
    further = {"history": 2, "observe": ["observation", "base_action"], "decision_period": 20}
    n = 2
    generator = np.random.default_rng(0)
    many = ResidualVectorWrapper(vector(robot, n, mode), base, acts_on={acts_on: None}, **further)
    ones = [
        ResidualWrapper(scalar(robot), base, acts_on={acts_on: None}, **further) for _ in range(n)
    ]
    observation, _ = many.reset(seed=5)
    expected = np.stack([one.reset(seed=5 + i)[0] for i, one in enumerate(ones)])
    np.testing.assert_array_equal(observation, expected)
    ended = np.zeros(n, dtype=bool)
    ends = 0
    behind = 0
    while behind < 5:  # decisions after both have ended
        behind += ends >= n
        residual = generator.uniform(-1.0, 1.0, many.action_space.shape)
        observation, reward, terminated, truncated, info = many.step(residual)
        for i, one in enumerate(ones):
            if mode is AutoresetMode.NEXT_STEP and ended[i]:
                alone, _ = one.reset()
                np.testing.assert_array_equal(observation[i], alone)
                assert (reward[i], terminated[i], truncated[i]) == (0.0, False, False)
                ended[i] = False
                continue
            alone, gained, fell, finished, last = one.step(residual[i])
            assert (reward[i], terminated[i], truncated[i]) == (gained, fell, finished)
            if not (fell or finished):
                np.testing.assert_array_equal(observation[i], alone)
                continue
            ends += 1
            final = info["final_obs"][i] if mode is AutoresetMode.SAME_STEP else observation[i]
            np.testing.assert_array_equal(final, alone)
            of_episode = info["final_info"] if mode is AutoresetMode.SAME_STEP else info
            for name, value in last["episode_metrics"].items():
                np.testing.assert_array_equal(of_episode["episode_metrics"][name][i], value)
            if mode is AutoresetMode.SAME_STEP:
                np.testing.assert_array_equal(observation[i], one.reset()[0])
            else:
                ended[i] = True


def test_restarts_in_a_row_lose_nothing() -> None:
    """Catches a second restart that forgets the first, and one that moves the history of worlds
    that go on."""

    def made() -> ResidualVectorWrapper:
        env = ResidualVectorWrapper(vector("testbed", 3), "input", history=2)
        env.reset(seed=3)
        return env

    env = made()
    generator = np.random.default_rng(4)
    for _ in range(12):
        before, *_ = env.step(generator.uniform(-1.0, 1.0, (3, 1)))
    for world in (0, 1):
        seeds = [None] * 3
        seeds[world] = 3 + world  # type: ignore[call-overload]
        after, _ = env.reset(seed=seeds, options={"reset_mask": np.arange(3) == world})
    np.testing.assert_array_equal(after[2], before[2])
    anew = made()
    residual = np.zeros((3, 1))
    later = env.step(residual)[0]
    fresh = anew.step(residual)[0]
    np.testing.assert_array_equal(later[:2], fresh[:2])
    # six columns of the observation, then encoder and its rate at the last decision and at the one
    # before
    np.testing.assert_array_equal(later[2, 6:], [*before[2, :2], *before[2, 6:8]])
    for _ in range(12):
        residual = generator.uniform(-1.0, 1.0, (3, 1))
        one = env.step(residual)[0]
        other = anew.step(residual)[0]
        np.testing.assert_array_equal(one[:2], other[:2])


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("robot", ["walker", "testbed"])
def test_checkers_of_gymnasium_and_sb3_pass(robot: str) -> None:
    """Catches an observation outside its space, a reset that does not seed, and an info that is
    no dictionary."""
    base = "input_output" if robot == "walker" else "input"
    check_env(ResidualWrapper(scalar(robot), base, history=1), skip_render_check=True)
    check_env_of_sb3(ResidualWrapper(scalar(robot), base))


def test_residuals_that_are_no_residuals_are_refused() -> None:
    """Catches a wrong shape that broadcasts, and nan."""
    env = ResidualWrapper(scalar("testbed"), "input")
    env.reset(seed=0)
    for wrong in (np.zeros(2), np.array([np.nan]), 0.5):
        with pytest.raises(ActionError, match="finite numbers of shape"):
            env.step(wrong)
    with pytest.raises(ConfigurationError, match="must be SameStep"):
        SB3VecEnv(vector("testbed", 2, AutoresetMode.NEXT_STEP))


def test_sb3_gets_ends_as_it_reads_them() -> None:
    """Catches a time limit that looks like a fall, a terminal observation of the next episode,
    and wrong returns."""
    venv = SB3VecEnv(ResidualVectorWrapper(vector("testbed", 2), "input"))
    venv.seed(3)
    venv.reset()
    total = np.zeros(2)
    length = 0
    while True:
        observation, reward, done, infos = venv.step(np.zeros((2, 1)))
        total = total + reward
        length = length + 1
        if done.any():
            break
        assert infos == [{}, {}]
    assert done.all()
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["episode"]["r"] == pytest.approx(total[i], rel=1e-5)
        assert info["episode"]["l"] == length
        assert np.isfinite(info["episode_metrics"]["link_error_rms_rad"])
        assert not np.array_equal(info["terminal_observation"], observation[i])


@cache
def trained(algorithm: Any) -> tuple[Any, VecNormalize, ResidualVectorWrapper]:
    """A little training on the testbed."""
    options = {PPO: {"n_steps": 4, "batch_size": 16}, SAC: {"learning_starts": 8}}[algorithm]
    torch.set_num_threads(1)
    env = ResidualVectorWrapper(vector("testbed", 4), "input", history=1)
    venv = VecNormalize(SB3VecEnv(env))
    model = algorithm(
        "MlpPolicy", venv, device="cpu", seed=0, policy_kwargs={"net_arch": [16, 16]}, **options
    )
    model.set_logger(Logger(folder=None, output_formats=[]))  # SB3's own makes a folder in /tmp
    model.learn(16)
    return model, venv, env


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_the_numpy_forward_pass_is_that_of_sb3(algorithm: Any, tmp_path: Path) -> None:
    """Catches a layer, an activation, a normalisation or a squashing that is not the one that
    was trained."""
    model, venv, env = trained(algorithm)
    tensors, kind = network_of(model, venv)
    description = ResidualDescription(robot="testbed", base="input", settings=env.settings, **kind)
    save_residual(tmp_path / "r", description, tensors)
    read, network = load_residual(tmp_path / "r")
    assert read.replace(weights_sha256=None) == description
    features = (
        np.random.default_rng(1).normal(size=(100, network.num_features)) * tensors["std"] * 3.0
        + tensors["mean"]
    )
    expected, _ = model.predict(venv.normalize_obs(features), deterministic=True)
    np.testing.assert_allclose(network(features), expected, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(network(features[3:4])[0], network(features)[3], rtol=0.0, atol=1e-6)
    assert np.abs(expected).max() > 1e-3


def test_a_model_of_sb3_is_exported_only_where_it_is_trusted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches code that is run unasked, and an export that loses the normalisation or the
    settings."""
    monkeypatch.chdir(tmp_path)
    model, venv, env = trained(PPO)
    model.save("mine.zip")
    venv.save("normaliser.pkl")
    given = {"env": "testbed", "base": "input", "settings": env.settings.model_dump(mode="json")}
    Path("c.yaml").write_text(json.dumps(given))
    arguments = ["export", "sb3", "mine.zip", "c.yaml", "--normaliser", "normaliser.pkl"]
    loaded = []
    monkeypatch.setattr(
        "train.learn.export.algorithm_class", lambda name: loaded.append(name) or PPO
    )
    with pytest.raises(SystemExit):
        main(arguments)
    assert "--trust-pickle" in capsys.readouterr().err
    assert loaded == []
    assert not Path("runs").exists()
    main([*arguments, "--trust-pickle"])
    description, network = load_residual(Path("runs/mine"))
    assert (description.base, description.settings) == ("input", env.settings)
    features = np.random.default_rng(1).normal(size=(20, network.num_features))
    expected, _ = model.predict(venv.normalize_obs(features), deterministic=True)
    np.testing.assert_allclose(network(features), expected, rtol=0.0, atol=1e-6)
    Path("c.yaml").write_text(
        json.dumps({**given, "settings": {**given["settings"], "history": 3}})
    )
    with pytest.raises(SystemExit):
        main([*arguments, "--trust-pickle", "--output", "runs/other"])
    assert re.search(
        r"takes \d+ features and gives 1 residuals, a residual on input of the testbed",
        capsys.readouterr().err,
    )
    Path("no.zip").write_bytes(b"nothing")
    with pytest.raises(SystemExit):
        main(["export", "sb3", "no.zip", "c.yaml", "--trust-pickle"])
    assert "no.zip is no model" in capsys.readouterr().err


def test_the_error_of_links_with_encoders_is_that_of_the_simulation() -> None:
    """Catches a sign, and an encoder of the motor in the place of the link's."""
    env: Any = gymnasium.make(
        "elastic_env/Robot-v0", scenario="ideal+soft", sensors=["link_encoder"]
    )
    corrected = around(env, "input", observe=("link_error",), decision_period=1)
    features = Features(corrected)
    none = np.zeros(env.action_space.shape, dtype=np.float32)
    observation, info = env.reset(seed=0)
    for _ in range(100):
        observation, _, _, _, info = env.step(none)
    errors, _ = features.at(observation[None], None, np.ones(1, dtype=np.bool_), None, None)
    truth = [info[f"link_error_{which}"] for which in ("lowest", "highest")]
    assert max(np.abs(truth)) > 5e-3
    np.testing.assert_allclose([errors.min(), errors.max()], truth, rtol=0.0, atol=1e-3)
    env = gymnasium.make("elastic_env/Robot-v0")
    with pytest.raises(ConfigurationError, match=r"link_error.*encoder_error"):
        Features(around(env, "input", observe=("link_error",)))


def test_errors_of_the_contact_are_those_of_the_simulation() -> None:
    """Catches a sign, a frame, the weight of the feet left out, and the wrong foot: held against
    the true ZMP."""
    env: Any = vector("walker", 2, scenario="ideal")
    seen_by = ("observation", "encoder_error", "contact_error")
    corrected = around(env, "input_output", observe=seen_by, decision_period=1)
    base = baselines.make("input_output", env)
    state = None
    table = env.unwrapped.assumed_model.observation_table
    features = Features(corrected)
    observation, info = env.reset(seed=0)
    seen = []
    true = []
    share = []
    memory = None
    fresh = np.ones(2, dtype=np.bool_)
    for step in range(450):
        values, memory = features.at(observation, memory, fresh, None, None)
        errors = values[:, len(table) :]
        fresh = np.zeros(2, dtype=np.bool_)
        np.testing.assert_array_equal(
            errors[:, :12],
            observation[:, table.group("encoder_angle")]
            - observation[:, table.group("reference_angle")],
        )
        if step > 0:
            seen.append(errors[:, 12:14])
            share.append(errors[:, 14])
            true.append(
                np.stack(
                    [info[f"zmp_{axis}"] - info[f"zmp_reference_{axis}"] for axis in "xy"], axis=1
                )
            )
        action, state = base.predict(observation, state, np.full(2, step == 0))
        observation, _, _, _, info = env.step(action)
    assert np.sqrt(np.mean(np.square(share))) < 0.1  # half of the weight and more on the wrong foot
    difference = np.array(seen) - np.array(true)
    assert np.sqrt(np.mean(np.square(true))) > 2e-3
    # the ground's tilt is known to 2 mrad, on which the center of mass stands 0.66 m high
    np.testing.assert_allclose(
        np.sqrt(np.mean(np.square(difference), axis=(0, 1))), 0.0, atol=1.4e-3
    )


def test_residuals_see_what_they_are_told_to() -> None:
    """Catches another order, and a history of what is no measurement or of another group."""
    env: Any = vector("walker", 2)
    table = env.unwrapped.assumed_model.observation_table
    generator = np.random.default_rng(0)
    features = Features(
        around(
            env,
            "input_output",
            observe=("imu_rate", "clock.swing", "load_share", "bending"),
            history=2,
        )
    )
    rates = np.arange(len(table))[table.group("imu_rate")]
    rows = generator.normal(size=(5, 2, len(table)))
    memory = None
    seen = np.zeros((2, 0))
    for decision in range(5):
        fresh = np.array([decision in (0, 3), decision == 0])
        seen, memory = features.at(rows[decision], memory, fresh, None, None)
    assert seen.shape == (2, features.width) == (2, 3 + 2 + len(BendingObserver.signals) + 2 * 3)
    np.testing.assert_array_equal(seen[:, :3], rows[4][:, rates])
    np.testing.assert_array_equal(seen[:, [3]], rows[4][:, table.group("clock.swing")])
    np.testing.assert_array_equal(seen[:, [4]], rows[4][:, table.group("load_share")])
    np.testing.assert_array_equal(
        seen[1, -6:], np.concatenate([rows[3][1, rates], rows[2][1, rates]])
    )
    np.testing.assert_array_equal(
        seen[0, -6:], np.concatenate([rows[3][0, rates], rows[3][0, rates]])
    )


def test_the_base_action_is_enough_to_see() -> None:
    """Catches features that need a source beside it."""
    env = scalar("testbed")
    corrected = around(env, "input", observe=("base_action",))
    rows, _ = env.reset(seed=0)
    seen, _ = Features(corrected).at(rows[None], None, np.ones(1, dtype=np.bool_), None, None)
    np.testing.assert_array_equal(seen, corrected.base_action(rows[None], None, None))


@pytest.mark.parametrize(
    ("robot", "observe", "message"),
    [
        ("testbed", ("bending",), "'bending'"),
        ("walker", ("clocks",), "clock"),
        ("walker", ("observation", "clock"), "clock are there twice"),
        ("walker", (), "observe"),
    ],
)
def test_features_that_do_not_exist_are_refused(
    robot: str, observe: tuple[str, ...], message: str
) -> None:
    """Catches a name that is ignored, and a message that does not help."""
    base = "input" if robot == "testbed" else "input_output"
    with pytest.raises(ConfigurationError, match=message):
        Features(around(vector(robot, 2), base, observe=observe))


@cache
def robot_of(robot: str) -> Any:
    """An environment whose policies every shipped residual of the robot can correct."""
    walk = {"step_period": 1.1, "num_steps": 1}  # which has a table over the phase
    options = {"robot": {"sensors": ["link_encoder"]}, "walker": walk}
    kinds = {"robot": "elastic_env/Robot-v0", "walker": WALKER, "testbed": TESTBED}
    return gymnasium.make(kinds[robot], **options.get(robot, {}))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name.endswith("/seed_0") else pytest.mark.slow)
        for name in shipped_names()
    ],
)
def test_residuals_that_come_with_the_package_are_found_by_name(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a name that only works in the source tree, and a folder that was damaged or left
    out."""
    monkeypatch.chdir(tmp_path)
    env = robot_of(read_description(Path(name)).robot)
    policy: Any = baselines.make(f"residual:{name}", env)
    assert policy.corrected.settings == read_description(Path(name)).settings


def test_a_residual_of_a_folder_plays_what_the_wrapper_decided(tmp_path: Path) -> None:
    """Catches a policy that decides at other steps, on other features, or around another base
    than in training."""
    env = scalar("walker")
    settings: Any = {"history": 2, "observe": ("observation", "base_action"), "decision_period": 10}
    corrected = around(env, "input_output", **settings)
    network = random_network(corrected, 0.3)
    wrapper = ResidualWrapper(
        scalar("walker"),
        "input_output",
        history=2,
        observe=("observation", "base_action"),
        decision_period=10,
    )
    features, _ = wrapper.reset(seed=3)
    seen = played(env, ResidualPolicy(corrected, network), 60)
    for decision in range(6):
        np.testing.assert_array_equal(features[:95], seen[10 * decision])
        features, *_ = wrapper.step(network(features[None])[0])
    np.testing.assert_array_equal(features[:95], seen[60])


def folder(path: Path) -> Path:
    """A residual for the testbed that is valid."""
    env = scalar("testbed")
    corrected = around(env, "input")
    width = Features(corrected).width
    tensors = {
        "mean": np.zeros(width),
        "std": np.ones(width),
        "weight0": np.zeros((4, width)),
        "bias0": np.zeros(4),
        "weight1": np.zeros((1, 4)),
        "bias1": np.zeros(1),
    }
    save_residual(path, ResidualDescription(robot="testbed", base="input"), tensors)
    return path


def test_make_reads_a_residual_and_runs_it_on_many_worlds(tmp_path: Path) -> None:
    """Catches a residual that only its training can use."""
    path = folder(tmp_path / "r")
    envs = vector("testbed", 3, AutoresetMode.NEXT_STEP)
    policy = baselines.make(f"residual:{path}", envs)
    base = baselines.make("input", envs)
    observation, _ = envs.reset(seed=0)
    np.testing.assert_array_equal(policy.predict(observation)[0], base.predict(observation)[0])
    with pytest.raises(ConfigurationError, match="for the testbed, the environment is the walker"):
        baselines.make(f"residual:{path}", scalar("walker"))
    description, _ = load_residual(path)
    (path / "residual.json").write_text(description.replace(joints=["elbow"]).model_dump_json())
    with pytest.raises(ConfigurationError, match=r"joints elbow; the environment's has [a-z]+$"):
        baselines.make(f"residual:{path}", envs)


def damaged(path: Path, **changes: Any) -> None:
    """Change tensors of a residual, and leave out their digest; None leaves one out."""
    tensors = load_file(path / "weights.safetensors") | changes
    save_file(
        {name: value for name, value in tensors.items() if value is not None},
        path / "weights.safetensors",
    )
    description = ResidualDescription(**json.loads((path / "residual.json").read_text()))
    (path / "residual.json").write_text(description.replace(weights_sha256=None).model_dump_json())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mean": None}, "must be mean, std, weight0"),
        ({"bias1": np.array([np.nan])}, "finite"),
        ({"std": np.zeros(6)}, "positive"),
        ({"weight0": np.zeros((4, 5))}, r"shape \(4, 6\), got \(4, 5\)"),
        (
            {"mean": np.zeros(7), "std": np.ones(7), "weight0": np.zeros((4, 7))},
            "must take 6 features.*it has 7",
        ),
    ],
)
def test_a_damaged_residual_says_what_is_wrong(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """Catches weights that run although they belong to something else."""
    path = folder(tmp_path / "r")
    damaged(path, **changes)
    with pytest.raises(ConfigurationError, match=message):
        baselines.make(f"residual:{path}", scalar("testbed"))


def test_weights_that_were_changed_are_refused(tmp_path: Path) -> None:
    """Catches weights of another training beside the description of this one."""
    path = folder(tmp_path / "r")
    save_file(
        load_file(path / "weights.safetensors") | {"bias1": np.ones(1)},
        path / "weights.safetensors",
    )
    with pytest.raises(
        ConfigurationError,
        match=r"weights\.safetensors was changed: residual\.json names the SHA-256",
    ):
        baselines.make(f"residual:{path}", scalar("testbed"))


@pytest.mark.parametrize("file", ["residual.json", "weights.safetensors"])
@pytest.mark.parametrize("kind", ["pipe", "huge", "device", "link", "folder"])
def test_a_residual_consists_of_plain_files_of_its_own(
    kind: str, file: str, tmp_path: Path
) -> None:
    """Catches 3 GB that are read to be refused, a pipe that is waited for, and a file of
    somebody else's."""
    path = folder(tmp_path / "r")
    (path / file).rename(tmp_path / "elsewhere")
    {
        "pipe": lambda: os.mkfifo(path / file),
        "huge": lambda: ((path / file).touch(), os.truncate(path / file, 3_000_000_000)),
        "device": lambda: (path / file).symlink_to("/dev/zero"),
        "link": lambda: (path / file).symlink_to(tmp_path / "elsewhere"),
        "folder": lambda: (path / file).mkdir(),
    }[kind]()
    said = {"pipe": "must be a plain file", "huge": "must have at most", "folder": "Is a directory"}
    with pytest.raises(
        ConfigurationError, match=said.get(kind, "is a link out of its folder; copy the file there")
    ):
        load_residual(path)


def test_a_residual_may_lie_behind_a_link(tmp_path: Path) -> None:
    """Catches a refusal of runs/latest/seed_0/last."""
    path = folder(tmp_path / "r")
    (tmp_path / "latest").symlink_to(path)
    assert load_residual(tmp_path / "latest")[0] == load_residual(path)[0]


@pytest.mark.parametrize("name", shipped_names())
def test_residuals_of_the_package_are_those_that_a_commit_of_the_history_trained(name: str) -> None:
    """Catches weights that were changed after training, or that code trained which nobody can
    look up."""
    description, _ = load_residual(Path(name))
    assert description.weights_sha256 is not None
    assert description.origin.commit is not None
    assert re.fullmatch("[0-9a-f]{40}", description.origin.commit), (
        "trained by changes that were not committed"
    )
    if (ROOT / ".git").exists() and git("rev-parse", "--is-shallow-repository") == "false":
        git("merge-base", "--is-ancestor", description.origin.commit, "HEAD")


def git(*arguments: str) -> str:
    """Output of git in this checkout; it must succeed."""
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments], check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


def test_a_folder_that_is_no_residual_says_what_is_needed(tmp_path: Path) -> None:
    """Catches a traceback for a path that is wrong, text that is no JSON, and a description of
    something else."""
    env = scalar("testbed")
    with pytest.raises(ConfigurationError, match=r"no residual at .*residual\.json"):
        baselines.make(f"residual:{tmp_path}", env)
    path = folder(tmp_path / "r")
    best, last = [folder(tmp_path / "seed" / name) for name in ("best", "last")]
    name = "seed"
    with pytest.raises(
        ConfigurationError, match=rf"give one of them: {last}, {best}$"
    ):  # the best one flatters itself
        baselines.make(f"residual:{tmp_path / name}", env)
    shutil.rmtree(tmp_path / name)
    with pytest.raises(
        ConfigurationError, match=rf"is no residual but has some inside; give one of them: {path}$"
    ):
        baselines.make(f"residual:{tmp_path}", env)
    silent = json.dumps({"robot": "testbed"})
    for text, message in (
        ("{", "is not JSON"),
        ("[]", "must be a mapping, got list"),
        (silent, "base"),
    ):
        (path / "residual.json").write_text(text)
        with pytest.raises(ConfigurationError, match=message):
            baselines.make(f"residual:{path}", env)
    path = folder(tmp_path / "s")
    (path / "weights.safetensors").write_bytes(b"\x80\x04pickle")
    with pytest.raises(ConfigurationError, match="cannot be read: it is missing, cut"):
        baselines.make(f"residual:{path}", env)


@pytest.mark.parametrize(
    "mode",
    [
        AutoresetMode.SAME_STEP,
        AutoresetMode.NEXT_STEP,
        pytest.param(AutoresetMode.DISABLED, marks=pytest.mark.slow),
    ],
)
def test_the_environment_under_a_wrapper_stays_as_it_was(mode: AutoresetMode) -> None:
    """Catches a wrapper that changes how the caller's own environment restarts."""
    moment = {"kind": "sine", "duration_s": 0.1, "onset_s": 0.1, "amplitude": 0.02}
    env, alone = (vector("testbed", 2, mode, reference=moment) for _ in range(2))
    wrapped = ResidualVectorWrapper(env, "input")
    wrapped.reset(seed=3)
    wrapped.step(np.zeros(wrapped.action_space.shape))
    assert env.unwrapped.autoreset_mode is env.metadata["autoreset_mode"] is mode
    assert wrapped.metadata["autoreset_mode"] is mode
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    for mine in (env, alone):
        mine.reset(seed=3)
    for _ in range(alone.unwrapped.task.num_steps + 3):
        np.testing.assert_array_equal(env.step(action)[0], alone.step(action)[0])
