"""Figure of an arm's identification: measured and predicted deflections, and residuals."""

from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.arm_fit import ArmFit
from baselines.identification.arm_result import ArmIdentification
from baselines.identification.pose_model import measurement_unit
from elastic_env.core.signals import Array
from train.figures.geometry_plots import draw_curve, draw_errors
from train.figures.plots import MRAD, label_text, new_figure, save

_COLUMNS = 4
_LEAST_LEVER = 0.1  # of the largest: its panel leaves out poses that show a joint less
_LEAST_SEEN = 0.01  # of the largest of all joints
_MOST_NAMED = 3  # columns of a measurement that a legend names
_DOTS = "#2a6f97"
_LINE = "#888888"


def draw_arm_identification(fit: ArmFit, result: ArmIdentification, path: Path) -> Path:
    """Measured against predicted deflection of each joint, residuals, and held-out errors.

    Measured is the predicted deflection and the part of the residual that a deflection of this
    joint alone explains.
    """
    count = len(result.joints)
    further = 1 if result.held_out is None else 3
    rows = -(-(count + further) // _COLUMNS)
    figure, panels = new_figure(rows, _COLUMNS, (3.1 * _COLUMNS, 2.9 * rows))
    predicted, measured = deflections(fit)
    for number, joint in enumerate(result.joints):
        axis = panels[number]
        _draw_joint(axis, predicted[:, number], measured[:, number])
        axis.set_title(f"{joint.joint}\n{_stiffness(joint)}", fontsize=9)
    _draw_residuals(panels[count], fit)
    if result.held_out is not None:
        draw_errors(panels[count + 1], result.held_out)
        draw_curve(panels[count + 2], result.held_out)
    for axis in panels[count + further :]:
        axis.set_visible(False)
    figure.suptitle("measured over predicted deflection θ − q of each joint [mrad]", fontsize=10)
    return save(figure, path)


def deflections(fit: ArmFit) -> tuple[Array, Array]:
    """Deflections of the joints, predicted and measured, (N, k) [rad]; nan where not seen."""
    model = fit.model
    elastic = fit.model.unknowns.elastic
    compliance, _ = fit.estimate("compliance")
    predicted = compliance * model.torque(fit.unknowns, fit.q)[:, elastic]
    # an offset turns a joint as a deflection does, so that its derivative is the lever of the
    # deflection
    lever = model.predict(fit.unknowns)[1][..., model.unknowns.slices["offset"]]
    size = np.sum(lever**2, axis=1)
    largest = size.max(axis=0)
    seen = size > np.maximum(_LEAST_LEVER**2 * largest, _LEAST_SEEN**2 * largest.max())
    along = np.sum(lever * fit.residual[..., None], axis=1)
    measured = predicted + along / np.where(seen, size, 1.0)
    return predicted, np.where(seen, measured, np.nan)


def _draw_joint(axis: Any, predicted: Array, measured: Array) -> None:
    if np.isnan(measured).all():
        where = {"ha": "center", "transform": axis.transAxes, "fontsize": 9}
        axis.text(0.5, 0.5, "the measurement\ndoes not show it", **where)
        return
    axis.axline((0.0, 0.0), slope=1.0, color=_LINE, lw=0.9)
    dots = {"s": 14, "color": _DOTS, "alpha": 0.8, "linewidths": 0, "zorder": 3}
    axis.scatter(MRAD * predicted, MRAD * measured, **dots)


def _draw_residuals(axis: Any, fit: ArmFit) -> None:
    unit = measurement_unit(fit.model.log.kind)
    factor, shown = (1.0, unit) if unit == "N·m" else (1e3, f"m{unit}")
    poses = np.arange(1, len(fit.residual) + 1)
    for column, name in zip(fit.residual.T, _names(fit), strict=True):
        axis.plot(poses, factor * column, ".", ms=4, label=label_text(name))
    axis.axhline(0.0, color=_LINE, lw=0.8)
    spread = f"spread {factor * fit.spread:.3g} {shown}"
    axis.set_title(f"residual [{shown}] by pose\n{spread}", fontsize=9)
    if len(_names(fit)) <= _MOST_NAMED:
        close = {"handletextpad": 0.1, "columnspacing": 0.6}
        axis.legend(fontsize=7, ncols=3, loc="upper right", **close)
    else:
        axis.set_xlabel("a colour per joint, in their order", fontsize=8)


def _names(fit: ArmFit) -> tuple[str, ...]:
    log = fit.model.log
    return ("tilt 1", "tilt 2") if log.kind == "imu" else log.columns


def _stiffness(joint: Any) -> str:
    if joint.stiffness_high_nm_per_rad is None:
        return "not told apart"
    bound = f"± {100 * joint.half_width:.2g} %"
    return f"K = {joint.stiffness_nm_per_rad:.4g} N·m/rad {bound}"
