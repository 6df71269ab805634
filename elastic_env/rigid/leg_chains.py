r"""Statics of legs hanging from one pelvis, for a whole batch: center of mass, feet, joint torques,
gradients.

Every leg is a chain of hinges about coordinate axes, so that taking a vector from link to link
mixes two of its components. All is computed in the frames of the links.

What joint i carries has, from the joint's anchor, the first moment l_i (kg·m). Under gravity g the
torque that holds it is, with the joint's axis z_i,

.. math:: \tau_i = -z_i \cdot (l_i \times g)

Ground that takes a weight W at a point of the sole is a mass −W/g in that point, which makes this
Eq. 4 of the paper with Jacobians from the center of mass to the contact point. A wrench on the
foot, with the moment n_i about the anchor of joint i, adds

.. math:: \tau_i = -z_i \cdot n_i

If joint j turns, all that it carries turns about its anchor. For a joint i before it

* weights keep their direction, and their moment changes by (z_j × l_j) × g; they have a potential,
  so the gradient is symmetric;
* a wrench (f, n) that is fixed in the foot, as a sensor in the foot measures it, changes by z_j × f
  and z_j × n_j. For i = j and i after j nothing changes.

Legs do not couple: the pelvis' orientation is given by g. `elastic_env.rigid.leg_kernels` computes
all this, row by row.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray
from elastic_env.rigid import leg_kernels as kernels


class LegChains:
    """Legs of one robot, each a chain of hinges about the axes of the pelvis frame; L legs of J
    joints.

    Args:
        model: Compiled rigid model.
        legs: Joint names of every leg, from hip to foot, equally many.
        feet_weigh: Whether the feet have mass; not where a sensor above them weighs them already.

    Raises:
        ConfigurationError: A leg is no chain of single hinges about a coordinate axis, or its links
            are turned.

    Attributes:
        axis: Coordinate axis that each joint turns about, (J,).
        legs: Row for the kernels, (1,): origins of the links in the frames of the links before them
            [m], first moments of the links from their anchors, with what is beyond hung into the
            next anchor [kg·m].
        mass: Mass of the whole robot [kg].
    """

    def __init__(
        self, model: mujoco.MjModel, legs: Sequence[Sequence[str]], feet_weigh: bool = True
    ) -> None:
        if len({len(leg) for leg in legs}) != 1:
            raise ConfigurationError(
                f"all legs must have equally many joints, got {[len(leg) for leg in legs]}"
            )
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
        last_moment = moment[:, -1].copy()
        moment[:, :-1] += carried[:, 1:, None] * offset[:, 1:]
        self.axis: IntArray = axis.astype(np.int64)
        self.mass = float(
            model.body_mass.sum() - (0.0 if feet_weigh else model.body_mass[bodies[:, -1]].sum())
        )
        # of the trunk, and of the legs as if they were in their hips
        fixed_moment = self._moment_of_the_rest(model, bodies) + carried[:, 0] @ offset[:, 0]
        row = (self.axis, offset, moment, last_moment, fixed_moment, self.mass)
        self.legs: Any = np.array([row], kernels.legs_type(*joints.shape))
        self._loads = kernels.loads_type(len(joints))

    def posture(self, q: Array) -> "LegPosture":
        """The legs at joint angles, (..., L, J) [rad]."""
        return LegPosture(self, q)

    def center_of_mass(self, q: Array) -> Array:
        """Center of mass of the whole robot in the pelvis frame, (..., L, J) [rad] to (..., 3)
        [m].
        """
        return self.com_and_feet(q)[0]

    def com_and_feet(
        self,
        q: Array,
        point: Sequence[float] | Array = (0.0, 0.0, 0.0),
        attitude: Array | None = None,
    ) -> tuple[Array, Array]:
        """Center of mass of the whole robot, and a point that is fixed in each foot, from the
        pelvis.

        Args:
            q: (..., L, J) [rad].
            point: From the ankle, in the frame of the foot [m].
            attitude: Roll and pitch of the pelvis, for a level frame, (..., 2) [rad]; None for the
                pelvis frame.

        Returns:
            (..., 3) and (..., L, 3) [m].
        """
        batch = q.shape[:-2]
        rows = as_rows(q, 2)
        com = np.empty((len(rows), 3))
        feet = np.empty((len(rows), rows.shape[1], 3))
        tilts = _IS_PELVIS if attitude is None else as_rows(attitude, 1)
        kernels.local_frames(self.legs, rows, tilts, np.asarray(point, dtype=np.float64), com, feet)
        return com.reshape(*batch, 3), feet.reshape(*batch, rows.shape[1], 3)

    def loads(self, rows: int) -> Any:
        """Rows for what loads the legs, (rows,), to be filled."""
        return np.empty(rows, self._loads)

    def torque(self, loads: Any, q: Array) -> Array:
        """Joint torques that hold the legs, (rows, L, J) [rad] to [N·m]; `loads` as of `loads`,
        (rows,).
        """
        torque = np.empty(q.shape)
        kernels.torques(self.legs, loads, q, torque)
        return torque

    def gradient(self, loads: Any, q: Array) -> Array:
        """∂τ/∂q of `torque`, (rows, L, J, J) [N·m/rad]."""
        gradient = np.empty((*q.shape, q.shape[-1]))
        kernels.gradients(self.legs, loads, q, gradient)
        return gradient

    def _moment_of_the_rest(self, model: mujoco.MjModel, bodies: IntArray) -> Array:
        """First moment of all bodies that are no leg, in the pelvis frame [kg·m]."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        pelvis = model.body_parentid[bodies[0, 0]]
        others = np.setdiff1d(np.arange(1, model.nbody), bodies)
        relative = (data.xipos[others] - data.xpos[pelvis]) @ data.xmat[pelvis].reshape(3, 3)
        return model.body_mass[others] @ relative


_IS_PELVIS: Array = np.empty((0, 2))
"""No attitudes: the level frame is that of the pelvis."""


class LegPosture:
    """Legs at some joint angles.

    Args:
        chains: The legs.
        q: Joint angles, (..., L, J) [rad].
    """

    def __init__(self, chains: LegChains, q: Array) -> None:
        self.chains = chains
        self.q = np.array(q, dtype=np.float64, order="C")


class LegLoads:
    """Legs at rest under gravity, under a mass at a point of each foot, and under a wrench on each
    foot.

    A mass is negative where the ground carries the foot; a wrench is known in the frame of its
    foot, and turns with it.

    Args:
        posture: Where the legs are.
        gravity: Acceleration of gravity in the pelvis frame, (..., 3) [m/s²]; None for none.
        mass: At a point of each foot, (..., L) [kg]; None for none.
        point: From the ankle, in the frame of the foot, (..., L, 3) [m].
        wrench: Force on each foot and moment about its ankle, (..., L, 3) each [N], [N·m]; None for
            none.
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
        self._chains = posture.chains
        self._q = posture.q
        rows = as_rows(self._q, 2)
        loads = self._chains.loads(len(rows)).reshape(self._q.shape[:-2])
        loads[...] = 0
        if gravity is not None:
            loads["gravity"] = gravity
        if mass is not None and point is not None:
            loads["mass"] = mass
            loads["point"] = point
        if wrench is not None:
            loads["wrench"][..., 0, :], loads["wrench"][..., 1, :] = wrench
        loads["legs_weigh"] = legs_weigh
        self._loads = loads.reshape(-1)
        self._rows = rows

    def torque(self) -> Array:
        """Joint torques that hold the legs, (..., L, J) [N·m]."""
        return self._chains.torque(self._loads, self._rows).reshape(self._q.shape)

    def gradient(self) -> Array:
        """∂τ/∂q, (..., L, J, J) [N·m/rad]; symmetric without a wrench."""
        return self._chains.gradient(self._loads, self._rows).reshape(
            *self._q.shape, self._q.shape[-1]
        )


def as_rows(values: Array, own: int) -> Array:
    """(..., a, b) with `own` axes of their own as (rows, a, b) in one piece, so that one kernel
    fits all.
    """
    shape = values.shape
    batch = shape[: len(shape) - own]
    if len(batch) == 1:
        return np.ascontiguousarray(values, dtype=np.float64)
    return np.ascontiguousarray(values, dtype=np.float64).reshape(
        int(np.prod(batch)), *shape[len(batch) :]
    )


def _require_chains(
    model: mujoco.MjModel, joints: IntArray, bodies: IntArray, axis: IntArray
) -> None:
    requirements = {
        "links parallel to the pelvis at zero angles": np.allclose(
            model.body_quat[bodies], [1.0, 0.0, 0.0, 0.0]
        ),
        "one hinge per link, at its origin and zero at the zero angle": (
            (model.body_jntnum[bodies] == 1).all()
            and (model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE).all()
            and not model.jnt_pos[joints].any()
            and not model.qpos0[model.jnt_qposadr[joints]].any()
        ),
        "axes +x, +y or +z in the same order": np.allclose(
            model.jnt_axis[joints], np.eye(3)[axis], atol=1e-12
        ),
        "each link hanging on the one before, and all legs on one body": (
            (model.body_parentid[bodies[:, 1:]] == bodies[:, :-1]).all()
            and (model.body_parentid[bodies[:, 0]] == model.body_parentid[bodies[0, 0]]).all()
        ),
        "nothing else hanging on a leg": (
            np.isin(np.flatnonzero(np.isin(model.body_parentid, bodies)), bodies).all()
        ),
    }
    missing = [requirement for requirement, is_met in requirements.items() if not is_met]
    if missing:
        raise ConfigurationError(
            f"legs must be chains with {'; '.join(missing)}; got the joints "
            f"{', '.join(model.joint(j).name for j in joints.ravel())}"
        )
