"""Live loops: an arm that follows targets, and the testbed as an environment."""

NAME = "hardware"
ID = "elastic_env/HardwareTestbed-v0"
