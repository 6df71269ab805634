"""A robot of three joints, as a user would write it: nothing of the package knows it."""

import mujoco

from elastic_env import ElasticJoint, JointRobot, Servo

_JOINT = ElasticJoint(
    stiffness=400.0,
    damping=4.0,
    rotor_inertia=0.2,
    coulomb_friction=0.5,
    encoder_counts_per_turn=2**18,
    servo=Servo(
        position_gain=2e4,
        velocity_gain=200.0,
        integral_gain=2e4,
        torque_limit=150.0,
        speed_limit=5.0,
    ),
)


def rigid_arm() -> mujoco.MjSpec:
    """An arm that yaws at its base and bends at shoulder and elbow; each link 0.4 m and 3 kg."""
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
    body.add_site(name="hand", pos=[0.4, 0, 0])
    return spec


ARM = JointRobot("arm", rigid_arm, dict.fromkeys(("base", "shoulder", "elbow"), _JOINT), imu="hand")
