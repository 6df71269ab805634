"""Live loops: the testbed on hardware as an environment, one control cycle for one step."""

NAME = "hardware"
ID = "elastic_env/HardwareTestbed-v0"
