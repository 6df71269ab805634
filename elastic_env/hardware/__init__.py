"""The testbed on real hardware: Dynamixel servos, a MicroStrain IMU, and an emulator of both.

    env → supervised bus ──socket──→ supervisor (limits, torque off) → bus → dynamixel-sdk → port
    env → attitude stream ──pipe──→ IMU reader → pymscl → port

Only the supervisor touches the servos' port; it outlives the program and switches torque off when
that dies or hangs.
"""
