"""What an identification of an arm found, as files hold it: intervals in JSON, stiffness in YAML."""

from pathlib import Path
from typing import Literal

import numpy as np

from baselines.identification.arm_fit import ArmFit
from baselines.identification.pose_log import Kind
from baselines.identification.pose_model import SMALLEST_LOAD
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray

Source = Literal["told apart", "wide interval", "assumed"]
"""Where the stiffness of a joint comes from: a narrow interval, as asked for, a wider one, or no bounded one."""

_SHOWN = 0.05  # of the largest derivative of the measurement by a joint: gravity couples the others by less
_ALIKE = 0.95  # correlation of two unknowns that the poses hardly tell apart


class JointStiffness(Model):
    """Stiffness of one joint. Intervals are of 95 %; None where they have no bound."""

    joint: str
    stiffness_nm_per_rad: float
    """What `joints.yaml` has."""
    source: Source
    stiffness_low_nm_per_rad: float | None
    stiffness_high_nm_per_rad: float | None
    half_width: float
    """Half-width of the interval of the compliance 1/K, relative to its estimate."""
    reason: str
    """Why the poses do not tell the stiffness apart; empty where they do."""
    friction_nm: float | None
    """Friction on the link side of the spring; None where the log has no sides of approach."""
    friction_half_width_nm: float | None
    offset_rad: float
    """What the motor encoder reads beyond θ."""
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
    payload_half_width_kg: float | None
    residual_spread: float
    """Standard deviation of the residuals [m], [rad] or [N·m]."""
    friction_is_noise: bool
    """Whether the log has no sides of approach, so that friction widens the intervals."""
    outlying_poses: tuple[int, ...]
    """Poses of the log, counted from 1, whose residual is far beyond the others'."""

    def stiffness(self) -> dict[str, dict[str, float]]:
        """A mapping as `PositionCompensator` and the environments take it."""
        return {joint.joint: {"stiffness": joint.stiffness_nm_per_rad} for joint in self.joints}

    def save(self, folder: Path) -> list[Path]:
        """Write `identification.json` and `joints.yaml`."""
        files = [folder / "identification.json", folder / "joints.yaml"]
        files[0].write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")
        lines = [_yaml_line(joint) for joint in self.joints]
        files[1].write_text("\n".join(["# stiffness [N·m/rad], by elastic identify", *lines]) + "\n", encoding="utf-8")
        return files


def described(fit: ArmFit, within: float, assumed: float | None, planned: Array | None = None) -> ArmIdentification:
    """The result of a fit.

    Args:
        fit: The fit.
        within: Largest half-width of 1/K, relative, of a joint that counts as told apart.
        assumed: K of joints of which the interval of 1/K holds zero; None for the largest K that was identified.
        planned: Information with the proposed poses, (p, p); None without a plan.

    Raises:
        ConfigurationError: No joint is identified and no stiffness is assumed.
    """
    compliance, half = fit.estimate("compliance")
    known = compliance > half
    if assumed is None:
        if not known.any():
            raise ConfigurationError(
                "the poses tell no stiffness: the interval of every joint reaches to rigid; log poses with larger "
                "gravity torques (--plan proposes them), or a finer measurement"
            )
        assumed = float((1.0 / compliance[known]).max())
    why, after = reasons(fit, within), None if planned is None else expected_half_width(fit, planned)
    joints = tuple(_joint(fit, i, within, assumed, why[i], after) for i in range(len(compliance)))
    payload, payload_half = fit.estimate("payload")
    return ArmIdentification(
        measurement=fit.model.log.kind, poses=len(fit.q), within=within, joints=joints,
        payload_kg=float(payload[0]) if len(payload) else None,
        payload_half_width_kg=float(payload_half[0]) if len(payload) else None,
        residual_spread=fit.spread, friction_is_noise=fit.model.log.direction is None,
        outlying_poses=tuple(int(pose) + 1 for pose in fit.outliers),
    )  # fmt: skip


def expected_half_width(fit: ArmFit, information: Array) -> Array:
    """Half-widths of the intervals of 1/K, relative, that an information promises, (k,)."""
    own = fit.model.unknowns.slices["compliance"]
    deviation = np.sqrt(np.diag(np.linalg.inv(information))[own]) * fit.model.scale[own]
    return fit.quantile * deviation / np.maximum(np.abs(fit.unknowns[own]), 1e-12)


def reasons(fit: ArmFit, within: float) -> list[str]:
    """Why the poses do not tell each stiffness apart; empty text where they do, (k,)."""
    compliance, half = fit.estimate("compliance")
    unloaded, unseen, alike = _unloaded(fit), _unseen(fit), _alike(fit)
    names = [fit.model.log.joints[at] for at in fit.model.unknowns.elastic]

    def reason(i: int) -> str:
        if half[i] <= within * compliance[i]:
            return ""
        if unloaded[i]:
            return "gravity does not load it in these poses"
        if unseen[i]:
            return "the measurement does not show its angle"
        others = [names[j] for j in np.flatnonzero(alike[i] & ~unloaded)]
        if others:
            return f"these poses do not separate it from {', '.join(others)}"
        return f"its interval is wider than ±{100.0 * within:.3g} %: its deflections are small beside the noise"

    return [reason(i) for i in range(len(names))]


def _unloaded(fit: ArmFit) -> BoolArray:
    """Which elastic joints carry no torque, (k,)."""
    return fit.model.load < SMALLEST_LOAD * np.abs(fit.model.arm.torque(fit.q)).max()


def _unseen(fit: ArmFit) -> BoolArray:
    """Which elastic joints do not move the measurement, (k,)."""
    _, gradient = fit.model.predicted(fit.unknowns)
    moved = np.abs(gradient[..., fit.model.unknowns.slices["offset"]]).max(axis=(0, 1))
    return moved < _SHOWN * moved.max()


def _alike(fit: ArmFit) -> BoolArray:
    """Which pairs of compliances have estimates that hardly differ in what they explain, (k, k)."""
    own = fit.model.unknowns.slices["compliance"]
    spread = np.linalg.inv(fit.information)[own, own]
    correlation = spread / np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    return (np.abs(correlation) > _ALIKE) & ~np.eye(len(spread), dtype=bool)


def _joint(fit: ArmFit, i: int, within: float, assumed: float, why: str, planned: Array | None) -> JointStiffness:
    (compliance, half), (offset, offset_half) = fit.estimate("compliance"), fit.estimate("offset")
    friction, friction_half = fit.estimate("friction")
    is_known, c, h = compliance[i] > half[i], float(compliance[i]), float(half[i])
    source: Source = "assumed" if not is_known else "told apart" if h <= within * c else "wide interval"
    return JointStiffness(
        joint=fit.model.log.joints[fit.model.unknowns.elastic[i]],
        stiffness_nm_per_rad=1.0 / c if is_known else assumed, source=source,
        stiffness_low_nm_per_rad=1.0 / (c + h) if c + h > 0.0 else None,
        stiffness_high_nm_per_rad=1.0 / (c - h) if is_known else None,
        half_width=h / max(abs(c), 1e-12), reason=why,
        friction_nm=float(friction[i]) if len(friction) else None,
        friction_half_width_nm=float(friction_half[i]) if len(friction) else None,
        offset_rad=float(offset[i]), offset_half_width_rad=float(offset_half[i]),
        largest_torque_nm=float(fit.model.load[i]),
        planned_half_width=None if planned is None else float(planned[i]),
    )  # fmt: skip


def _yaml_line(joint: JointStiffness) -> str:
    """A joint of `joints.yaml`, with where its stiffness comes from."""
    says = {
        "told apart": f"± {100 * joint.half_width:.2g} %",
        "wide interval": f"± {100 * joint.half_width:.2g} %: {joint.reason}",
        "assumed": f"assumed, not identified: {joint.reason}",
    }[joint.source]
    name = joint.joint if joint.joint.replace("_", "").isalnum() else f'"{joint.joint}"'
    return f"{name}: {{stiffness: {joint.stiffness_nm_per_rad:.6g}}}  # {says}"
