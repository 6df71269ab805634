r"""Measurements of an arm with elastic joints at rest, and their derivatives by the unknowns.

The encoders read θ + o. At rest the transmissions carry

.. math:: K (\theta - q) = \tau(q) + m\, b(q) + F d

with the gravity torque τ, a payload m that adds b per kilogram, and friction on the link side of
the springs: F d after an approach from the side d = ±1. Unknown are the compliances c = 1/K, in
which the deflection is linear, the offsets o, and where asked F, m, and the frame of the
measurement. Link encoders show q, a tracker R p(q) + t, an IMU its link's vertical, and torque
sensors the right-hand side. Derivatives follow from

.. math:: (1 + C\, \partial\tau/\partial q)\, dq = -do - (\tau + m b + F d)\, dc - C (b\, dm + d\, dF)
"""  # noqa: E501

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from baselines.identification.geometry_model import cross_matrix
from baselines.identification.pose_log import Kind, PoseLog
from baselines.identification.static_arm import Attitude, StaticArm
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.joint.load_continuation import follow_load

Frame = Literal["known", "offset", "pose"]
"""Knowledge of the measurement's frame: all, its directions, or nothing."""

LARGEST_DEFLECTION_RAD = 0.3
"""Scale of the unknown compliances: the largest torque of a joint bends it by about as much, or
less.
"""
SMALLEST_LOAD = 1e-3
"""Share of the largest torque in the arm below which a joint counts as not loaded."""

_PRIOR = {"offset": 0.3, "payload_kg": 10.0, "translation_m": 1.0, "rotation_rad": 0.3}
_FIRST_ITERATIONS = 6
_MOST_ITERATIONS = 50
_LAST_STEP_RAD = 1e-12
_SOFT = 0.5
"""Change of the deflection by that of the link angle from which on the load is followed."""
_FINEST_STEP = 0.05
"""Share of the load in a step of a path, at least."""
_FARTHEST_RAD = 1e3
"""Deflections beyond this are none."""


@dataclass(frozen=True)
class Unknowns:
    """Places of the unknowns in one vector: c, o, F of the elastic joints, m, then the frame.

    Attributes:
        elastic: Positions of the joints whose stiffness is sought, (k,).
        friction: Whether F is unknown.
        payload: Whether m is unknown.
        translation: Whether the frame's origin is unknown.
        rotation: Whether its directions are.
    """

    elastic: IntArray
    friction: bool
    payload: bool
    translation: bool
    rotation: bool

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Part of the vector for each kind of unknown."""
        k = len(self.elastic)
        sizes = {
            "compliance": k,
            "offset": k,
            "friction": k * self.friction,
            "payload": int(self.payload),
            "translation": 3 * self.translation,
            "rotation": 3 * self.rotation,
        }
        ends = np.cumsum(list(sizes.values()))
        return {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.slices["rotation"].stop

    @staticmethod
    def of(log: PoseLog, elastic: Sequence[str], frame: Frame, payload: bool) -> "Unknowns":
        """The unknowns that a log needs."""
        return Unknowns(
            elastic=np.array([log.joints.index(joint) for joint in elastic], dtype=np.int64),
            friction=log.direction is not None,
            payload=payload,
            translation=log.kind == "end_effector" and frame != "known",
            rotation=(log.kind == "end_effector" and frame == "pose")
            or (log.kind == "imu" and frame != "known"),
        )

    def of_frame(self) -> "Unknowns":
        """Those of the frame alone, which a rigid arm has too."""
        none = np.empty(0, dtype=np.int64)
        return replace(self, elastic=none, friction=False, payload=False)


@dataclass(frozen=True)
class PoseModel:
    """Measurements of poses as a function of the unknowns.

    Attributes:
        arm: The rigid arm.
        log: The poses; `measured` is used only to find the axes of an IMU and the frame to begin
            with.
        unknowns: What is sought.
    """

    arm: StaticArm
    log: PoseLog
    unknowns: Unknowns

    @cached_property
    def load(self) -> Array:
        """Largest torque of each elastic joint in these poses, (k,) [N·m]."""
        return np.abs(self._weight(self.log.theta)).max(axis=0)[self.unknowns.elastic]

    @cached_property
    def scale(self) -> Array:
        """Plausible size of each unknown, (p,)."""
        own = self.unknowns.slices
        largest = max(float(np.abs(self._weight(self.log.theta)).max()), 1e-9)
        load = np.maximum(self.load, SMALLEST_LOAD * largest)
        scale = np.empty(self.unknowns.size)
        scale[own["compliance"]] = LARGEST_DEFLECTION_RAD / load
        scale[own["offset"]] = _PRIOR["offset"]
        scale[own["friction"]] = load[: own["friction"].stop - own["friction"].start]
        scale[own["payload"]] = _PRIOR["payload_kg"]
        scale[own["translation"]] = _PRIOR["translation_m"]
        scale[own["rotation"]] = _PRIOR["rotation_rad"]
        return scale

    def start_with(self, deflection_rad: float) -> Array:
        """Unknowns to begin with, (p,): a deflection under each largest torque, and zeros."""
        values = np.zeros(self.unknowns.size)
        compliance = self.unknowns.slices["compliance"]
        scale = self.scale[compliance]
        values[compliance] = scale * deflection_rad / LARGEST_DEFLECTION_RAD
        return values

    @cached_property
    def _aligned(self) -> Array:
        """Rotation of the frame to begin with, (3, 3)."""
        if not self.unknowns.rotation:
            return np.eye(3)
        at = self.arm.attitude(self.log.theta)
        if self.log.kind == "imu":
            shown = vertical(self.log.measured)
            own = at.rotation.transpose(0, 2, 1) @ self.arm.up
        else:
            shown = self.log.measured - self.log.measured.mean(axis=0)
            own = at.position - at.position.mean(axis=0)
        return Rotation.align_vectors(shown, own)[0].as_matrix()

    def at(self, log: PoseLog) -> "PoseModel":
        """The same unknowns at other poses; rotations are still from the first frame of these."""
        other = replace(self, log=log)
        other.__dict__["_aligned"] = self._aligned
        return other

    @property
    def target(self) -> Array:
        """Measurements that `predict` has to meet, (N, m)."""
        if self.log.kind == "imu":
            return np.zeros((len(self.log), 2))
        return self.log.measured

    def expand(self, unknowns: Array, name: str) -> Array:
        """Compliance c, offset o or friction F of all joints; 0 where it is not sought, (n,)."""
        values = np.zeros(len(self.log.joints))
        own = unknowns[self.unknowns.slices[name]]
        values[self.unknowns.elastic[: len(own)]] = own
        return values

    def payload_kg(self, unknowns: Array) -> float:
        """Mass of the payload [kg]."""
        return float(unknowns[self.unknowns.slices["payload"]].sum())

    def torque(self, unknowns: Array, q: Array) -> Array:
        """Torques that the transmissions carry at link angles, (N, n) [N·m]."""
        torque = self._weight(q)
        if self.unknowns.payload:
            torque = torque + self.payload_kg(unknowns) * self.arm.payload_torque(q)
        if self.log.direction is not None:
            torque = torque + self.expand(unknowns, "friction") * self.log.direction
        return torque

    def _weight(self, q: Array) -> Array:
        """Torques that hold the arm against its weight and known torques, (N, n) [N·m]."""
        torque = self.arm.torque(q)
        return torque if self.log.known is None else torque - self.log.known

    def link_angles(self, unknowns: Array) -> tuple[Array, Array]:
        """Link angles at rest, (N, n) [rad], and (1 + C ∂τ/∂q)⁻¹ there, (N, n, n).

        Raises:
            ElasticError: The load overcomes a spring.
        """
        theta = self.log.theta - self.expand(unknowns, "offset")
        compliance = self.expand(unknowns, "compliance")
        one = np.eye(len(compliance))
        q = theta
        # these shrink the error by about τ′/K each, so that derivatives are taken in place
        for _ in range(_FIRST_ITERATIONS):
            q = theta - compliance * self.torque(unknowns, q)
            q = np.where(np.abs(q - theta) < _FARTHEST_RAD, q, theta)
        payload_kg = self.payload_kg(unknowns)
        bend = compliance[:, None] * self.arm.torque_gradient(q, payload_kg)
        is_soft = np.abs(bend).sum(axis=-1).max(axis=-1)[:, None] >= _SOFT
        inverse = np.linalg.inv(one + np.where(is_soft[..., None], 0.0, bend))
        is_open = ~is_soft.all()
        for _ in range(_MOST_ITERATIONS if is_open else 0):
            missing = q - theta + compliance * self.torque(unknowns, q)
            step = inverse @ missing[..., None]
            q = np.where(is_soft, q, q - step[..., 0])
            if not np.abs(step[~is_soft[:, 0]]).max() > _LAST_STEP_RAD:
                is_open = False
                break
        if not is_open and not is_soft.any():
            return q, inverse
        followed = is_soft | is_open
        q = np.where(followed, self._followed(unknowns, theta, compliance, followed), q)
        bend = compliance[:, None] * self.arm.torque_gradient(q, payload_kg)
        return q, np.where(followed[..., None], np.linalg.inv(one + bend), inverse)

    def _followed(self, unknowns: Array, theta: Array, compliance: Array, rows: BoolArray) -> Array:
        """Link angles on soft springs, by a load that grows, (N, n) [rad]."""
        path = follow_load(
            theta,
            compliance,
            lambda q: self.torque(unknowns, q),
            lambda q: self.arm.torque_gradient(q, self.payload_kg(unknowns)),
            tolerance=_LAST_STEP_RAD,
            rows=rows,
            unique=False,
            names_rest=False,
            finest=_FINEST_STEP,
        )
        if path.lost.any():
            pose = int(path.lost[:, 0].argmax()) + 1
            raise ElasticError(
                f"no link angles for pose {pose}: {path.reason(compliance, self.log.joints)}. Check"
                " zeros, units and frame (--frame) of the log's columns, the point that was"
                " measured (--end-effector), and the masses of the model"
            )
        return path.q

    def predict(self, unknowns: Array) -> tuple[Array, Array]:
        """Measurements, (N, m), and their derivatives by the unknowns, (N, m, p)."""
        q, inverse = self.link_angles(unknowns)
        dq = self._link_gradient(unknowns, q, inverse)
        if self.log.kind == "end_effector":
            return self._positions(unknowns, q, dq)
        if self.log.kind == "imu":
            return self._verticals(unknowns, q, dq)
        at = [self.log.joints.index(joint) for joint in self.log.columns]
        if self.log.kind == "link_encoders":
            return q[:, at], dq[:, at]
        return self._torques(unknowns, q, dq, at)

    def prediction_error(self, unknowns: Array) -> Array:
        """Measured less predicted, (N, k, d): vectors of k places in the unit of the measurement.

        Places are a point, the end of a unit vertical, or the joints.
        """
        if self.log.kind == "imu":
            q, _ = self.link_angles(unknowns)
            seen = self._seen(unknowns, self.arm.attitude(q))
            return (vertical(self.log.measured) - seen)[:, None]
        missed = self.target - self.predict(unknowns)[0]
        return missed[:, None] if self.log.kind == "end_effector" else missed[..., None]

    def _link_gradient(self, unknowns: Array, q: Array, inverse: Array) -> Array:
        """∂q/∂unknowns, (N, n, p)."""
        own = self.unknowns.slices
        elastic = self.unknowns.elastic
        compliance = self.expand(unknowns, "compliance")
        gradient = np.zeros((*q.shape, self.unknowns.size))
        by_torque = inverse * self.torque(unknowns, q)[:, None]
        gradient[..., own["compliance"]] = -by_torque[..., elastic]
        gradient[..., own["offset"]] = -inverse[..., elastic]
        if self.log.direction is not None:
            by_friction = inverse * (compliance * self.log.direction)[:, None]
            gradient[..., own["friction"]] = -by_friction[..., elastic]
        if self.unknowns.payload:
            bend = compliance * self.arm.payload_torque(q)
            gradient[..., own["payload"]] = -inverse @ bend[..., None]
        return gradient

    def _turned(self, unknowns: Array) -> Array:
        """Rotation from the model's to the measurement's frame, (3, 3)."""
        turn = unknowns[self.unknowns.slices["rotation"]]
        if not len(turn):
            return self._aligned
        return Rotation.from_rotvec(turn).as_matrix() @ self._aligned

    def _positions(self, unknowns: Array, q: Array, dq: Array) -> tuple[Array, Array]:
        """Positions that a tracker shows [m]."""
        own = self.unknowns.slices
        R = self._turned(unknowns)
        at = self.arm.attitude(q)
        turned = at.position @ R.T
        gradient = R @ at.position_gradient @ dq
        gradient[..., own["translation"]] = np.eye(3)[:, : 3 * self.unknowns.translation]
        if self.unknowns.rotation:
            gradient[..., own["rotation"]] = -cross_matrix(turned)
        shift = unknowns[own["translation"]]
        return turned + (shift if len(shift) else 0.0), gradient

    def _seen(self, unknowns: Array, at: Attitude) -> Array:
        """Unit verticals that the IMU should see, (N, 3)."""
        return self._turned(unknowns) @ at.rotation.transpose(0, 2, 1) @ self.arm.up

    def _verticals(self, unknowns: Array, q: Array, dq: Array) -> tuple[Array, Array]:
        """Tilt between the verticals that the IMU should see and saw, about two axes [rad]."""
        own = self.unknowns.slices
        at = self.arm.attitude(q)
        up = self.arm.up
        across = _across(vertical(self.log.measured))
        back = self._turned(unknowns) @ at.rotation.transpose(0, 2, 1)
        seen = self._seen(unknowns, at)
        turning = cross_matrix(np.broadcast_to(up, seen.shape))
        gradient = back @ turning @ at.rotation_gradient @ dq
        if self.unknowns.rotation:
            gradient[..., own["rotation"]] = -cross_matrix(seen)
        return (across @ seen[..., None])[..., 0], across @ gradient

    def _torques(self, unknowns: Array, q: Array, dq: Array, at: list[int]) -> tuple[Array, Array]:
        """Torques that sensors show [N·m]."""
        own = self.unknowns.slices
        elastic = self.unknowns.elastic
        gradient = self.arm.torque_gradient(q, self.payload_kg(unknowns)) @ dq
        if self.log.direction is not None:
            sides = np.eye(q.shape[1]) * self.log.direction[:, None]
            gradient[..., own["friction"]] += sides[..., elastic]
        if self.unknowns.payload:
            gradient[..., own["payload"]] += self.arm.payload_torque(q)[..., None]
        return self.torque(unknowns, q)[:, at], gradient[:, at]


def vertical(attitude: Array) -> Array:
    """Unit vector against gravity in an IMU's frame from roll and pitch, (N, 2) [rad] to (N, 3).

    Of R = R_z(yaw) R_y(pitch) R_x(roll), from the IMU's to the world's frame, it is the last row.
    """
    roll = attitude[..., 0]
    pitch = attitude[..., 1]
    return np.stack(
        [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=-1
    )


def roll_and_pitch(direction: Array) -> Array:
    """The inverse of `vertical`, (N, 3) to (N, 2) [rad]."""
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack([np.arctan2(y, z), -np.arcsin(np.clip(x, -1.0, 1.0))], axis=-1)


def measurement_unit(kind: Kind) -> str:
    """Unit of a measurement's residual."""
    return {"end_effector": "m", "torques": "N·m"}.get(kind, "rad")


def _across(directions: Array) -> Array:
    """Two unit vectors across each direction, (N, 3) to (N, 2, 3)."""
    least = np.eye(3)[np.abs(directions).argmin(axis=-1)]
    first = np.cross(directions, least)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=-2)
