"""Figures of identifications, one for each kind: testbed, arm, geometry and servo."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compensation.gravity_torque import make_gravity
from baselines.identification.arm_fit import ArmFit
from baselines.identification.arm_result import ArmIdentification
from baselines.identification.geometry_result import GeometryIdentification
from baselines.identification.holdout import HeldOut
from baselines.identification.identify import Identification
from baselines.identification.pose_log import MEASUREMENT_UNITS
from baselines.identification.servo_log import ServoLog
from baselines.identification.static_points import StaticPoints, link_torque
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import RobotModel
from train.figures.plots import MRAD, label_text, new_figure, save, show_numbers

_FIT_COLOUR = "#2a6f97"
_RIVAL_COLOUR = "#9aa5b1"
_LINE_COLOUR = "#888888"
_LOG_COLOUR = "#222222"
_REPLAY_COLOUR = "#d1495b"
_JOINTS_PER_ROW = 4
_LOGS_PER_ROW = 3
_MOST_LOGS = 12
_SMALLEST_LEVER = 0.1  # of the joint's largest; its panel leaves out other poses
_SMALLEST_JOINT_LEVER = 0.01  # of the largest of all joints
_MOST_NAMED_COLUMNS = 3  # of a measurement, in a legend
_SMALLEST_HEIGHT = 3.4
_ROW_HEIGHT = 0.24


def draw_identification(
    result: Identification,
    points: StaticPoints,
    models: Sequence[RobotModel],
    path: Path,
) -> Path:
    """Draw deflection over gravity torque with the fitted lines, as Fig. 5 of the paper."""
    gravities = [make_gravity(model) for model in models]
    torque = link_torque(points, gravities, result.link_angles(points))
    deflection = points.theta - points.q
    figure, (top, bottom) = new_figure(2, 1, (7.2, 6.4), sharex=True, height_ratios=(3, 1.2))
    line = np.linspace(torque.min() - 3.0, torque.max() + 3.0, 400)
    for direction, marker, face, label in (
        (1, "^", _FIT_COLOUR, "approached from below"),
        (-1, "v", "none", "approached from above"),
    ):
        chosen = points.direction == direction
        style = {"marker": marker, "facecolors": face, "edgecolors": _FIT_COLOUR}
        style |= {"s": 34, "linewidths": 1.2, "zorder": 3}
        x = torque[chosen]
        top.scatter(x, MRAD * deflection[chosen], label=label, **style)
        fitted = _fit_line(result, line, direction)
        dash = "-" if direction > 0 else "--"
        top.plot(line, MRAD * fitted, color=_FIT_COLOUR, lw=0.9, ls=dash)
        residual = deflection[chosen] - _fit_line(result, x, direction)
        if result.imu_sine_error_rad is not None:
            residual = residual + result.imu_sine_error_rad * np.sin(points.q[chosen])
        bottom.scatter(x, MRAD * residual, **style)
    slope = result.line_stiffness_nm_per_rad
    plain = line / slope + np.mean(deflection - torque / slope)
    label = f"plain line, K = {slope:.1f}"
    top.plot(line, MRAD * plain, color=_LINE_COLOUR, lw=1.0, ls=":", label=label)
    bounds = f"{result.stiffness_low_nm_per_rad:.1f} to {result.stiffness_high_nm_per_rad:.1f}"
    K = f"K = {result.stiffness_nm_per_rad:.1f} N·m/rad"
    top.set_title(f"{K}, 95 % interval {bounds}")
    texts = (
        f"friction {result.friction_nm:.2f} N·m",
        f"dead band {MRAD * result.dead_band_rad:.2f} mrad",
        f"offset {MRAD * result.offset_rad:+.2f} mrad",
        f"Pearson r {result.pearson_r:.4f}",
    )
    top.text(0.03, 0.95, "\n".join(texts), transform=top.transAxes, va="top", fontsize=9)
    top.set_ylabel("deflection θ − q [mrad]")
    top.legend(loc="lower right")
    bottom.axhline(0.0, color=_LINE_COLOUR, lw=0.8)
    bottom.set_ylabel("residual [mrad]")
    bottom.set_xlabel("gravity torque at the link angle [N·m]")
    return save(figure, path)


def _fit_line(result: Identification, torque: Array, direction: int) -> Array:
    load = torque + direction * result.friction_nm
    return (
        load / result.stiffness_nm_per_rad
        + np.sign(load) * result.dead_band_rad / 2.0
        + result.offset_rad
    )


def draw_arm_identification(fit: ArmFit, result: ArmIdentification, path: Path) -> Path:
    """Draw measured over predicted deflection of each joint, residuals, and held-out errors.

    The measured deflection is the predicted one plus the part of the residual that a deflection of
    this joint alone explains.
    """
    count = len(result.joints)
    further = 1 if result.held_out is None else 3
    rows = -(-(count + further) // _JOINTS_PER_ROW)
    figure, panels = new_figure(rows, _JOINTS_PER_ROW, (3.1 * _JOINTS_PER_ROW, 2.9 * rows))
    predicted, measured = deflections(fit)
    for number, joint in enumerate(result.joints):
        axis = panels[number]
        _draw_joint(axis, predicted[:, number], measured[:, number])
        axis.set_title(f"{joint.joint}\n{_stiffness_text(joint)}", fontsize=9)
    _draw_residuals(panels[count], fit)
    if result.held_out is not None:
        draw_errors(panels[count + 1], result.held_out)
        draw_curve(panels[count + 2], result.held_out)
    for axis in panels[count + further :]:
        axis.set_visible(False)
    figure.suptitle("measured over predicted deflection θ − q of each joint [mrad]", fontsize=10)
    return save(figure, path)


def deflections(fit: ArmFit) -> tuple[Array, Array]:
    """Predicted and measured deflections of the joints, (N, k) [rad]; nan where not measured."""
    model = fit.model
    elastic = fit.model.unknowns.elastic
    compliance, _ = fit.estimate("compliance")
    predicted = compliance * model.torque(fit.unknowns, fit.q)[:, elastic]
    # an offset turns a joint as a deflection does, so its derivative is the deflection's lever
    lever = model.predict(fit.unknowns)[1][..., model.unknowns.slices["offset"]]
    size = np.sum(lever**2, axis=1)
    largest = size.max(axis=0)
    of_all = _SMALLEST_JOINT_LEVER**2 * largest.max()
    is_measured = size > np.maximum(_SMALLEST_LEVER**2 * largest, of_all)
    projection = np.sum(lever * fit.residual[..., None], axis=1)
    measured = predicted + projection / np.where(is_measured, size, 1.0)
    return predicted, np.where(is_measured, measured, np.nan)


def _draw_joint(axis: Any, predicted: Array, measured: Array) -> None:
    if np.isnan(measured).all():
        style = {"ha": "center", "transform": axis.transAxes, "fontsize": 9}
        axis.text(0.5, 0.5, "the measurement\ndoes not show it", **style)
        return
    axis.axline((0.0, 0.0), slope=1.0, color=_LINE_COLOUR, lw=0.9)
    dots = {"s": 14, "color": _FIT_COLOUR, "alpha": 0.8, "linewidths": 0, "zorder": 3}
    axis.scatter(MRAD * predicted, MRAD * measured, **dots)


def _draw_residuals(axis: Any, fit: ArmFit) -> None:
    log = fit.model.log
    unit = MEASUREMENT_UNITS[log.kind]
    factor, shown_unit = (1.0, unit) if unit == "N·m" else (1e3, f"m{unit}")
    poses = np.arange(1, len(fit.residual) + 1)
    names = ("tilt 1", "tilt 2") if log.kind == "imu" else log.columns
    for column, name in zip(fit.residual.T, names, strict=True):
        axis.plot(poses, factor * column, ".", ms=4, label=label_text(name))
    axis.axhline(0.0, color=_LINE_COLOUR, lw=0.8)
    spread = f"spread {factor * fit.spread:.3g} {shown_unit}"
    axis.set_title(f"residual [{shown_unit}] by pose\n{spread}", fontsize=9)
    if len(names) <= _MOST_NAMED_COLUMNS:
        axis.legend(fontsize=7, ncols=3, loc="upper right", handletextpad=0.1, columnspacing=0.6)
    else:
        axis.set_xlabel("a colour per joint, in their order", fontsize=8)


def _stiffness_text(joint: Any) -> str:
    if joint.stiffness_high_nm_per_rad is None:
        return "K not identified"
    bound = f"± {100 * joint.half_width:.2g} %"
    return f"K = {joint.stiffness_nm_per_rad:.4g} N·m/rad {bound}"


def draw_geometry(result: GeometryIdentification, path: Path) -> Path:
    """Draw held-out errors and those of rivals, the error over the number of poses, and K."""
    joints = [j for j in result.joints if np.isfinite(j.stiffness_nm_per_rad)]
    panels = 1 if result.held_out is None else 3
    height = max(_SMALLEST_HEIGHT, _ROW_HEIGHT * len(joints) + 1.2)
    figure, axes = new_figure(1, panels, (4.3 * panels, height))
    if result.held_out is not None:
        draw_errors(axes[0], result.held_out)
        draw_curve(axes[1], result.held_out)
    axis = axes[-1]
    axis.set_title("K [N·m/rad] with 95 % intervals")
    for row, joint in enumerate(joints):
        low = joint.stiffness_low_nm_per_rad
        high = joint.stiffness_high_nm_per_rad
        K = joint.stiffness_nm_per_rad
        axis.plot([low or K, high or 10.0 * K], [row, row], color=_RIVAL_COLOUR, lw=2.5)
        axis.plot(K, row, "o", color=_FIT_COLOUR, ms=5)
    axis.set_yticks(range(len(joints)), [joint.joint for joint in joints], fontsize=8)
    axis.set_xscale("log")
    show_numbers(axis.xaxis, numticks=6)  # more numbers would overlap
    axis.invert_yaxis()
    return save(figure, path)


def draw_errors(axis: Any, held_out: HeldOut) -> None:
    """Draw bars of the held-out errors of all predictions."""
    names = [error.name for error in held_out.errors]
    values = [error.rms for error in held_out.errors]
    colours = [_RIVAL_COLOUR] * (len(names) - 1) + [_FIT_COLOUR]
    bars = axis.barh(names, values, color=colours)
    axis.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize=9)
    axis.set_xlim(0.0, 1.18 * max(values))
    axis.invert_yaxis()
    title = f"{held_out.held_out} held-out poses:\nrms [{held_out.unit}]"
    axis.set_title(title, fontsize=9)


def draw_curve(axis: Any, held_out: HeldOut) -> None:
    """Draw the held-out error of the identification over the number of poses."""
    poses = [point.poses for point in held_out.curve]
    axis.plot(poses, [point.rms for point in held_out.curve], "o-", color=_FIT_COLOUR)
    rigid = held_out.errors[0].rms
    axis.axhline(rigid, color=_RIVAL_COLOUR, lw=1.0, ls="--")
    axis.text(poses[0], rigid, "rigid, as given", fontsize=8, va="bottom")
    axis.set_yscale("log")
    show_numbers(axis.yaxis)
    axis.set_xlabel("poses that were fitted")
    axis.set_title(f"identified, over the number of poses:\nrms [{held_out.unit}]", fontsize=9)


def draw_servo(
    logs: Sequence[ServoLog], played: Sequence[Array], path: Path, *, is_held_out: bool
) -> Path:
    """Draw a panel per log, with the goal, the measured and the replayed angle.

    Args:
        logs: Logs; the first twelve are drawn.
        played: Replayed angles of each, (N,) [rad].
        path: PNG file.
        is_held_out: True if the replay was not fitted to them; the title names it.
    """
    pairs = list(zip(logs, played, strict=True))[:_MOST_LOGS]
    columns = min(_LOGS_PER_ROW, len(pairs))
    rows = -(-len(pairs) // columns)
    figure, axes = new_figure(rows, columns, (4.3 * columns, 2.7 * rows + 0.4))
    for axis, (log, q) in zip(axes, pairs, strict=False):
        goal = np.where(log.enabled, log.goal, np.nan)
        axis.plot(log.time, goal, "--", color=_RIVAL_COLOUR, lw=1.2, label="goal")
        axis.plot(log.time, log.position, color=_LOG_COLOUR, lw=1.6, label="measured")
        axis.plot(log.time, q, color=_REPLAY_COLOUR, lw=1.2, label="replayed")
        rms = MRAD * float(np.sqrt(np.mean((q - log.position) ** 2)))
        gain = "" if log.gain is None else f", gain {log.gain:g}"
        axis.set_title(label_text(f"{log.name}{gain}: {rms:.1f} mrad rms"), fontsize=9)
    for axis in axes[len(pairs) :]:
        axis.set_visible(False)
    axes[0].legend(fontsize=8)
    figure.supxlabel("time [s]", fontsize=10)
    figure.supylabel("angle [rad]", fontsize=10)
    if is_held_out:
        figure.suptitle("logs that were not fitted", fontsize=11)
    return save(figure, path)
