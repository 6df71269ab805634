"""The analytic compensators: gravity torque, output and input compensation (Eqs. 1 to 6), the
oracle.
"""
