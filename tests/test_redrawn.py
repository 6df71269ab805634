"""Inputs whose checks a redrawing once moved or lost."""

import os
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import NO_INPUTS
from baselines.identification.servo_file import is_servo_log
from baselines.identification.servo_log import read_servo_log
from elastic_env.core.config import quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.mujoco_friction import VaryingFriction
from elastic_env.robots.robot.environment import EXAMPLE
from elastic_env.robots.robot.joints import home_of_joints
from elastic_env.world.joint_config import RewardWeights

TESTBED = "elastic_env/Testbed-v0"


def test_the_oracle_takes_inputs_that_correct_what_it_knows() -> None:
    """Catches an error where the old one had none, and a correction of the true deflection.

    On the walker the controller inside takes the correction, which moves the offset a little.
    """
    for name, size, tolerance in ((TESTBED, 1, 0.0), ("elastic_env/WalkInPlace-v0", 12, 0.02)):
        env = gymnasium.make(name)
        observation, _ = env.reset(seed=0)
        policy = baselines.make("oracle", env)
        state = None
        for _ in range(300):  # beyond the ramp
            action, state = policy.predict(observation, state)
            observation, *_ = env.step(action)
        plain, _ = policy.predict(observation, state)
        inputs = NO_INPUTS._replace(deflection=np.full((1, size), 0.1))
        corrected, _ = policy.predict(observation, state, inputs=inputs)
        assert np.abs(corrected - plain).max() <= tolerance * np.abs(plain).max()
        if size > 1:
            inputs = NO_INPUTS._replace(zmp=np.full((1, 2), 0.01))
            action, _ = policy.predict(observation, state, inputs=inputs)
            assert np.isfinite(action).all()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"observe_link": "false"}, "observe_link must be true or false, got 'false'"),
        ({"observe_link": True, "sensors": 5}, "sensors must be a list, got 5"),
    ],
)
def test_observe_link_is_true_or_false(arguments: dict[str, Any], said: str) -> None:
    """Catches text that counts as true."""
    with pytest.raises(ConfigurationError, match=said):
        gymnasium.make(TESTBED, **arguments)


class MyWeights(RewardWeights):
    energy: float = quantity("1", 1.0, ge=0)


def test_weights_of_further_terms_are_taken() -> None:
    """Catches a weight that the testbed's own terms do not have."""
    gymnasium.make(TESTBED, reward=MyWeights())


def test_numbers_of_a_model_that_end_like_ours_are_not_ours() -> None:
    """Catches a joint that the model does not have."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><custom><numeric name="x_dry_friction" data="1 2 3 4"/></custom>
        <worldbody><body><joint name="one"/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    assert VaryingFriction(model).joints == []


def test_home_keeps_off_a_limit_on_one_side() -> None:
    """Catches a home on the stop, from which no reference can leave."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><compiler angle="radian"/><worldbody><body><geom size=".1"/>
        <joint name="one" range="0.5 1000"/></body></worldbody></mujoco>"""
    )
    assert home_of_joints(model, ["one"]).tolist() == [0.6]


def test_joints_that_are_no_mapping_are_refused() -> None:
    """Catches a traceback of a path."""
    with pytest.raises(ConfigurationError, match="joints must be a YAML file or a mapping"):
        gymnasium.make("elastic_env/Robot-v0", model=EXAMPLE, joints=5)


@pytest.mark.parametrize("name", ["log.csv", "log.json", "log.parquet"])
def test_a_pipe_in_the_place_of_a_log_is_not_waited_for(name: str, tmp_path: Path) -> None:
    """Catches a reader that opens a named pipe, also to see what kind of log it is."""
    pipe = tmp_path / name
    os.mkfifo(pipe)
    assert is_servo_log(pipe) == (name != "log.csv")
    with pytest.raises(ConfigurationError, match="log"):
        read_servo_log(pipe)
