"""Robots with several hinges on which formulas for one joint would fail, and MuJoCo's gravity
torque for them."""

from collections.abc import Sequence

import mujoco
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.robots.testbed.model import JOINT, Pendulum, rigid_spec
from elastic_env.world.robot_model import RobotModel

# A trunk with two hinges whose anchors are off the body's origin; an arm with one more, and a leg
# of two bodies. Frames
# are turned, references differ from zero, gravity is tilted, and a body without joints rides along.
TREE = """<mujoco>
  <option gravity="1.1 -0.7 -9.6"/>
  <compiler angle="radian"/>
  <worldbody>
    <body name="trunk" pos="0.1 0.2 0.9" euler="0.3 -0.2 0.5">
      <joint name="yaw" axis="0.1 0.2 1" pos="0.02 -0.03 0.04" ref="0.3"/>
      <joint name="pitch" axis="0 1 0.3" pos="-0.05 0.01 0.06" ref="-0.2"/>
      <inertial mass="7.5" pos="0.03 -0.02 0.15" quat="0.9 0.1 0.3 0.2" diaginertia="0.3 0.2 0.1"/>
      <body name="box" pos="0 0.1 0.3">
        <inertial mass="2" pos="0.05 0.06 0.07" diaginertia="0.02 0.02 0.02"/>
      </body>
      <body name="arm" pos="0 0.25 0.3" quat="0.8 0.2 -0.4 0.1">
        <joint name="elbow" axis="1 0.2 0" pos="0.03 0.02 -0.01" ref="0.7"/>
        <inertial mass="1.7" pos="0.2 0 -0.1" diaginertia="0.02 0.02 0.01"/>
      </body>
      <body name="thigh" pos="0.02 -0.1 -0.1" euler="-0.4 0.1 0.2">
        <joint name="hip" axis="0.3 1 0" pos="0 0 0.02"/>
        <inertial mass="4.2" pos="0.01 0.02 -0.2" diaginertia="0.05 0.05 0.02"/>
        <body name="shank" pos="0 0.01 -0.4" quat="0.95 -0.1 0.2 0.1">
          <joint name="knee" axis="0 -1 0.1" pos="0.01 0.02 0" ref="-0.5"/>
          <joint name="twist" axis="0 0.1 1" pos="0.02 0 -0.1"/>
          <inertial mass="2.6" pos="0.02 -0.01 -0.22" diaginertia="0.04 0.04 0.01"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""
ORDER = ("knee", "yaw", "elbow", "twist", "pitch", "hip")  # not the order of the model


def robot(xml: str, joints: Sequence[str]) -> RobotModel:
    """A robot of equal elastic joints."""
    joint = ElasticJoint(stiffness=1000.0, rotor_inertia=0.1)
    return RobotModel(dict.fromkeys(joints, joint), mujoco.MjModel.from_xml_string(xml), 0.004)


def tree() -> RobotModel:
    """The robot above."""
    return robot(TREE, ORDER)


def pendulum(mass_scale: float = 1.0) -> RobotModel:
    """The paper's testbed, with its mass scaled."""
    joint = ElasticJoint(stiffness=1001.0, rotor_inertia=0.839)
    return RobotModel(
        {JOINT: joint}, rigid_spec(Pendulum().with_mass_scaled(mass_scale)).compile(), 0.004
    )


def bias_of_mujoco(model: RobotModel, q: Array) -> Array:
    """MuJoCo's bias force at rest, which is the gravity torque, (n,) [N·m]."""
    data = mujoco.MjData(model.rigid)
    for name, angle in zip(model.joint_names, q, strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_forward(model.rigid, data)
    return np.array([data.joint(name).qfrc_bias[0] for name in model.joint_names])
