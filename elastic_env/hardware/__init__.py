"""The testbed on real hardware: Dynamixel servos, a MicroStrain IMU, and an emulator of both.

    live loop → supervised bus ──socket──→ supervisor (guard, torque off) → bus → dynamixel-sdk →
    port live loop → attitude stream ──memory──→ IMU reader → pymscl → port

`buses` speaks to servos in SI units, `safety` keeps a motion within its limits, `live` makes an
environment of them, and `emulator` stands in for servos and IMU. All numbers that a user can set
stand in `settings`.

Only the supervisor touches the servos' port. It outlives the program, and switches torque off when
that dies or hangs.
"""
