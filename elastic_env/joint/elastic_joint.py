"""Parameters of one elastic joint: transmission, rotor, friction, servo and encoder."""

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, Parameter
from elastic_env.joint.motor import Motor


class Servo(Model):
    r"""Position servo on the rotor: PID on the motor encoder, limited in torque.

    .. math::
        \tau_m = \mathrm{clip}(k_p (u - \theta) - k_v \dot\theta + k_i \int (u - \theta) dt, \pm \tau_{max})

    A cascade of a position P loop and a velocity PI loop, as position servos have it, acts like
    this PID. The integrator lets it hold its angle without steady-state error. Against wind-up it
    is clamped to what it can be needed for: the torque limit on top of k_v θ̇ at the speed limit.

    With a `motor` the PID sets the duty cycle of the pulse-width modulation. The gains are those at
    rest, where the duty cycle u gives the torque k_t V u / R. The back-EMF takes from it:

    .. math::
        \tau_m = \mathrm{clip}(\mathrm{clip}(\tau_{PID}, \pm k_t V u_{max} / R)
        - k_t k_e \dot\theta / R, \pm \tau_{max})

    The torque limit is that of the current, k_t i_max; give the stall torque where there is none.
    """  # noqa: E501

    position_gain: float = quantity("N·m/rad", gt=0)
    """k_p, position gain [N·m/rad]."""
    velocity_gain: float = quantity("N·m·s/rad", 0.0, ge=0)
    """k_v, velocity gain [N·m·s/rad]."""
    integral_gain: float = quantity("N·m/(rad·s)", 0.0, ge=0)
    """k_i, integral gain, 0 for none [N·m/(rad·s)]."""
    torque_limit: float = quantity("N·m", gt=0)
    """Largest torque of the servo at the output [N·m]."""
    speed_limit: float = quantity("rad/s", gt=0)
    """No-load speed of the servo at the output [rad/s]."""
    motor: Motor | None = quantity("1", None)
    """DC motor with back-EMF and PWM limit; None for a torque that does not depend on speed [1]."""

    @property
    def braking(self) -> float:
        """k_v and what the back-EMF adds to it [N·m·s/rad]."""
        return self.velocity_gain + (0.0 if self.motor is None else self.motor.damping)

    @property
    def integral_limit(self) -> float:
        """Largest magnitude of the position error's integral [rad·s]; 0 without one."""
        if self.integral_gain == 0.0:
            return 0.0
        most = self.torque_limit + self.braking * self.speed_limit
        return most / self.integral_gain

    def largest_torque(self, speed: Parameter = 0.0) -> Array:
        """Torque that the servo has at a speed, broadcast from (..., n) [rad/s] to [N·m].

        The motor's torque falls with the speed; without a motor it is the limit throughout.
        """
        limit = np.full(np.shape(speed), self.torque_limit)
        if self.motor is None:
            return limit
        left = self.motor.stall_torque - self.motor.damping * np.abs(speed)
        return np.minimum(limit, left.clip(min=0.0))


class FrictionTerms(Model):
    """Terms of `elastic_env.joint.friction.dry_friction` that change with load or speed."""

    load_friction: float = quantity("1", 0.0, ge=0, lt=1)
    """c, share of the torque passed that is lost to dry friction, see `dry_friction` [1]."""
    static_friction: float = quantity("N·m", 0.0, ge=0)
    """F_s, excess of dry friction at rest over that in motion [N·m]."""
    stribeck_speed: float = quantity("rad/s", 0.0, ge=0)
    """ω_s, speed at which that excess is down to 37 %; required with `static_friction` [rad/s]."""

    def _check(self) -> None:
        if self.static_friction > 0.0 and self.stribeck_speed == 0.0:
            raise ValueError(
                f"static_friction = {self.static_friction:g} N·m needs a stribeck_speed above 0"
                " [rad/s], by which it falls to 37 %; 0.05 rad/s is usual for gears"
            )


class ElasticJoint(FrictionTerms):
    """One elastic joint: transmission, rotor, friction, servo and motor encoder.

    A rigid joint has no `ElasticJoint`; compare with one by the `rigid` form of
    `elastic_env.joint.make_elastic.make_elastic`.
    """

    stiffness: float = quantity("N·m/rad", gt=0)
    """K, stiffness of the transmission [N·m/rad]."""
    damping: float = quantity("N·m·s/rad", 0.0, ge=0)
    """D, damping of the transmission [N·m·s/rad]."""
    rotor_inertia: float = quantity("kg·m²", gt=0)
    """B, rotor inertia reflected to the output [kg·m²]."""
    backlash: float = quantity("rad", 0.0, ge=0, lt=np.pi)
    """Width of the dead band of the deflection [rad]."""
    coulomb_friction: float = quantity("N·m", 0.0, ge=0)
    """Dry friction on the link side of the spring [N·m]."""
    viscous_friction: float = quantity("N·m·s/rad", 0.0, ge=0)
    """Viscous friction on the link side [N·m·s/rad]."""
    encoder_counts_per_turn: int | None = quantity("1", None, gt=0)
    """Motor encoder, counts per turn of the output; None for continuous [1]."""
    servo: Servo | None = quantity("1", None)
    """Position servo on the rotor; None to add no actuator [1]."""
