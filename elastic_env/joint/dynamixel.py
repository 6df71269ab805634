"""The paper's actuator, Dynamixel PRO H54-200-S500-R, with the source of every number.

| parameter | value | source |
|---|---|---|
| K | 1001 N·m/rad | the paper, section IV-B |
| B | 0.839 kg·m² | 33.3 g·cm² (maxon EC-4pole 30) × 501.923²; gear inertia unknown, not included |
| friction | 5.4 N·m | derived from the paper's r = 0.9775 and Fig. 6; published losses give about 6 N·m for the gear |
| backlash | below 1.75 mrad | ROBOTIS e-manual: 6 arcmin; 0 by default, the bound in scenario `backlash` |
| encoder | 501,923 counts/turn | ROBOTIS e-manual; 1000 per motor turn, so it sits on the motor side |
| torque | 84 N·m | current limit 1240 counts = 20 A (THORMANG3 legs) on the measured line 4.338 N·m/A − 2.694 N·m |
| speed | 3.47 rad/s | ROBOTIS e-manual: 33.1 rpm without load |
| D | 10 N·m·s/rad | our assumption: not published; `docs/testbed.md` shows the sensitivity from 5 to 50 |
| servo | 18000, 250 | position gain and upper joint damping of the DYROS-JET MuJoCo model; real scaling unpublished |
| integrator | 0.1 s | our assumption: the real cascade has one, its time constant is not published |
"""  # noqa: E501

import math

from elastic_env.joint.elastic_joint import ElasticJoint, Servo

ENCODER_COUNTS_PER_TURN = 501_923
"""Counts of the motor encoder per turn of the output."""

TORQUE_PER_CURRENT = 4.338
LOSS_NM = 2.694
"""The measured line: slope [N·m/A], and torque that does not reach the output [N·m]."""

_ROTOR_INERTIA_KG_M2 = 33.3e-7
_GEAR_RATIO = 501.923
_CURRENT_LIMIT_A = 1240 * 33.0 / 2048
_POSITION_GAIN = 18_000.0
_INTEGRATOR_TIME_S = 0.1

SERVO = Servo(
    position_gain=_POSITION_GAIN,
    velocity_gain=250.0,
    integral_gain=_POSITION_GAIN / _INTEGRATOR_TIME_S,
    torque_limit=round(TORQUE_PER_CURRENT * _CURRENT_LIMIT_A - LOSS_NM, 1),
    speed_limit=round(33.1 * 2.0 * math.pi / 60.0, 2),
)

H54_200_S500_R = ElasticJoint(
    stiffness=1001.0,
    damping=10.0,
    rotor_inertia=round(_ROTOR_INERTIA_KG_M2 * _GEAR_RATIO**2, 3),
    coulomb_friction=5.4,
    encoder_counts_per_turn=ENCODER_COUNTS_PER_TURN,
    servo=SERVO,
)
"""Dynamixel PRO H54-200-S500-R with the values of the table above."""
