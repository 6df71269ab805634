"""Tables of arms: how far one sags, and what encoders on its links are worth."""

from collections.abc import Mapping

import numpy as np
from scipy.stats import bootstrap

from docs.pages.cells import Rows, minus, page_table
from elastic_env.core.signals import Array
from train.evaluate.episodes import group_by

_FIRST = "panda"
"""Robot of the gallery that README begins with."""
_POLICIES = ("input", "link_encoder")
_TOOL = "end_effector_error_rms_m"
"""Policies of an arm that are compared, and by what."""


def one_arm(gallery: Rows) -> str:
    """How far one arm of the gallery sags at rest, with and without compensation."""
    row = next(row for row in gallery if row["robot"] == _FIRST)
    shown = [
        [
            f"{1e3 * float(row[f'{kind}{policy}_rms_m']):.1f}"
            for policy in ("uncompensated", "input")
        ]
        for kind in ("", "soft_")
    ]
    head = [f"{row['title']}, sag at rest [mm]", "without compensation", "`input`"]
    lines = [["K as assumed", *shown[0]], ["K 30 % softer than assumed", *shown[1]]]
    return page_table(head, lines)


def link_encoders(episodes: Rows) -> str:
    """Error of the end effector with and without encoders on the links of an arm, episode by
    episode.
    """
    rows = []
    for scenario, own in group_by(episodes, lambda row: row["scenario"]).items():
        errors = {
            p: np.array([float(row[_TOOL]) for row in own if row["policy"] == p]) for p in _POLICIES
        }
        base, other = (errors[policy] for policy in _POLICIES)
        ends = bootstrap(
            (base, other),
            _change,
            paired=True,
            vectorized=True,
            method="BCa",
            rng=np.random.default_rng(0),
        ).confidence_interval
        change = f"{_percent(_change(base, other))} [{_percent(ends.low)}, {_percent(ends.high)}]"
        rows.append(
            [f"`{scenario}`", f"{1e3 * base.mean():.2f}", f"{1e3 * other.mean():.2f}", change]
        )
    head = ["scenario", *(f"`{policy}` [mm]" for policy in _POLICIES), "change"]
    return page_table(head, rows)


def _change(base: Array, other: Array, axis: int = -1) -> Array:
    return np.asarray(other.mean(axis=axis) / base.mean(axis=axis) - 1.0)


def _percent(value: float | Array) -> str:
    return minus(f"{100.0 * float(value):+.0f}") + " %"


def arm_identification(rows: Rows) -> str:
    """How well the stiffness of an arm is found over many logs of known truth, from
    `tests.identification_trials`.
    """
    kinds = group_by(rows, lambda row: (row["poses"], row["log"]))
    lines = [
        [f"{poses} poses", *_found(own)]
        for (poses, log), own in kinds.items()
        if log != "no friction"
    ]
    head = [
        "log",
        f"intervals that hold the true K, of {rows[0]['trials']}",
        "K within 3 %, of joints told apart",
        "tip before [mm]",
        "after: median, largest",
    ]
    return page_table(head, lines)


def _found(joints: Rows) -> list[str]:
    """Cells of a kind of log: over its joints, and of its arm."""
    holds = [round(float(row["holds"])) for row in joints]
    within, told = (
        sum(round(float(row[name])) for row in joints) for name in ("within", "told_apart")
    )
    arm = joints[0]
    return [
        f"{min(holds)} to {max(holds)}",
        f"{within} of {told}",
        f"{1e3 * float(arm['before_median_m']):.1f}",
        _two(arm, "after_median_m", "after_most_m"),
    ]


def _two(row: Mapping[str, str], *names: str) -> str:
    return ", ".join(f"{1e3 * float(row[name]):.2f}" for name in names)
