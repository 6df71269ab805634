r"""Errors of a policy's local frame where the support foot changes, against the truth.

The local frame of a walking controller has its origin at the sole of the support foot. Joint angles
and IMU give its place (section II.B of the paper). With elastic joints it is off by the vector e.
For a deflection δ of the hip roll joint alone (the paper's θ) and the leg length L, Eq. 1 gives

.. math:: e = L \, [0, \; 2 \sin(δ/2) \cos(δ/2), \; 2 \sin²(δ/2)]

When the support foot changes, the frame moves to the other foot, and the estimated center of mass
jumps.

Axes are level and have the heading of the pelvis, which no sensor of the robot measures. The
footholds are those of the plan in its local frame (`elastic_env.motion.walk_plan`).
"""

from typing import Any

import numpy as np

from baselines.walking.controller import LocalFrame, local_frame
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.gait import Timing
from elastic_env.world.robot_model import WalkerModel


def support_changes(timing: Timing) -> IntArray:
    """Scored control steps at which the support foot differs from the control step before."""
    changed = np.zeros(len(timing.support), dtype=np.bool_)
    changed[1:] = timing.support[1:] != timing.support[:-1]
    return np.flatnonzero(changed & timing.scored)


def tilt(R: Array) -> Array:
    """Roll and pitch (of yaw, pitch, roll) of a rotation, (..., 3, 3) to (..., 2) [rad]."""
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    return np.stack([roll, -np.arcsin(np.clip(R[..., 2, 0], -1.0, 1.0))], axis=-1)


def frame_error(estimate: LocalFrame, true: LocalFrame, foot: int) -> Array:
    """Estimated minus true place of a foot's sole, the vector e, (num_worlds, 3) [m]."""
    return estimate.soles[:, foot] - true.soles[:, foot]


def com_jump(estimate: LocalFrame, footholds: Array, old: int, new: int) -> Array:
    """Jump of the estimated center of mass at a change of feet, (num_worlds, 3) [m].

    Args:
        estimate: Local frame by the policy's joint angles.
        footholds: Planned middles of the soles in the plan's local frame, (2, 2) [m].
        old: Support foot before the change.
        new: Support foot after it.
    """
    com = estimate.com[:, None] - estimate.soles + np.pad(footholds, ((0, 0), (0, 1)))
    return com[:, new] - com[:, old]


class SupportChanges:
    """Errors of the local frame at every support change, in many worlds that walk in step.

    Args:
        model: The assumed walker.
    """

    def __init__(self, model: WalkerModel) -> None:
        self._biped = model.biped
        self._soles = model.plan.local.ankles[..., :2]
        self._support = model.plan.timing.support
        self._changes = set(support_changes(model.plan.timing).tolist())
        self._attitude = model.observation_table.group("imu_attitude")
        self._errors: list[Array] = []
        self._jumps: list[Array] = []

    def record(self, step: int, q_estimate: Array, observation: Array, truth: Any) -> None:
        """Record a control step.

        Args:
            step: Its number, 0 at the start of the episodes.
            q_estimate: Joint angles that the policy estimates, (num_worlds, 12) [rad].
            observation: Observation of the policy, (num_worlds, m).
            truth: True state at that time, an `elastic_env.robots.thormang.records.WalkTruth`.
        """
        if step not in self._changes:
            return
        estimate = local_frame(self._biped, q_estimate, observation[:, self._attitude])
        true = local_frame(self._biped, truth.q, tilt(truth.pelvis_R))
        old = int(self._support[step - 1])
        new = int(self._support[step])
        self._errors.append(frame_error(estimate, true, new))
        self._jumps.append(com_jump(estimate, self._soles[step], old, new))

    def metrics(self, world: int) -> dict[str, float]:
        """Metrics of a world over its support changes so far; none without a change."""
        if not self._errors:
            return {}
        errors = np.array([error[world] for error in self._errors])
        lengths = np.linalg.norm(errors, axis=1)
        jumps = np.linalg.norm([jump[world] for jump in self._jumps], axis=1)
        return {
            "frame_error_mean_m": float(lengths.mean()),
            "frame_error_max_m": float(lengths.max()),
            "frame_error_y_mean_m": float(np.abs(errors[:, 1]).mean()),
            "com_jump_mean_m": float(jumps.mean()),
            "com_jump_max_m": float(jumps.max()),
        }
