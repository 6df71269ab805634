"""Statics of legs that hang from one pelvis, for many robots at once.

The legs are a tree of `elastic_env.rigid.tree.kernels` whose base is the pelvis and whose tips are
the feet. The direction of gravity gives the orientation of the pelvis.
"""

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import solve_stiffness
from elastic_env.rigid.tree import kernels
from elastic_env.rigid.tree.links import Tree

_ANKLE: Array = np.zeros(3)
_NO_ATTITUDE: Array = np.empty((0, 2))
"""No attitudes: results are in the frame of the pelvis."""
_NO_TORQUE: Array = np.empty((0, 0))


class LegChains:
    """The L legs of one robot, chains of equally many hinges at one pelvis, n hinges in all.

    Args:
        model: Compiled rigid model.
        legs: Joint names of every leg, from hip to foot.
        weightless: Bodies to count without weight, such as feet below a force sensor.

    Attributes:
        mass: Mass of the whole robot, without the weightless bodies [kg].
        loads_type: Type of the rows of loads on a robot.
        links: The tree, rows of `elastic_env.rigid.tree.kernels.LINK`.
    """

    def __init__(
        self, model: mujoco.MjModel, legs: Sequence[Sequence[str]], weightless: Sequence[int] = ()
    ) -> None:
        model_copy = copy.copy(model)
        model_copy.body_mass[list(weightless)] = 0.0
        pelvis = int(model.body_parentid[model.joint(legs[0][0]).bodyid[0]])
        joints = [name for leg in legs for name in leg]
        tree = Tree.of(model_copy, joints, {}, root=pelvis)
        for number, leg in enumerate(legs):
            foot = int(model.joint(leg[-1]).bodyid[0])
            link = tree.links[tree.carrier[foot]]
            link["tip"] = number
            link["tip_R"] = tree.R[foot]
            link["tip_place"] = tree.place[foot]
        self.mass = float(model_copy.body_mass.sum())
        self.loads_type = kernels.loads_type(len(legs))
        self.links = tree.links
        self._legs = len(legs)

    def center_of_mass(self, q: Array) -> Array:
        """Center of mass of the robot in the pelvis frame, (rows, n) [rad] to (rows, 3) [m]."""
        return self.com_and_feet(q)[0]

    def com_and_feet(
        self, q: Array, point: Array = _ANKLE, attitude: Array = _NO_ATTITUDE
    ) -> tuple[Array, Array]:
        """Return the center of mass of the robot and a point fixed in each foot, from the pelvis.

        Args:
            q: (rows, n) [rad].
            point: Point from the ankle, in the frame of the foot, (3,) [m].
            attitude: Roll and pitch of the pelvis, for a level frame, (rows, 2) [rad]; no rows,
                (0, 2), for the pelvis frame.

        Returns:
            (rows, 3) and (rows, L, 3) [m].
        """
        com = np.empty((len(q), 3))
        feet = np.empty((len(q), self._legs, 3))
        kernels.com_and_tips(self.links, _dense(q), _dense(attitude), point, com, feet)
        return com, feet

    def sole_tilts(self, q: Array, attitude: Array, bending: Array) -> Array:
        """Return the tilt of the soles by motors and IMU, and its share by the joints' deflection.

        Args:
            q: (rows, n) [rad].
            attitude: Roll and pitch of the pelvis, (rows, 2) [rad].
            bending: Deflection of the joints, (rows, n) [rad].

        Returns:
            Both, (2, rows, L, 2) [rad].
        """
        tilts = np.empty((2, len(q), self._legs, 2))
        motion = (_dense(q), _dense(attitude), _dense(bending))
        kernels.tip_tilts(self.links, *motion, *tilts)
        return tilts

    def loads(
        self,
        rows: int,
        gravity: Array | float = 0.0,
        mass: Array | float = 0.0,
        point: Array | float = 0.0,
        wrench: tuple[Array, Array] | None = None,
    ) -> Any:
        """Return rows of loads, one for each robot.

        A mass is negative where the ground carries the foot. A wrench turns with its foot.

        Args:
            rows: Number of rows.
            gravity: Acceleration of gravity in the pelvis frame, (rows, 3) [m/s²].
            mass: Mass at a point of each foot, (rows, L) [kg].
            point: Point from the ankle, in the frame of the foot, (rows, L, 3) [m].
            wrench: Force on each foot and moment about its ankle, in the frame of the foot, (rows,
                L, 3) each [N], [N·m]; None for none.
        """
        loads = np.zeros(rows, self.loads_type)
        loads["gravity"] = gravity
        loads["mass"] = mass
        loads["point"] = point
        if wrench is not None:
            loads["wrench"] = np.stack(wrench, axis=-2)
        return loads

    def torque(self, loads: Any, q: Array) -> Array:
        """Joint torques that hold the legs under loads, (rows,), from (rows, n) [rad] to [N·m]."""
        torque = np.empty(q.shape)
        kernels.gravity_torques(self.links, loads, _dense(q), torque)
        return torque


class LegTorque(NamedTuple):
    """Torques of legs under loads that stay the same in any posture, (num_worlds, n)."""

    chains: LegChains
    loads: Any
    """Rows of `LegChains.loads_type`, (num_worlds,)."""

    def gravity_torque(self, q: Array) -> Array:
        """Torque that holds the legs, (num_worlds, n) [rad] to [N·m]."""
        return self.chains.torque(self.loads, q)

    def gravity_gradient(self, q: Array) -> Array:
        """∂τ_g/∂q, (num_worlds, n, n) [N·m/rad].

        It is not symmetric under a wrench, which turns with its foot.
        """
        gradient = np.empty((*q.shape, q.shape[1]))
        kernels.gravity_gradients(self.chains.links, self.loads, _dense(q), gradient)
        return gradient

    def solve(self, q: Array, stiffness: Array, torque: Array | None = None) -> Array:
        """(K + ∂τ_g/∂q)⁻¹ τ, leg by leg.

        Args:
            q: (num_worlds, n) [rad].
            stiffness: K, (n,) [N·m/rad].
            torque: τ, (num_worlds, n) [N·m]; None for τ_g.

        Returns:
            (num_worlds, n) [rad].

        Raises:
            ElasticError: The matrix is singular.
        """
        x = np.empty(q.shape)
        right = _NO_TORQUE if torque is None else _dense(torque)
        links = self.chains.links
        if not kernels.solve_legs(links, self.loads, _dense(q), stiffness, right, x):
            torque = self.gravity_torque(q) if torque is None else torque
            # raises the error of a singular matrix
            K = np.broadcast_to(stiffness, q.shape)
            solve_stiffness(K, self.gravity_gradient(q), torque)
        return x


def _dense(values: Array) -> Array:
    """Return a contiguous array, so that one kernel fits all arrays."""
    return np.ascontiguousarray(values)
