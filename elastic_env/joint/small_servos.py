r"""Named position servos of small arms, with the source of their figures.

A register of the position gain g sets the duty cycle u = g κ (goal − θ), with κ as the table has
it. At rest the torque is k_t V u / R, so that k_p = g κ k_t V / R: it grows with the supply.

Identified figures are those that [Rhoban2025] publishes (github.com/Rhoban/bam, Apache-2.0, model
M3). Its friction grows with the torques on both sides of the gear, F = F' + s (|τ_J| + |τ|), where
the link needs τ = τ_J − F as the load goes up. By τ_J alone that is

.. math:: F = \frac{F'}{1 + s} + \frac{2 s}{1 + s} |\tau_J|

Going down the source's friction is larger than ours, by (1 + s)/(1 − s). Figures of sheets are
ROBOTIS' e-manual and, for the STS3250, Feetech's sheet of 2024-01-16 as quoted by robonine.com. All
are at the output shaft. A sheet's stall torque is what the servo still lifts, so that the motor has
(τ + F₀)/(1 − c). In the recordings of that repository's branch `xl330` the PWM register is 2.546 g
per rad of error, half of what the e-manual says of the X series.

| servo | k_t, k_e, R | rotor, friction | κ, g | k_p |
|---|---|---|---|---|
| XL330-M288, 5 V | M3 | M3 | PWM 885 and 1/256, as recorded; 400 | 0.84 |
| STS3215, 7.4 V | M3 | M3 | M3; 32 | 23.9 |
| STS3250, 12 V | sheet: 4.90 N·m, 7.87 rad/s; k_t = k_e assumed | as STS3215, assumed | as STS3215; 32 | 47.6 |
| MX-64, 12 V | M3 | M3 | M3; 32 | 27.7 |
| MX-106, 12 V | M3 | M3 | M3; 32 | 50.4 |
| XM430-W350, 12 V | sheet: 4.1 N·m, 2.3 A, 4.82 rad/s | as MX-64, assumed | e-manual: PWM 885, 1/128; 800 | 22.5 |

Assumed for all: K = 20 k_p, as the encoder sits behind the gear and sees what that gives; D by a
damping ratio of 0.17; no Stribeck term, no velocity gain. The factory's integral gain is 0, so that
these servos sag.

[Rhoban2025] See `elastic_env.joint.friction`.
"""  # noqa: E501

from dataclasses import dataclass

import numpy as np

from elastic_env.core.errors import require_known
from elastic_env.joint.elasticity import ElasticJoint, Servo
from elastic_env.joint.motor import Motor

COUNTS_PER_TURN = 4096
_PER_XM_GAIN = COUNTS_PER_TURN / (2.0 * np.pi * 128.0 * 885.0)
_PER_XL_GAIN = 0.5 * _PER_XM_GAIN
"""Duty cycle per register of the position gain and rad: X series by the e-manual, and XL330
[1/rad].
"""
_PER_MX_GAIN = 0.158
_PER_STS_GAIN = 0.166 * 1.1787
_TO_SERVO = 20.0
"""K over k_p, assumed."""
_DAMPING_RATIO = 0.17
_KG_CM = 0.0980665
"""A kilogram-force at a centimetre [N·m]."""

_Given = float | None
"""A gain or a voltage [V]; None for the usual one."""


@dataclass(frozen=True)
class Gear:
    """Rotor and friction of a servo.

    Attributes:
        rotor_inertia: B [kg·m²].
        base: F', dry friction without load [N·m].
        share: s, of the torques on both sides of the gear [1].
        viscous: Viscous friction [N·m·s/rad].
    """

    rotor_inertia: float
    base: float
    share: float
    viscous: float

    @property
    def coulomb_friction(self) -> float:
        """Constant part, F₀ [N·m]."""
        return self.base / (1.0 + self.share)

    @property
    def load_friction(self) -> float:
        """Share of the torque passed, c [1]."""
        return 2.0 * self.share / (1.0 + self.share)


@dataclass(frozen=True)
class SmallServo:
    """A servo as its sources have it, at the output shaft.

    Attributes:
        motor: At the usual supply.
        gear: Behind it.
        per_gain: κ, duty cycle per register of the position gain and rad [1/rad].
        gain: The factory's register of the position gain [1].
    """

    motor: Motor
    gear: Gear
    per_gain: float
    gain: float

    def joint(self, gain: _Given = None, voltage: _Given = None) -> ElasticJoint:
        """The elastic joint with this servo.

        Args:
            gain: Register of the position gain; default the factory's [1].
            voltage: Supply; default the usual one [V].
        """
        motor = self.motor if voltage is None else self.motor.replace(voltage=voltage)
        at_rest = motor.torque_constant * motor.voltage / motor.resistance
        position_gain = at_rest * self.per_gain * (self.gain if gain is None else gain)
        stiffness = _TO_SERVO * position_gain
        rotor_inertia = self.gear.rotor_inertia
        return ElasticJoint(
            stiffness=stiffness,
            damping=2.0 * _DAMPING_RATIO * float(np.sqrt(stiffness * rotor_inertia)),
            rotor_inertia=rotor_inertia,
            coulomb_friction=self.gear.coulomb_friction,
            load_friction=self.gear.load_friction,
            viscous_friction=self.gear.viscous,
            encoder_counts_per_turn=COUNTS_PER_TURN,
            servo=Servo(
                position_gain=position_gain,
                torque_limit=motor.stall_torque,
                speed_limit=motor.no_load_speed,
                motor=motor,
            ),
        )


def _of_sheet(
    lifted: float, no_load_speed: float, voltage: float, current: float | None, gear: Gear
) -> Motor:
    """The motor of a sheet.

    Args:
        lifted: Stall torque at the output [N·m].
        no_load_speed: Speed without load [rad/s].
        voltage: Supply [V].
        current: At stall [A]; None for k_t = k_e.
        gear: Whose friction the motor overcomes at stall.
    """
    stall_torque = (lifted + gear.coulomb_friction) / (1.0 - gear.load_friction)
    back_emf = voltage / no_load_speed
    torque_constant = back_emf if current is None else stall_torque / current
    return Motor(
        torque_constant=torque_constant,
        back_emf=back_emf,
        resistance=torque_constant * voltage / stall_torque,
        voltage=voltage,
    )


def _identified(
    constant: float, resistance: float, voltage: float, pwm_limit: float = 1.0
) -> Motor:
    """A motor of which one constant k_t = k_e [N·m/A] was identified."""
    own = {"torque_constant": constant, "back_emf": constant, "resistance": resistance}
    return Motor(**own, voltage=voltage, pwm_limit=pwm_limit)


_XL330 = Gear(rotor_inertia=0.002596, base=0.00232, share=0.2641, viscous=0.0169)
_STS3215 = Gear(rotor_inertia=0.0235, base=0.0556, share=0.2116, viscous=0.0315)
_MX_64 = Gear(rotor_inertia=0.01124, base=0.1022, share=0.0758, viscous=0.00063)
_MX_106 = Gear(rotor_inertia=0.02485, base=0.1134, share=0.1082, viscous=0.01194)

SMALL_SERVOS = {
    "XL330-M288": SmallServo(_identified(0.2915, 2.0, 5.0), _XL330, _PER_XL_GAIN, gain=400),
    "STS3215": SmallServo(_identified(1.265, 2.453, 7.4, 0.97), _STS3215, _PER_STS_GAIN, gain=32),
    "STS3250": SmallServo(
        motor=_of_sheet(50.0 * _KG_CM, np.pi / 3.0 / 0.133, 12.0, current=None, gear=_STS3215),
        gear=_STS3215,
        per_gain=_PER_STS_GAIN,
        gain=32,
    ),
    "MX-64": SmallServo(_identified(1.6315, 3.571, 12.0, 0.9625), _MX_64, _PER_MX_GAIN, gain=32),
    "MX-106": SmallServo(_identified(2.2042, 2.6533, 12.0, 0.9625), _MX_106, _PER_MX_GAIN, gain=32),
    "XM430-W350": SmallServo(
        motor=_of_sheet(4.1, 46.0 * 2.0 * np.pi / 60.0, 12.0, current=2.3, gear=_MX_64),
        gear=_MX_64,
        per_gain=_PER_XM_GAIN,
        gain=800,
    ),
}
"""Small servos by name."""


def small_servo(name: str, gain: _Given = None, voltage: _Given = None) -> ElasticJoint:
    """The elastic joint of a named servo.

    Args:
        name: One of `SMALL_SERVOS`.
        gain: Register of the position gain; default the factory's [1].
        voltage: Supply; default the usual one [V].

    Raises:
        ConfigurationError: An unknown name, or a gain or voltage that is not positive.
    """
    require_known("servo", [name], SMALL_SERVOS)
    return SMALL_SERVOS[name].joint(gain, voltage)
