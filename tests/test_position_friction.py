"""Dry friction that grows with the load, in commands for live robots: closed forms, rest, a small
servo in MuJoCo."""

from typing import Any

import mujoco
import numpy as np
import pytest

from baselines import PositionCompensator
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.make_elastic import transform_hinges
from elastic_env.joint.motor import Motor
from elastic_env.motion.trajectory import minimum_jerk
from elastic_env.world.worlds import SingleWorld

LOAD_NM = 0.4905
K = 40.0
K_P = 4.0
PENDULUM = """<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="RK4"/>
  <worldbody><body><joint name="servo" axis="0 -1 0"/>
  <inertial mass="0.5" pos="0 0 -0.1" diaginertia="0.0005 0.0005 0.0005"/></body></worldbody>
</mujoco>"""
FRICTION: dict[str, Any] = {
    "coulomb_friction": 0.02,
    "load_friction": 0.3,
    "static_friction": 0.01,
    "stribeck_speed": 0.1,
}


MOTOR = Motor(torque_constant=0.5, back_emf=0.55, resistance=2.5, voltage=6.0)
SERVO: dict[str, Any] = {"position_gain": K_P, "velocity_gain": 0.05, "motor": MOTOR}


def compensator(**options: Any) -> PositionCompensator:
    """Of the pendulum, whose servo gives way by 0.16 rad."""
    settings = {"stiffness": K, **FRICTION, "servo": SERVO}
    given = {"limit_rad": 0.6, "period_s": 0.01, **options}
    return PositionCompensator.from_model(PENDULUM, {"servo": settings}, **given)


def along(made: PositionCompensator, path: Array) -> Array:
    """Commands along a path of the desired angle, (T,) [rad]."""
    return np.array([made.command([q])[0] for q in path])


def test_up_and_down_the_command_is_the_closed_form() -> None:
    """Catches a share of the wrong torque, and a direction against the motion."""
    made = compensator()
    path = np.concatenate([np.linspace(0.0, 1.0, 101), np.linspace(1.0, 0.5, 51)[1:]])
    up, down = along(made, path)[[100, -1]]
    compliance = 1.0 / K + 1.0 / K_P
    lag = (0.05 + 0.5 * 0.55 / 2.5) / K_P  # at 1 rad/s
    fast = 0.01 * np.exp(-((1.0 / 0.1) ** 2))
    above = (LOAD_NM * np.sin(1.0) + 0.02 + fast) / 0.7
    below = (LOAD_NM * np.sin(0.5) - 0.02 - fast) / 1.3
    assert up == pytest.approx(1.0 + compliance * above + lag, rel=1e-6)
    assert down == pytest.approx(0.5 + compliance * below - lag, rel=1e-6)


def test_desired_angles_that_tremble_at_rest_do_not_turn_the_friction() -> None:
    """Catches chatter: the command moves with the weight alone, by less than twice the noise."""
    made = compensator()
    along(made, np.linspace(0.0, 1.0, 101))
    noise = 0.7e-3 * np.random.default_rng(4).uniform(-1.0, 1.0, 300)
    commands = along(made, 1.0 + noise)
    assert np.ptp(commands) < 2.0 * np.ptp(noise)
    still = compensator()
    assert np.ptp(along(still, 1.0 + noise)) < 2.0 * np.ptp(noise)


def test_the_link_angle_of_a_command_is_what_was_desired() -> None:
    """Catches an output compensator that does not know the side of the friction."""
    for path in (np.linspace(0.0, 1.0, 101), np.linspace(1.5, 1.0, 51)):
        made = compensator()
        q = path[-1]
        along(made, np.array([*path, q, q]))
        sign = np.sign(path[-1] - path[0])
        torque = (LOAD_NM * np.sin(q) + sign * 0.03) / (1.0 - sign * 0.3)
        assert made.link_angle([q + torque / K])[0] == pytest.approx(q, abs=1e-9)


def test_friction_can_be_left_out_and_is_without_a_share_of_the_load() -> None:
    """Catches commands of robots that stand which change, and an argument without effect."""
    path = np.linspace(0.0, 1.0, 11)
    expected = path + (1.0 / K + 1.0 / K_P) * LOAD_NM * np.sin(path)
    np.testing.assert_allclose(along(compensator(friction=False), path), expected, rtol=1e-12)
    settings = {"stiffness": K, "coulomb_friction": 0.02, "servo": {"position_gain": K_P}}
    plain = PositionCompensator.from_model(PENDULUM, {"servo": settings}, limit_rad=0.6)
    np.testing.assert_allclose(along(plain, path), expected, rtol=1e-12)
    rubbed = PositionCompensator.from_model(
        PENDULUM, {"servo": settings}, limit_rad=0.6, friction=True
    )
    assert along(rubbed, path)[-1] == pytest.approx(expected[-1] + 0.275 * 0.02)


def test_a_small_servo_follows_and_rests_where_it_should() -> None:
    """Catches any of it on the plant: with friction compensated the pendulum ends within 6 mrad of
    where it should be, from both sides; without, 20 mrad and more away."""
    servo = Servo(torque_limit=2.0, speed_limit=10.0, **SERVO)
    joint = ElasticJoint(stiffness=K, damping=0.02, rotor_inertia=0.004, servo=servo, **FRICTION)
    spec = mujoco.MjSpec.from_string(PENDULUM)
    model = transform_hinges(spec, {"servo": joint}).compile()
    left: dict[bool, list[float]] = {}
    for friction in (True, False):
        made = compensator(friction=friction)
        world = SingleWorld(model)
        left[friction] = []
        for start, end in ((0.0, 1.0), (1.0, 1.4), (1.4, 0.8)):
            way = minimum_jerk(np.linspace(0.0, 1.0, 150))
            for q in [*(start + (end - start) * way), *[end] * 20]:
                world.ctrl[0] = made.command([q])[0]
                world.advance(20)
            angle = world.qpos[0, model.joint("servo").qposadr[0]]
            left[friction].append(abs(float(angle) - end))
    assert max(left[True]) < 6e-3
    assert min(left[False]) > 2e-2


def test_friction_that_takes_all_of_the_load_is_refused() -> None:
    """Catches a command without end."""
    with pytest.raises(ConfigurationError, match=r"load_friction must be .* < 1, got 1\.2"):
        PositionCompensator.from_model(PENDULUM, {"servo": {"stiffness": K, "load_friction": 1.2}})


def test_a_payload_that_jumps_is_said_with_the_friction_of_its_load() -> None:
    """Up, a load takes (1 − c)⁻¹ of its torque: catches a jump by the weight alone."""
    made = compensator()
    along(made, np.linspace(0.0, 1.0, 101))
    before = along(made, np.array([1.0]))[0]
    added = 0.05 * 9.81 * 0.1 * np.sin(1.0)
    jump = 1e3 * (1.0 / K + 1.0 / K_P) * added / 0.7
    with pytest.warns(UserWarning, match=rf"'servo' by {jump:.3g} mrad at once"):
        made.set_payload(0.05, at=(0.0, 0.0, -0.1))
    assert 1e3 * (along(made, np.array([1.0]))[0] - before) == pytest.approx(jump, rel=1e-6)


def test_a_rotor_leads_by_its_torque_over_the_position_gain() -> None:
    """Catches a lead of the wrong sign, or one with the inertia of the links: k_p e = B q̈."""
    leads = []
    for rotor_inertia in (0.002, 0.005):
        settings = {"stiffness": K, "rotor_inertia": rotor_inertia, **FRICTION, "servo": SERVO}
        given: dict[str, Any] = {"limit_rad": 0.6, "period_s": 0.01}
        made = PositionCompensator.from_model(PENDULUM, {"servo": settings}, **given)
        leads.append(made.command([0.2], [0.1], [3.0]))
    np.testing.assert_allclose(leads[1] - leads[0], 0.003 * 3.0 / K_P, rtol=1e-9)
