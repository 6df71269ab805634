"""Teachers, whose actors see the true robot: what they see, and that no robot plays them."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

import baselines
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.residual_folder import load_residual, save_residual
from baselines.residual.settings import (
    TRUE_QUANTITIES,
    ResidualDescription,
    ResidualSettings,
)
from baselines.residual.true_robot import truth_of
from baselines.residual_env import ResidualVectorWrapper
from elastic_env.core.errors import ConfigurationError
from elastic_env.robots.thormang.environment import make as make_walk
from tests.test_training import interrupted_after
from train.learn.export import export_zip
from train.learn.train_config import TrainConfig, training_worlds
from train.learn.training import Training

QUICK: dict[str, Any] = {"step_period": [0.3, 0.4, 0.3], "num_steps": 2}


def teacher(**settings: Any) -> ResidualSettings:
    """A teacher that sees all there is."""
    return ResidualSettings(observe=("clock.swing",), privileged=TRUE_QUANTITIES, **settings)


def test_a_teacher_sees_the_robot_that_was_drawn() -> None:
    """Catches a moment of the load about another axis, a slope of another direction, and figures
    of the robot before."""
    env = make_walk(**QUICK, scenario="drawn")
    task = env.unwrapped.task
    features = Features(
        Corrected(
            baselines.make("input_output", env),
            env.unwrapped.assumed_model,
            teacher(),
            truth_of(env),
        )
    )
    names = [signal.name for signal in features.signals]
    for seed in (0, 1):
        observation, _ = env.reset(seed=seed)
        found, _ = features.at(observation[None], None, np.ones(1, np.bool_), None, True)
        seen = dict(zip(names, found[0].tolist(), strict=True))
        robot = task._robots[0]
        K = np.array(robot.stiffness) - 1.0
        joints = env.unwrapped.assumed_model.joint_names
        np.testing.assert_allclose([seen[f"true_stiffness.{name}"] for name in joints], K)
        assert seen["true_backlash.l_knee"] == pytest.approx(robot.backlash_rad)
        assert seen["true_friction.factor"] == robot.friction
        assert seen["true_load.mass"] == robot.load_kg
        assert seen["true_load.forward"] == robot.load_kg * robot.load_x_m
        assert seen["true_load.left"] == robot.load_kg * robot.load_y_m
        rise = np.hypot(seen["true_slope.forward"], seen["true_slope.left"])
        assert rise == pytest.approx(robot.slope_rad)
        direction = np.arctan2(seen["true_slope.left"], seen["true_slope.forward"])
        turned = (direction - robot.slope_direction_rad) / (2.0 * np.pi)
        assert turned == pytest.approx(round(turned), abs=1e-9)
    named = make_walk(**QUICK, scenario="payload+slope")
    named.reset(seed=0)
    assert named.unwrapped.truth().load[0].tolist() == pytest.approx([5.0, 5.0 * 0.0056, 0.0])
    assert np.hypot(*named.unwrapped.truth().slope[0]) == pytest.approx(np.deg2rad(1.0))


def test_a_teacher_of_a_mixture_sees_every_world_its_own_robot() -> None:
    """Catches robots of another environment of the mixture."""
    config = TrainConfig(
        env="walker",
        reference=[0.3, 0.4, 0.3],
        scenarios=["soft", "payload"],
        worlds=4,
        base="foothold",
        settings={"observe": ["clock.swing"], "privileged": ["stiffness", "load"], "mirror": True},
    )
    worlds = training_worlds(config, config.shares, 1)
    features, _ = worlds.reset(seed=0)
    soft = np.repeat([-0.3, 0.0], 2)
    np.testing.assert_allclose(features[:, 1:13], np.repeat(soft[:, None], 12, axis=1), atol=1e-12)
    np.testing.assert_array_equal(features[:, 13], [0.0, 0.0, 5.0, 5.0])
    features, *_ = worlds.step(np.zeros(worlds.action_space.shape))
    np.testing.assert_array_equal(features[:, 13], [0.0, 0.0, 5.0, 5.0])


def test_no_robot_plays_a_teacher(tmp_path: Path) -> None:
    """Catches a policy that looks deployable and reads the simulation."""
    env = make_walk(**QUICK)
    model = env.unwrapped.assumed_model
    with pytest.raises(ConfigurationError, match=r"true stiffness, .*no residual for a robot"):
        Features(Corrected(baselines.make("input_output", env), model, teacher()))
    testbed: Any = gymnasium.make_vec(
        "elastic_env/Testbed-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    with pytest.raises(ConfigurationError, match=r"only the simulation of a walker knows"):
        ResidualVectorWrapper(testbed, "input", privileged=["load"])
    config = TrainConfig(env="walker", settings=teacher())
    with pytest.raises(ConfigurationError, match=r"a teacher, .*is not exported"):
        export_zip(tmp_path / "model.zip", config, tmp_path / "out", trust_pickle=True)
    with pytest.raises(ConfigurationError, match=r"unknown quantity that a teacher sees 'mass'"):
        ResidualSettings(privileged=["mass"])


def test_a_teacher_is_played_in_simulation_to_know_the_ceiling(tmp_path: Path) -> None:
    """Catches a teacher that is scored without what it sees, or as one trained policy of many."""
    env = make_walk(**QUICK, scenario="payload")
    settings = ResidualSettings(
        observe=("clock.swing",), privileged=("load",), acts_on={"hip": {"pitch": 0.01}}
    )
    tensors = {
        "mean": np.zeros(4),
        "std": np.ones(4),
        "weight0": np.array([[0.0, 0.1, 0.0, 0.0]]),
        "bias0": np.zeros(1),
    }
    joints = env.unwrapped.assumed_model.joint_names
    description = ResidualDescription(
        robot="walker", joints=joints, base="foothold", settings=settings
    )
    save_residual(tmp_path / "teacher", description, tensors)
    policy: Any = baselines.make(f"residual:{tmp_path / 'teacher'}", env)
    observation, _ = env.reset(seed=0)
    _, state = policy.predict(observation)
    np.testing.assert_allclose(state.residual, [[0.5]])


CRITIC: dict[str, Any] = {
    "env": "walker",
    "reference": [0.2, 0.3, 0.2],
    "scenarios": ["drawn"],
    "base": "foothold",
    "worlds": 2,
    "decisions": 32,
    "evaluate_every": 32,
    "checkpoint_every": 32,
    "evaluation_episodes": 1,
    "env_options": {"num_steps": 1},
    "settings": {"observe": ["clock.swing", "standing", "landing"], "mirror": True},
    "critic_sees": ["load", "mounting"],
    "algorithm_options": {"n_steps": 8, "batch_size": 8, "n_epochs": 2},
}


def test_the_truth_that_a_critic_sees_is_none_of_the_residual(tmp_path: Path) -> None:
    """Catches an actor that reads the truth, an export of other columns, and a critic that does
    not see it."""
    training = Training(TrainConfig(**CRITIC), 0, tmp_path, threads=1)
    with pytest.raises(KeyboardInterrupt):
        training.run(interrupted_after(16))  # before its policy is played
    policy = training.model.policy
    seen = np.random.default_rng(0).normal(size=(5, 10 + 5)).astype(np.float32)
    other = seen.copy()
    other[:, 10:] += 1.0
    with torch.no_grad():
        actions, values = (
            [call(torch.as_tensor(rows)) for rows in (seen, other)]
            for call in (lambda rows: policy.get_distribution(rows).mode(), policy.predict_values)
        )
    assert torch.equal(*actions)
    assert not torch.allclose(*values)
    description, network = load_residual(training._keep_policy("last"))
    assert network.num_features == 10
    assert description.settings.privileged == ()
    statistics = training.model.get_vec_normalize_env().obs_rms
    std = np.sqrt(statistics.var[:10] + 1e-8)
    raw = statistics.mean[:10] + std * seen[:, :10]
    expected = np.clip(actions[0].numpy(), -1.0, 1.0)
    np.testing.assert_allclose(network(raw), expected, rtol=0, atol=1e-6)


def test_a_critic_sees_the_true_robot_in_the_mirror_where_the_actor_is() -> None:
    """Catches truth of other worlds, and a load that hangs on the other side of a mirrored step."""
    config = TrainConfig(**{**CRITIC, "env_options": {"num_steps": 2}})
    worlds = training_worlds(config, [("drawn", 2)], 1)
    features, _ = worlds.reset(seed=0)
    truth = worlds.unwrapped.envs[0].truth()
    assert worlds.actor_features == 10
    np.testing.assert_array_equal(features[:, 10:], np.hstack([truth.load, truth.mounting]))
    for _ in range(19):  # into the second step, which stands on the right foot
        features, *_ = worlds.step(np.zeros(worlds.action_space.shape))
    truth = worlds.unwrapped.envs[0].truth()
    mirrored = np.hstack([truth.load * [1, 1, -1], truth.mounting * [-1, 1]])
    np.testing.assert_array_equal(features[:, 10:], mirrored)


def test_a_training_without_such_a_critic_is_read_back() -> None:
    """Catches an empty list that the defaults have and a file may not."""
    config = TrainConfig()
    assert TrainConfig.model_validate(config.model_dump(mode="json")) == config


def test_a_critic_of_actions_sees_no_truth() -> None:
    """Catches a key that is taken and has no effect."""
    with pytest.raises(ConfigurationError, match=r"critic_sees is for PPO and A2C.*got SAC"):
        TrainConfig(**{**CRITIC, "algorithm": "SAC", "algorithm_options": {}})
    with pytest.raises(ConfigurationError, match=r"unknown quantity that a critic sees 'mass'"):
        TrainConfig(**{**CRITIC, "critic_sees": ["mass"]})
