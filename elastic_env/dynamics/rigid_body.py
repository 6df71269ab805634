"""Rigid-body dynamics by Pinocchio, the independent reference for everything that MuJoCo or NumPy compute of a model.

The only file that imports pinocchio. Kinematic tree and inertias are taken from a compiled MuJoCo model in full
precision (its XML output has six digits); the algorithms are Pinocchio's.
"""

from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
import pinocchio

from elastic_env.core.errors import ConfigurationError, require_known
from elastic_env.core.signals import Array


class RigidBody:
    """A fixed-base tree of hinges, on (..., n) joint angles in a chosen order.

    Args:
        model: Compiled rigid model.
        joints: Hinges of the model, in the order of the last axis.
        held: Position of every other joint, a hinge [rad] or a slide [m].

    Raises:
        ConfigurationError: A joint is no hinge, does not exist, or is left out.
    """

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str], held: Mapping[str, float] | None = None) -> None:
        held = held or {}
        require_hinge_tree(model, joints, but=list(held))
        self._model, self._carriers = _convert(model, held)
        self._bare: list[pinocchio.Inertia] = [inertia.copy() for inertia in self._model.inertias]
        self._data = self._model.createData()
        self._columns = np.array([self._model.joints[self._model.getJointId(joint)].idx_v for joint in joints])
        self._square = np.ix_(self._columns, self._columns)
        self._zero = np.array([model.qpos0[model.joint(joint).qposadr[0]] for joint in joints])

    def gravity_torque(self, q: Array) -> Array:
        """τ_g that holds the robot at rest, (..., n) [rad] to (..., n) [N·m]."""
        return self._rows(lambda row: pinocchio.computeGeneralizedGravity(self._model, self._data, row), q - self._zero)

    def gravity_gradient(self, q: Array) -> Array:
        """∂τ_g/∂q, (..., n) [rad] to (..., n, n) [N·m/rad]."""
        n, moved = q.shape[-1], q - self._zero
        if q.ndim == 1:
            return self._gradient(moved)
        return np.array([self._gradient(row) for row in moved.reshape(-1, n)]).reshape(*q.shape, n)

    def _gradient(self, row: Array) -> Array:
        full = pinocchio.computeGeneralizedGravityDerivatives(self._model, self._data, self._full(row))
        return full[self._square]

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:
        """Torque of a motion without friction, from (..., n) [rad], [rad/s], [rad/s²] to (..., n) [N·m]."""
        return self._rows(lambda *rows: pinocchio.rnea(self._model, self._data, *rows), q - self._zero, q_dot, q_ddot)

    def set_load(self, body: int, mass: float, place: Array) -> None:
        """Let a body carry one point mass, in the place of the last one.

        Args:
            body: Number of the body in MuJoCo's model.
            mass: Of the load, 0 for none [kg].
            place: In the frame of the body, (3,) [m].
        """
        carrier, T_joint_body = self._carriers[body]
        for joint, inertia in enumerate(self._bare):
            self._model.inertias[joint] = inertia
        load = pinocchio.Inertia(mass, T_joint_body.act(place), np.zeros((3, 3)))
        self._model.inertias[carrier] = self._bare[carrier] + load

    def _rows(self, function: Callable[..., Array], *arrays: Array) -> Array:
        if arrays[0].ndim == 1:
            return function(*(self._full(array) for array in arrays))[self._columns]
        n = arrays[0].shape[-1]
        rows = [array.reshape(-1, n) for array in arrays]
        result = np.empty(rows[0].shape)
        for i in range(len(result)):
            result[i] = function(*(self._full(row[i]) for row in rows))[self._columns]
        return result.reshape(arrays[0].shape)

    def _full(self, row: Array) -> Array:
        full = np.empty(self._model.nv)
        full[self._columns] = row
        return full


class FloatingBody:
    """A robot whose base is free and level: translation of the base and its hinges, on (..., n) arrays.

    Args:
        model: Compiled rigid model with one free joint, at its base.
        joints: All hinges of the model, in the order of the last axis.

    Raises:
        ConfigurationError: A joint does not exist or is left out, or the base is not free.
    """

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str]) -> None:
        free = [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
        if len(free) != 1:
            raise ConfigurationError(f"a floating robot needs one free joint, this model has {len(free)}")
        require_hinge_tree(model, joints, but=free)
        self._model, _ = _convert(model)
        self._data = self._model.createData()
        base = self._model.joints[self._model.getJointId(free[0])]
        names = [self._model.joints[self._model.getJointId(joint)] for joint in joints]
        self._base_q, self._base_v = base.idx_q, base.idx_v
        self._q = np.array([joint.idx_q for joint in names])
        self._zero = np.array([model.qpos0[model.joint(joint).qposadr[0]] for joint in joints])
        self._v = np.array([joint.idx_v for joint in names])

    def inverse_dynamics(
        self, q: Array, base_dot: Array, q_dot: Array, base_ddot: Array, q_ddot: Array
    ) -> tuple[Array, Array]:
        """What a motion needs besides gravity compensation, and gravity, without any contact.

        Args:
            q: Hinges, (N, n) [rad].
            base_dot: Velocity of the level base, (N, 3) [m/s].
            q_dot: Rates of the hinges [rad/s].
            base_ddot: Acceleration of the base [m/s²].
            q_ddot: Accelerations of the hinges [rad/s²].

        Returns:
            Force and moment about the origin of the base, (N, 6) [N], [N·m], and joint torques, (N, n) [N·m].
        """
        base_q, base_v = self._base_q, self._base_v
        position, velocity, acceleration = np.zeros(self._model.nq), np.zeros(self._model.nv), np.zeros(self._model.nv)
        position[base_q + 6] = 1.0  # the unit quaternion of a level base
        wrench, torque = np.empty((len(q), 6)), np.empty(q.shape)
        for i in range(len(q)):
            position[self._q] = q[i] - self._zero
            velocity[base_v : base_v + 3], velocity[self._v] = base_dot[i], q_dot[i]
            acceleration[base_v : base_v + 3], acceleration[self._v] = base_ddot[i], q_ddot[i]
            effort = pinocchio.rnea(self._model, self._data, position, velocity, acceleration)
            wrench[i], torque[i] = effort[base_v : base_v + 6], effort[self._v]
        return wrench, torque

    def mass_matrix(self, q: Array) -> Array:
        """Inertia of base translation, base rotation and hinges, (n,) [rad] to (6 + n, 6 + n) [kg], [kg·m], [kg·m²]."""
        position = np.zeros(self._model.nq)
        position[self._base_q + 6], position[self._q] = 1.0, q - self._zero
        rows = np.concatenate([np.arange(self._base_v, self._base_v + 6), self._v])
        full = pinocchio.crba(self._model, self._data, position)
        return np.triu(full)[np.ix_(rows, rows)] + np.triu(full, 1).T[np.ix_(rows, rows)]

    def center_of_mass(self, q: Array) -> Array:
        """Center of mass of the whole robot in the frame of the base, (N, n) [rad] to (N, 3) [m]."""
        position = np.zeros(self._model.nq)
        position[self._base_q + 6] = 1.0
        com = np.empty((len(q), 3))
        for i in range(len(q)):
            position[self._q] = q[i] - self._zero
            com[i] = pinocchio.centerOfMass(self._model, self._data, position)
        return com


def require_hinge_tree(model: mujoco.MjModel, joints: Sequence[str], but: Sequence[str] = ()) -> None:
    """Check that a rigid model moves by the named hinges and nothing else, `but` some joints.

    Raises:
        ConfigurationError: A joint is no hinge, does not exist, or is left out.
    """
    kinds = {model.joint(j).name: model.jnt_type[j] for j in range(model.njnt) if model.joint(j).name not in but}
    names = list(kinds)
    for name, kind in kinds.items():
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            raise ConfigurationError(f"joint {name!r} of the rigid model is no hinge; trees of hinges are needed")
    require_known("joint of the rigid model", joints, names)
    if sorted(joints) != sorted(names):
        raise ConfigurationError(
            f"all {len(names)} joints must be named ({', '.join(names)}), got {len(joints)}: {', '.join(joints)}"
        )


def _convert(
    model: mujoco.MjModel, held: Mapping[str, float] | None = None
) -> tuple[pinocchio.Model, dict[int, tuple[int, pinocchio.SE3]]]:
    """Pinocchio's model of a MuJoCo tree of hinges, with or without a free base, and some joints held in place.

    Returns:
        The model, and of every body of MuJoCo the joint that carries it and its pose in the frame of that joint.
    """
    held = held or {}
    tree = pinocchio.Model()
    tree.gravity.linear = model.opt.gravity.copy()
    joint_of = {0: 0}  # MuJoCo body -> Pinocchio joint that carries it
    T_joint_body = {0: pinocchio.SE3.Identity()}
    for b in range(1, model.nbody):
        parent = int(model.body_parentid[b])
        T = T_joint_body[parent] * _placement(model.body_pos[b], model.body_quat[b])
        carrier = joint_of[parent]
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            if model.joint(j).name in held:
                T *= _displacement(model, j, held[model.joint(j).name])
                continue
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
                freeflyer = pinocchio.JointModelFreeFlyer()
                carrier = tree.addJoint(carrier, freeflyer, pinocchio.SE3.Identity(), model.joint(j).name)
                T = pinocchio.SE3.Identity()
                continue
            T_body_anchor = pinocchio.SE3(np.eye(3), model.jnt_pos[j].copy())
            revolute = pinocchio.JointModelRevoluteUnaligned(model.jnt_axis[j].copy())
            carrier = tree.addJoint(carrier, revolute, T * T_body_anchor, model.joint(j).name)
            T = T_body_anchor.inverse()
        joint_of[b], T_joint_body[b] = carrier, T
        T_body_com = _placement(model.body_ipos[b], model.body_iquat[b])
        inertia = pinocchio.Inertia(float(model.body_mass[b]), np.zeros(3), np.diag(model.body_inertia[b]))
        tree.appendBodyToJoint(carrier, inertia, T * T_body_com)
    return tree, {b: (joint_of[b], T_joint_body[b]) for b in joint_of}


def _displacement(model: mujoco.MjModel, joint: int, position: float) -> pinocchio.SE3:
    """How a hinge [rad] or slide [m] that is held moves its body from where the model is drawn."""
    way, axis = position - model.qpos0[model.jnt_qposadr[joint]], model.jnt_axis[joint].copy()
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        return pinocchio.SE3(np.eye(3), way * axis)
    anchor = pinocchio.SE3(np.eye(3), model.jnt_pos[joint].copy())
    turn = pinocchio.SE3(pinocchio.AngleAxis(way, axis).toRotationMatrix(), np.zeros(3))
    return anchor * turn * anchor.inverse()


def _placement(position: Array, quaternion: Array) -> pinocchio.SE3:
    w, x, y, z = quaternion
    return pinocchio.SE3(pinocchio.Quaternion(w, x, y, z), position.copy())
