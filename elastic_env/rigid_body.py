"""Rigid-body dynamics by Pinocchio, the independent reference for everything that MuJoCo or NumPy compute of a model.

The only file that imports pinocchio. Kinematic tree and inertias are taken from a compiled MuJoCo model in full
precision (its XML output has six digits); the algorithms are Pinocchio's.
"""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import pinocchio

from elastic_env.errors import ConfigurationError, unknown_name
from elastic_env.signals import Array


class RigidBody:
    """A fixed-base tree of hinges, on (..., n) joint angles in a chosen order.

    Args:
        model: Compiled rigid model; its joints must all be hinges.
        joints: All hinges of the model, in the order of the last axis.

    Raises:
        ConfigurationError: A joint is no hinge, does not exist, or is left out.
    """

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str]) -> None:
        require_hinge_tree(model, joints)
        self._model = _convert(model)
        self._data = self._model.createData()
        self._columns = np.array([self._model.joints[self._model.getJointId(joint)].idx_v for joint in joints])
        self._square = np.ix_(self._columns, self._columns)
        self._zero = np.array([model.qpos0[model.joint(joint).qposadr[0]] for joint in joints])

    def gravity_torque(self, q: Array) -> Array:
        """τ_g that holds the robot at rest, (..., n) [rad] to (..., n) [N·m]."""
        return self._rows(lambda row: pinocchio.computeGeneralizedGravity(self._model, self._data, row), q - self._zero)

    def gravity_gradient(self, q: Array) -> Array:
        """∂τ_g/∂q, (..., n) [rad] to (..., n, n) [N·m/rad]."""
        n = q.shape[-1]
        rows = (q - self._zero).reshape(-1, n)
        gradient = np.empty((len(rows), n, n))
        for i, row in enumerate(rows):
            full = pinocchio.computeGeneralizedGravityDerivatives(self._model, self._data, self._full(row))
            gradient[i] = full[self._square]
        return gradient.reshape(*q.shape, n)

    def inverse_dynamics(self, q: Array, q_dot: Array, q_ddot: Array) -> Array:
        """Torque of a motion without friction, from (..., n) [rad], [rad/s], [rad/s²] to (..., n) [N·m]."""
        return self._rows(lambda *rows: pinocchio.rnea(self._model, self._data, *rows), q - self._zero, q_dot, q_ddot)

    def _rows(self, function: Callable[..., Array], *arrays: Array) -> Array:
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


def require_hinge_tree(model: mujoco.MjModel, joints: Sequence[str]) -> None:
    """Check that a rigid model moves by the named hinges and nothing else.

    Raises:
        ConfigurationError: A joint is no hinge, does not exist, or is left out.
    """
    names = [model.joint(j).name for j in range(model.njnt)]
    for name, kind in zip(names, model.jnt_type, strict=True):
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            raise ConfigurationError(f"joint {name!r} of the rigid model is no hinge; trees of hinges are needed")
    for joint in joints:
        if joint not in names:
            raise unknown_name("joint of the rigid model", joint, names)
    if sorted(joints) != sorted(names):
        raise ConfigurationError(
            f"all {len(names)} joints must be named ({', '.join(names)}), got {len(joints)}: {', '.join(joints)}"
        )


def _convert(model: mujoco.MjModel) -> pinocchio.Model:
    """Pinocchio's model of a MuJoCo tree of hinges."""
    tree = pinocchio.Model()
    tree.gravity.linear = model.opt.gravity.copy()
    joint_of = {0: 0}  # MuJoCo body -> Pinocchio joint that carries it
    T_joint_body = {0: pinocchio.SE3.Identity()}
    for b in range(1, model.nbody):
        parent = int(model.body_parentid[b])
        T = T_joint_body[parent] * _placement(model.body_pos[b], model.body_quat[b])
        carrier = joint_of[parent]
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            T_body_anchor = pinocchio.SE3(np.eye(3), model.jnt_pos[j].copy())
            revolute = pinocchio.JointModelRevoluteUnaligned(model.jnt_axis[j].copy())
            carrier = tree.addJoint(carrier, revolute, T * T_body_anchor, model.joint(j).name)
            T = T_body_anchor.inverse()
        joint_of[b], T_joint_body[b] = carrier, T
        T_body_com = _placement(model.body_ipos[b], model.body_iquat[b])
        inertia = pinocchio.Inertia(float(model.body_mass[b]), np.zeros(3), np.diag(model.body_inertia[b]))
        tree.appendBodyToJoint(carrier, inertia, T * T_body_com)
    return tree


def _placement(position: Array, quaternion: Array) -> pinocchio.SE3:
    w, x, y, z = quaternion
    return pinocchio.SE3(pinocchio.Quaternion(w, x, y, z), position.copy())
