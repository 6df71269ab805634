"""Signs of a log that contradict the model: swapped encoders, joints that turn the other way."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from baselines.identification.pose_log import PoseLog
from baselines.identification.pose_model import PoseModel
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray

_EXPLAINED = 0.8
"""Share of a joint's deflections that a spring of negative stiffness explains where it
contradicts the model.
"""
_MOST_CORRELATED = -0.9
_LEAST_MOTION_RAD = 0.05
_BETTER = 0.2
"""Ratio of the spreads of the residuals with a sign turned round and as logged, where the sign
is wrong.
"""
_MOST_NAMED = 4
_MOST_JOINTS = 16
"""Joints of an arm whose signs are tried."""


def require_like_encoders(log: PoseLog) -> None:
    """Refuse link encoders that run against the motor encoders.

    Raises:
        ConfigurationError: Those of a joint do.
    """
    if log.kind != "link_encoders":
        return
    wrong = []
    for column, joint in enumerate(log.columns):
        theta = log.theta[:, log.joints.index(joint)]
        q = log.measured[:, column]
        moves = min(np.ptp(theta), np.ptp(q)) > _LEAST_MOTION_RAD
        if moves and np.corrcoef(theta, q)[0, 1] < _MOST_CORRELATED:
            wrong.append(joint)
    if wrong:
        raise ConfigurationError(
            f"theta and q run against each other: a sign is wrong ({_joints(wrong)}); give both the"
            " sign of the model"
        )


def require_deflections_with_load(model: PoseModel, unknowns: Array, half_width: Array) -> None:
    """Refuse link encoders that show springs of negative stiffness.

    Args:
        model: The poses.
        unknowns: Estimates, (p,).
        half_width: Of the intervals of the compliances, (k,) [rad/(N·m)].

    Raises:
        ConfigurationError: The links of a joint deflect against their load.
    """
    if model.log.kind != "link_encoders":
        return
    compliance = unknowns[model.unknowns.slices["compliance"]]
    torque = model.torque(unknowns, model.link_angles(unknowns)[0])
    against = []
    for i, at in enumerate(model.unknowns.elastic):
        name = model.log.joints[at]
        if name in model.log.columns and compliance[i] < -half_width[i]:
            measured = model.log.theta[:, at] - model.log.measured[:, model.log.columns.index(name)]
            missing = measured - compliance[i] * torque[:, at]
            if np.var(missing) < (1.0 - _EXPLAINED) * np.var(measured):
                against.append(name)
    if against:
        raise ConfigurationError(
            "the links deflect against their load: are theta and q swapped, or a sign wrong"
            f" ({_joints(against)})? Springs give way to the load; give theta.JOINT of the motor"
            " encoder and q.JOINT of the link encoder in the signs of the model"
        )


def require_signs(model: PoseModel, spread_of: Callable[[PoseModel], float]) -> None:
    """Refuse a log that fits the model far better with the sign of a joint turned round.

    Args:
        model: The poses.
        spread_of: Spread of the residuals, also with other poses.

    Raises:
        ConfigurationError: There is such a joint.
    """
    joints = model.log.joints
    if len(joints) > _MOST_JOINTS:
        return
    found = {joint: spread_of(replace(model, log=turn_joint(model.log, joint))) for joint in joints}
    least = min(found.values())
    if least < _BETTER * spread_of(model):
        wrong = [joint for joint, own in found.items() if own < 2.0 * least]
        raise ConfigurationError(
            f"the links deflect against their load: a sign is wrong ({_joints(wrong)}). With all"
            f" columns of {' or '.join(wrong[:3])} turned round the poses fit the model; give them"
            " the sign of the model"
        )


def turn_joint(log: PoseLog, joint: str) -> PoseLog:
    """A log in which a joint turns the other way."""
    at = np.array(log.joints) == joint
    measured = log.measured
    if log.kind in ("link_encoders", "torques"):
        measured = _negative(measured, np.array(log.columns) == joint)
    return replace(
        log,
        theta=_negative(log.theta, at),
        measured=measured,
        direction=None if log.direction is None else _negative(log.direction, at),
        known=None if log.known is None else _negative(log.known, at),
    )


def _negative(table: Array, columns: BoolArray) -> Array:
    return np.where(columns, -table, table)


def _joints(names: Sequence[str]) -> str:
    """A joint, or one of several, of which the first few are named."""
    if len(names) > _MOST_NAMED:
        names = [*names[:_MOST_NAMED], f"{len(names) - _MOST_NAMED} others"]
    return f"joint {' or '.join(names)}"
