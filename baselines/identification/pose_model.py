r"""Measurements of an arm with elastic joints at rest, and their derivatives by the unknowns.

The encoders read θ + o. At rest the transmissions carry

.. math:: K (\theta - q) = \tau(q) + m\, b(q) + F d

with the gravity torque τ, a payload m that adds b per kilogram, and friction on the link side of
the springs: F d after an approach from the side d = ±1. The unknowns are the compliances c = 1/K,
in which the deflection is linear, and the offsets o. F, m, and the frame of the measurement are
optional unknowns. Link encoders measure q, a tracker R p(q) + t, an IMU its link's vertical, and
torque sensors the right-hand side. Derivatives follow from

.. math:: (1 + C\, \partial\tau/\partial q)\, dq = -do - (\tau + m b + F d)\, dc - C (b\, dm + d\, dF)
"""  # noqa: E501

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from baselines.identification.pose_log import PoseLog
from baselines.identification.pose_unknowns import PoseUnknowns
from baselines.identification.rotations import cross_matrix, normals_of, vertical
from baselines.identification.static_arm import Attitude, StaticArm
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.joint.load_continuation import follow_load

LARGEST_DEFLECTION_RAD = 0.3
"""Scale of the unknown compliances: the largest torque of a joint bends it by at most about this
angle.
"""
SMALLEST_LOAD = 1e-3
"""Share of the largest torque in the arm below which a joint counts as not loaded."""

_OFFSET_SCALE_RAD = 0.3
_PAYLOAD_SCALE_KG = 10.0
_TRANSLATION_SCALE_M = 1.0
_ROTATION_SCALE_RAD = 0.3
_FIRST_ITERATIONS = 6
"""Fixed-point iterations before Newton's method."""
_MOST_ITERATIONS = 50
_LAST_STEP_RAD = 1e-12
_SOFT_RATIO = 0.5
"""Change of the deflection by that of the link angle from which on a growing load is followed."""
_LEAST_LOAD_STEP = 0.05
"""Share of the load in a step of a path, at least."""
_LARGEST_ITERATE_RAD = 1e3
"""Deflection beyond which the fixed-point iteration diverges and starts again."""


@dataclass(frozen=True)
class PoseModel:
    """Measurements of poses as a function of the unknowns.

    Attributes:
        arm: The rigid arm.
        log: The poses; `measured` is used only for the axes of an IMU and the first frame.
        unknowns: Kinds of unknowns and their order.
    """

    arm: StaticArm
    log: PoseLog
    unknowns: PoseUnknowns

    @cached_property
    def load(self) -> Array:
        """Largest torque of each elastic joint in these poses, (k,) [N·m]."""
        return np.abs(self._weight(self.log.theta)).max(axis=0)[self.unknowns.elastic]

    @cached_property
    def scale(self) -> Array:
        """Plausible size of each unknown, (p,)."""
        parts = self.unknowns.slices
        largest = max(float(np.abs(self._weight(self.log.theta)).max()), 1e-9)
        load = np.maximum(self.load, SMALLEST_LOAD * largest)
        scale = np.empty(self.unknowns.size)
        scale[parts["compliance"]] = LARGEST_DEFLECTION_RAD / load
        scale[parts["offset"]] = _OFFSET_SCALE_RAD
        friction = parts["friction"]
        scale[friction] = load[: friction.stop - friction.start]
        scale[parts["payload"]] = _PAYLOAD_SCALE_KG
        scale[parts["translation"]] = _TRANSLATION_SCALE_M
        scale[parts["rotation"]] = _ROTATION_SCALE_RAD
        return scale

    def start_with(self, deflection_rad: float) -> Array:
        """First unknowns, (p,): a deflection under the largest torque of each joint, and zeros."""
        values = np.zeros(self.unknowns.size)
        compliance = self.unknowns.slices["compliance"]
        scale = self.scale[compliance]
        values[compliance] = scale * deflection_rad / LARGEST_DEFLECTION_RAD
        return values

    @cached_property
    def _alignment(self) -> Array:
        """First rotation of the frame, (3, 3)."""
        if not self.unknowns.rotation:
            return np.eye(3)
        attitude = self.arm.attitude(self.log.theta)
        if self.log.kind == "imu":
            measured = vertical(self.log.measured)
            nominal = attitude.rotation.transpose(0, 2, 1) @ self.arm.up
        else:
            measured = self.log.measured - self.log.measured.mean(axis=0)
            nominal = attitude.position - attitude.position.mean(axis=0)
        return Rotation.align_vectors(measured, nominal)[0].as_matrix()

    def with_log(self, log: PoseLog) -> "PoseModel":
        """The same unknowns at other poses; rotations start from the same first frame."""
        other = replace(self, log=log)
        other.__dict__["_alignment"] = self._alignment
        return other

    @property
    def target(self) -> Array:
        """Measurements to which predictions are fitted, (N, m)."""
        if self.log.kind == "imu":
            return np.zeros((len(self.log), 2))
        return self.log.measured

    def expand(self, unknowns: Array, name: str) -> Array:
        """Compliance c, offset o or friction F of all joints; 0 where it is no unknown, (n,)."""
        values = np.zeros(len(self.log.joints))
        part = unknowns[self.unknowns.slices[name]]
        values[self.unknowns.elastic[: len(part)]] = part
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
        known = self.log.known_torque
        return torque if known is None else torque - known

    def link_angles(self, unknowns: Array) -> tuple[Array, Array]:
        """Link angles at rest, (N, n) [rad], and (1 + C ∂τ/∂q)⁻¹ there, (N, n, n).

        Raises:
            ElasticError: The load overcomes a spring.
        """
        theta = self.log.theta - self.expand(unknowns, "offset")
        compliance = self.expand(unknowns, "compliance")
        identity = np.eye(len(compliance))
        q = theta
        # each shrinks the error by about τ′/K, so that derivatives are taken near the solution
        for _ in range(_FIRST_ITERATIONS):
            q = theta - compliance * self.torque(unknowns, q)
            q = np.where(np.abs(q - theta) < _LARGEST_ITERATE_RAD, q, theta)
        payload_kg = self.payload_kg(unknowns)
        bend = compliance[:, None] * self.arm.torque_gradient(q, payload_kg)
        is_soft = np.abs(bend).sum(axis=-1).max(axis=-1)[:, None] >= _SOFT_RATIO
        inverse = np.linalg.inv(identity + np.where(is_soft[..., None], 0.0, bend))
        is_unsolved = ~is_soft.all()
        for _ in range(_MOST_ITERATIONS if is_unsolved else 0):
            missing = q - theta + compliance * self.torque(unknowns, q)
            step = inverse @ missing[..., None]
            q = np.where(is_soft, q, q - step[..., 0])
            if not np.abs(step[~is_soft[:, 0]]).max() > _LAST_STEP_RAD:
                is_unsolved = False
                break
        if not is_unsolved and not is_soft.any():
            return q, inverse
        followed = is_soft | is_unsolved
        at_end = self._follow_load(unknowns, theta, compliance, followed)
        q = np.where(followed, at_end, q)
        bend = compliance[:, None] * self.arm.torque_gradient(q, payload_kg)
        return q, np.where(followed[..., None], np.linalg.inv(identity + bend), inverse)

    def _follow_load(
        self, unknowns: Array, theta: Array, compliance: Array, rows: BoolArray
    ) -> Array:
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
            finest=_LEAST_LOAD_STEP,
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
        joints = [self.log.joints.index(joint) for joint in self.log.columns]
        if self.log.kind == "link_encoders":
            return q[:, joints], dq[:, joints]
        return self._torques(unknowns, q, dq, joints)

    def prediction_error(self, unknowns: Array) -> Array:
        """Measured less predicted, (N, k, d): vectors of k places in the unit of the measurement.

        Places are a point, the end of a unit vertical, or the joints.
        """
        if self.log.kind == "imu":
            q, _ = self.link_angles(unknowns)
            predicted = self._imu_verticals(unknowns, self.arm.attitude(q))
            return (vertical(self.log.measured) - predicted)[:, None]
        error = self.target - self.predict(unknowns)[0]
        return error[:, None] if self.log.kind == "end_effector" else error[..., None]

    def _link_gradient(self, unknowns: Array, q: Array, inverse: Array) -> Array:
        """∂q/∂unknowns, (N, n, p)."""
        parts = self.unknowns.slices
        elastic = self.unknowns.elastic
        compliance = self.expand(unknowns, "compliance")
        gradient = np.zeros((*q.shape, self.unknowns.size))
        by_torque = inverse * self.torque(unknowns, q)[:, None]
        gradient[..., parts["compliance"]] = -by_torque[..., elastic]
        gradient[..., parts["offset"]] = -inverse[..., elastic]
        if self.log.direction is not None:
            by_friction = inverse * (compliance * self.log.direction)[:, None]
            gradient[..., parts["friction"]] = -by_friction[..., elastic]
        if self.unknowns.payload:
            bend = compliance * self.arm.payload_torque(q)
            gradient[..., parts["payload"]] = -inverse @ bend[..., None]
        return gradient

    def _frame_rotation(self, unknowns: Array) -> Array:
        """Rotation from the model's to the measurement's frame, (3, 3)."""
        turn = unknowns[self.unknowns.slices["rotation"]]
        if not len(turn):
            return self._alignment
        return Rotation.from_rotvec(turn).as_matrix() @ self._alignment

    def _positions(self, unknowns: Array, q: Array, dq: Array) -> tuple[Array, Array]:
        """Positions that a tracker measures [m], and their derivatives."""
        parts = self.unknowns.slices
        R = self._frame_rotation(unknowns)
        attitude = self.arm.attitude(q)
        rotated = attitude.position @ R.T
        gradient = R @ attitude.position_gradient @ dq
        translation = parts["translation"]
        gradient[..., translation] = np.eye(3)[:, : 3 * self.unknowns.translation]
        if self.unknowns.rotation:
            gradient[..., parts["rotation"]] = -cross_matrix(rotated)
        shift = unknowns[translation]
        return rotated + (shift if len(shift) else 0.0), gradient

    def _imu_verticals(self, unknowns: Array, attitude: Attitude) -> Array:
        """Predicted unit verticals in the IMU's frame, (N, 3)."""
        R = self._frame_rotation(unknowns)
        return R @ attitude.rotation.transpose(0, 2, 1) @ self.arm.up

    def _verticals(self, unknowns: Array, q: Array, dq: Array) -> tuple[Array, Array]:
        """Tilt between predicted and measured verticals about two axes [rad], with derivatives."""
        attitude = self.arm.attitude(q)
        normals = normals_of(vertical(self.log.measured))
        R = self._frame_rotation(unknowns) @ attitude.rotation.transpose(0, 2, 1)
        predicted = self._imu_verticals(unknowns, attitude)
        turning = cross_matrix(np.broadcast_to(self.arm.up, predicted.shape))
        gradient = R @ turning @ attitude.rotation_gradient @ dq
        if self.unknowns.rotation:
            gradient[..., self.unknowns.slices["rotation"]] = -cross_matrix(predicted)
        return (normals @ predicted[..., None])[..., 0], normals @ gradient

    def _torques(
        self, unknowns: Array, q: Array, dq: Array, joints: list[int]
    ) -> tuple[Array, Array]:
        """Torques that sensors of some joints measure [N·m], and their derivatives."""
        parts = self.unknowns.slices
        elastic = self.unknowns.elastic
        gradient = self.arm.torque_gradient(q, self.payload_kg(unknowns)) @ dq
        if self.log.direction is not None:
            sides = np.eye(q.shape[1]) * self.log.direction[:, None]
            gradient[..., parts["friction"]] += sides[..., elastic]
        if self.unknowns.payload:
            gradient[..., parts["payload"]] += self.arm.payload_torque(q)[..., None]
        return self.torque(unknowns, q)[:, joints], gradient[:, joints]
