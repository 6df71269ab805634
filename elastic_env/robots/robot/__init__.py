"""Any robot on a fixed base, from a file of MJCF or URDF and the elasticity of its joints."""

NAME = "robot"
ID = "elastic_env/Robot-v0"
