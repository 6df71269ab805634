"""An arm of seven joints: calls of the compensator for live robots, and the torque of a batch link
by link.

Compare within a group of one run only.
"""

from typing import Any

import mujoco
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from baselines import PositionCompensator
from elastic_env.rigid.rigid_body import RigidBody
from tests.test_tree import ByPinocchio

JOINTS = [f"joint{i}" for i in range(7)]


def arm() -> mujoco.MjModel:
    """Links of 0.15 m, turning and bending in turn."""
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for i, name in enumerate(JOINTS):
        body = body.add_body(
            name=f"link{i}", pos=[0, 0, 0.15], mass=3.0 - 0.3 * i, ipos=[0.03, 0, 0.07]
        )
        body.inertia = [0.01, 0.01, 0.005]
        body.explicitinertial = True
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, i % 2, 1 - i % 2])
    return spec.compile()


@pytest.mark.parametrize("name", ["command", "link_angle"])
def test_compensator_of_live_robots(benchmark: BenchmarkFixture, name: str) -> None:
    """One call."""
    benchmark.group = f"PositionCompensator.{name}"
    compensator = PositionCompensator.from_model(arm(), 1000.0)
    benchmark(getattr(compensator, name), np.random.default_rng(0).uniform(-1.0, 1.0, 7))


@pytest.mark.parametrize("kind", [RigidBody, ByPinocchio])
@pytest.mark.parametrize("rows", [1, 64, 1024])
def test_gravity_torque(benchmark: BenchmarkFixture, kind: Any, rows: int) -> None:
    """Of a batch in one pass, and row by row."""
    benchmark.group = f"gravity torque, {rows} rows"
    benchmark(
        kind(arm(), JOINTS).gravity_torque, np.random.default_rng(0).uniform(-1.0, 1.0, (rows, 7))
    )
