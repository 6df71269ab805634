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
    joints = group_by(rows, lambda row: row["joint"])
    head = ["", *(f"{poses} poses, {log}" for poses, log in kinds)]
    counted = [[f"`{joint}`", *(_count(row) for row in own)] for joint, own in joints.items()]
    arm = [own[0] for own in kinds.values()]
    errors = [
        ["**error before [mm]**", *(f"{1e3 * float(row['before_median_m']):.1f}" for row in arm)],
        [
            "**error after [mm], median, largest**",
            *(_two(row, "after_median_m", "after_most_m") for row in arm),
        ],
    ]
    return page_table(head, [*counted, *errors])


def _count(row: Mapping[str, str]) -> str:
    half_width = 100.0 * float(row["half_width_median"])
    wide = f"± {half_width:.2g} %" if half_width < 100.0 else "no upper end"
    holds, within, told = (round(float(row[name])) for name in ("holds", "within", "told_apart"))
    return f"{holds}; {f'{within} of {told}' if told else '–'}; {wide}"


def _two(row: Mapping[str, str], *names: str) -> str:
    return ", ".join(f"{1e3 * float(row[name]):.2f}" for name in names)
