"""Places of markers on a tree of joints by geometry, encoders and compliance.

The nominal model has a frame for each hinge, whose z axis is the hinge's axis. A real arm differs:

* its encoders read θ + o;
* each frame is displaced by small lengths v and turned by small angles ω against its parent;
* gravity turns each joint by φ = c ∘ Fᵀ m, with the moment m of all weight beyond the joint about
  its anchor, in the axes F of the joint's housing. c_z = 1/K is the compliance about the joint's
  own axis, so that φ_z = −τ_g/K is what Eq. 10 has. c_x and c_y are lateral compliance:
  bearings and links that bend [Tenhumberg2023];
* dry friction on the link holds a joint back from the side d = ±1 of its approach, and further
  torques may be known: m_z has −F d and τ_known besides the weight, as in `pose_model`;
* a tracker measures R p + t of the places p of markers, which are not exactly known either.

With `dh` each frame has the four parameters of Denavit and Hartenberg: a length and an angle about
the common normal of its axis and that of the parent, a length along its own axis, and the encoder's
offset. `full` has all three lengths and both angles across the axis. `geometry_gradient` has the
derivatives.

[Tenhumberg2023] J. Tenhumberg, B. Bäuml, "Calibration of an Elastic Humanoid Upper Body and
Efficient Compensation for Motion Planning", IEEE-RAS Humanoids.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np

from baselines.identification.rotations import rotation_of
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.rigid.leg_kinematics import rotation_z
from elastic_env.rigid.tree.links import Tree

Geometry = Literal["offsets", "dh", "full"]
"""Unknown geometry besides markers and tracker: the encoders' offsets; also the parameters of
Denavit and Hartenberg; or all lengths and angles.
"""

_MOST_ITERATIONS = 600
_LAST_STEP_RAD = 1e-12
_LARGEST_CHANGE_RAD = 1.0
"""Change of a deflection in one iteration from which on the iteration diverges."""
_PARALLEL = 1e-6
"""Length of a cross product below which two axes count as parallel."""


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


class ArmParameters(NamedTuple):
    """Values of all parameters, by kind.

    Attributes:
        translation, rotation: Frame of the tracker, (3,) [m] and a rotation vector (3,) [rad].
        marker: Displacement of the markers from their nominal places, (k, 3) [m].
        offset: Offsets of the encoders, (n,) [rad].
        length: v of each joint, in the axes of its nominal frame, (n, 3) [m].
        angle: ω of each joint, in the same axes, (n, 3) [rad].
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
    """Friction and known torques about the joints' own axes, n joints and N poses.

    Attributes:
        direction: Side of approach, (N, n): +1 from below, −1 from above, 0 unknown [1].
        known_torque: Known torque besides the weight, (N, n) [N·m], positive where it turns the
            joint forward.
    """

    direction: Array
    known_torque: Array

    def part(self, poses: IntArray) -> "AxialTorques":
        """Torques of some of the poses."""
        return AxialTorques(self.direction[poses], self.known_torque[poses])


class Posture(NamedTuple):
    """Frames of the joints in the base, n joints and N poses.

    Attributes:
        housing: Axes of each joint before it turns, (n, N, 3, 3).
        link: Axes of each joint after it has turned, (n, N, 3, 3).
        anchor: Point on the axis of each joint, (n, N, 3) [m].
        lever: First moment of the weight beyond each joint about its anchor, (n, N, 3) [N·m].
        marker: Places of the markers, (N, k, 3) [m].
    """

    housing: Array
    link: Array
    anchor: Array
    lever: Array
    marker: Array


@dataclass(frozen=True, eq=False)
class GeometryModel:
    """Markers as a function of parameters, at given motor encoders.

    Attributes:
        joints: Names of the joints, (n,).
        parent: Joint before each joint, -1 for the base; parents come before their children, (n,).
        nominal: Frames in the frames of the parents at the reference angles, (n, 3, 3).
        anchor: Anchors in the frames of the parents, (n, 3) [m].
        reference: Reference angles of the joints, at which the model is drawn, (n,) [rad].
        weight: Weight of the link behind each joint, (n,) [N].
        weight_moment: Its first moment about the anchor, in the link's frame, (n, 3) [N·m].
        down: Direction of gravity in the base, (3,).
        markers: Markers that the tracker measures.
        alignment, origin: First rotation from base to tracker, (3, 3), and first place of the base,
            (3,) [m].
    """

    joints: tuple[str, ...]
    parent: IntArray
    nominal: Array
    anchor: Array
    reference: Array
    weight: Array
    weight_moment: Array
    down: Array
    markers: tuple[Marker, ...]
    alignment: Array
    origin: Array

    @classmethod
    def from_tree(
        cls,
        tree: Tree,
        joints: Sequence[str],
        gravity: Array,
        markers: Sequence[tuple[str, int, Array]],
    ) -> Self:
        """Model of the links of a rigid model.

        Args:
            tree: Links whose joints are in the model's order.
            joints: Names of these joints.
            gravity: Acceleration of gravity in the base, (3,) [m/s²].
            markers: Name, body and place in the body's frame [m] of each marker.
        """
        links = tree.links[1:]
        size = float(np.linalg.norm(gravity))
        on_joints = [
            Marker(name, tree.carrier[body] - 1, tree.place[body] + tree.R[body] @ place)
            for name, body, place in markers
        ]
        return cls(
            joints=tuple(joints),
            parent=links["parent"] - 1,
            nominal=links["R"],
            anchor=links["anchor"],
            reference=links["zero"],
            weight=size * links["weight"],
            weight_moment=size * links["weight_moment"],
            down=gravity / size,
            markers=tuple(on_joints),
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

        The first one is the common normal of the axis and the parent's axis, which counts as
        vertical for the first joint. The second one completes a frame with the axis.
        """
        normals = np.empty((self.num_joints, 2, 3))
        for j in range(self.num_joints):
            parent_axis = self.nominal[j].T @ np.array([0.0, 0.0, 1.0])
            normal = np.cross(parent_axis, [0.0, 0.0, 1.0])
            if np.linalg.norm(normal) < _PARALLEL:
                normal = self.nominal[j].T @ self.anchor[j] * [1.0, 1.0, 0.0]
            if np.linalg.norm(normal) < _PARALLEL:
                normal = np.array([1.0, 0.0, 0.0])
            normals[j, 0] = normal / np.linalg.norm(normal)
            normals[j, 1] = np.cross([0.0, 0.0, 1.0], normals[j, 0])
        return normals

    def nominal_parameters(self) -> ArmParameters:
        """Parameters of the rigid nominal model."""
        n = self.num_joints
        return ArmParameters(
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
        self, parameters: ArmParameters, theta: Array, axial: AxialTorques | None = None
    ) -> Array:
        """Places of the markers in the tracker's frame, (N, k, 3) [m], at motor encoders (N, n).

        Raises:
            ElasticError: The load overcomes a joint.
        """
        posture = self.posture(parameters, theta, axial)
        return self.to_tracker(parameters, posture.marker)

    def posture(
        self, parameters: ArmParameters, theta: Array, axial: AxialTorques | None = None
    ) -> Posture:
        """The joints at rest, by iteration: deflections follow from the moments at the last ones.

        Args:
            parameters: Parameters of the arm.
            theta: Motor encoders, (N, n) [rad].
            axial: Torques besides the weight; None for none.

        Raises:
            ElasticError: The load overcomes a joint.
        """
        angles = theta - parameters.offset - self.reference
        turn = np.zeros((*angles.shape, 3))
        posture = self._place(parameters, angles, turn)
        if not parameters.compliance.any():
            return posture
        for _ in range(_MOST_ITERATIONS):
            next_turn = parameters.compliance * self.loads(parameters, posture, axial)
            change = np.abs(next_turn - turn).max()
            turn = next_turn
            if not change < _LARGEST_CHANGE_RAD:
                break
            posture = self._place(parameters, angles, turn)
            if change < _LAST_STEP_RAD:
                return posture
        worst = int(np.abs(turn).max(axis=(0, 2)).argmax())
        raise ElasticError(
            f"gravity overcomes joint {self.joints[worst]!r} at a compliance of"
            f" {parameters.compliance[worst].max():.3g} rad/(N·m): there is no posture at rest"
        )

    def loads(
        self, parameters: ArmParameters, posture: Posture, axial: AxialTorques | None
    ) -> Array:
        """Moments that bend the joints, in the axes of the housings, (N, n, 3) [N·m]."""
        moments = self.moments(posture)
        if axial is not None:
            friction = parameters.friction * axial.direction
            moments[..., 2] += axial.known_torque - friction
        return moments

    def tracker_rotation(self, parameters: ArmParameters) -> Array:
        """Rotation from the base to the tracker, (3, 3)."""
        return rotation_of(parameters.rotation) @ self.alignment

    def to_tracker(self, parameters: ArmParameters, places: Array) -> Array:
        """Places in the tracker's frame, from the base, (..., 3) [m]."""
        R = self.tracker_rotation(parameters)
        return places @ R.T + self.origin + parameters.translation

    def _place(self, parameters: ArmParameters, angles: Array, turn: Array) -> Posture:
        """Frames at given angles of the joints, and deflections in the axes of the housings."""
        count, n = angles.shape
        housing = np.empty((n, count, 3, 3))
        link = np.empty((n, count, 3, 3))
        anchor = np.empty((n, count, 3))
        lever = np.empty((n, count, 3))
        errors = rotation_of(parameters.angle)
        deflections = rotation_of(turn)
        for j, parent in enumerate(self.parent):
            R = np.eye(3) if parent < 0 else link[parent]
            origin = np.zeros(3) if parent < 0 else anchor[parent]
            anchor[j] = origin + R @ (self.anchor[j] + self.nominal[j] @ parameters.length[j])
            housing[j] = R @ (self.nominal[j] @ errors[j])
            link[j] = housing[j] @ deflections[:, j] @ rotation_z(angles[:, j])
            lever[j] = link[j] @ self.weight_moment[j]
        load = self.weight.copy()
        for j in range(n - 1, -1, -1):
            parent = self.parent[j]
            if parent >= 0:
                lever[parent] += lever[j] + load[j] * (anchor[j] - anchor[parent])
                load[parent] += load[j]
        places = [
            np.broadcast_to(marker.place + shift, (count, 3))
            if marker.joint < 0
            else anchor[marker.joint] + link[marker.joint] @ (marker.place + shift)
            for marker, shift in zip(self.markers, parameters.marker, strict=True)
        ]
        return Posture(housing, link, anchor, lever, np.stack(places, axis=1))

    def moments(self, posture: Posture) -> Array:
        """Moments of gravity about the anchors, in the axes of the housings, (N, n, 3) [N·m]."""
        moment = np.cross(posture.lever, self.down)
        return np.einsum("jnba,jnb->nja", posture.housing, moment)
