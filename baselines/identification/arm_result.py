"""Result of an identification of an arm: intervals in JSON, stiffness in YAML."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from baselines.identification.arm_fit import ArmFit, deviations
from baselines.identification.holdout import HeldOut
from baselines.identification.pose_log import Kind
from baselines.identification.pose_model import SMALLEST_LOAD
from baselines.identification.results import save_result, stiffness_ends, stiffness_line
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.core.yaml_text import yaml_line
from elastic_env.joint.model_joints import hinges_of

Source = Literal["told apart", "wide interval", "no upper end", "rigid", "assumed"]
"""Origin of a joint's stiffness.

An estimate with an interval as narrow as required, with a wider one, or with one that reaches to
rigid. Rigid where the poses do not determine the joint, or where the estimate of 1/K is negative.
Assumed where the user gave K instead.
"""

_WIDEST_OFFSET_RAD = 0.05
"""Half-width of an offset's interval above which the poses do not determine the offset."""
_LARGEST_HALF_WIDTH = 0.5
"""The same for friction and payload, as a share of their plausible size."""
_LEAST_EFFECT = 0.05
"""Share of the largest derivative by a joint's angle below which a joint is not measured.

Gravity couples the other joints by less.
"""
_LARGEST_CORRELATION = 0.95
"""Correlation of two compliances above which the poses hardly separate them."""
UNLOADED = "gravity does not load it in these poses"
UNSEEN = "the measurement does not show its angle"
NEGATIVE = "stiffer than the log can tell; the estimate is negative"


class JointStiffness(Model):
    """Stiffness of one joint, with 95 % intervals; None where they have no bound."""

    joint: str
    stiffness_nm_per_rad: float = Field(allow_inf_nan=True)
    """Value in `joints.yaml`; infinite for a rigid joint, which JSON has as null."""
    source: Source
    stiffness_low_nm_per_rad: float | None
    stiffness_high_nm_per_rad: float | None
    half_width: float
    """Half-width of the interval of the compliance 1/K, relative to its estimate."""
    reason: str
    """Reason why the interval is too wide; empty where it is narrow."""
    is_negative: bool = False
    """True if the estimate of 1/K is negative: the joint is stiffer than the log can tell."""
    friction_nm: float | None
    """Friction on the link side of the spring; None where the poses do not determine it."""
    friction_half_width_nm: float | None
    offset_rad: float | None
    """Reading of the motor encoder less θ; None where the poses do not determine it."""
    offset_half_width_rad: float
    largest_torque_nm: float
    """Largest gravity torque in the poses."""
    planned_half_width: float | None = None
    """Relative half-width that is expected with the proposed poses."""


class ArmIdentification(Model):
    """Result of an identification of an arm; written as `identification.json`."""

    measurement: Kind
    poses: int
    within: float
    """Relative half-width of 1/K up to which a joint counts as told apart."""
    joints: tuple[JointStiffness, ...]
    payload_kg: float | None
    """Mass of the payload; None where it is not estimated, or not determined by the poses."""
    payload_half_width_kg: float | None
    residual_spread: float
    """Standard deviation of the residuals [m], [rad] or [N·m]."""
    friction_is_noise: bool
    """True if the log has no sides of approach, so that friction widens the intervals."""
    rigid_joints: tuple[str, ...] = ()
    """Joints of the log that were assumed rigid."""
    held_joints: tuple[str, ...] = ()
    """Hinges of the model that are not in the log: they were held."""
    outlying_poses: tuple[int, ...]
    """Poses of the log, counted from 1, whose residual is far beyond the others'."""
    held_out: HeldOut | None = None
    """Errors at poses that another fit did not use; None where none were held out."""

    def save(self, folder: Path) -> list[Path]:
        """Write `identification.json` and `joints.yaml`."""
        head = "# stiffness [N·m/rad], by elastic identify; .inf for a rigid joint"
        lines = [
            stiffness_line(joint.joint, joint.stiffness_nm_per_rad, _comment(joint))
            for joint in self.joints
        ]
        rigid = "rigid: not sought"
        lines += [stiffness_line(name, math.inf, rigid) for name in self.rigid_joints]
        lines += [yaml_line(name, "held", "not in the log") for name in self.held_joints]
        return save_result(self, folder, head, lines)


def describe_fit(
    fit: ArmFit,
    within: float,
    assumed: float | None,
    planned: Array | None = None,
    held_out: HeldOut | None = None,
) -> ArmIdentification:
    """Result of a fit.

    Args:
        fit: The fit.
        within: Largest half-width of 1/K, relative, of a joint that counts as told apart.
        assumed: K of joints whose interval of 1/K contains zero; None for their own estimate, or
            rigid.
        planned: Information with the proposed poses, (p, p); None without a plan.
        held_out: Errors at poses that another fit did not use.

    Raises:
        ConfigurationError: No joint is identified and no stiffness is assumed.
    """
    compliance, half = fit.estimate("compliance")
    if assumed is None and not (compliance > half).any():
        raise ConfigurationError(
            "the poses tell no stiffness: the interval of every joint reaches to rigid; log poses"
            " with larger gravity torques (--plan proposes them), or a finer measurement"
        )
    expected = None if planned is None else expected_half_width(fit, planned)
    joints = tuple(
        _joint_stiffness(fit, i, within, assumed, reason, expected)
        for i, reason in enumerate(wide_interval_reasons(fit, within))
    )
    payload, payload_half = _determined_estimate(fit, "payload")
    log = fit.model.log
    elastic = [joint.joint for joint in joints]
    return ArmIdentification(
        measurement=log.kind,
        poses=len(fit.q),
        within=within,
        joints=joints,
        payload_kg=payload,
        payload_half_width_kg=payload_half,
        residual_spread=fit.spread,
        friction_is_noise=log.direction is None,
        rigid_joints=tuple(joint for joint in log.joints if joint not in elastic),
        held_joints=tuple(
            joint for joint in hinges_of(fit.model.arm.model) if joint not in log.joints
        ),
        outlying_poses=tuple(int(pose) + 1 for pose in fit.outliers),
        held_out=held_out,
    )


def expected_half_width(fit: ArmFit, information: Array) -> Array:
    """Relative half-widths of the intervals of 1/K to expect from an information, (k,)."""
    compliance = fit.unknowns[fit.model.unknowns.slices["compliance"]]
    deviation = deviations(fit.model, information, "compliance")
    return fit.quantile * deviation / np.maximum(np.abs(compliance), 1e-12)


def wide_interval_reasons(fit: ArmFit, within: float) -> list[str]:
    """Reasons for intervals of 1/K wider than `within`; empty text for narrow ones, (k,)."""
    compliance, half = fit.estimate("compliance")
    model = fit.model
    unloaded = model.load < SMALLEST_LOAD * np.abs(model.arm.torque(fit.q)).max()
    _, gradient = model.predict(fit.unknowns)
    effect = np.abs(gradient[..., model.unknowns.slices["offset"]]).max(axis=(0, 1))
    unseen = effect < _LEAST_EFFECT * effect.max()
    correlated = _correlated_compliances(fit)
    names = [model.log.joints[joint] for joint in model.unknowns.elastic]

    def reason(i: int) -> str:
        if half[i] <= within * compliance[i]:
            return ""
        if unloaded[i]:
            return UNLOADED
        if unseen[i]:
            return UNSEEN
        others = [names[j] for j in np.flatnonzero(correlated[i] & ~unloaded)]
        if others:
            return f"these poses do not separate it from {', '.join(others)}"
        return (
            f"its interval is wider than ±{100.0 * within:.3g} %: its deflections are small beside"
            " the noise"
        )

    return [reason(i) for i in range(len(names))]


def _correlated_compliances(fit: ArmFit) -> BoolArray:
    """Pairs of compliances that the poses hardly separate, (k, k)."""
    part = fit.model.unknowns.slices["compliance"]
    covariance = np.linalg.inv(fit.information)[part, part]
    variance = np.diag(covariance)
    correlation = covariance / np.sqrt(np.outer(variance, variance))
    is_diagonal = np.eye(len(covariance), dtype=bool)
    return (np.abs(correlation) > _LARGEST_CORRELATION) & ~is_diagonal


def _joint_stiffness(
    fit: ArmFit, i: int, within: float, assumed: float | None, reason: str, expected: Array | None
) -> JointStiffness:
    """Result of one joint; `expected` has the half-widths with the proposed poses, (k,)."""
    compliance, half = fit.estimate("compliance")
    c = float(compliance[i])
    h = float(half[i])
    best = float(bounded_compliance(fit)[i])
    offset, offset_half = fit.estimate("offset")
    friction, friction_half = _determined_estimate(fit, "friction", i)
    is_observable = reason not in (UNLOADED, UNSEEN)
    is_rigid = best == 0.0 or not is_observable
    source: Source
    if c > h and not is_rigid:
        source = "told apart" if h <= within * c else "wide interval"
    elif assumed is not None:
        source = "assumed"
    else:
        source = "rigid" if is_rigid else "no upper end"
    stiffness = math.inf
    if source != "rigid":
        stiffness = 1.0 / best if assumed is None or c > h else assumed
    low, high = stiffness_ends(c, h)
    return JointStiffness(
        joint=fit.model.log.joints[fit.model.unknowns.elastic[i]],
        stiffness_nm_per_rad=stiffness,
        source=source,
        stiffness_low_nm_per_rad=low,
        stiffness_high_nm_per_rad=high,
        half_width=h / max(abs(c), 1e-12),
        reason=reason,
        is_negative=is_observable and best == 0.0,
        friction_nm=friction,
        friction_half_width_nm=friction_half,
        offset_rad=float(offset[i]) if offset_half[i] < _WIDEST_OFFSET_RAD else None,
        offset_half_width_rad=float(offset_half[i]),
        largest_torque_nm=float(fit.model.load[i]),
        planned_half_width=None if expected is None else float(expected[i]),
    )


def bounded_compliance(fit: ArmFit) -> Array:
    """Best estimates under the condition that none is negative, (k,) [rad/(N·m)].

    To first order: a negative estimate becomes zero, and the others change by their covariance.
    """
    compliance, _ = fit.estimate("compliance")
    part = fit.model.unknowns.slices["compliance"]
    scale = fit.model.scale[part]
    covariance = np.linalg.inv(fit.information)[part, part]
    best = scaled = compliance / scale
    zero = np.zeros(len(best), dtype=np.bool_)
    while (best < 0.0).any():
        zero |= best < 0.0
        multiplier = np.linalg.solve(covariance[np.ix_(zero, zero)], scaled[zero])
        best = scaled - covariance[:, zero] @ multiplier
        best[zero] = 0.0
    return compliance if not zero.any() else best * scale


def _determined_estimate(fit: ArmFit, name: str, i: int = 0) -> tuple[float | None, float | None]:
    """An estimate, None where the poses do not determine it, and its half-width.

    Both are None where it is not an unknown.
    """
    values, half = fit.estimate(name)
    if not len(values):
        return None, None
    scale = fit.model.scale[fit.model.unknowns.slices[name]]
    is_determined = half[i] < _LARGEST_HALF_WIDTH * scale[i]
    return float(values[i]) if is_determined else None, float(half[i])


def _comment(joint: JointStiffness) -> str:
    """Comment of a joint in `joints.yaml`: its interval, or why it is rigid."""
    width = f"± {100 * joint.half_width:.2g} %"
    comments = {
        "told apart": width,
        "wide interval": f"{width}: {joint.reason}",
        "no upper end": f"own estimate, may be rigid: {joint.reason}",
        "rigid": f"rigid: {NEGATIVE if joint.is_negative else joint.reason}",
        "assumed": f"assumed, not identified: {joint.reason}",
    }
    return comments[joint.source]
