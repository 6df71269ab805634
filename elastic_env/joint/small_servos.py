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
per rad of error, half of the e-manual's value for the X series.

| servo | k_t, k_e, R | rotor, friction | κ, g | k_p |
|---|---|---|---|---|
| XL330-M288, 5 V | M3 | M3 | PWM 885 and 1/256, as recorded; 400 | 0.84 |
| STS3215, 7.4 V | M3 | M3 | M3; 32 | 23.9 |
| STS3250, 12 V | sheet: 4.90 N·m, 7.87 rad/s; k_t = k_e assumed | as STS3215, assumed | as STS3215; 32 | 47.6 |
| MX-64, 12 V | M3 | M3 | M3; 32 | 27.7 |
| MX-106, 12 V | M3 | M3 | M3; 32 | 50.4 |
| XM430-W350, 12 V | sheet: 4.1 N·m, 2.3 A, 4.82 rad/s | as MX-64, assumed | e-manual: PWM 885, 1/128; 800 | 22.5 |

Assumed for all: K = 20 k_p, as the encoder sits behind the gear and measures its bending; D by a
damping ratio of 0.17; no Stribeck term, no velocity gain. The factory's integral gain is 0, so that
these servos sag.

[Rhoban2025] See `elastic_env.joint.friction`.
"""  # noqa: E501

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from elastic_env.core.errors import require_known
from elastic_env.core.files import read_rows
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.motor import Motor

_COUNTS_PER_TURN = 4096
_STIFFNESS_PER_GAIN = 20.0
"""K over k_p, assumed."""
_DAMPING_RATIO = 0.17


@dataclass(frozen=True)
class SmallServo:
    """Figures of a servo from its sources, at the output shaft.

    Attributes:
        motor: Its motor at the usual supply.
        rotor_inertia: B [kg·m²].
        base: F', dry friction without load [N·m].
        share: s, share of the torques on both sides of the gear that is lost to friction [1].
        viscous: Viscous friction [N·m·s/rad].
        per_gain: κ, duty cycle per register of the position gain and rad [1/rad].
        gain: The factory's register of the position gain [1].
    """

    motor: Motor
    rotor_inertia: float
    base: float
    share: float
    viscous: float
    per_gain: float
    gain: float

    def joint(self, gain: float | None, voltage: float | None) -> ElasticJoint:
        """Return the elastic joint with this servo; arguments as in `small_servo`."""
        motor = self.motor if voltage is None else self.motor.replace(voltage=voltage)
        torque_per_duty = motor.torque_constant * motor.voltage / motor.resistance
        gain = self.gain if gain is None else gain
        position_gain = torque_per_duty * self.per_gain * gain
        stiffness = _STIFFNESS_PER_GAIN * position_gain
        swing = float(np.sqrt(stiffness * self.rotor_inertia))
        return ElasticJoint(
            stiffness=stiffness,
            damping=2.0 * _DAMPING_RATIO * swing,
            rotor_inertia=self.rotor_inertia,
            coulomb_friction=self.base / (1.0 + self.share),
            load_friction=2.0 * self.share / (1.0 + self.share),
            viscous_friction=self.viscous,
            encoder_counts_per_turn=_COUNTS_PER_TURN,
            servo=Servo(
                position_gain=position_gain,
                torque_limit=motor.stall_torque,
                speed_limit=motor.no_load_speed,
                motor=motor,
            ),
        )


def _read_servo(row: dict[str, str]) -> SmallServo:
    figures = {key: float(value) for key, value in row.items() if key != "name"}
    motor = Motor(**{name: figures.pop(name) for name in Motor.model_fields})
    return SmallServo(motor, **figures)


_ROWS = read_rows(Path(__file__).with_suffix(".csv"))
SMALL_SERVOS = {row["name"]: _read_servo(row) for row in _ROWS}
"""Small servos by name."""


def small_servo(name: str, gain: float | None = None, voltage: float | None = None) -> ElasticJoint:
    """Return the elastic joint of a named servo.

    Args:
        name: One of `SMALL_SERVOS`.
        gain: Register of the position gain; None for the factory's [1].
        voltage: Supply; None for the usual one [V].

    Raises:
        ConfigurationError: An unknown name, or a gain or voltage that is not positive.
    """
    require_known("servo", [name], SMALL_SERVOS)
    return SMALL_SERVOS[name].joint(gain, voltage)
