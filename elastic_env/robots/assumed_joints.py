"""Elastic joints that are assumed for a robot whose stiffness nobody has published."""

import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.model_joints import hinges_of, mass_matrix
from elastic_env.rigid.rigid_body import RigidBody

SAG_RAD = 0.015
"""Assumed deflection of a joint under the largest torque of its robot's weight [rad]."""
_LEAST_TORQUE_SHARE = 0.05
"""Least torque that the stiffness of a joint is designed for, over the largest torque [1]."""
_LEAST_FREQUENCY_RAD_S = 2.0 * np.pi * 5.0
"""Least frequency of the links on a joint's spring [rad/s]."""
_ROTOR_SHARE = 0.5
"""Rotor inertia over the inertia of the joint's links [1]."""
_LEAST_ROTOR_SHARE = 0.01
"""Part of the rotor inertia over the largest inertia of links [1]."""
_DAMPING_RATIO = 0.1
_SERVO_RATE_RAD_S = 20.0
"""Rate of the servos' three poles [rad/s]."""
_POSES = 50
"""Number of random poses."""
_RANGE_SHARE = 0.8
"""Share of a joint's range in random poses [1]."""
_LARGEST_RAD = np.pi
"""Largest angle in random poses [rad]."""


def random_poses(model: MjModel, generator: np.random.Generator, number: int = _POSES) -> Array:
    """Draw poses within the inner part of the joints' ranges, (number, n) [rad].

    The robot may collide with itself in these poses.
    """
    ids = [int(model.joint(name).id) for name in hinges_of(model)]
    limited = model.jnt_limited[ids, None].astype(bool)
    ranges = np.where(limited, model.jnt_range[ids], [-_LARGEST_RAD, _LARGEST_RAD])
    # a range beyond half a turn, such as Kinova's 47° to 313°, is cut off there
    ends = np.clip(ranges, -_LARGEST_RAD, _LARGEST_RAD)
    middle = ends.mean(axis=1)
    half = _RANGE_SHARE * np.ptp(ends, axis=1) / 2.0
    return generator.uniform(middle - half, middle + half, (number, len(ids)))


def assumed_joints(model: MjModel) -> dict[str, ElasticJoint]:
    r"""Make elastic joints by one rule for all robots, because measured values are missing.

    .. math::
        K_j = \max\left(\frac{\tau_j}{0.015}, \frac{\max_i \tau_i}{20 \cdot 0.015}, (10 \pi)^2 M_j\right), \quad
        B_j = \frac{M_j}{2} + \frac{\max_i M_i}{100}, \quad D_j = 0.2 \sqrt{K_j m_j}

    τ_j is the largest gravity torque over random poses, M_j the largest inertia about the joint.
    Users of arms report a sag of 0.015 rad. A frequency of 10π rad/s prevents slow oscillations of
    a vertical axis, which carries no weight. m_j is the inertia on the spring: rotor in series with
    the least inertia of the links while the other joints are free. K is rounded to two digits.

    Args:
        model: Compiled rigid model; all of its joints are hinges.

    Returns:
        Joints by name, with servos that hold their angles.
    """  # noqa: E501
    names = hinges_of(model)
    poses = random_poses(model, np.random.default_rng(0))
    torque = np.abs(RigidBody(model, names).gravity_torque(poses)).max(axis=0)
    inertia = np.array([_mass_matrix(model, pose) for pose in poses])
    links = np.diagonal(inertia, axis1=1, axis2=2).max(axis=0)
    free = (1.0 / np.diagonal(np.linalg.inv(inertia), axis1=1, axis2=2)).min(axis=0)
    carried = np.maximum(torque, _LEAST_TORQUE_SHARE * torque.max())
    stiffness = np.maximum(carried / SAG_RAD, _LEAST_FREQUENCY_RAD_S**2 * links)
    digit = 10.0 ** (np.floor(np.log10(stiffness)) - 1.0)
    stiffness = np.round(stiffness / digit) * digit
    rotor = _ROTOR_SHARE * links + _LEAST_ROTOR_SHARE * links.max()
    damping = 2.0 * _DAMPING_RATIO * np.sqrt(stiffness / (1.0 / rotor + 1.0 / free))
    joints: dict[str, ElasticJoint] = {}
    for j, name in enumerate(names):
        K = float(stiffness[j])
        total = float(rotor[j] + links[j])
        joints[name] = ElasticJoint(
            stiffness=K,
            damping=float(damping[j]),
            rotor_inertia=float(rotor[j]),
            servo=_servo(total, K, float(torque.max() + 25.0 * total)),
        )
    return joints


def _servo(inertia: float, stiffness: float, torque_limit: float) -> Servo:
    """Make a servo that holds its angle and is no softer than its spring.

    With a rigid load it has three equal poles.
    """
    rate = _SERVO_RATE_RAD_S
    load_inertia = max(inertia, stiffness / (3.0 * rate**2))
    return Servo(
        position_gain=3.0 * load_inertia * rate**2,
        velocity_gain=3.0 * load_inertia * rate,
        integral_gain=load_inertia * rate**3,
        torque_limit=torque_limit,
        speed_limit=5.0,
    )


def _mass_matrix(model: MjModel, pose: Array) -> Array:
    """Mass matrix without armature, (n, n) [kg·m²]."""
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    return mass_matrix(model, data) - np.diag(model.dof_armature)
