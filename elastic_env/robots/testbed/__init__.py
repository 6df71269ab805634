"""The testbed of the paper: one servo, one spring, one pendulum."""
