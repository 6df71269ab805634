"""Checks of a log of static poses against the model of the arm: number of poses, units, signs.

A log whose signs contradict the model is refused: swapped encoders, joints that turn the other way.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from baselines.identification.pose_log import PoseLog
from baselines.identification.pose_model import PoseModel
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray

_SPARE_POSES = 3
"""Poses needed beyond those that give as many numbers as there are unknowns."""
_SPREAD_RATIO = 3.0
"""Ratio between measured spread of positions and the model's from which the units differ."""
_OPPOSITE_CORRELATION = -0.9
"""Correlation of two encoders of a joint below which their signs differ."""
_LEAST_MOTION_RAD = 0.05
"""Motion of a joint below which the signs of its encoders are not compared."""
_EXPLAINED_SHARE = 0.8
"""Share of a joint's deflections that a spring of negative stiffness explains where it
contradicts the model.
"""
_WRONG_SIGN_RATIO = 0.2
"""Ratio of the spreads of the residuals with the sign reversed and as logged, where the sign is
wrong.
"""
_MOST_JOINTS = 16
"""Joints of an arm up to which every sign is tried."""
_MOST_NAMED = 4
"""Joints that a message names."""


def needed_poses(model: PoseModel) -> int:
    """Least number of poses that determines the unknowns."""
    return -(-model.unknowns.size // model.target.shape[1]) + _SPARE_POSES


def require_poses(model: PoseModel) -> None:
    """Refuse logs with fewer numbers than unknowns, and positions in another unit.

    Raises:
        ConfigurationError: Too few poses, or positions that the arm cannot reach.
    """
    needed = needed_poses(model)
    if len(model.log) < needed:
        raise ConfigurationError(
            f"{model.unknowns.size} unknowns need at least {needed} poses of"
            f" {model.target.shape[1]} measured numbers each, the log has {len(model.log)}; log"
            " further poses, or seek fewer joints by --joints"
        )
    if model.log.kind != "end_effector":
        return
    positions = (model.arm.attitude(model.log.theta).position, model.log.measured)
    # root mean square distances from the mean, which do not depend on the frame
    expected, measured = (float(np.sqrt(np.var(p, axis=0).sum())) for p in positions)
    if not expected / _SPREAD_RATIO < measured < expected * _SPREAD_RATIO:
        raise ConfigurationError(
            f"the columns end_effector spread over {measured:.3g} m, {model.arm.end_effector!r} of"
            f" the model over {expected:.3g} m: convert millimetres to metres, or name the body"
            " that was measured by --end-effector"
        )


def require_equal_signs(log: PoseLog) -> None:
    """Refuse link encoders that count against the motor encoders.

    Raises:
        ConfigurationError: Both encoders of a joint run against each other.
    """
    if log.kind != "link_encoders":
        return
    wrong = []
    for column, joint in enumerate(log.columns):
        theta = log.theta[:, log.joints.index(joint)]
        q = log.measured[:, column]
        moves = min(np.ptp(theta), np.ptp(q)) > _LEAST_MOTION_RAD
        if moves and np.corrcoef(theta, q)[0, 1] < _OPPOSITE_CORRELATION:
            wrong.append(joint)
    if wrong:
        raise ConfigurationError(
            f"theta and q run against each other: a sign is wrong ({_joint_names(wrong)}); give"
            " both the sign of the model"
        )


def require_deflections_with_load(model: PoseModel, unknowns: Array, half_width: Array) -> None:
    """Refuse link encoders that show springs of negative stiffness.

    Args:
        model: The poses.
        unknowns: Estimates, (p,).
        half_width: Half-widths of the intervals of the compliances, (k,) [rad/(N·m)].

    Raises:
        ConfigurationError: The links of a joint deflect against their load.
    """
    if model.log.kind != "link_encoders":
        return
    compliance = unknowns[model.unknowns.slices["compliance"]]
    torque = model.torque(unknowns, model.link_angles(unknowns)[0])
    wrong = []
    for i, joint in enumerate(model.unknowns.elastic):
        name = model.log.joints[joint]
        if name in model.log.columns and compliance[i] < -half_width[i]:
            q = model.log.measured[:, model.log.columns.index(name)]
            deflection = model.log.theta[:, joint] - q
            residual = deflection - compliance[i] * torque[:, joint]
            if np.var(residual) < (1.0 - _EXPLAINED_SHARE) * np.var(deflection):
                wrong.append(name)
    if wrong:
        raise ConfigurationError(
            "the links deflect against their load: are theta and q swapped, or a sign wrong"
            f" ({_joint_names(wrong)})? Springs give way to the load; give theta.JOINT of the motor"
            " encoder and q.JOINT of the link encoder in the signs of the model"
        )


def require_signs(model: PoseModel, spread_of: Callable[[PoseModel], float]) -> None:
    """Refuse a log that fits the model far better with the sign of a joint reversed.

    Args:
        model: The poses.
        spread_of: Spread of the residuals of given poses.

    Raises:
        ConfigurationError: There is such a joint.
    """
    joints = model.log.joints
    if len(joints) > _MOST_JOINTS:
        return
    logs = {joint: reverse_joint(model.log, joint) for joint in joints}
    spreads = {joint: spread_of(replace(model, log=logs[joint])) for joint in joints}
    least = min(spreads.values())
    if least < _WRONG_SIGN_RATIO * spread_of(model):
        wrong = [joint for joint, spread in spreads.items() if spread < 2.0 * least]
        raise ConfigurationError(
            f"the links deflect against their load: a sign is wrong ({_joint_names(wrong)}). With"
            f" all columns of {' or '.join(wrong[:3])} turned round the poses fit the model; give"
            " them the sign of the model"
        )


def reverse_joint(log: PoseLog, joint: str) -> PoseLog:
    """Copy of a log in which a joint turns the other way."""
    column = np.array(log.joints) == joint
    measured = log.measured
    if log.kind in ("link_encoders", "torques"):
        measured = _negate(measured, np.array(log.columns) == joint)
    return replace(
        log,
        theta=_negate(log.theta, column),
        measured=measured,
        direction=_negate(log.direction, column),
        known_torque=_negate(log.known_torque, column),
    )


def _negate(table: Any, columns: BoolArray) -> Any:
    return None if table is None else np.where(columns, -table, table)


def _joint_names(names: Sequence[str]) -> str:
    """One joint, or alternatives of which the first few are named."""
    if len(names) > _MOST_NAMED:
        names = [*names[:_MOST_NAMED], f"{len(names) - _MOST_NAMED} others"]
    return f"joint {' or '.join(names)}"
