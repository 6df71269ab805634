"""Gymnasium environments of robots with elastic joints: testbed, arms, a humanoid that walks.

import gymnasium, elastic_env
env = gymnasium.make("elastic_env/WalkInPlace-v0", step_period=3.0, scenario="nominal")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

from elastic_env.core.installed import import_package
from elastic_env.rendering.headless import prefer_egl

if TYPE_CHECKING:
    from elastic_env.core.errors import ActionError, ConfigurationError, ElasticError
    from elastic_env.joint.elastic_joint import ElasticJoint, Servo
    from elastic_env.joint.make_elastic import make_elastic
    from elastic_env.joint.motor import Motor
    from elastic_env.joint.mujoco_friction import VaryingFriction
    from elastic_env.joint.small_servos import small_servo
    from elastic_env.robots.joint_robot import JointRobot

__version__ = "0.1.0"
__all__ = [
    "IDS",
    "ActionError",
    "ConfigurationError",
    "ElasticError",
    "ElasticJoint",
    "JointRobot",
    "Motor",
    "Servo",
    "VaryingFriction",
    "make_elastic",
    "small_servo",
]

_ENVIRONMENTS = (
    "elastic_env.robots.testbed",
    "elastic_env.robots.thormang",
    "elastic_env.robots.robot",
    "elastic_env.hardware.live",
)
"""Packages that define NAME and ID of an environment, and make it in a module `environment`."""

_MODULES = {
    "ActionError": "elastic_env.core.errors",
    "ConfigurationError": "elastic_env.core.errors",
    "ElasticError": "elastic_env.core.errors",
    "ElasticJoint": "elastic_env.joint.elastic_joint",
    "JointRobot": "elastic_env.robots.joint_robot",
    "Motor": "elastic_env.joint.motor",
    "Servo": "elastic_env.joint.elastic_joint",
    "VaryingFriction": "elastic_env.joint.mujoco_friction",
    "make_elastic": "elastic_env.joint.make_elastic",
    "small_servo": "elastic_env.joint.small_servos",
}
_PACKAGES = ("baselines", "train")
"""Packages that `from elastic_env import baselines` gives, too."""


def __getattr__(name: str) -> Any:
    """Import a public name at its first use: helper processes of a control loop must start fast."""
    if name in _PACKAGES:
        return import_package(name)
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


prefer_egl()
IDS: dict[str, str] = {}
"""Gymnasium's ids of the environments by their short names."""
for _name in _ENVIRONMENTS:
    _package = import_module(_name)
    IDS[_package.NAME] = _package.ID
    _make = f"{_name}.environment:make"
    gymnasium.register(_package.ID, _make, vector_entry_point=f"{_make}_vector")
