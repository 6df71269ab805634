r"""The DC motor of a servo, at the output shaft.

    τ = k_t (V u − k_e ω) / R,   |u| ≤ u_max

with the duty cycle u of the pulse-width modulation. All constants are behind the gear. With a gear
ratio N and its efficiency η, k_t is N η times that of the bare motor, and k_e is N times. The
inductance is left out: its time constant L/R is well below a millisecond.
"""

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, Parameter


class Motor(Model):
    """A brushed DC motor behind its gear, driven by pulse-width modulation."""

    torque_constant: float = quantity("N·m/A", gt=0)
    """k_t, torque per current at the output [N·m/A]."""
    back_emf: float = quantity("V·s/rad", gt=0)
    """k_e, voltage per speed of the output [V·s/rad]."""
    resistance: float = quantity("Ω", gt=0)
    """R, resistance of winding, bridge and leads [Ω]."""
    voltage: float = quantity("V", gt=0)
    """V, supply voltage under load [V]."""
    pwm_limit: float = quantity("1", 1.0, gt=0, le=1)
    """Largest duty cycle u of the pulse-width modulation [1]."""

    @property
    def stall_torque(self) -> float:
        """Torque at rest under the largest duty cycle [N·m]."""
        return self.torque_constant * self.voltage * self.pwm_limit / self.resistance

    @property
    def no_load_speed(self) -> float:
        """Speed without load and friction under the largest duty cycle [rad/s]."""
        return self.voltage * self.pwm_limit / self.back_emf

    @property
    def damping(self) -> float:
        """Loss of torque per speed by the back-EMF, k_t k_e / R [N·m·s/rad]."""
        return self.torque_constant * self.back_emf / self.resistance


def motor_torque(motor: Motor, duty: Array, speed: Array) -> Array:
    r"""Torque of a motor at the output shaft.

    .. math:: \tau = k_t (V u - k_e \omega) / R, \quad |u| \le u_{max}

    Args:
        motor: Its constants.
        duty: u, (..., n), limited here to the motor's `pwm_limit` [1].
        speed: ω of the output, (..., n) [rad/s].

    Returns:
        τ, (..., n) [N·m].
    """
    duty = duty.clip(-motor.pwm_limit, motor.pwm_limit)
    current = (motor.voltage * duty - motor.back_emf * speed) / motor.resistance
    return motor.torque_constant * current


def terminal_speed(motor: Motor, load: Parameter, viscous_friction: Parameter = 0.0) -> Array:
    r"""Speed at which the motor under its largest duty cycle carries a load.

    .. math:: \omega = (\tau_{stall} - \tau_{load}) / (k_t k_e / R + d)

    Args:
        motor: Its constants.
        load: Torque against the motion, gravity and dry friction, (..., n) [N·m].
        viscous_friction: d of the link, broadcast against (..., n) [N·m·s/rad].

    Returns:
        ω, (..., n) [rad/s]; negative where the load drives the motor back.
    """
    return (motor.stall_torque - np.asarray(load)) / (motor.damping + viscous_friction)
