"""The testbed of the paper: one servo, one spring, one pendulum."""

NAME = "testbed"
ID = "elastic_env/Testbed-v0"
