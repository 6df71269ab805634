"""Live loops: the testbed on hardware as an environment, one control cycle on the bus for one step."""

NAME = "hardware"
ID = "elastic_env/HardwareTestbed-v0"
