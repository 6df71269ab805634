r"""Further poses that determine the stiffness: a D_s-optimal choice from random poses.

Poses are drawn within the joint ranges. Poses in which parts of the arm touch are dropped, if the
model has shapes. The chosen poses shrink the joint confidence region of the compliances most. With
the information M of all unknowns and its block M_f of the nuisance parameters (offsets, friction,
frame, payload) they maximise

.. math:: \log\det M - \log\det M_f, \quad M = M_0 + \sum_i J_i^T J_i / \sigma^2

where M_0 is the information of the log and the prior. Poses are added one by one, then exchanged
until no exchange is better (V. V. Fedorov, "Theory of Optimal Experiments", Academic Press, 1972;
D_s-optimality: A. Atkinson, A. Donev, R. Tobias, "Optimum Experimental Designs, with SAS", Oxford,
2007, ch. 10). The weak prior makes this a Bayesian design, so that joints that no pose determines
do no harm (K. Chaloner and I. Verdinelli, Statistical Science 10(3), 1995).
"""

from dataclasses import dataclass, replace
from itertools import islice

import mujoco
import numpy as np

from baselines.identification.arm_fit import ArmFit, add_information, information_of
from baselines.identification.pose_log import AXES, Kind, PoseLog
from baselines.identification.pose_model import PoseModel
from baselines.identification.rotations import roll_and_pitch
from baselines.identification.static_arm import StaticArm
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray

CANDIDATES = 1000
"""Poses from which a plan is chosen."""

MOST_PLANNED = 200
"""Poses of a plan."""

_MOST_DRAWS = 20 * CANDIDATES
"""Random poses that are tried, at most."""
_RANGE_SHARE = 0.95
"""Share of the joint ranges that is used: commands that lead the link stay within the range."""
_UNLIMITED_RAD = np.pi
"""End of the range of joints that have none."""
_MOST_EXCHANGE_ROUNDS = 10
"""Rounds of exchanges; two or three are usual."""
_LEAST_GAIN = 1e-6
"""Gain in log det M below which poses are not exchanged."""


@dataclass(frozen=True)
class PosePlan:
    """Poses to visit, and the information of the log together with them.

    Attributes:
        theta: Motor angles, (count, n) [rad].
        direction: Sides to approach them from, (count, n); None where friction is no unknown.
        information: Information on all unknowns in units of their scales, (p, p).
    """

    theta: Array
    direction: Array | None
    information: Array


def plan_poses(
    model: PoseModel,
    unknowns: Array,
    spread: float,
    information: Array,
    candidates: PoseLog,
    count: int,
) -> PosePlan:
    """Choose poses that determine the stiffness.

    Args:
        model: Unknowns and their scales.
        unknowns: Estimates, (p,).
        spread: Noise of a measurement, in its unit.
        information: Information so far, in units of the scales, (p, p).
        candidates: Poses to choose from.
        count: Number of poses to choose.
    """
    at_candidates = replace(model, log=candidates)
    at_candidates.__dict__["scale"] = model.scale  # both in the log's units
    rows, _ = information_of(at_candidates, unknowns, spread)
    chosen = _choose_poses(rows, information, count, len(model.unknowns.elastic))
    direction = None if candidates.direction is None else candidates.direction[chosen]
    information = add_information(information, rows[chosen])
    return PosePlan(candidates.theta[chosen], direction, information)


def plan_further(fit: ArmFit, candidates: PoseLog, count: int) -> PosePlan:
    """Choose poses that add most to the information of a fitted log; arguments as `plan_poses`."""
    return plan_poses(fit.model, fit.unknowns, fit.spread, fit.information, candidates, count)


def candidate_poses(
    arm: StaticArm, shapes: mujoco.MjModel, log: PoseLog, generator: np.random.Generator
) -> PoseLog:
    """Random poses within limits and without contacts.

    Pairs of bodies that touch in all poses of the log do not count.

    Args:
        arm: The arm.
        shapes: The same arm with its collision shapes, if it has any.
        log: Log whose kind of measurement is planned for.
        generator: Source of poses and sides of approach.

    Raises:
        ElasticError: Nearly all poses are in contact.
    """
    unlimited = [-_UNLIMITED_RAD, _UNLIMITED_RAD]
    low, high = np.where(np.isfinite(arm.ranges), arm.ranges, unlimited).T
    middle = 0.5 * (low + high)
    half = 0.5 * _RANGE_SHARE * (high - low)
    data = mujoco.MjData(shapes)
    if shapes.nkey:
        data.qpos[:] = shapes.key_qpos[0]
    addresses = [int(shapes.joint(joint).qposadr[0]) for joint in arm.joints]

    def contacts(q: Array) -> set[tuple[int, int]]:
        """Pairs of bodies that touch at joint angles, (n,) [rad]."""
        data.qpos[addresses] = q
        mujoco.mj_kinematics(shapes, data)
        mujoco.mj_comPos(shapes, data)
        mujoco.mj_collision(shapes, data)
        bodies = shapes.geom_bodyid[data.contact.geom[: data.ncon]]
        return {(int(min(pair)), int(max(pair))) for pair in bodies}

    usual = set.intersection(*map(contacts, log.theta if len(log) else [middle]))
    draws = (middle + half * generator.uniform(-1.0, 1.0, len(middle)) for _ in range(_MOST_DRAWS))
    free = (theta for theta in draws if contacts(theta) <= usual)
    poses = list(islice(free, CANDIDATES))
    if len(poses) < CANDIDATES // 10:
        raise ElasticError(
            f"only {len(poses)} of {_MOST_DRAWS} random poses are free of contacts;"
            " check joint ranges and shapes of the model, or give a model without shapes"
        )
    theta = np.array(poses)
    sides = None
    if log.direction is not None:
        sides = generator.choice([-1.0, 1.0], size=theta.shape)
    measured = _rigid_measurement(arm, log, theta)
    return replace(log, theta=theta, measured=measured, direction=sides)


def empty_log(arm: StaticArm, kind: Kind) -> PoseLog:
    """Log without poses, with sides of approach, for a measurement that is planned."""
    columns = AXES.get(kind, arm.joints)
    nothing = np.zeros((0, len(arm.joints)))
    return PoseLog(arm.joints, nothing, kind, columns, np.zeros((0, len(columns))), nothing)


def _rigid_measurement(arm: StaticArm, log: PoseLog, theta: Array) -> Array:
    """Measurement of an arm with rigid joints in the model's frame, (N, m).

    `PoseModel` uses it only for the axes of an IMU and the first frame.
    """
    if log.kind == "end_effector":
        return arm.attitude(theta).position
    if log.kind == "imu":
        return roll_and_pitch(arm.attitude(theta).rotation.transpose(0, 2, 1) @ arm.up)
    return np.zeros((len(theta), len(log.columns)))


def _choose_poses(rows: Array, information: Array, count: int, k: int) -> IntArray:
    """Indices of poses by a greedy choice with exchanges.

    Args:
        rows: Scaled derivatives of the candidates, (N, m, p).
        information: Information so far, (p, p).
        count: Number of poses to choose.
        k: Number of compliances, the first unknowns, which the criterion is about.
    """
    chosen: list[int] = []
    for _ in range(min(count, len(rows))):
        so_far = add_information(information, rows[chosen])
        best, _ = _best_pose(rows, so_far, chosen, k)
        chosen.append(best)
    for _ in range(_MOST_EXCHANGE_ROUNDS):
        before = list(chosen)
        for i in range(len(chosen)):
            others = chosen[:i] + chosen[i + 1 :]
            without = add_information(information, rows[others])
            best, gains = _best_pose(rows, without, others, k)
            if gains[best] > gains[chosen[i]] + _LEAST_GAIN:
                chosen[i] = best
        if chosen == before:
            break
    return np.array(chosen, dtype=np.int64)


def _best_pose(rows: Array, information: Array, chosen: list[int], k: int) -> tuple[int, Array]:
    """The pose that adds most to the criterion, and the gain of each pose, (candidates,)."""
    nuisance = _gain(rows[..., k:], information[k:, k:])
    gains = _gain(rows, information) - nuisance
    gains[chosen] = -np.inf
    return int(np.argmax(gains)), gains


def _gain(rows: Array, information: Array) -> Array:
    """Gain of each pose in log det M, (candidates,), by the determinant lemma."""
    inner = rows @ np.linalg.solve(information, rows.transpose(0, 2, 1))
    return np.linalg.slogdet(np.eye(rows.shape[1]) + inner)[1]
