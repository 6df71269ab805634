r"""Errors of a policy's local frame where the support foot changes, against the truth.

The local frame of a walking controller stands at the sole of the support foot, where joint angles
and IMU put it (section II.B of the paper). With elastic joints it is off by the vector e; for a
deflection δ of the hip roll joint alone (the paper's θ), with leg length L, that is Eq. 1:

.. math:: e = L \, [0, \; 2 \sin(δ/2) \cos(δ/2), \; 2 \sin²(δ/2)]

Where the support foot changes, the frame is taken anew from the other foot, and the estimated
center of mass jumps.

Axes are level and have the heading of the pelvis, which no sensor of the robot shows. The footholds
are those of the plan in its local frame (`elastic_env.motion.walk_plan`).
"""

from typing import Any

import numpy as np

from baselines.walking.controller import LocalFrame, local_frame
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion.gait import Timing
from elastic_env.world.robot_model import WalkerModel


def support_changes(timing: Timing) -> IntArray:
    """Scored control steps at which the support foot is another than a control step before."""
    changed = np.zeros(len(timing.support), dtype=np.bool_)
    changed[1:] = timing.support[1:] != timing.support[:-1]
    return np.flatnonzero(changed & timing.scored)


def tilt(R: Array) -> Array:
    """Roll and pitch (of yaw, pitch, roll) of a rotation, (..., 3, 3) to (..., 2) [rad]."""
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    return np.stack([roll, -np.arcsin(np.clip(R[..., 2, 0], -1.0, 1.0))], axis=-1)


def frame_error(estimate: LocalFrame, true: LocalFrame, foot: int) -> Array:
    """e: the place of a foot's sole by the estimate, minus the true one, (num_worlds, 3) [m]."""
    return estimate.soles[:, foot] - true.soles[:, foot]


def com_jump(estimate: LocalFrame, footholds: Array, old: int, new: int) -> Array:
    """Jump of the estimated center of mass at a change of feet, (num_worlds, 3) [m].

    Args:
        estimate: Local frame by the policy's joint angles.
        footholds: Planned middles of the soles, on which the frame stands, (2, 2) [m].
        old: Support foot before.
        new: Support foot after.
    """
    com = estimate.com[:, None] - estimate.soles + np.pad(footholds, ((0, 0), (0, 1)))
    return com[:, new] - com[:, old]


class SupportChanges:
    """Errors of the local frame in many worlds that walk in step, taken at every support change.

    Args:
        model: The walker as it is assumed.
    """

    def __init__(self, model: WalkerModel) -> None:
        self._biped = model.biped
        self._soles = model.plan.local.ankles[..., :2]
        self._support = model.plan.timing.support
        self._changes = set(support_changes(model.plan.timing).tolist())
        self._attitude = model.observation_table.group("imu_attitude")
        self._errors: list[Array] = []
        self._jumps: list[Array] = []

    def take(self, step: int, q_estimate: Array, seen: Array, truth: Any) -> None:
        """Take a control step.

        Args:
            step: Its number, 0 at the start of the episodes.
            q_estimate: Joint angles as the policy sees them, (num_worlds, 12) [rad].
            seen: Its observation, (num_worlds, m).
            truth: True state at that time, an `elastic_env.robots.thormang.records.WalkTruth`.
        """
        if step not in self._changes:
            return
        estimate = local_frame(self._biped, q_estimate, seen[:, self._attitude])
        true = local_frame(self._biped, truth.q, tilt(truth.pelvis_R))
        old = int(self._support[step - 1])
        new = int(self._support[step])
        self._errors.append(frame_error(estimate, true, new))
        self._jumps.append(com_jump(estimate, self._soles[step], old, new))

    def metrics(self, world: int) -> dict[str, float]:
        """Figures of a world over its support changes so far; none without a change."""
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
