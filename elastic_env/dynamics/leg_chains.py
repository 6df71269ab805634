r"""Statics of legs hanging from one pelvis, in NumPy for a whole batch: center of mass, feet, joint torques, gradients.

Every leg is a chain of hinges about coordinate axes, so that taking a vector from link to link mixes two of its
components. All is computed in the frames of the links.

What joint i carries has, from the joint's anchor, the first moment l_i (kg·m). Under gravity g the torque that holds it
is, with the joint's axis z_i,

.. math:: \tau_i = -z_i \cdot (l_i \times g)

Ground that takes a weight W at a point of the sole is a mass −W/g in that point, which makes this Eq. 4 of the paper
with Jacobians from the center of mass to the contact point. A wrench on the foot, with the moment n_i about the anchor
of joint i, adds

.. math:: \tau_i = -z_i \cdot n_i

If joint j turns, all that it carries turns about its anchor. For a joint i before it

* weights keep their direction, and their moment changes by (z_j × l_j) × g; they have a potential, so the gradient is
  symmetric;
* a wrench (f, n) that is fixed in the foot, as a sensor in the foot measures it, changes by z_j × f and z_j × n_j. For
  i = j and i after j nothing changes.

Legs do not couple: the pelvis' orientation is given by g. Vectors have their three components first and the batch last,
(3, ..., L), joints before both, so that every operation runs over whole batches.
"""

from collections.abc import Sequence
from typing import TypeAlias

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray

Part: TypeAlias = list[tuple[int, Array]]
"""The components of a constant vector that are not zero, with their values on all legs."""

_OTHERS = {0: (1, 2), 1: (2, 0), 2: (0, 1)}
"""The axes into which the others turn: a rotation about the key turns the first towards the second."""
_LEVER, _FORCE, _MOMENT = range(3)
"""What a joint carries: first moment of the masses, and a wrench."""


class LegChains:
    """Legs of one robot, each a chain of hinges about the axes of the pelvis frame; L legs of J joints.

    Args:
        model: Compiled rigid model.
        legs: Joint names of every leg, from hip to foot, equally many.
        feet_weigh: Whether the feet have mass; not where a sensor above them weighs them already.

    Raises:
        ConfigurationError: A leg is no chain of single hinges about a coordinate axis, or its links are turned.

    Attributes:
        axis: Coordinate axis that each joint turns about, J.
        offset: Origin of each link in the frame of the link before it, J parts [m].
        moment: First moment of each link from its anchor, with what is beyond it hung into the next anchor, J parts
            [kg·m].
        mass: Mass of the whole robot [kg].
    """

    def __init__(self, model: mujoco.MjModel, legs: Sequence[Sequence[str]], feet_weigh: bool = True) -> None:
        if len({len(leg) for leg in legs}) != 1:
            raise ConfigurationError(f"all legs must have equally many joints, got {[len(leg) for leg in legs]}")
        joints = np.array([[model.joint(name).id for name in leg] for leg in legs])
        bodies = model.jnt_bodyid[joints]
        axis = np.argmax(np.abs(model.jnt_axis[joints[0]]), axis=-1)
        _require_chains(model, joints, bodies, axis)
        mass = model.body_mass[bodies]
        if not feet_weigh:
            mass[:, -1] = 0.0
        carried = np.cumsum(mass[:, ::-1], axis=1)[:, ::-1]
        offset = model.body_pos[bodies]  # (L, J, 3)
        moment = mass[..., None] * model.body_ipos[bodies]
        moment[:, :-1] += carried[:, 1:, None] * offset[:, 1:]
        self.axis: list[int] = axis.tolist()
        self.offset, self.moment = _parts(offset), _parts(moment)
        before = np.concatenate([np.zeros_like(moment[:, :1]), moment[:, :-1]], axis=1)
        self._hung = _parts(np.stack([before, offset]))
        """What taking moment and foot across a joint adds to them, (2, L) per component."""
        self._last_moment = moment[:, -1]
        self.mass = float(model.body_mass.sum() - (0.0 if feet_weigh else model.body_mass[bodies[:, -1]].sum()))
        self._fixed_moment = self._moment_of_the_rest(model, bodies) + carried[:, 0] @ offset[:, 0]
        """First moment of the trunk, and of the legs as if they were in their hips [kg·m]."""

    def posture(self, q: Array) -> "LegPosture":
        """The legs at joint angles, (..., L, J) [rad]."""
        return LegPosture(self, q)

    def center_of_mass(self, q: Array) -> Array:
        """Center of mass of the whole robot in the pelvis frame, (..., L, J) [rad] to (..., 3) [m]."""
        return self.com_and_feet(q)[0]

    def com_and_feet(self, q: Array, point: Sequence[float] = (0.0, 0.0, 0.0)) -> tuple[Array, Array]:
        """Center of mass of the whole robot, and a point that is fixed in each foot, in the pelvis frame.

        Args:
            q: (..., L, J) [rad].
            point: From the ankle, in the frame of the foot [m].

        Returns:
            (..., 3) and (..., L, 3) [m].
        """
        posture = self.posture(q)
        shape = [2, *[1] * (q.ndim - 2), -1]
        foot = np.broadcast_to(np.asarray(point), self._last_moment.shape)
        pair = np.empty((3, 2, *posture.sine.shape[1:]))
        pair[:] = np.stack([self._last_moment, foot]).transpose(2, 0, 1).reshape(3, *shape)
        for j in range(len(self.axis) - 1, -1, -1):
            posture.into_parent(j, pair, out=pair)
            for component, added in self._hung[j]:
                pair[component] += added.reshape(shape)
        legs, feet = np.moveaxis(pair, 0, -1)
        return (self._fixed_moment + legs.sum(axis=-2)) / self.mass, feet

    def _moment_of_the_rest(self, model: mujoco.MjModel, bodies: IntArray) -> Array:
        """First moment of all bodies that are no leg, in the pelvis frame [kg·m]."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        pelvis = model.body_parentid[bodies[0, 0]]
        others = np.setdiff1d(np.arange(1, model.nbody), bodies)
        relative = (data.xipos[others] - data.xpos[pelvis]) @ data.xmat[pelvis].reshape(3, 3)
        return model.body_mass[others] @ relative


class LegPosture:
    """Legs at some joint angles.

    Args:
        chains: The legs.
        q: Joint angles, (..., L, J) [rad].
    """

    def __init__(self, chains: LegChains, q: Array) -> None:
        self.chains = chains
        angles = q.transpose(-1, *range(q.ndim - 1)).copy()
        self.sine, self.cosine = np.sin(angles), np.cos(angles)

    def into_link(self, j: int, vectors: Array, out: Array) -> Array:
        """Vectors of the link before joint j in the frame of the link behind it, (3, ...) to `out`."""
        first, second = _OTHERS[self.chains.axis[j]]
        return self._turned(j, vectors, out, first, second)

    def into_parent(self, j: int, vectors: Array, out: Array) -> Array:
        """Vectors of the link behind joint j in the frame of the link before it, (3, ...) to `out`, or in place."""
        first, second = _OTHERS[self.chains.axis[j]]
        return self._turned(j, vectors, out, second, first)

    def _turned(self, j: int, vectors: Array, out: Array, first: int, second: int) -> Array:
        """Seen from a frame that is turned from the first axis to the second."""
        s, c, x, y = self.sine[j], self.cosine[j], vectors[first], vectors[second]
        across_x, across_y = s * y, s * x  # before either is written over
        turned_x, turned_y = out[first], out[second]
        np.add(np.multiply(c, x, out=turned_x), across_x, out=turned_x)
        np.subtract(np.multiply(c, y, out=turned_y), across_y, out=turned_y)
        if out is not vectors:
            out[self.chains.axis[j]] = vectors[self.chains.axis[j]]
        return out


class LegLoads:
    """Legs at rest under gravity, under a mass at a point of each foot, and under a wrench on each foot.

    A mass is negative where the ground carries the foot; a wrench is known in the frame of its foot, and turns with it.

    Args:
        posture: Where the legs are.
        gravity: Acceleration of gravity in the pelvis frame, (..., 3) [m/s²]; None for none.
        mass: At a point of each foot, (..., L) [kg]; None for none.
        point: From the ankle, in the frame of the foot, (..., L, 3) [m].
        wrench: Force on each foot and moment about its ankle, (..., L, 3) each [N], [N·m]; None for none.
        legs_weigh: Whether the legs themselves have mass.
    """

    def __init__(
        self,
        posture: LegPosture,
        gravity: Array | None = None,
        mass: Array | None = None,
        point: Array | None = None,
        wrench: tuple[Array, Array] | None = None,
        legs_weigh: bool = True,
    ) -> None:
        self._posture = posture
        self._gravity = None if gravity is None else self._in_links(gravity)
        self._has_wrench = wrench is not None
        self._carried = self._carried_by_joints(mass, point, wrench, legs_weigh)
        """What each joint carries, in the frame of its link, (J, 3, V, ...): first moment, force, moment."""

    def torque(self) -> Array:
        """Joint torques that hold the legs, (..., L, J) [N·m]."""
        torque = np.zeros_like(self._posture.sine)
        for j, axis in enumerate(self._posture.chains.axis):
            carried, own = self._carried[j], torque[j]
            if self._gravity is not None:
                first, second = _OTHERS[axis]
                lever, g = carried[:, _LEVER], self._gravity[j]
                np.subtract(lever[second] * g[first], lever[first] * g[second], out=own)
            if self._has_wrench:
                np.subtract(own, carried[axis, _MOMENT], out=own)
        return torque.transpose(*range(1, torque.ndim), 0)

    def gradient(self) -> Array:
        """∂τ/∂q, (..., L, J, J) [N·m/rad]; symmetric without a wrench."""
        posture, axes = self._posture, self._posture.chains.axis
        J, V, batch = len(axes), self._carried.shape[2], posture.sine.shape[1:]
        gradient = np.zeros((J, J, *batch))
        changes = np.zeros((3, V, J, *batch))  # of what is carried, by the joints from j on
        for j in range(J - 1, -1, -1):
            axis, (first, second) = axes[j], _OTHERS[axes[j]]
            carried, change = self._carried[j], changes[:, :, j]
            if self._gravity is not None:  # of the moment of the weights
                lever, g, by_weight = carried[:, _LEVER], self._gravity[j], change[:, _LEVER]
                np.multiply(lever[first], g[axis], out=by_weight[first])
                np.multiply(lever[second], g[axis], out=by_weight[second])
                np.negative(lever[first] * g[first] + lever[second] * g[second], out=by_weight[axis])
                np.negative(changes[axis, _LEVER, j:], out=gradient[j, j:])
                gradient[j + 1 :, j] = gradient[j, j + 1 :]
            if self._has_wrench:
                np.subtract(gradient[j, j + 1 :], changes[axis, _MOMENT, j + 1 :], out=gradient[j, j + 1 :])
                np.negative(carried[second, _FORCE:], out=change[first, _FORCE:])
                change[second, _FORCE:] = carried[first, _FORCE:]
            if j > 0:
                moved = changes[:, :, j:]
                self._take_across(j, posture.into_parent(j, moved, out=moved))
        return gradient.transpose(*range(2, gradient.ndim), 0, 1)

    def _in_links(self, gravity: Array) -> Array:
        """Gravity in the frames of all links, (J, 3, ...)."""
        posture = self._posture
        links = np.empty((len(posture.chains.axis), 3, *posture.sine.shape[1:]))
        vector = np.moveaxis(gravity, -1, 0)[..., None]
        for j, link in enumerate(links):
            vector = posture.into_link(j, vector, out=link)
        return links

    def _carried_by_joints(
        self, mass: Array | None, point: Array | None, wrench: tuple[Array, Array] | None, legs_weigh: bool
    ) -> Array:
        chains, posture = self._posture.chains, self._posture
        carried = np.zeros((len(chains.axis), 3, 1 if wrench is None else 3, *posture.sine.shape[1:]))
        foot = carried[-1]
        if mass is not None and point is not None:
            foot[:, _LEVER] = mass * np.moveaxis(point, -1, 0)
        if wrench is not None:
            foot[:, _FORCE], foot[:, _MOMENT] = (np.moveaxis(vector, -1, 0) for vector in wrench)
        for j in range(len(chains.axis) - 1, -1, -1):
            if self._gravity is not None and legs_weigh:
                for k, own in chains.moment[j]:
                    carried[j, k, _LEVER] += own
            if j > 0:
                before = self._take_across(j, posture.into_parent(j, carried[j], out=carried[j - 1]))
                if mass is not None:
                    for k, own in chains.offset[j]:
                        before[k, _LEVER] += mass * own
        return carried

    def _take_across(self, j: int, vectors: Array) -> Array:
        """Moments about the anchor of joint j, now in the frame of the link before, about that link's, (3, V, ...)."""
        if self._has_wrench:
            force, moment = vectors[:, _FORCE], vectors[:, _MOMENT]
            for k, own in self._posture.chains.offset[j]:  # d × f
                first, second = _OTHERS[k]
                moment[first] -= own * force[second]
                moment[second] += own * force[first]
        return vectors


def _parts(vectors: Array) -> list[Part]:
    """Vectors of all joints of all legs, (..., L, J, 3), joint by joint."""
    by_joint = vectors.transpose(-2, -1, *range(vectors.ndim - 2))
    return [[(k, component) for k, component in enumerate(vector) if component.any()] for vector in by_joint]


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
