"""Table and remarks of `elastic identify --robot`."""

from collections.abc import Iterator, Sequence

from rich import box
from rich.table import Table

from baselines.identification.arm_fit import LARGE_RESIDUAL_RATIO, USUAL_NOISE, noise_text
from baselines.identification.arm_result import NEGATIVE, ArmIdentification, JointStiffness, Source
from train.commands.held_out import number_or_dash
from train.runs.console import make_table


def result_table(result: ArmIdentification) -> Table:
    """An identification as a table."""
    joints = result.joints
    intervals = [_interval(joint) for joint in joints]
    stiffness = [number_or_dash(joint.stiffness_nm_per_rad) for joint in joints]
    pairs = zip(stiffness, intervals, strict=True)
    columns: dict[str, Sequence[str]] = {
        "joint": [joint.joint for joint in joints],
        "K": [interval if interval == "–" else K for K, interval in pairs],
        "95 % interval": intervals,
        "±": [percent(joint.half_width) for joint in joints],
    }
    if joints[0].planned_half_width is not None:
        columns["planned ±"] = [percent(joint.planned_half_width) for joint in joints]
    if not result.friction_is_noise:
        columns["F [N·m]"] = [number_or_dash(j.friction_nm, ".2f") for j in joints]
    columns["o [mrad]"] = [number_or_dash(j.offset_rad, ".2f", 1e3) for j in joints]
    measurement = result.measurement.replace("_", " ")
    title = f"K [N·m/rad] from {result.poses} poses, by {measurement}"
    rows = zip(*columns.values(), strict=True)
    table = make_table(title, list(columns), rows, box=box.SIMPLE, padding=(0, 1, 0, 0))
    for column in table.columns:
        column.no_wrap = True
    return table


def remarks(result: ArmIdentification) -> Iterator[str]:
    """Remarks below the table: payload, joints with wide intervals, poses that do not fit."""
    joints = result.joints
    half_width_kg = result.payload_half_width_kg
    if half_width_kg is not None and result.payload_kg is None:
        width = f"± {half_width_kg:.3g} kg"
        yield f"the poses do not tell the payload: its interval is {width} wide"
    elif half_width_kg is not None:
        yield f"payload {result.payload_kg:.3f} ± {half_width_kg:.3f} kg"
    for reason in dict.fromkeys(joint.reason for joint in joints if joint.reason):
        names = ", ".join(joint.joint for joint in joints if joint.reason == reason)
        yield f"not told apart to {100 * result.within:g} %: {names}; {reason}"
    if negative := [joint.joint for joint in joints if joint.is_negative]:
        yield f"{', '.join(negative)}: {NEGATIVE}"
    for source, text in _SOURCE_REMARKS.items():
        names = ", ".join(
            joint.joint
            if source == "rigid"
            else f"{joint.joint} {joint.stiffness_nm_per_rad:.4g} N·m/rad"
            for joint in joints
            if joint.source == source
        )
        if names:
            yield text.format(names)
    usual = USUAL_NOISE[result.measurement]
    if result.residual_spread > LARGE_RESIDUAL_RATIO * usual:
        yield (
            "the residuals are far beyond the usual noise of"
            f" {noise_text(usual, result.measurement)}: look for other elastic joints, another"
            " frame (--frame) or body (--end-effector), friction, and errors of the model"
        )
    if result.outlying_poses:
        poses = ", ".join(map(str, result.outlying_poses))
        yield f"poses that do not fit the others: {poses}; check them"
    if result.held_joints:
        held = ", ".join(result.held_joints)
        yield f"not in the log, and taken as held where the model has them: {held}"
    uncertain = [joint for joint in joints if joint.reason]
    if uncertain and joints[0].planned_half_width is None:
        yield "--plan 20 proposes poses that tell more"
    unimproved = [j.joint for j in uncertain if (j.planned_half_width or 0.0) > 1.0]
    if unimproved:
        yield (
            f"no proposed pose tells {', '.join(unimproved)}: gravity must load the joint, and the"
            " measurement must show it; tilt the base, hang on a weight, or measure it by hand"
        )


_SOURCE_REMARKS: dict[Source, str] = {
    "no upper end": (
        "joints.yaml has the estimate, {}, although the interval reaches to rigid; --assume"
        " changes it"
    ),
    "rigid": "joints.yaml has {} as rigid (.inf); --assume changes it",
    "assumed": "joints.yaml has the assumed K for {}",
}
"""Remarks on joints whose interval reaches to rigid."""


def _interval(joint: JointStiffness) -> str:
    low = number_or_dash(joint.stiffness_low_nm_per_rad)
    high = number_or_dash(joint.stiffness_high_nm_per_rad)
    return "–" if "–" in (low, high) else f"{low} to {high}"


def percent(half: float | None) -> str:
    """A relative half-width as text; above 100 % where there is none."""
    return "> 100 %" if half is None or half > 1.0 else f"{100 * half:.2g} %"
