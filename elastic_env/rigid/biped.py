"""Model of a robot with two legs, for gaits."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid.leg_chains import LegChains
from elastic_env.rigid.leg_kinematics import JOINTS, LegGeometry, leg_angles, turn


@dataclass(frozen=True, eq=False)
class Biped:
    """A robot with a left and a right leg of six hinges each.

    Attributes:
        rigid: Compiled rigid model with a free pelvis.
        joint_names: The twelve hinges, left leg first, from hip to foot.
        leg: Lengths of thigh and shank.
        hips: Intersections of the hip axes, left and right, in the pelvis frame, (2, 3) [m].
        ankle_height: Height of the ankle axes over the sole [m].
        sole_half_size: Half length and half width of the soles, whose middles lie under the ankles
            [m].
    """

    rigid: mujoco.MjModel
    joint_names: tuple[str, ...]
    leg: LegGeometry
    hips: Array
    ankle_height: float
    sole_half_size: tuple[float, float]

    @cached_property
    def chains(self) -> LegChains:
        """The legs for batches."""
        return LegChains(self.rigid, self._legs)

    @cached_property
    def chains_above_feet(self) -> LegChains:
        """The legs without weight of the feet: the sensors at the ankles do not measure it."""
        return LegChains(self.rigid, self._legs, weightless=self.feet)

    @cached_property
    def weightless_chains(self) -> LegChains:
        """The legs as if all mass were in the pelvis."""
        bodies = [int(self.rigid.joint(name).bodyid[0]) for name in self.joint_names]
        return LegChains(self.rigid, self._legs, weightless=bodies)

    @cached_property
    def feet(self) -> list[int]:
        """Bodies of the feet in the rigid model, left first."""
        return [int(self.rigid.joint(leg[-1]).bodyid[0]) for leg in self._legs]

    @property
    def _legs(self) -> list[tuple[str, ...]]:
        half = len(JOINTS)
        return [self.joint_names[:half], self.joint_names[half:]]

    @cached_property
    def weight(self) -> float:
        """Weight of the whole robot [N]."""
        return self.chains.mass * self.gravity

    @cached_property
    def gravity(self) -> float:
        """Acceleration of gravity [m/s²]."""
        return float(np.linalg.norm(self.rigid.opt.gravity))

    @property
    def footholds(self) -> Array:
        """Middles of the soles side by side under the hips, at the usual width, (2, 2) [m]."""
        return self.hips[:, :2]

    @property
    def ankles(self) -> Array:
        """Ankles with the feet flat on their footholds, left first, (2, 3) [m]."""
        return np.hstack([self.footholds, np.full((2, 1), self.ankle_height)])

    def joint_angles(
        self, pelvis: Array, ankles: Array, heading: Array | float = 0.0, foot_yaw: Any = 0.0
    ) -> Array:
        """Inverse kinematics with level pelvis and soles.

        Args:
            pelvis: Position of the pelvis, (..., 3) [m].
            ankles: Positions of the ankles, (..., 2, 3) [m].
            heading: Heading of the pelvis, (...) [rad].
            foot_yaw: Headings of the feet, (..., 2) [rad].

        Returns:
            (..., 12) [rad].

        Raises:
            ElasticError: A foot is out of reach.
        """
        heading = np.asarray(heading)[..., None]
        relative_yaw = heading - foot_yaw
        target = turn(ankles - pelvis[..., None, :], -heading) - self.hips
        level = np.broadcast_to(np.eye(3), (*target.shape, 3))
        # the hip's first axis is vertical: solve for a parallel sole, then turn the whole leg
        q = leg_angles(self.leg, turn(target, relative_yaw), level)
        q[..., 0] -= relative_yaw
        return q.reshape(*pelvis.shape[:-1], 2 * len(JOINTS))
