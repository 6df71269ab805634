r"""Statics of legs hanging from one pelvis, in NumPy for a whole batch: frames, center of mass, torques, gradient.

All vectors are in the pelvis frame. With axis z_i and anchor a_i of joint i of a leg, mass m_i and first moment
s_i = Σ m c of what it carries, gravity g, and a contact force f at the point p of its foot with a moment n, the joint
torque that holds the leg at rest is

.. math:: \tau_i = -z_i \cdot \big((s_i - m_i a_i) \times g + (p - a_i) \times f + n\big)

which is Eq. 4 of the paper with Jacobians from the center of mass to the contact point, and its gradient, with f fixed
and p moving with the foot, for j ≥ i

.. math:: \partial\tau_i / \partial q_j =
    -z_i \cdot \big((z_j \times (s_j - m_j a_j)) \times g + (z_j \times (p - a_j)) \times f\big)

It is symmetric, the Hessian of a potential. Legs do not couple: the pelvis' orientation is given by g.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import mujoco
import numpy as np

from elastic_env.errors import ConfigurationError
from elastic_env.signals import Array, IntArray


@dataclass(frozen=True)
class LegFrames:
    """Legs at some joint angles, in the pelvis frame; L legs of J joints.

    Attributes:
        axes: Joint axes z_i, (..., L, J, 3).
        anchors: A point on each axis, a_i, (..., L, J, 3) [m].
        moments: First moments m c of the joints' own links, (..., L, J, 3) [kg·m].
        carried: Mass that each joint carries, (L, J) [kg].
        foot_R: Orientation of the foot, (..., L, 3, 3).
        com: Center of mass of the whole robot, (..., 3) [m].
    """

    axes: Array
    anchors: Array
    moments: Array
    carried: Array
    foot_R: Array
    com: Array

    @cached_property
    def levers(self) -> Array:
        """s_i − m_i a_i of all that a joint carries, (..., L, J, 3) [kg·m]."""
        beyond = np.cumsum(self.moments[..., ::-1, :], axis=-2)[..., ::-1, :]
        return beyond - self.carried[..., None] * self.anchors

    @property
    def ankle(self) -> Array:
        """Origin of the foot, where the ankle axes meet, (..., L, 3) [m]."""
        return self.anchors[..., -1, :]


class LegChains:
    """Legs of one robot, each a chain of hinges about the axes of the pelvis frame.

    Args:
        model: Compiled rigid model.
        legs: Joint names of every leg, from hip to foot, equally many.
        feet_weigh: Whether the feet have mass; not where a sensor above them weighs them already.

    Raises:
        ConfigurationError: A leg is no chain of single hinges about a coordinate axis, or its links are turned.
    """

    def __init__(self, model: mujoco.MjModel, legs: Sequence[Sequence[str]], feet_weigh: bool = True) -> None:
        if len({len(leg) for leg in legs}) != 1:
            raise ConfigurationError(f"all legs must have equally many joints, got {[len(leg) for leg in legs]}")
        joints = np.array([[model.joint(name).id for name in leg] for leg in legs])
        bodies = model.jnt_bodyid[joints]
        self._axis = np.argmax(np.abs(model.jnt_axis[joints[0]]), axis=-1)
        _require_chains(model, joints, bodies, self._axis)
        offset = model.body_pos[bodies]  # (L, J, 3), of each link in its parent
        self._displacements = [
            [(component, offset[:, j, component]) for component in range(3) if offset[:, j, component].any()]
            for j in range(offset.shape[1])
        ]
        """Components of each link's offset that are not zero, with their values on every leg."""
        self._mass = model.body_mass[bodies]
        if not feet_weigh:
            self._mass[:, -1] = 0.0
        self._ipos = model.body_ipos[bodies]
        self._carried = np.cumsum(self._mass[:, ::-1], axis=1)[:, ::-1]
        self.mass = float(model.body_mass.sum() - (0.0 if feet_weigh else model.body_mass[bodies[:, -1]].sum()))
        """Mass of the whole robot [kg]."""
        self._trunk_moment = self._moment_of_the_rest(model, bodies)

    def frames(self, q: Array) -> LegFrames:
        """Forward kinematics of all legs, (..., L, J) [rad]."""
        shape, J = q.shape[:-1], q.shape[-1]
        angles = q.transpose(-1, *range(q.ndim - 1)).copy()
        sine, cosine = np.sin(angles), np.cos(angles)
        # joints and components come first in memory, so that every operation runs over whole batches
        axes, anchors = np.empty((2, J, 3, *shape))
        columns = np.zeros((3, 3, *shape))  # of the orientation of the last link
        columns[0, 0] = columns[1, 1] = columns[2, 2] = 1.0
        links = np.empty((J, 3, 3, *shape))
        anchor = np.zeros((3, *shape))
        for j in range(J):
            for component, offset in self._displacements[j]:
                anchor = anchor + columns[component] * offset
            axis = self._axis[j]
            first, second = _OTHERS[axis]
            axes[j], anchors[j], turned = columns[axis], anchor, links[j]
            turned[axis] = columns[axis]
            turned[first] = cosine[j] * columns[first] + sine[j] * columns[second]
            turned[second] = cosine[j] * columns[second] - sine[j] * columns[first]
            columns = turned
        per_leg = (*[1] * len(shape), -1)  # against (..., L) of a joint and component
        ipos = self._ipos.T.reshape(3, J, *per_leg)
        coms = anchors + links[:, 0] * ipos[0] + links[:, 1] * ipos[1] + links[:, 2] * ipos[2]
        moments = self._mass.T.reshape(J, *per_leg) * coms
        legs = moments.sum(axis=0).sum(axis=-1)
        com = (self._trunk_moment + legs.transpose(*range(1, legs.ndim), 0)) / self.mass
        return LegFrames(
            axes=_vectors_last(axes),
            anchors=_vectors_last(anchors),
            moments=_vectors_last(moments),
            carried=self._carried,
            foot_R=columns.transpose(*range(2, columns.ndim), 1, 0),
            com=com,
        )

    def _moment_of_the_rest(self, model: mujoco.MjModel, bodies: IntArray) -> Array:
        """First moment of all bodies that are no leg, in the pelvis frame [kg·m]."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        pelvis = model.body_parentid[bodies[0, 0]]
        others = np.setdiff1d(np.arange(1, model.nbody), bodies)
        relative = (data.xipos[others] - data.xpos[pelvis]) @ data.xmat[pelvis].reshape(3, 3)
        return model.body_mass[others] @ relative


def holding_torque(frames: LegFrames, gravity: Array, force: Array, point: Array, moment: Array | None = None) -> Array:
    """Joint torques of legs at rest under contact forces, see the module.

    Args:
        frames: Where the legs are.
        gravity: Acceleration of gravity, (..., 3) [m/s²].
        force: On each foot by the ground, (..., L, 3) [N].
        point: Where it acts, (..., L, 3) [m].
        moment: About that point, (..., L, 3) [N·m]; None for none.

    Returns:
        τ, (..., L, J) [N·m].
    """
    load = cross(frames.levers, gravity[..., None, None, :])
    load += cross(point[..., None, :] - frames.anchors, force[..., None, :])
    if moment is not None:
        load += moment[..., None, :]
    return -dot(frames.axes, load)


def holding_torque_gradient(
    frames: LegFrames, gravity: Array, force: Array | None = None, point: Array | None = None
) -> Array:
    """∂τ/∂q of `holding_torque` with the force fixed in space and its point fixed in the foot, (..., L, J, J).

    Without force and point it is that of the legs' weight.
    """
    turned = cross(cross(frames.axes, frames.levers), gravity[..., None, None, :])
    if force is not None and point is not None:
        turned += cross(cross(frames.axes, point[..., None, :] - frames.anchors), force[..., None, :])
    product = -(frames.axes @ turned.swapaxes(-1, -2))
    J = product.shape[-1]
    return product * _upper(J, 0) + (product * _upper(J, 1)).swapaxes(-1, -2)


def cross(a: Array, b: Array) -> Array:
    """Vector product over the last axis, in the memory order of its larger argument, which makes it fast."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    like = a if a.shape[:-1] == x.shape else b
    product = np.empty_like(like) if like.shape[:-1] == x.shape else np.empty((*x.shape, 3))
    product[..., 0], product[..., 1], product[..., 2] = x, az * bx - ax * bz, ax * by - ay * bx
    return product


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis of three components."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def rotated(R: Array, v: Array) -> Array:
    """R v, (..., 3, 3) and (..., 3) to (..., 3)."""
    return R[..., 0] * v[..., 0, None] + R[..., 1] * v[..., 1, None] + R[..., 2] * v[..., 2, None]


_OTHERS = {0: (1, 2), 1: (2, 0), 2: (0, 1)}


@cache
def _upper(size: int, diagonal: int) -> Array:
    """Ones above a diagonal, the diagonal included."""
    return np.triu(np.ones((size, size)), diagonal)


def _vectors_last(array: Array) -> Array:
    """A view with joints and components last, (J, 3, ..., L) to (..., L, J, 3)."""
    return array.transpose(*range(2, array.ndim), 0, 1)


def _require_chains(model: mujoco.MjModel, joints: IntArray, bodies: IntArray, axis: IntArray) -> None:
    requirements = {
        "links parallel to the pelvis at zero angles": np.allclose(model.body_quat[bodies], [1.0, 0.0, 0.0, 0.0]),
        "one hinge per link, at its origin and zero at the zero angle": (
            (model.body_jntnum[bodies] == 1).all()
            and (model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE).all()
            and not model.jnt_pos[joints].any()
            and not model.qpos0[model.jnt_qposadr[joints]].any()
        ),
        "axes +x, +y or +z in the same order": np.allclose(model.jnt_axis[joints], np.eye(3)[axis], atol=1e-12),
        "each link hanging on the one before, and all legs on one body": (
            (model.body_parentid[bodies[:, 1:]] == bodies[:, :-1]).all()
            and (model.body_parentid[bodies[:, 0]] == model.body_parentid[bodies[0, 0]]).all()
        ),
        "nothing else hanging on a leg": np.isin(np.flatnonzero(np.isin(model.body_parentid, bodies)), bodies).all(),
    }
    missing = [requirement for requirement, is_met in requirements.items() if not is_met]
    if missing:
        raise ConfigurationError(
            f"legs must be chains with {'; '.join(missing)}; got the joints "
            f"{', '.join(model.joint(j).name for j in joints.ravel())}"
        )
