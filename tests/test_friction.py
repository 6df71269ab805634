"""Dry friction and the DC motor, against closed forms, limits and the balance of power."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.friction import dry_friction
from elastic_env.joint.motor import Motor, motor_torque, terminal_speed

MOTOR = Motor(torque_constant=0.4, back_emf=0.5, resistance=3.0, voltage=5.0, pwm_limit=0.9)

numbers = st.floats(-1e3, 1e3)
sizes = st.floats(0.0, 1e3)
shapes = hnp.array_shapes(min_dims=1, max_dims=3, max_side=4)


def test_dry_friction_is_the_closed_form() -> None:
    """Catches a width that is not that of the exponent, and a load with its sign."""
    friction = dry_friction(
        speed=np.array([0.0, 0.1, -0.1, -0.2]),
        load=np.array([-2.0, -2.0, 2.0, 0.0]),
        coulomb=0.5,
        load_ratio=0.4,
        static=0.3,
        stribeck_speed=0.1,
    )
    e = np.exp(-1.0)
    expected = [1.6, 1.3 + 0.3 * e, 1.3 + 0.3 * e, 0.5 + 0.3 * e**4]
    np.testing.assert_allclose(friction, expected, rtol=1e-15)


def test_without_load_and_stribeck_terms_it_is_coulomb_friction() -> None:
    """Catches a zero width that becomes NaN, at any speed."""
    speed = np.array([0.0, 1e-300, 1.0, -1e300])
    np.testing.assert_array_equal(dry_friction(speed, np.ones(4), 0.7), np.full(4, 0.7))


@pytest.mark.parametrize("speed", [1e-3, 1.0, 1e200])
def test_far_above_the_stribeck_speed_the_excess_is_gone(speed: float) -> None:
    """Catches an exponent that overflows, and the limit of no width: an excess at rest only."""
    for width in (1e-4, 1e-300, 0.0):
        moving, resting = dry_friction(np.array([speed, 0.0]), np.zeros(2), 1.0, 0.0, 2.0, width)
        assert (moving, resting) == (1.0, 3.0)


@given(
    speed=shapes.flatmap(lambda shape: hnp.arrays(np.float64, shape, elements=numbers)),
    load=numbers,
    coulomb=sizes,
    load_ratio=st.floats(0.0, 1.0, exclude_max=True),
    static=sizes,
    stribeck_speed=sizes,
)
def test_dry_friction_is_even_bounded_and_falls_with_speed(
    speed: np.ndarray,
    load: float,
    coulomb: float,
    load_ratio: float,
    static: float,
    stribeck_speed: float,
) -> None:
    """Catches a friction that drives, and one that depends on a direction; for any shape."""
    loads = np.full(speed.shape, load)
    terms = (coulomb, load_ratio, static, stribeck_speed)
    friction = dry_friction(speed, loads, *terms)
    assert friction.shape == speed.shape
    np.testing.assert_array_equal(friction, dry_friction(-speed, -loads, *terms))
    kinetic = coulomb + load_ratio * abs(load)
    assert (friction >= kinetic).all()
    assert (friction <= (kinetic + static) * (1.0 + 1e-15)).all()
    assert (dry_friction(2.0 * speed, loads, *terms) <= friction).all()


@given(duty=st.floats(-2.0, 2.0), speed=st.floats(-50.0, 50.0))
def test_a_motor_gives_no_more_power_than_its_supply(duty: float, speed: float) -> None:
    """Catches a sign of the back-EMF, and a duty cycle beyond its limit.

    Electric power V u i heats the winding by R i² and meets the back-EMF by k_e ω i; of that, the
    share k_t/k_e arrives at the output.
    """
    torque = float(motor_torque(MOTOR, np.array(duty), np.array(speed)))
    limited = min(max(duty, -0.9), 0.9)
    current = torque / MOTOR.torque_constant
    heat = MOTOR.resistance * current**2
    gear = MOTOR.back_emf / MOTOR.torque_constant
    assert MOTOR.voltage * limited * current == pytest.approx(heat + gear * torque * speed)


def test_stall_torque_and_no_load_speed_are_the_ends_of_the_line() -> None:
    """Catches a limit of the duty cycle that one end forgets."""
    full = np.ones(3)
    speed = np.array([0.0, MOTOR.no_load_speed, MOTOR.no_load_speed / 2.0])
    torque = motor_torque(MOTOR, full, speed)
    np.testing.assert_allclose(torque, [0.6, 0.0, 0.3], atol=1e-15)
    assert MOTOR.stall_torque == pytest.approx(0.4 * 5.0 * 0.9 / 3.0)
    assert MOTOR.no_load_speed == pytest.approx(9.0)


@given(load=st.floats(-1.0, 1.0), viscous=st.floats(0.0, 1.0))
def test_at_its_terminal_speed_the_motor_balances_the_load(load: float, viscous: float) -> None:
    """Catches viscous friction with the wrong sign."""
    speed = terminal_speed(MOTOR, load, viscous)
    torque = motor_torque(MOTOR, np.array(1.0), speed)
    assert float(torque) == pytest.approx(load + viscous * float(speed))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"load_friction": 1.0}, r"load_friction must be .* >= 0 and < 1, got 1\.0"),
        ({"load_friction": -0.1}, r"load_friction must be .* >= 0 and < 1, got -0\.1"),
        ({"static_friction": -0.1}, r"static_friction must be .* >= 0 \[N·m\], got -0\.1"),
        ({"stribeck_speed": -0.1}, r"stribeck_speed must be .* >= 0 \[rad/s\], got -0\.1"),
        ({"static_friction": 0.2}, r"static_friction = 0\.2 N·m needs a stribeck_speed above 0"),
    ],
)
def test_a_friction_that_cannot_be_is_refused(change: dict[str, Any], problem: str) -> None:
    """Catches a joint that passes nothing, and a Stribeck excess of no width."""
    with pytest.raises(ConfigurationError, match=problem):
        ElasticJoint(stiffness=100.0, rotor_inertia=0.1, **change)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"torque_constant": 0.0}, r"torque_constant must be .* > 0 \[N·m/A\], got 0\.0"),
        ({"back_emf": 0.0}, r"back_emf must be .* > 0 \[V·s/rad\], got 0\.0"),
        ({"resistance": -3.0}, r"resistance must be .* > 0 \[Ω\], got -3\.0"),
        ({"voltage": np.nan}, r"voltage must be .* > 0 \[V\], got nan"),
        ({"pwm_limit": 1.1}, r"pwm_limit must be .* > 0 and <= 1, got 1\.1"),
        ({"pwm_limit": 0.0}, r"pwm_limit must be .* > 0 and <= 1, got 0\.0"),
    ],
)
def test_a_motor_that_cannot_be_is_refused(change: dict[str, Any], problem: str) -> None:
    """Catches a bound that is missing; a PWM limit in percent is one."""
    with pytest.raises(ConfigurationError, match=problem):
        MOTOR.replace(**change)


def test_a_servo_takes_a_motor_and_has_none_by_default() -> None:
    """Catches a default that would change every robot that stands."""
    servo = Servo(position_gain=5.0, torque_limit=0.6, speed_limit=9.0)
    assert servo.motor is None
    assert servo.replace(motor=MOTOR).motor == MOTOR
