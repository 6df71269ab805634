"""Figures of the testbed.

Angles are drawn in mrad; every function writes one file and returns its path.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from baselines.compensation.gravity_torque import make_gravity
from baselines.identification.identify import Identification, StaticPoints, link_torque
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import RobotModel
from train.evaluate.episodes import Evaluation
from train.figures.colours import policy_colours
from train.figures.plots import MRAD, Evaluations, label_text, new_figure, save

_PAPER_RANGES_MRAD = {"uncompensated": (-56.2, 41.7), "input": (-3.7, 7.1)}
"""Fig. 6 of the paper."""
_BLUE = "#2a6f97"


def draw_identification(
    result: Identification,
    points: StaticPoints,
    models: Sequence[RobotModel],
    path: Path,
) -> Path:
    """Deflection against gravity torque with the fitted lines, as Fig. 5 of the paper."""
    gravities = [make_gravity(model) for model in models]
    torque = link_torque(points, gravities, result.link_angles(points))
    deflection = points.theta - points.q
    shape = {"sharex": True, "height_ratios": (3, 1.2)}
    figure, (top, bottom) = new_figure(2, 1, (7.2, 6.4), **shape)
    line = np.linspace(torque.min() - 3.0, torque.max() + 3.0, 400)
    for direction, marker, face, label in (
        (1, "^", _BLUE, "approached from below"),
        (-1, "v", "none", "approached from above"),
    ):
        chosen = points.direction == direction
        style = {"marker": marker, "facecolors": face, "edgecolors": _BLUE}
        style |= {"s": 34, "linewidths": 1.2, "zorder": 3}
        x = torque[chosen]
        top.scatter(x, MRAD * deflection[chosen], label=label, **style)
        fitted = _fit_line(result, line, direction)
        dash = "-" if direction > 0 else "--"
        top.plot(line, MRAD * fitted, color=_BLUE, lw=0.9, ls=dash)
        residual = deflection[chosen] - _fit_line(result, x, direction)
        if result.imu_sine_error_rad is not None:
            residual = residual + result.imu_sine_error_rad * np.sin(points.q[chosen])
        bottom.scatter(x, MRAD * residual, **style)
    slope = result.line_stiffness_nm_per_rad
    plain = line / slope + np.mean(deflection - torque / slope)
    label = f"plain line, K = {slope:.1f}"
    top.plot(line, MRAD * plain, color="#888888", lw=1.0, ls=":", label=label)
    bounds = f"{result.stiffness_low_nm_per_rad:.1f} to {result.stiffness_high_nm_per_rad:.1f}"
    K = f"K = {result.stiffness_nm_per_rad:.1f} N·m/rad"
    top.set_title(f"{K}, 95 % interval {bounds}")
    found = (
        f"friction {result.friction_nm:.2f} N·m",
        f"dead band {MRAD * result.dead_band_rad:.2f} mrad",
        f"offset {MRAD * result.offset_rad:+.2f} mrad",
        f"Pearson r {result.pearson_r:.4f}",
    )
    place = {"transform": top.transAxes, "va": "top", "fontsize": 9}
    top.text(0.03, 0.95, "\n".join(found), **place)
    top.set_ylabel("deflection θ − q [mrad]")
    top.legend(loc="lower right")
    bottom.axhline(0.0, color="#888888", lw=0.8)
    bottom.set_ylabel("residual [mrad]")
    bottom.set_xlabel("gravity torque at the link angle [N·m]")
    return save(figure, path)


def draw_static_errors(evaluations: Evaluations, model: RobotModel, path: Path) -> Path:
    """Link error at the static positions, with and without compensation, as Fig. 6 of the paper."""
    figure, (axis,) = new_figure(1, 1, (7.6, 5.2))
    gravity = [make_gravity(model)]
    shades = policy_colours([e.condition.policy.title for e in evaluations])
    for index, evaluation in enumerate(evaluations):
        policy = evaluation.condition.policy.title
        points = evaluation.points
        if points is None:
            continue
        error = MRAD * static_errors(evaluation)
        shade = shades[policy]
        style = {"marker": "xosDv^"[index % 6], "linewidths": 1.3, "zorder": 3}
        open_dots = {"facecolors": "none", "edgecolors": shade}
        style |= open_dots if index else {"color": shade}
        low = error.min()
        high = error.max()
        label = f"{label_text(policy)}: {low:+.1f} to {high:+.1f} mrad{_paper(policy)}"
        torque = link_torque(points, gravity, points.q)
        axis.scatter(torque, error, s=34, label=label, **style)
        axis.axhspan(low, high, color=shade, alpha=0.08, lw=0)
        for bound in _PAPER_RANGES_MRAD.get(policy, ()):
            axis.axhline(bound, color=shade, lw=0.9, ls=":")
    axis.set_title(f"Link error at rest, scenario {evaluations[0].condition.scenario}")
    axis.set_xlabel("gravity torque at the link angle [N·m]")
    axis.set_ylabel("q_ref − q by the link's IMU [mrad]")
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.16), fontsize=9)
    return save(figure, path)


def static_errors(evaluation: Evaluation) -> Array:
    """Link error by the IMU, averaged over each window at rest, (visits,) [rad]."""
    assert evaluation.points is not None
    return evaluation.rest_references - evaluation.points.q


def _fit_line(result: Identification, torque: Array, direction: int) -> Array:
    load = torque + direction * result.friction_nm
    return (
        load / result.stiffness_nm_per_rad
        + np.sign(load) * result.dead_band_rad / 2.0
        + result.offset_rad
    )


def _paper(policy: str) -> str:
    if policy not in _PAPER_RANGES_MRAD:
        return ""
    low, high = _PAPER_RANGES_MRAD[policy]
    return f" (paper, dotted: {low:+.1f} to {high:+.1f})"
