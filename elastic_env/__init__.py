"""Gymnasium environments of robots with elastic joints: a single-actuator testbed and a humanoid walking in place.

import gymnasium, elastic_env
env = gymnasium.make("elastic_env/WalkInPlace-v0", step_period=3.0, scenario="nominal")
"""

import gymnasium

from elastic_env.headless import prefer_egl

__version__ = "0.1.0"

prefer_egl()
gymnasium.register(
    id="elastic_env/Testbed-v0",
    entry_point="elastic_env.entry_points:make_testbed",
    vector_entry_point="elastic_env.entry_points:make_testbed_vector",
)
gymnasium.register(
    id="elastic_env/HardwareTestbed-v0",
    entry_point="elastic_env.hardware.entry_points:make_hardware_testbed",
    vector_entry_point="elastic_env.hardware.entry_points:make_hardware_testbed_vector",
)
gymnasium.register(
    id="elastic_env/WalkInPlace-v0",
    entry_point="elastic_env.entry_points:make_walk",
    vector_entry_point="elastic_env.entry_points:make_walk_vector",
)
