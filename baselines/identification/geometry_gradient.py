r"""Derivatives of markers on a tree of joints by geometry, encoders and compliance.

They are exact. Each parameter is a twist of everything beyond a joint: an axis, and a velocity at
the anchor. It moves markers, and it moves weights, whose moments turn the joints again:

.. math:: (1 - c \, \partial m/\partial\varphi) \, d\varphi = m \, dc + c \, dm

with the moments m, the compliances c and the deflections φ of `geometry_model`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from baselines.identification.geometry_model import (
    ArmParameters,
    AxialTorques,
    GeometryModel,
    Posture,
)
from baselines.identification.rotations import cross_matrix, left_jacobian
from elastic_env.core.signals import Array, BoolArray, IntArray


def marker_gradient(
    model: GeometryModel,
    parameters: ArmParameters,
    theta: Array,
    axial: AxialTorques | None = None,
) -> tuple[Array, ArmParameters]:
    """Places of the markers, and their derivatives; arguments as `GeometryModel.posture`.

    Returns:
        Places in the tracker's frame, (N, k, 3) [m], and the derivatives (N, k, 3, ...) by each
        parameter.
    """
    posture = model.posture(parameters, theta, axial)
    places = model.to_tracker(parameters, posture.marker)
    loads = model.loads(parameters, posture, axial)
    motion = _SmallMotion(model, parameters, posture, loads)
    frames = _nominal_frames(model, posture)
    lengths = _turns_about(frames)
    lengths = lengths._replace(axis=lengths.velocity, velocity=lengths.axis)
    angles = _turns_about(frames @ left_jacobian(parameters.angle))
    count, k, _ = places.shape
    n = model.num_joints
    is_own = np.eye(3 * n, dtype=np.bool_)
    diagonal = np.where(is_own, loads.reshape(count, 1, 3 * n), 0.0)
    by_compliance = motion.turn_gradient(diagonal)
    by_friction = np.zeros((count, k, 3, n))
    if axial is not None:
        turns = (-parameters.compliance[:, 2] * axial.direction)[:, None]
        by_friction = motion.turn_gradient(np.where(is_own[:, 2::3], turns, 0.0))
    return places, ArmParameters(
        translation=np.broadcast_to(np.eye(3), (count, k, 3, 3)),
        rotation=-cross_matrix(places - model.origin - parameters.translation)
        @ left_jacobian(parameters.rotation),
        marker=motion.marker_place_gradient(),
        offset=-motion.twist_gradient(_turns_of_joints(posture)),
        length=motion.twist_gradient(lengths).reshape(count, k, 3, n, 3),
        angle=motion.twist_gradient(angles).reshape(count, k, 3, n, 3),
        compliance=by_compliance.reshape(count, k, 3, n, 3),
        friction=by_friction,
    )


class _Twists(NamedTuple):
    """Small motions of everything beyond joints, P of them.

    Attributes:
        joint: Joint of each twist, (P,).
        axis: Angular velocity, (N, P, 3).
        velocity: Velocity of the joint's anchor, (N, P, 3).
        turns_housing: True if the joint's own housing turns too, (P,).
    """

    joint: IntArray
    axis: Array
    velocity: Array
    turns_housing: BoolArray


@dataclass(frozen=True, eq=False)
class _SmallMotion:
    """Motion of markers and joints by small changes about a posture.

    Attributes:
        model: The tree.
        parameters: Parameters of the posture.
        posture: Frames of the joints, n joints and N poses.
        loads: Moments that bend the joints, in the axes of the housings, (N, n, 3) [N·m].
    """

    model: GeometryModel
    parameters: ArmParameters
    posture: Posture
    loads: Array

    def marker_place_gradient(self) -> Array:
        """Derivatives by the places of the markers on their links, (N, k, 3, k, 3)."""
        R = self.model.tracker_rotation(self.parameters)
        k = len(self.model.markers)
        gradient = np.zeros((len(self.loads), k, 3, k, 3))
        for i, marker in enumerate(self.model.markers):
            link = np.eye(3) if marker.joint < 0 else self.posture.link[marker.joint]
            gradient[:, i, :, i] = R @ link
        return gradient

    def twist_gradient(self, twists: _Twists) -> Array:
        """Derivatives by twists, (N, k, 3, P)."""
        turns = self._moment_changes(twists)
        return self.turn_gradient(turns, self._marker_velocities(twists))

    def turn_gradient(self, turns: Array, direct: Array | float = 0.0) -> Array:
        """Derivatives of the places in the tracker's frame, (N, k, 3, P).

        Args:
            turns: Turns of the joints before the moments follow, (N, 3 n, P) [rad].
            direct: Velocities of the markers in the base without deflections, (N, k, 3, P).
        """
        matrix, by_deflections = self._deflections
        deflections = np.linalg.solve(matrix, turns)
        R = self.model.tracker_rotation(self.parameters)
        return R @ (direct + np.einsum("nkaq,nqp->nkap", by_deflections, deflections))

    @cached_property
    def _deflections(self) -> tuple[Array, Array]:
        """1 − c ∂m/∂φ, (N, 3 n, 3 n), and the markers' velocities in the base, (N, k, 3, 3 n)."""
        housings = np.moveaxis(self.posture.housing, 0, 1)
        axes = housings @ left_jacobian(self.parameters.compliance * self.loads)
        twists = _turns_about(axes, turns_housing=False)
        matrix = np.eye(3 * self.model.num_joints) - self._moment_changes(twists)
        return matrix, self._marker_velocities(twists)

    def _marker_velocities(self, twists: _Twists) -> Array:
        """Velocities of the markers in the base, (N, k, 3, P)."""
        velocities = []
        anchor = np.moveaxis(self.posture.anchor, 0, 1)[:, twists.joint]
        for i, marker in enumerate(self.model.markers):
            lever = self.posture.marker[:, i, None] - anchor
            velocity = np.cross(twists.axis, lever) + twists.velocity
            is_carried = 0.0
            if marker.joint >= 0:
                is_carried = self.model.is_beyond[twists.joint, marker.joint]
            velocities.append(velocity * np.reshape(is_carried, (-1, 1)))
        return np.stack(velocities, axis=1).transpose(0, 1, 3, 2)

    def _moment_changes(self, twists: _Twists) -> Array:
        """C times the change of the moments in the axes of the housings, (N, 3 n, P) [rad]."""
        n = self.model.num_joints
        count = len(self.loads)
        is_beyond = self.model.is_beyond
        changes = np.empty((n, count, len(twists.joint), 3))
        lever = np.moveaxis(self.posture.lever, 0, 1)
        carried_weight = (is_beyond @ self.model.weight)[twists.joint, None]
        by_carried = np.cross(twists.axis, lever[:, twists.joint])
        by_carried = by_carried + carried_weight * twists.velocity
        for j in range(n):
            # the twist moves joint j itself, or weight beyond it
            carries = is_beyond[twists.joint, j][:, None]
            is_beyond_joint = is_beyond[j, twists.joint][:, None]
            by_joint = np.cross(twists.axis, lever[:, j, None])
            beyond = np.where(is_beyond_joint, by_carried, 0.0)
            change = np.where(carries, by_joint, beyond)
            moment = np.cross(change, self.model.down)
            turns = carries & ((twists.joint != j) | twists.turns_housing)[:, None]
            joint_moment = np.cross(self.posture.lever[j], self.model.down)[:, None]
            moment = moment - np.where(turns, np.cross(twists.axis, joint_moment), 0.0)
            changes[j] = moment @ self.posture.housing[j]
        stacked = changes.transpose(1, 0, 3, 2).reshape(count, 3 * n, -1)
        return self.parameters.compliance.reshape(-1, 1) * stacked


def _nominal_frames(model: GeometryModel, posture: Posture) -> Array:
    """Axes of the nominal frames behind their parents' links, (N, n, 3, 3)."""
    base = np.broadcast_to(np.eye(3), posture.link.shape[1:])
    parents = [base if parent < 0 else posture.link[parent] for parent in model.parent]
    return np.stack(parents, axis=1) @ model.nominal


def _turns_of_joints(posture: Posture) -> _Twists:
    """Turns of the joints about their own axes, n twists."""
    axis = np.moveaxis(posture.link[..., 2], 0, 1)
    n = axis.shape[1]
    return _Twists(np.arange(n), axis, np.zeros_like(axis), np.zeros(n, dtype=np.bool_))


def _turns_about(frames: Array, turns_housing: bool = True) -> _Twists:
    """A turn of each joint about each axis of its frame, (N, n, 3, 3): 3 n twists."""
    count, n = frames.shape[:2]
    axis = frames.transpose(0, 1, 3, 2).reshape(count, 3 * n, 3)
    return _Twists(
        joint=np.repeat(np.arange(n), 3),
        axis=axis,
        velocity=np.zeros_like(axis),
        turns_housing=np.full(3 * n, turns_housing),
    )
