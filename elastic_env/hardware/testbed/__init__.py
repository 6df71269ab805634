"""The testbed on hardware, as an environment."""

NAME, ID = "hardware", "elastic_env/HardwareTestbed-v0"
