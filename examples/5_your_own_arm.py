"""
5. Your own arm
===============

An arm with three joints sags under its own weight. First we command it with a live compensator,
then we simulate it.
"""

import gymnasium
import mujoco
import numpy as np

import baselines
from baselines import PositionCompensator
from elastic_env import ElasticJoint, JointRobot, Servo


def rigid_arm() -> mujoco.MjSpec:
    """Yaw at the base, pitch at shoulder and elbow; each link 0.4 m and 3 kg."""
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for name, axis, offset in (
        ("base", [0, 0, 1], 0.0),
        ("shoulder", [0, 1, 0], 0.1),
        ("elbow", [0, 1, 0], 0.4),
    ):
        body = body.add_body(name=name, pos=[offset, 0, 0])
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, 0.4, 0, 0],
            size=[0.04, 0, 0],
            mass=3.0,
            contype=0,
            conaffinity=0,
        )
    return spec


# %%
# On the robot
# ------------
#
# The compensator needs the rigid model and the stiffness of the joints. It reads files as well,
# such as
# ``from_model("arm.urdf", ...)``.

compensator = PositionCompensator.from_model(rigid_arm(), {"*": 400.0})
wanted = np.array([0.0, -0.4, 0.6])
command = compensator.command(wanted)
print("joints    ", compensator.joints)
print("lead      ", np.round(1e3 * (command - wanted), 1), "mrad")
print(
    "link angle",
    np.round(compensator.link_angle(command), 4),
    "rad when the encoders show the command",
)
np.testing.assert_allclose(compensator.link_angle(command), wanted, atol=1e-6)

# %%
# A servo that gives way under a load has a gain, and needs a larger lead.

soft_servo = PositionCompensator.from_model(rigid_arm(), {"*": 400.0}, position_gain=800.0)
print("lead      ", np.round(1e3 * (soft_servo.command(wanted) - wanted), 1), "mrad")

# %%
# In simulation
# -------------
#
# A ``JointRobot`` is the same arm with elastic joints as an environment.

servo = Servo(
    position_gain=2e4, velocity_gain=200.0, integral_gain=2e4, torque_limit=150.0, speed_limit=5.0
)
joint = ElasticJoint(
    stiffness=400.0, damping=4.0, rotor_inertia=0.2, servo=servo
)  # K, D, B in SI units
arm = JointRobot("arm", rigid_arm, {"base": joint, "shoulder": joint, "elbow": joint})
arm.register()

env = gymnasium.make("elastic_env/Arm-v0", scenario="nominal", reference="sine")
for name in ("uncompensated", "input", "dynamic"):
    policy = baselines.make(name, env)
    observation, info = env.reset(seed=0)
    state = None
    done = False
    while not done:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    print(f"{name:13} {1e3 * info['episode_metrics']['link_error_rms_rad']:6.2f} mrad rms")
