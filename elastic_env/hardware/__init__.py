"""Real hardware: arms of Feetech and Dynamixel servos, the testbed with its IMU, and an emulator.

    live loop → supervised bus ──socket──→ supervisor (guard, torque off) → bus → port
    live loop → attitude stream ──memory──→ IMU reader → pymscl → port

`buses` speaks to servos in SI units, `safety` keeps a motion within its limits, `live` moves an arm
or makes an environment of the testbed, and `emulator` stands in for servos and IMU. All numbers
that a user can set stand in `settings` and `arm_settings`.

Only the supervisor touches the servos' port. It outlives the program, and switches torque off when
that dies or hangs.
"""
