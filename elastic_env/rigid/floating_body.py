"""Rigid-body dynamics of a robot on a free base by Pinocchio, one posture after the other.

This is the only file that imports Pinocchio. Tests compare it with MuJoCo and with our formulas.
Kinematic tree and inertias come from a compiled MuJoCo model in full precision (its XML output has
six digits).
"""

from collections.abc import Sequence

import mujoco
import numpy as np
import pinocchio

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.rigid.rigid_body import require_hinge_tree


class FloatingBody:
    """A robot whose base is free and level, of any heading, on (..., n) arrays.

    Args:
        model: Compiled rigid model with one free joint, at its base.
        joints: All hinges of the model, in the order of the last axis.

    Raises:
        ConfigurationError: A joint does not exist or is left out, or the base is not free.
    """

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str]) -> None:
        free_ids = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        free = [model.joint(int(j)).name for j in free_ids]
        if len(free) != 1:
            got = f"this model has {len(free)}"
            raise ConfigurationError(f"a floating robot needs one free joint, {got}")
        require_hinge_tree(model, joints, but=free)
        self._model = pinocchio_model(model)
        self._data = self._model.createData()
        base = self._model.joints[self._model.getJointId(free[0])]
        names = [self._model.joints[self._model.getJointId(joint)] for joint in joints]
        self._base_q = base.idx_q
        self._base_v = base.idx_v
        self._q = np.array([joint.idx_q for joint in names])
        addresses = [int(model.joint(joint).qposadr[0]) for joint in joints]
        self._zero = model.qpos0[addresses]
        self._v = np.array([joint.idx_v for joint in names])

    def inverse_dynamics(
        self, q: Array, base_dot: Array, q_dot: Array, base_ddot: Array, q_ddot: Array
    ) -> tuple[Array, Array]:
        """Forces and torques of a motion, gravity included, without contact or `gravcomp`.

        Args:
            q: Hinges, (N, n) [rad].
            base_dot: Velocity of the level base, in its frame, and rate of its heading, (N, 4)
                [m/s], [rad/s].
            q_dot: Rates of the hinges [rad/s].
            base_ddot: Acceleration of the base, in its frame, and of its heading [m/s²], [rad/s²].
            q_ddot: Accelerations of the hinges [rad/s²].

        Returns:
            Force and moment about the origin of the base, in its frame, (N, 6) [N], [N·m], and
            joint torques, (N, n) [N·m].
        """
        base = self._base_v
        rate = np.zeros(self._model.nv)
        change = np.zeros(self._model.nv)
        wrench = np.empty((len(q), 6))
        torque = np.empty(q.shape)
        for i in range(len(q)):
            velocity = base_dot[i]
            rate[base : base + 3] = velocity[:3]
            rate[base + 5] = velocity[3]
            rate[self._v] = q_dot[i]
            # acceleration in the turning frame of the base
            change[base : base + 3] = base_ddot[i, :3]
            change[base] += velocity[3] * velocity[1]
            change[base + 1] -= velocity[3] * velocity[0]
            change[base + 5] = base_ddot[i, 3]
            change[self._v] = q_ddot[i]
            position = self._position(q[i])
            effort = pinocchio.rnea(self._model, self._data, position, rate, change)
            wrench[i] = effort[base : base + 6]
            torque[i] = effort[self._v]
        return wrench, torque

    def _position(self, q: Array) -> Array:
        """Return Pinocchio's position vector for hinges (n,) [rad] on a level base."""
        position = np.zeros(self._model.nq)
        position[self._base_q + 6] = 1.0  # the unit quaternion of a level base
        position[self._q] = q - self._zero
        return position

    def mass_matrix(self, q: Array) -> Array:
        """Inertia of base translation, base rotation, hinges: (n,) [rad] to (6 + n, 6 + n) [SI]."""
        rows = np.concatenate([np.arange(self._base_v, self._base_v + 6), self._v])
        full = pinocchio.crba(self._model, self._data, self._position(q))
        return (np.triu(full) + np.triu(full, 1).T)[np.ix_(rows, rows)]

    def center_of_mass(self, q: Array) -> Array:
        """Center of mass of the robot in the frame of the base, (N, n) [rad] to (N, 3) [m]."""
        com = np.empty((len(q), 3))
        for i in range(len(q)):
            position = self._position(q[i])
            com[i] = pinocchio.centerOfMass(self._model, self._data, position)
        return com


def pinocchio_model(model: mujoco.MjModel) -> pinocchio.Model:
    """Return Pinocchio's model of a MuJoCo tree of hinges, with or without a free base."""
    tree = pinocchio.Model()
    tree.gravity.linear = model.opt.gravity.copy()
    joint_of = {0: 0}  # MuJoCo body -> Pinocchio joint that carries it
    T_joint_body = {0: pinocchio.SE3.Identity()}
    for b in range(1, model.nbody):
        parent = int(model.body_parentid[b])
        T = T_joint_body[parent] * _placement(model.body_pos[b], model.body_quat[b])
        carrier = joint_of[parent]
        for j in np.flatnonzero(model.jnt_bodyid == b):
            name = model.joint(int(j)).name
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
                T = pinocchio.SE3.Identity()
                free = pinocchio.JointModelFreeFlyer()
                carrier = tree.addJoint(carrier, free, T, name)
                continue
            T_body_anchor = pinocchio.SE3(np.eye(3), model.jnt_pos[j].copy())
            revolute = pinocchio.JointModelRevoluteUnaligned(model.jnt_axis[j].copy())
            carrier = tree.addJoint(carrier, revolute, T * T_body_anchor, name)
            T = T_body_anchor.inverse()
        joint_of[b] = carrier
        T_joint_body[b] = T
        T_body_com = _placement(model.body_ipos[b], model.body_iquat[b])
        moments = np.diag(model.body_inertia[b])
        inertia = pinocchio.Inertia(float(model.body_mass[b]), np.zeros(3), moments)
        tree.appendBodyToJoint(carrier, inertia, T * T_body_com)
    return tree


def _placement(position: Array, quaternion: Array) -> pinocchio.SE3:
    w, x, y, z = quaternion
    return pinocchio.SE3(pinocchio.Quaternion(w, x, y, z), position.copy())
