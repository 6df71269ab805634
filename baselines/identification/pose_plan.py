r"""Further poses that tell stiffness apart: a D_s-optimal choice from random poses.

Poses are drawn within the joint ranges. Those in which parts of the arm touch are dropped, where
the model has shapes. Of the rest those are chosen that shrink the joint confidence region of the
compliances most. With the information M of all unknowns and its block M_f of those that are not
sought (offsets, friction, frame, payload) this maximises

.. math:: \log\det M - \log\det M_f, \quad M = M_0 + \sum_i J_i^T J_i / \sigma^2

where M_0 holds the log and the prior. Poses are added one by one, then exchanged for better ones
until none is better (V. V. Fedorov, "Theory of Optimal Experiments", Academic Press, 1972;
D_s-optimality: A. Atkinson, A. Donev, R. Tobias, "Optimum Experimental Designs, with SAS", Oxford,
2007, ch. 10). The weak prior makes this a Bayesian design, so that joints that no pose tells apart
do no harm (K. Chaloner and I. Verdinelli, Statistical Science 10(3), 1995).
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from baselines.identification.arm_fit import ArmFit, information_of
from baselines.identification.pose_log import AXES, Kind, PoseLog
from baselines.identification.pose_model import PoseModel, roll_and_pitch
from baselines.identification.static_arm import StaticArm
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray

CANDIDATES = 1000
"""Poses from which a plan is chosen."""

MOST_PLANNED = 200
"""Poses of a plan."""

_MOST_DRAWS = 20  # times the candidates
_WITHIN = 0.95  # share of the joint ranges: commands that lead the link stay within
_UNLIMITED_RAD = np.pi  # range of joints without one
_MOST_EXCHANGES = 10  # rounds; two or three are usual
_LEAST_GAIN = 1e-6


@dataclass(frozen=True)
class PosePlan:
    """Poses to visit, and what the log and they together would tell.

    Attributes:
        theta: Motor angles, (count, n) [rad].
        direction: Sides to approach them from, (count, n); None where friction is not sought.
        information: Of all unknowns in units of their scales, with these poses, (p, p).
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
    """Choose poses that tell the stiffness apart.

    Args:
        model: What the unknowns and their scales are taken from.
        unknowns: Estimates, (p,).
        spread: Noise of a measurement, in its unit.
        information: What is known already, in units of the scales, (p, p).
        candidates: Poses to choose from.
        count: How many.
    """
    own = replace(model, log=candidates)
    own.__dict__["scale"] = model.scale  # of the log: both informations have its units
    rows, _ = information_of(own, unknowns, spread)
    chosen = _chosen(rows, information, count, len(model.unknowns.elastic))
    direction = None if candidates.direction is None else candidates.direction[chosen]
    return PosePlan(candidates.theta[chosen], direction, _with(information, rows[chosen]))


def plan_further(fit: ArmFit, candidates: PoseLog, count: int) -> PosePlan:
    """Choose poses that add most to what a log has told; arguments as `plan_poses`."""
    return plan_poses(fit.model, fit.unknowns, fit.spread, fit.information, candidates, count)


def candidate_poses(
    arm: StaticArm, shapes: mujoco.MjModel, like: PoseLog, generator: np.random.Generator
) -> PoseLog:
    """Random poses within limits and without contacts.

    Pairs of bodies that touch in all poses of the log do not count.

    Args:
        arm: The arm.
        shapes: The same arm with its collision shapes, if it has any.
        like: Log whose kind of measurement is planned for.
        generator: Where poses and sides of approach come from.

    Raises:
        ElasticError: Nearly all poses are in contact.
    """
    unlimited = [-_UNLIMITED_RAD, _UNLIMITED_RAD]
    low, high = np.where(np.isfinite(arm.ranges), arm.ranges, unlimited).T
    middle = 0.5 * (low + high)
    half = 0.5 * _WITHIN * (high - low)
    data = mujoco.MjData(shapes)
    if shapes.nkey:
        data.qpos[:] = shapes.key_qpos[0]
    at = [int(shapes.joint(joint).qposadr[0]) for joint in arm.joints]

    def touching(q: Array) -> set[tuple[int, int]]:
        """Pairs of bodies that touch at joint angles, (n,) [rad]."""
        data.qpos[at] = q
        mujoco.mj_kinematics(shapes, data)
        mujoco.mj_comPos(shapes, data)
        mujoco.mj_collision(shapes, data)
        bodies = shapes.geom_bodyid[data.contact.geom[: data.ncon]]
        return {(int(min(pair)), int(max(pair))) for pair in bodies}

    usual = set.intersection(*map(touching, like.theta if len(like) else [middle]))
    poses: list[Array] = []
    for _ in range(_MOST_DRAWS * CANDIDATES):
        theta = middle + half * generator.uniform(-1.0, 1.0, len(middle))
        if touching(theta) <= usual:
            poses.append(theta)
        if len(poses) == CANDIDATES:
            break
    if len(poses) < CANDIDATES // 10:
        raise ElasticError(
            f"only {len(poses)} of {_MOST_DRAWS * CANDIDATES} random poses are free of contacts;"
            " check joint ranges and shapes of the model, or give a model without shapes"
        )
    theta = np.array(poses)
    sides = None
    if like.direction is not None:
        sides = generator.choice([-1.0, 1.0], size=theta.shape)
    measured = _rigid_measurement(arm, like, theta)
    return replace(like, theta=theta, measured=measured, direction=sides)


def empty_log(arm: StaticArm, kind: Kind) -> PoseLog:
    """The log of a measurement that is yet to be made, with sides of approach."""
    columns = AXES.get(kind, arm.joints)
    nothing = np.zeros((0, len(arm.joints)))
    return PoseLog(arm.joints, nothing, kind, columns, np.zeros((0, len(columns))), nothing)


def _rigid_measurement(arm: StaticArm, like: PoseLog, theta: Array) -> Array:
    """Measurement of a sensor in the model's own frame, of rigid joints.

    Only its directions matter, (N, m).
    """
    if like.kind == "end_effector":
        return arm.attitude(theta).position
    if like.kind == "imu":
        return roll_and_pitch(arm.attitude(theta).rotation.transpose(0, 2, 1) @ arm.up)
    return np.zeros((len(theta), len(like.columns)))


def _chosen(rows: Array, information: Array, count: int, sought: int) -> IntArray:
    """Numbers of the poses that a greedy choice with exchanges takes."""
    chosen: list[int] = []
    for _ in range(min(count, len(rows))):
        best, _ = _best(rows, _with(information, rows[chosen]), chosen, sought)
        chosen.append(best)
    for _ in range(_MOST_EXCHANGES):
        before = list(chosen)
        for place in range(len(chosen)):
            others = chosen[:place] + chosen[place + 1 :]
            without = _with(information, rows[others])
            best, gains = _best(rows, without, others, sought)
            if gains[best] > gains[chosen[place]] + _LEAST_GAIN:
                chosen[place] = best
        if chosen == before:
            break
    return np.array(chosen, dtype=np.int64)


def _best(rows: Array, information: Array, taken: list[int], sought: int) -> tuple[int, Array]:
    """The pose that adds most to the criterion, and what each adds, (candidates,)."""
    others = _gain(rows[..., sought:], information[sought:, sought:])
    gains = _gain(rows, information) - others
    gains[taken] = -np.inf
    return int(np.argmax(gains)), gains


def _gain(rows: Array, information: Array) -> Array:
    """Gain of each pose in log det M, (candidates,), by the determinant lemma."""
    if not len(information):
        return np.zeros(len(rows))
    inner = rows @ np.linalg.solve(information, rows.transpose(0, 2, 1))
    return np.linalg.slogdet(np.eye(rows.shape[1]) + inner)[1]


def _with(information: Array, rows: Array) -> Array:
    return information + np.tensordot(rows, rows, axes=([0, 1], [0, 1]))
