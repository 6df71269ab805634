"""Real hardware: arms of Feetech and Dynamixel servos, the testbed with its IMU, and an emulator.

    live loop → supervised bus ──socket──→ supervisor (guard, torque off) → bus → port
    live loop → attitude stream ──memory──→ IMU reader → pymscl → port

`buses` commands servos in SI units. `safety` keeps a motion within its limits. `live` moves an arm
or runs the testbed as an environment. `emulator` replaces servos and IMU. All numbers that a user
can set are in `settings` and `arm_settings`.

Only the supervisor uses the servos' port. It outlives the program, and switches torque off when the
program dies or hangs.
"""
