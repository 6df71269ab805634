"""Servos that give way by up to two radians: every pose is solved, or its two rests are named."""

import re
import warnings
from functools import cache

import numpy as np
import pytest

from baselines import PositionCompensator
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.robots.robot.environment import configure_robot
from elastic_env.world.joint_plant import JointPlant

WEIGHT_NM = 0.4905
K = 40.0
PENDULUM = """<mujoco><compiler angle="radian"/><worldbody><body name="link">
  <joint name="servo" axis="0 -1 0"/>
  <inertial mass="0.5" pos="0 0 -0.1" diaginertia="0.0005 0.0005 0.0005"/></body></worldbody>
</mujoco>"""
RATIOS = [0.5, 1.5, 2.0]
"""m g l / k_p."""


@cache
def plant(ratio: float) -> JointPlant:
    """The pendulum in Robot-v0, on a servo that gives way."""
    servo = {"position_gain": WEIGHT_NM / ratio, "torque_limit": 3.0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        config = configure_robot(
            PENDULUM, {"servo": {"stiffness": K, "servo": servo}}, scenario="ideal"
        )
        return config.robot.plant(config)


def rests(command: float, ratio: float) -> Array:
    """All stable rests within half a turn of a command, by a grid [rad]."""
    stiffness = 1.0 / (ratio / WEIGHT_NM + 1.0 / K)
    grid = np.linspace(command - np.pi, command + np.pi, 20_001)
    values = stiffness * (grid - command) + WEIGHT_NM * np.sin(grid)
    return grid[np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))]


@pytest.mark.parametrize("ratio", RATIOS)
def test_any_command_of_a_soft_servo_has_a_rest_or_two_names(ratio: float) -> None:
    """Catches an episode that cannot begin, and a pose that is refused without its name."""
    for command in np.linspace(-np.pi, np.pi, 37):
        known = rests(command, ratio)
        try:
            q = plant(ratio).rest_angle(np.array([[command]]))
        except ElasticError as error:
            named = [float(angle) for angle in re.findall(r"at (-?[\d.]+) rad", str(error))]
            np.testing.assert_allclose(sorted(named), known, atol=2e-3)
        else:
            assert np.abs(known - q).min() < 1e-3


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_command_brings_a_soft_servo_where_it_should_be(ratio: float) -> None:
    """Catches an offset that is cut or of the wrong pose; the command of a pose needs no search."""
    compensator = PositionCompensator.from_model(
        PENDULUM, K, position_gain=WEIGHT_NM / ratio, limit_rad=3.0
    )
    compliance = 1.0 / K + ratio / WEIGHT_NM
    for q in np.linspace(-1.1, 1.1, 13):  # beyond, commands pass the top
        command = compensator.command([q])
        assert command[0] == pytest.approx(q + compliance * WEIGHT_NM * np.sin(q), rel=1e-12)
        assert plant(ratio).rest_angle(command[None])[0, 0] == pytest.approx(q, abs=1e-9)
