"""Result of an identification of an arm: intervals in JSON, stiffness in YAML."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from baselines.identification.arm_fit import ArmFit
from baselines.identification.holdout import HeldOut
from baselines.identification.pose_log import Kind
from baselines.identification.pose_model import SMALLEST_LOAD
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray
from elastic_env.core.yaml_text import yaml_line
from elastic_env.joint.model_joints import hinges_of

Source = Literal["told apart", "wide interval", "no upper end", "rigid", "assumed"]
"""Origin of a joint's stiffness.

An estimate with a narrow interval, as asked for; with a wider one; or with one that reaches to
rigid. Rigid where the poses say nothing of the joint, or where the estimate of 1/K is negative.
Assumed where the user gave K in its place.
"""

_OFFSET_KNOWN_RAD = 0.05
"""Half-width of an offset's interval above which the poses do not tell the offset."""
_KNOWN = 0.5
"""The same for friction and payload, as a share of their plausible size."""
_SHOWN = 0.05
"""Share of the largest derivative by a joint: gravity couples the others by less."""
UNLOADED = "gravity does not load it in these poses"
UNSEEN = "the measurement does not show its angle"
NEGATIVE = "stiffer than the log can tell; the estimate is negative"
_ALIKE = 0.95  # correlation of two unknowns that the poses hardly tell apart


class JointStiffness(Model):
    """Stiffness of one joint. Intervals are of 95 %; None where they have no bound."""

    joint: str
    stiffness_nm_per_rad: float = Field(allow_inf_nan=True)
    """Value in `joints.yaml`; infinite for a rigid joint, which JSON has as null."""
    source: Source
    stiffness_low_nm_per_rad: float | None
    stiffness_high_nm_per_rad: float | None
    half_width: float
    """Half-width of the interval of the compliance 1/K, relative to its estimate."""
    reason: str
    """Why the poses do not tell the stiffness apart; empty where they do."""
    is_negative: bool = False
    """True if the estimate of 1/K is negative: the joint is stiffer than the log can tell."""
    friction_nm: float | None
    """Friction on the link side of the spring; None where the poses do not tell it."""
    friction_half_width_nm: float | None
    offset_rad: float | None
    """Reading of the motor encoder beyond θ; None where the poses do not tell it."""
    offset_half_width_rad: float
    largest_torque_nm: float
    """Largest gravity torque in the poses."""
    planned_half_width: float | None = None
    """Half-width that is expected with the proposed poses."""


class ArmIdentification(Model):
    """Result of an identification of an arm; written as `identification.json`."""

    measurement: Kind
    poses: int
    within: float
    """Half-width up to which a joint counts as told apart."""
    joints: tuple[JointStiffness, ...]
    payload_kg: float | None
    """Mass of the payload; None where it is not sought, or where the poses do not tell it."""
    payload_half_width_kg: float | None
    residual_spread: float
    """Standard deviation of the residuals [m], [rad] or [N·m]."""
    friction_is_noise: bool
    """True if the log has no sides of approach, so that friction widens the intervals."""
    rigid_joints: tuple[str, ...] = ()
    """Joints of the log that were taken as rigid."""
    held_joints: tuple[str, ...] = ()
    """Hinges of the model that the log does not have: they were held."""
    outlying_poses: tuple[int, ...]
    """Poses of the log, counted from 1, whose residual is far beyond the others'."""
    held_out: HeldOut | None = None
    """Errors at poses that another fit did not see; None where there are none."""

    def save(self, folder: Path) -> list[Path]:
        """Write `identification.json` and `joints.yaml`."""
        files = [folder / "identification.json", folder / "joints.yaml"]
        files[0].write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")
        head = "# stiffness [N·m/rad], by elastic identify; .inf for a rigid joint"
        lines = [
            yaml_line(joint.joint, {"stiffness": _written(joint)}, _comment(joint))
            for joint in self.joints
        ]
        lines += [
            yaml_line(name, {"stiffness": math.inf}, "rigid: not sought")
            for name in self.rigid_joints
        ]
        lines += [yaml_line(name, "held", "not in the log") for name in self.held_joints]
        files[1].write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
        return files


def describe_fit(
    fit: ArmFit,
    within: float,
    assumed: float | None,
    planned: Array | None = None,
    held_out: HeldOut | None = None,
) -> ArmIdentification:
    """The result of a fit.

    Args:
        fit: The fit.
        within: Largest half-width of 1/K, relative, of a joint that counts as told apart.
        assumed: K of joints whose interval of 1/K holds zero; None for their own estimate, or
            rigid.
        planned: Information with the proposed poses, (p, p); None without a plan.
        held_out: Errors at poses that another fit did not see.

    Raises:
        ConfigurationError: No joint is identified and no stiffness is assumed.
    """
    compliance, half = fit.estimate("compliance")
    if assumed is None and not (compliance > half).any():
        raise ConfigurationError(
            "the poses tell no stiffness: the interval of every joint reaches to rigid; log poses"
            " with larger gravity torques (--plan proposes them), or a finer measurement"
        )
    why = reasons(fit, within)
    after = None if planned is None else expected_half_width(fit, planned)
    joints = tuple(_joint(fit, i, within, assumed, reason, after) for i, reason in enumerate(why))
    payload, payload_half = _first_known(fit, "payload")
    log = fit.model.log
    sought = [joint.joint for joint in joints]
    return ArmIdentification(
        measurement=log.kind,
        poses=len(fit.q),
        within=within,
        joints=joints,
        payload_kg=payload,
        payload_half_width_kg=payload_half,
        residual_spread=fit.spread,
        friction_is_noise=log.direction is None,
        rigid_joints=tuple(joint for joint in log.joints if joint not in sought),
        held_joints=tuple(
            joint for joint in hinges_of(fit.model.arm.model) if joint not in log.joints
        ),
        outlying_poses=tuple(int(pose) + 1 for pose in fit.outliers),
        held_out=held_out,
    )


def expected_half_width(fit: ArmFit, information: Array) -> Array:
    """Half-widths of the intervals of 1/K, relative, that an information promises, (k,)."""
    own = fit.model.unknowns.slices["compliance"]
    deviation = np.sqrt(np.diag(np.linalg.inv(information))[own]) * fit.model.scale[own]
    return fit.quantile * deviation / np.maximum(np.abs(fit.unknowns[own]), 1e-12)


def reasons(fit: ArmFit, within: float) -> list[str]:
    """Why the poses do not tell each stiffness apart; empty text where they do, (k,)."""
    compliance, half = fit.estimate("compliance")
    model = fit.model
    unloaded = model.load < SMALLEST_LOAD * np.abs(model.arm.torque(fit.q)).max()
    _, gradient = model.predict(fit.unknowns)
    moved = np.abs(gradient[..., model.unknowns.slices["offset"]]).max(axis=(0, 1))
    unseen = moved < _SHOWN * moved.max()
    alike = _alike(fit)
    names = [fit.model.log.joints[at] for at in fit.model.unknowns.elastic]

    def reason(i: int) -> str:
        if half[i] <= within * compliance[i]:
            return ""
        if unloaded[i]:
            return UNLOADED
        if unseen[i]:
            return UNSEEN
        others = [names[j] for j in np.flatnonzero(alike[i] & ~unloaded)]
        if others:
            return f"these poses do not separate it from {', '.join(others)}"
        return (
            f"its interval is wider than ±{100.0 * within:.3g} %: its deflections are small beside"
            " the noise"
        )

    return [reason(i) for i in range(len(names))]


def _alike(fit: ArmFit) -> BoolArray:
    """Pairs of compliances whose estimates hardly differ in what they explain, (k, k)."""
    own = fit.model.unknowns.slices["compliance"]
    spread = np.linalg.inv(fit.information)[own, own]
    correlation = spread / np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    return (np.abs(correlation) > _ALIKE) & ~np.eye(len(spread), dtype=bool)


def _joint(
    fit: ArmFit, i: int, within: float, assumed: float | None, why: str, planned: Array | None
) -> JointStiffness:
    compliance, half = fit.estimate("compliance")
    c = float(compliance[i])
    h = float(half[i])
    best = float(bounded_compliance(fit)[i])
    offset, offset_half = fit.estimate("offset")
    friction, friction_half = _first_known(fit, "friction", i)
    is_shown = why not in (UNLOADED, UNSEEN)
    is_rigid = best == 0.0 or not is_shown
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
    return JointStiffness(
        joint=fit.model.log.joints[fit.model.unknowns.elastic[i]],
        stiffness_nm_per_rad=stiffness,
        source=source,
        stiffness_low_nm_per_rad=1.0 / (c + h) if c + h > 0.0 else None,
        stiffness_high_nm_per_rad=1.0 / (c - h) if c > h else None,
        half_width=h / max(abs(c), 1e-12),
        reason=why,
        is_negative=is_shown and best == 0.0,
        friction_nm=friction,
        friction_half_width_nm=friction_half,
        offset_rad=float(offset[i]) if offset_half[i] < _OFFSET_KNOWN_RAD else None,
        offset_half_width_rad=float(offset_half[i]),
        largest_torque_nm=float(fit.model.load[i]),
        planned_half_width=None if planned is None else float(planned[i]),
    )


def bounded_compliance(fit: ArmFit) -> Array:
    """Compliances that fit best among those that are not negative, (k,) [rad/(N·m)].

    To first order: where an estimate is negative it becomes zero, and the others take over what it
    explained.
    """
    compliance, _ = fit.estimate("compliance")
    own = fit.model.unknowns.slices["compliance"]
    size = fit.model.scale[own]
    spread = np.linalg.inv(fit.information)[own, own]
    best = compliance / size
    zero = np.zeros(len(best), dtype=np.bool_)
    while (best < 0.0).any():
        zero |= best < 0.0
        taken = np.linalg.solve(spread[np.ix_(zero, zero)], compliance[zero] / size[zero])
        best = compliance / size - spread[:, zero] @ taken
        best[zero] = 0.0
    return compliance if not zero.any() else best * size


def _first_known(fit: ArmFit, name: str, i: int = 0) -> tuple[float | None, float | None]:
    """An estimate, None where the poses do not tell it, and its half-width, None if not sought."""
    values, half = fit.estimate(name)
    if not len(values):
        return None, None
    size = fit.model.scale[fit.model.unknowns.slices[name]]
    is_known = half[i] < _KNOWN * size[i]
    return float(values[i]) if is_known else None, float(half[i])


def _written(joint: JointStiffness) -> float:
    """K as `joints.yaml` has it: six digits, infinite for a rigid joint [N·m/rad]."""
    return float(f"{joint.stiffness_nm_per_rad:.6g}")


def _comment(joint: JointStiffness) -> str:
    """How well the stiffness of a joint is known."""
    width = f"± {100 * joint.half_width:.2g} %"
    says = {
        "told apart": width,
        "wide interval": f"{width}: {joint.reason}",
        "no upper end": f"own estimate, may be rigid: {joint.reason}",
        "rigid": f"rigid: {NEGATIVE if joint.is_negative else joint.reason}",
        "assumed": f"assumed, not identified: {joint.reason}",
    }
    return says[joint.source]
