r"""Where markers on a tree of joints are, as a function of geometry, encoders and compliance.

The nominal model has a frame for each hinge, whose z axis is the hinge's axis. A real arm differs:

* its encoders read θ + o;
* each frame is displaced by small lengths v and turned by small angles ω against its parent;
* gravity turns each joint by φ = c ∘ Fᵀ m, with the moment m of all weight beyond the joint about
  its anchor, in the axes F of the joint's housing. c_z = 1/K is the compliance about the joint's
  own axis, so that φ_z = −τ_g/K is what Eq. 10 has. c_x and c_y are lateral compliance:
  bearings and links that bend [Tenhumberg2023];
* dry friction on the link holds a joint back from the side d = ±1 of its approach, and further
  torques may be known: m_z has −F d and τ_known besides the weight, as in `pose_model`;
* a tracker shows R p + t of the places p of markers, which are not exactly known either.

With `dh` each frame has the four parameters of Denavit and Hartenberg: a length and an angle about
the common normal of its axis and that of the parent, a length along its own axis, and the encoder's
offset. `full` has all three lengths and both angles across the axis.

Derivatives are exact. Each parameter is a twist of all that lies beyond a joint: an axis, and a
velocity at the anchor. It moves markers, and it moves weights, whose moments turn the joints anew:

.. math:: (1 - c \, \partial m/\partial\varphi) \, d\varphi = m \, dc + c \, dm

[Tenhumberg2023] J. Tenhumberg, B. Bäuml, "Calibration of an Elastic Humanoid Upper Body and
Efficient Compensation for Motion Planning", IEEE-RAS Humanoids.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.rigid.tree.links import Tree

Geometry = Literal["offsets", "dh", "full"]
"""What is unknown of the geometry besides markers and tracker: the encoders' offsets; also the
parameters of Denavit and Hartenberg; or all lengths and angles.
"""

_MOST_ITERATIONS = 600
_LAST_STEP_RAD = 1e-12
_FARTHEST_RAD = 1.0
"""Deflection beyond which none is looked for."""
_PARALLEL = 1e-6
_SMALL_RAD = 1e-6


@dataclass(frozen=True)
class Marker:
    """A marker of a tracker.

    Attributes:
        name: Site or body of the model.
        joint: Joint that carries it, -1 for the base.
        place: Nominal place in the frame of that joint, (3,) [m].
    """

    name: str
    joint: int
    place: Array


class Parameters(NamedTuple):
    """Values of all parameters, by kind.

    Attributes:
        translation, rotation: Frame of the tracker, (3,) [m] and a rotation vector (3,) [rad].
        marker: Displacement of the markers from their nominal places, (k, 3) [m].
        offset: Of the encoders, (n,) [rad].
        length: v of each joint, in the axes of its nominal frame, (n, 3) [m].
        angle: ω of each joint, likewise, (n, 3) [rad].
        compliance: c about the axes of each housing, (n, 3) [rad/(N·m)]; 1/K is the last one.
        friction: F of each joint, (n,) [N·m].
    """

    translation: Array
    rotation: Array
    marker: Array
    offset: Array
    length: Array
    angle: Array
    compliance: Array
    friction: Array


class AxialTorques(NamedTuple):
    """What acts about the joints' own axes beside the weight, n joints and N poses.

    Attributes:
        direction: Side of approach, (N, n): +1 from below, −1 from above, 0 unknown [1].
        known: Known further torque, (N, n) [N·m], positive where it turns the joint forward.
    """

    direction: Array
    known: Array

    def of_poses(self, chosen: IntArray) -> "AxialTorques":
        """Those of some of the poses."""
        return AxialTorques(self.direction[chosen], self.known[chosen])


class Posture(NamedTuple):
    """Frames of the joints in the base, n joints and N poses.

    Attributes:
        housing: Axes of each joint before it turns, (n, N, 3, 3).
        link: The same after, (n, N, 3, 3).
        anchor: (n, N, 3) [m].
        lever: First moment of the weight beyond each joint about its anchor, (n, N, 3) [N·m].
        marker: Places of the markers, (N, k, 3) [m].
    """

    housing: Array
    link: Array
    anchor: Array
    lever: Array
    marker: Array


class Twists(NamedTuple):
    """Small motions of all that lies beyond joints, P of them.

    Attributes:
        joint: (P,).
        axis: Angular velocity, (N, P, 3).
        velocity: Of the joint's anchor, (N, P, 3).
        turns_housing: Whether the joint's own housing turns too, (P,).
    """

    joint: IntArray
    axis: Array
    velocity: Array
    turns_housing: BoolArray


@dataclass(frozen=True, eq=False)
class GeometryModel:
    """Markers as a function of parameters, at given motor encoders.

    Attributes:
        joints: Names of the joints, (n,).
        parent: Joint before each joint, -1 for the base; parents come before their children, (n,).
        nominal: Frames in those of the parents where the joints are drawn, (n, 3, 3).
        anchor: Anchors in the frames of the parents, (n, 3) [m].
        drawn: Joint angles where the model is drawn, (n,) [rad].
        weight: Of the link behind each joint, (n,) [N].
        weight_moment: Its first moment about the anchor, in the link's frame, (n, 3) [N·m].
        down: Direction of gravity in the base, (3,).
        markers: Those that the tracker sees.
        alignment, origin: Rotation from base to tracker to begin with, (3, 3), and where the base
            is, (3,) [m].
    """

    joints: tuple[str, ...]
    parent: IntArray
    nominal: Array
    anchor: Array
    drawn: Array
    weight: Array
    weight_moment: Array
    down: Array
    markers: tuple[Marker, ...]
    alignment: Array
    origin: Array

    @classmethod
    def of(
        cls,
        tree: Tree,
        joints: Sequence[str],
        gravity: Array,
        markers: Sequence[tuple[str, int, Array]],
    ) -> Self:
        """Of the links of a rigid model.

        Args:
            tree: Links whose joints are in the model's order.
            joints: Names of these joints.
            gravity: Acceleration of gravity in the base, (3,) [m/s²].
            markers: Name, body and place in the body's frame [m] of each marker.
        """
        links = tree.links[1:]
        size = float(np.linalg.norm(gravity))
        seen = [
            Marker(name, tree.carrier[body] - 1, tree.place[body] + tree.R[body] @ place)
            for name, body, place in markers
        ]
        return cls(
            joints=tuple(joints),
            parent=links["parent"] - 1,
            nominal=links["R"],
            anchor=links["anchor"],
            drawn=links["zero"],
            weight=size * links["weight"],
            weight_moment=size * links["weight_moment"],
            down=gravity / size,
            markers=tuple(seen),
            alignment=np.eye(3),
            origin=np.zeros(3),
        )

    @property
    def num_joints(self) -> int:
        """Number of joints n."""
        return len(self.parent)

    @cached_property
    def is_beyond(self) -> BoolArray:
        """True where joint j is joint i or beyond it, (i, j)."""
        beyond = np.eye(self.num_joints, dtype=np.bool_)
        for j, parent in enumerate(self.parent):
            if parent >= 0:
                beyond[:, j] |= beyond[:, parent]
        return beyond

    @cached_property
    def normals(self) -> Array:
        """Unit vectors across each axis in its nominal frame, (n, 2, 3).

        The first one is the common normal of the axis and that of the parent, whose axis counts as
        vertical for the first joint. The second one completes a frame with the axis.
        """
        normals = np.empty((self.num_joints, 2, 3))
        for j in range(self.num_joints):
            before = self.nominal[j].T @ np.array([0.0, 0.0, 1.0])
            normal = np.cross(before, [0.0, 0.0, 1.0])
            if np.linalg.norm(normal) < _PARALLEL:
                normal = self.nominal[j].T @ self.anchor[j] * [1.0, 1.0, 0.0]
            if np.linalg.norm(normal) < _PARALLEL:
                normal = np.array([1.0, 0.0, 0.0])
            normals[j, 0] = normal / np.linalg.norm(normal)
            normals[j, 1] = np.cross([0.0, 0.0, 1.0], normals[j, 0])
        return normals

    def nominal_parameters(self) -> Parameters:
        """Those of the rigid nominal model."""
        n = self.num_joints
        return Parameters(
            translation=np.zeros(3),
            rotation=np.zeros(3),
            marker=np.zeros((len(self.markers), 3)),
            offset=np.zeros(n),
            length=np.zeros((n, 3)),
            angle=np.zeros((n, 3)),
            compliance=np.zeros((n, 3)),
            friction=np.zeros(n),
        )

    def predict_markers(
        self, parameters: Parameters, theta: Array, axial: AxialTorques | None = None
    ) -> Array:
        """Places of the markers as the tracker shows them, (N, k, 3) [m], at motor encoders (N, n).

        Raises:
            ElasticError: The load overcomes a joint.
        """
        return self._shown(parameters, self.posture(parameters, theta, axial).marker)

    def posture(
        self, parameters: Parameters, theta: Array, axial: AxialTorques | None = None
    ) -> Posture:
        """The joints at rest, by iteration: each deflection from the moments at the last ones.

        Args:
            parameters: Of the arm.
            theta: Motor encoders, (N, n) [rad].
            axial: What acts beside the weight; None for nothing.

        Raises:
            ElasticError: The load overcomes a joint.
        """
        angles = theta - parameters.offset - self.drawn
        turn = np.zeros((*angles.shape, 3))
        posture = self._place(parameters, angles, turn)
        if not parameters.compliance.any():
            return posture
        for _ in range(_MOST_ITERATIONS):
            settled = parameters.compliance * self._loads(parameters, posture, axial)
            change = np.abs(settled - turn).max()
            turn = settled
            if not change < _FARTHEST_RAD:
                break
            posture = self._place(parameters, angles, turn)
            if change < _LAST_STEP_RAD:
                return posture
        worst = int(np.abs(turn).max(axis=(0, 2)).argmax())
        raise ElasticError(
            f"gravity overcomes joint {self.joints[worst]!r} at a compliance of"
            f" {parameters.compliance[worst].max():.3g} rad/(N·m): there is no posture at rest"
        )

    def _loads(self, parameters: Parameters, posture: Posture, axial: AxialTorques | None) -> Array:
        """Moments that bend the joints, in the axes of the housings, (N, n, 3) [N·m]."""
        moments = self.moments(posture)
        if axial is not None:
            moments[..., 2] += axial.known - parameters.friction * axial.direction
        return moments

    def gradient(
        self, parameters: Parameters, theta: Array, axial: AxialTorques | None = None
    ) -> tuple[Array, Parameters]:
        """Places of the markers, and their derivatives; arguments as `posture`.

        Returns:
            Measured, (N, k, 3) [m], and the derivatives (N, k, 3, ...) by each parameter.
        """
        posture = self.posture(parameters, theta, axial)
        shown = self._shown(parameters, posture.marker)
        R = self._tracker(parameters)
        count = len(theta)
        n = self.num_joints
        k = len(self.markers)
        loads = self._loads(parameters, posture, axial)
        compliance = parameters.compliance
        # deflections φ of all joints: 1 − c ∂m/∂φ, and the markers by them
        housings = np.moveaxis(posture.housing, 0, 1)
        axes = housings @ _left_jacobian(compliance * loads)
        bending = self._about(axes, turns_housing=False)
        stiff = np.eye(3 * n) - self._moment_change(posture, bending, compliance)
        by_bending = self._marker_change(posture, bending)

        def by_turns(turns: Array, direct: Array | float = 0.0) -> Array:
            """Derivatives of the measurement by turns of the joints, (N, 3 n, P) [rad].

            `direct` is what the markers move besides.
            """
            turned = np.linalg.solve(stiff, turns)
            return R @ (direct + np.einsum("nkaq,nqp->nkap", by_bending, turned))

        def by(twists: Twists) -> Array:
            """Derivatives of the measurement by twists, (N, k, 3, P)."""
            turns = self._moment_change(posture, twists, compliance)
            return by_turns(turns, self._marker_change(posture, twists))

        turning = Twists(
            joint=np.arange(n),
            axis=np.moveaxis(posture.link[..., 2], 0, 1),
            velocity=np.zeros((count, n, 3)),
            turns_housing=np.zeros(n, dtype=np.bool_),
        )
        frames = self._nominal_frames(posture)
        tilting = self._about(frames @ _left_jacobian(parameters.angle))
        along = self._about(frames)
        along = along._replace(axis=along.velocity, velocity=along.axis)
        own = np.zeros((count, 3 * n, 3 * n))
        own[:, np.arange(3 * n), np.arange(3 * n)] = loads.reshape(count, 3 * n)
        held = np.zeros((count, 3 * n, n))
        if axial is not None:
            by_friction = -compliance[:, 2] * axial.direction
            held[:, np.arange(2, 3 * n, 3), np.arange(n)] = by_friction
        of_marker = np.zeros((count, k, 3, k, 3))
        for i, marker in enumerate(self.markers):
            of_marker[:, i, :, i] = R @ (
                np.eye(3) if marker.joint < 0 else posture.link[marker.joint]
            )
        return shown, Parameters(
            translation=np.broadcast_to(np.eye(3), (count, k, 3, 3)),
            rotation=-cross_matrix(shown - self.origin - parameters.translation)
            @ _left_jacobian(parameters.rotation),
            marker=of_marker,
            offset=-by(turning),
            length=by(along).reshape(count, k, 3, n, 3),
            angle=by(tilting).reshape(count, k, 3, n, 3),
            compliance=by_turns(own).reshape(count, k, 3, n, 3),
            friction=np.zeros((count, k, 3, n)) if axial is None else by_turns(held),
        )

    def _tracker(self, parameters: Parameters) -> Array:
        """Rotation from the base to the tracker, (3, 3)."""
        return rotation_of(parameters.rotation) @ self.alignment

    def _shown(self, parameters: Parameters, marker: Array) -> Array:
        return marker @ self._tracker(parameters).T + self.origin + parameters.translation

    def _place(self, parameters: Parameters, angles: Array, turn: Array) -> Posture:
        """Frames at given angles of the joints, and deflections in the axes of the housings."""
        count, n = angles.shape
        housing = np.empty((n, count, 3, 3))
        link = np.empty((n, count, 3, 3))
        anchor = np.empty((n, count, 3))
        lever = np.empty((n, count, 3))
        errors = rotation_of(parameters.angle)
        bent = rotation_of(turn)
        for j, parent in enumerate(self.parent):
            R = np.eye(3) if parent < 0 else link[parent]
            origin = np.zeros(3) if parent < 0 else anchor[parent]
            anchor[j] = origin + R @ (self.anchor[j] + self.nominal[j] @ parameters.length[j])
            housing[j] = R @ (self.nominal[j] @ errors[j])
            link[j] = housing[j] @ bent[:, j] @ rotation_about_z(angles[:, j])
            lever[j] = link[j] @ self.weight_moment[j]
        beyond = self.weight.copy()
        for j in range(n - 1, -1, -1):
            parent = self.parent[j]
            if parent >= 0:
                lever[parent] += lever[j] + beyond[j] * (anchor[j] - anchor[parent])
                beyond[parent] += beyond[j]
        places = [
            np.broadcast_to(marker.place + moved, (count, 3))
            if marker.joint < 0
            else anchor[marker.joint] + link[marker.joint] @ (marker.place + moved)
            for marker, moved in zip(self.markers, parameters.marker, strict=True)
        ]
        return Posture(housing, link, anchor, lever, np.stack(places, axis=1))

    def moments(self, posture: Posture) -> Array:
        """Moments of gravity about the anchors, in the axes of the housings, (N, n, 3) [N·m]."""
        moment = np.cross(posture.lever, self.down)
        return np.einsum("jnba,jnb->nja", posture.housing, moment)

    def _nominal_frames(self, posture: Posture) -> Array:
        """Axes of the nominal frames behind their parents' links, (N, n, 3, 3)."""
        count = posture.link.shape[1]
        parents = [
            np.broadcast_to(np.eye(3), (count, 3, 3)) if parent < 0 else posture.link[parent]
            for parent in self.parent
        ]
        return np.stack(parents, axis=1) @ self.nominal

    def _about(self, frames: Array, turns_housing: bool = True) -> Twists:
        """A turn of each joint about each axis of its frame, (N, n, 3, 3): 3 n twists."""
        count, n = frames.shape[:2]
        axis = frames.transpose(0, 1, 3, 2).reshape(count, 3 * n, 3)
        return Twists(
            joint=np.repeat(np.arange(n), 3),
            axis=axis,
            velocity=np.zeros_like(axis),
            turns_housing=np.full(3 * n, turns_housing),
        )

    def _marker_change(self, posture: Posture, twists: Twists) -> Array:
        """Velocities of the markers in the base, (N, k, 3, P)."""
        changes = []
        anchor = np.moveaxis(posture.anchor, 0, 1)[:, twists.joint]
        for i, marker in enumerate(self.markers):
            arm = posture.marker[:, i, None] - anchor
            moved = np.cross(twists.axis, arm) + twists.velocity
            carried = 0.0
            if marker.joint >= 0:
                carried = self.is_beyond[twists.joint, marker.joint]
            changes.append(moved * np.reshape(carried, (-1, 1)))
        return np.stack(changes, axis=1).transpose(0, 1, 3, 2)

    def _moment_change(self, posture: Posture, twists: Twists, compliance: Array) -> Array:
        """C times the change of the moments in the axes of the housings, (N, 3 n, P) [rad]."""
        count = posture.link.shape[1]
        changes = np.empty((self.num_joints, count, len(twists.joint), 3))
        lever = np.moveaxis(posture.lever, 0, 1)
        own_lever = lever[:, twists.joint]
        own_weight = (self.is_beyond @ self.weight)[twists.joint, None]
        of_outer = np.cross(twists.axis, own_lever) + own_weight * twists.velocity
        for j in range(self.num_joints):
            # the twist moves joint j itself, or weight beyond it
            carries = self.is_beyond[twists.joint, j][:, None]
            is_inner = self.is_beyond[j, twists.joint][:, None]
            of_inner = np.cross(twists.axis, lever[:, j, None])
            change = np.where(carries, of_inner, np.where(is_inner, of_outer, 0.0))
            moment = np.cross(change, self.down)
            turns = carries & ((twists.joint != j) | twists.turns_housing)[:, None]
            own = np.cross(posture.lever[j], self.down)[:, None]
            moment = moment - np.where(turns, np.cross(twists.axis, own), 0.0)
            changes[j] = moment @ posture.housing[j]
        stacked = changes.transpose(1, 0, 3, 2).reshape(count, 3 * self.num_joints, -1)
        return compliance.reshape(-1, 1) * stacked


def rotation_of(vectors: Array) -> Array:
    """Rotations by rotation vectors, (..., 3) [rad] to (..., 3, 3)."""
    flat = Rotation.from_rotvec(np.reshape(vectors, (-1, 3))).as_matrix()
    return flat.reshape(*np.shape(vectors)[:-1], 3, 3)


def rotation_about_z(angles: Array) -> Array:
    """Rotations about z, (N,) [rad] to (N, 3, 3)."""
    R = np.zeros((len(angles), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(angles)
    R[:, 1, 0] = np.sin(angles)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    return R


def _left_jacobian(vectors: Array) -> Array:
    """Angular velocity by the rate of a rotation vector, (..., 3) to (..., 3, 3)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    safe = np.where(angle < _SMALL_RAD, 1.0, angle)
    W = cross_matrix(vectors)
    first = np.where(angle < _SMALL_RAD, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(angle < _SMALL_RAD, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + first * W + second * (W @ W)


def cross_matrix(vectors: Array) -> Array:
    """Matrices of the cross product with vectors from the left, (..., 3) to (..., 3, 3)."""
    return np.cross(np.eye(3), np.expand_dims(vectors, -2))
