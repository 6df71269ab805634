"""Inverse dynamics of a planned walk: force of the ground, its ZMP, and joint torques."""

from dataclasses import dataclass

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import derivatives
from elastic_env.rigid.biped import Biped
from elastic_env.rigid.contact_force import contact_points, shares
from elastic_env.rigid.leg_kinematics import turn


@dataclass(frozen=True)
class Feet:
    """Ankles (T, 2, 3) [m], headings of the feet (T, 2) and of the pelvis (T,) [rad]."""

    ankles: Array
    yaw: Array
    heading: Array


@dataclass(frozen=True)
class WalkDynamics:
    """Force of the ground, its ZMP and vertical moment, joint torques, (T, ...) each."""

    force: Array
    zmp: Array
    moment: Array
    torque: Array


def walk_dynamics(
    biped: Biped, pelvis: Array, heading: Array, q: Array, period_s: float
) -> WalkDynamics:
    """Compute the inverse dynamics of the whole body; the force is in the world frame.

    Joint torques are those without contact.
    """
    # imported late: robots that do not walk start a tenth faster without Pinocchio
    from elastic_env.rigid.floating_body import FloatingBody

    body = FloatingBody(biped.rigid, biped.joint_names)
    q_dot, q_ddot = derivatives(q, period_s)
    pelvis_rates = derivatives(pelvis, period_s)
    heading_rates = derivatives(heading, period_s)
    base_dot, base_ddot = (
        np.concatenate([turn(linear, -heading), angular[:, None]], axis=1)
        for linear, angular in zip(pelvis_rates, heading_rates, strict=True)
    )
    wrench, torque = body.inverse_dynamics(q, base_dot, q_dot, base_ddot, q_ddot)
    force = turn(wrench[:, :3], heading)
    moment = turn(wrench[:, 3:], heading)
    # the moment of the ground's force about the pelvis has no horizontal part about the ZMP
    height = -pelvis[:, 2]
    x = (-moment[:, 1] + height * force[:, 0]) / force[:, 2]
    y = (moment[:, 0] + height * force[:, 1]) / force[:, 2]
    about_zmp = moment[:, 2] - (x * force[:, 1] - y * force[:, 0])
    zmp = np.stack([x, y], axis=-1) + pelvis[:, :2]
    return WalkDynamics(force, zmp, about_zmp, torque)


def walk_torque(biped: Biped, feet: Feet, q: Array, dynamics: WalkDynamics, share: Array) -> Array:
    """Compute joint torques with the ground's force shared between the feet, (T, 12) [N·m]."""
    weights = shares(share)
    points = np.zeros((len(q), 2, 3))
    points[..., :2] = contact_points(dynamics.zmp, share, feet.ankles[..., :2])
    forces = weights[..., None] * dynamics.force[:, None]
    moments = np.zeros_like(forces)
    moments[..., 2] = weights * dynamics.moment[:, None]
    moments += np.cross(points - feet.ankles, forces)
    wrench = (turn(forces, -feet.yaw), turn(moments, -feet.yaw))
    contact = biped.chains.loads(len(q), wrench=wrench)
    return dynamics.torque + biped.chains.torque(contact, q)
