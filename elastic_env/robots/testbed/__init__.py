"""The testbed of the paper: one servo, one spring, one pendulum."""

NAME, ID = "testbed", "elastic_env/Testbed-v0"
