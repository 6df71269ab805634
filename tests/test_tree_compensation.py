"""Compensation on trees with `gravcomp`, springs of joints, and servos that give way under a
load."""

from typing import Any

import mujoco
import numpy as np
import pytest

from baselines import PositionCompensator
from baselines.compensation.compensators import GravityCompensator, Motion
from baselines.compensation.gravity_torque import make_gravity
from elastic_env import ElasticJoint, JointRobot, Servo
from elastic_env.core.errors import ConfigurationError
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.world.robot_model import RobotModel
from tests.played import metrics_of

# As an arm: a base that turns, a shoulder with a spring, an elbow, and gravity compensation on two
# of the bodies.
ARM = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 0.4" gravcomp="1">
      <joint name="turn" axis="0.2 0 1"/>
      <inertial mass="3" pos="0.05 0 0.1" diaginertia="0.02 0.02 0.02"/>
      <body name="upper" pos="0 0 0.2" euler="0.1 0.2 0">
        <joint name="shoulder" axis="0 1 0" stiffness="12" springref="0.3"/>
        <inertial mass="2.5" pos="0.2 0.02 0" diaginertia="0.02 0.03 0.03"/>
        <body name="lower" pos="0.4 0 0" gravcomp="0.4">
          <joint name="elbow" axis="0 1 0.1" pos="0.01 0 0" ref="0.2"/>
          <inertial mass="1.5" pos="0.15 0 0.01" diaginertia="0.01 0.01 0.01"/>
          <site name="tool" pos="0.3 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""
STIFFNESS = {"elbow": 400.0, "turn": 500.0, "shoulder": 900.0}
NAMES = list(STIFFNESS)  # not the order of the model
KP = 800.0


def rigid() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(ARM)


def joints(integral_gain: float) -> dict[str, ElasticJoint]:
    gain = 20.0 * KP if integral_gain else KP
    servo = Servo(
        position_gain=gain,
        velocity_gain=60.0,
        integral_gain=integral_gain,
        torque_limit=150.0,
        speed_limit=5.0,
    )
    return {
        name: ElasticJoint(
            stiffness=K, damping=4.0, rotor_inertia=0.2, coulomb_friction=0.3, servo=servo
        )
        for name, K in STIFFNESS.items()
    }


def robot(integral_gain: float, home: Any = (0.2, 0.1, -0.3)) -> JointRobot:
    return JointRobot("carried_arm", rigid, joints(integral_gain), home=list(home))


def poses(count: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1.0, 1.0, (count, 3))


def test_the_torque_is_that_of_mujoco() -> None:
    """Catches gravcomp of the wrong sign and a spring that pulls the wrong way; MuJoCo's own
    forces are the judge."""
    model = rigid().compile()
    data = mujoco.MjData(model)
    torque = RigidBody(model, NAMES)
    for q, q_dot, q_ddot in zip(poses(20), poses(20)[::-1], 3.0 * poses(20), strict=True):
        for name, *state in zip(NAMES, q, q_dot, q_ddot, strict=True):
            joint = data.joint(name)
            joint.qpos, joint.qvel, joint.qacc = state
        mujoco.mj_inverse(model, data)
        expected = [data.joint(name).qfrc_inverse[0] for name in NAMES]
        np.testing.assert_allclose(
            torque.inverse_dynamics(q, q_dot, q_ddot), expected, rtol=1e-9, atol=1e-9
        )
        change = 1e-6 * np.eye(3)
        slope = (torque.gravity_torque(q + change) - torque.gravity_torque(q - change)).T / 2e-6
        np.testing.assert_allclose(torque.gravity_gradient(q), slope, atol=1e-6)


@pytest.mark.parametrize("integral_gain", [0.0, 8000.0])
def test_policy_and_live_compensator_agree(integral_gain: float) -> None:
    """Catches two formulas for one thing: springs, gravcomp, and the sag of a servo without an
    integrator."""
    model = rigid().compile()
    live = PositionCompensator(
        model, STIFFNESS, joints=NAMES, limit_rad=10.0, position_gain=None if integral_gain else KP
    )
    policy = GravityCompensator(RobotModel(joints(integral_gain), model, 0.004), output="newton")
    q = poses(50)
    offset, _ = policy.offset(Motion(q, 0.0 * q, 0.0 * q), np.zeros((50, 0)))
    np.testing.assert_allclose(q + offset, [live.command(row) for row in q], atol=1e-9)
    np.testing.assert_allclose(
        policy.link_angle(q, offset), [live.link_angle(row) for row in q], atol=1e-9
    )


def errors(
    policy: str, scenario: str, integral_gain: float, home: Any, reference: dict[str, Any]
) -> float:
    """RMS link error of an episode [rad]."""
    env = robot(integral_gain, home).robot.make(scenario=scenario, reference=reference)
    metrics = metrics_of(env, policy)
    assert metrics["clipped_share"] == 0.0
    return float(metrics["link_error_rms_rad"])


STILL = {"kind": "sine", "amplitude": 1e-9, "duration_s": 0.25, "onset_s": 1.0}
MOVING = {"kind": "sine", "amplitude": 0.4, "frequency_hz": 0.6, "duration_s": 1.5, "onset_s": 0.5}


@pytest.mark.parametrize("integral_gain", [pytest.param(0.0, marks=pytest.mark.slow), 8000.0])
def test_at_rest_input_takes_the_sag_away(integral_gain: float) -> None:
    """Catches a compensator that leaves the sag of the servo, or compensates a weight that
    gravcomp carries."""
    (home,) = poses(1)
    sag = errors("uncompensated", "ideal", integral_gain, home, STILL)
    assert errors("input", "ideal", integral_gain, home, STILL) < 0.01 * sag


@pytest.mark.parametrize("integral_gain", [0.0, pytest.param(8000.0, marks=pytest.mark.slow)])
def test_in_motion_dynamic_takes_the_error_away(integral_gain: float) -> None:
    """Catches springs, gravcomp or servo sag that inverse dynamics forget."""
    home = (0.2, 0.1, -0.3)
    without = errors("uncompensated", "ideal", integral_gain, home, MOVING)
    assert errors("dynamic", "ideal", integral_gain, home, MOVING) < 0.05 * without


def test_a_robot_of_servos_that_give_way_starts_at_rest() -> None:
    """Catches a start above the sag, from which the robot drops: θ = u − τ/k_p, by MuJoCo's own
    acceleration."""
    env: Any = robot(0.0).robot.make(scenario="ideal", reference=STILL)
    env.reset(seed=0)
    first = env.unwrapped.truth()
    for _ in range(100):
        env.step(np.zeros(3, dtype=np.float32))
    later = env.unwrapped.truth()
    np.testing.assert_allclose(later.q, first.q, atol=1e-7)
    np.testing.assert_allclose(later.theta, first.theta, atol=1e-7)
    assert np.abs(first.theta - np.array([0.2, 0.1, -0.3])).max() > 2e-3


def test_a_method_that_knows_gravity_alone_is_refused() -> None:
    """Catches springs and gravcomp that are silently left out."""
    with pytest.raises(ConfigurationError, match=r"'hinge' has gravity only.*choose tree"):
        make_gravity(RobotModel(joints(0.0), rigid().compile(), 0.004), "hinge")
