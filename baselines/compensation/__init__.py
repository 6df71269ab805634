"""The analytic compensators: gravity torque, output and input compensation, the oracle."""
