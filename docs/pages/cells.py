"""Small tables of comparisons, kept under docs/results: a row per cell and statistic, and the
metrics that pages show.

python -m docs.pages.keep RUN ...    # docs/results/NAME.csv from the episodes of each run
"""

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from elastic_env.core.errors import ConfigurationError
from elastic_env.robots.thormang.walk_signals import BLOCKS
from train.evaluate.episodes import group_by
from train.report.markdown import to_markdown
from train.report.tables import Table
from train.runs.escaping import write_csv

Rows = Sequence[Mapping[str, str]]
"""Rows of a table, a column by its name."""
_SCALES = {"_rad": 1e3, "_m": 1e3, "_s": 1e3}
_PLACE = ("policy", "reference", "scenario")
_STATISTICS: Mapping[str, Callable[[Sequence[float]], float]] = {
    "median": lambda values: float(np.median(values)),
    "mean": lambda values: float(np.mean(values)),
    "worst": max,
}


@dataclass(frozen=True)
class Kept:
    """The kept part of a comparison: metrics, and statistics over the episodes that did not
    fail.
    """

    metrics: Sequence[str]
    statistics: Sequence[str] = ("median",)
    table: str = ""
    """Name of the table; empty for that of the comparison."""
    only: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Values by column, where not all cells are kept."""


_WALK = ("pelvis_error_rms_rad", "zmp_deviation_rms_m")
_ATTITUDE = (
    "pelvis_roll_rms_rad",
    "pelvis_roll_peak_rad",
    "pelvis_pitch_rms_rad",
    "pelvis_pitch_peak_rad",
)
_ZMP = ("zmp_deviation_rms_m", "zmp_deviation_x_rms_m", "zmp_deviation_y_rms_m")
_FEET = ("early_touchdown_mean_s", "frame_error_mean_m", "com_jump_mean_m")
_ENDS = ("link_error_imu_min_rad", "link_error_imu_max_rad")

_BLOCK_METRICS = (("pelvis_error", "rad"), ("zmp_deviation", "m"))

_BLOCKS = (
    *_WALK,
    *(f"{name}_{block}_rms_{unit}" for block in BLOCKS for name, unit in _BLOCK_METRICS),
    "foot_drift_end_m",
)
_GAITS = {"walker": "3 s", "walker_1600ms": "1.6 s", "walker_1100ms": "1.1 s"}
"""Step periods of the comparisons of residuals."""

KEPT: Mapping[str, Kept] = {
    "paper": Kept((*_ATTITUDE, *_ZMP, *_FEET), ("median", "worst")),
    "walker": Kept((*_WALK, *_ATTITUDE, *_ZMP[1:], "early_touchdown_mean_s")),
    "leaderboard": Kept(
        (*_WALK, "imu_error_rms_rad"),
        ("mean",),
        "walker_imu",
        {
            "reference": ["3 s"],
            "scenario": ["nominal", "imu"],
            "policy": ["input_output", "posture", "adaptive_posture"],
        },
    ),
    "walks": Kept(_BLOCKS, ("mean",)),
    **{
        f"learned_{name}": Kept(
            _BLOCKS, ("mean",), f"walks_{name}", {"reference": [f"{gait} num_steps=20"]}
        )
        for name, gait in _GAITS.items()
    },
    "footholds": Kept((*_WALK, "end_position_error_m", "end_heading_error_rad"), ("mean",)),
    "walker_sensitivity": Kept((*_ATTITUDE[:2], _ATTITUDE[3], _ZMP[2])),
    "testbed": Kept(("link_error_rms_rad",)),
    "testbed_damping": Kept(("link_error_rms_rad", *_ENDS)),
    "testbed_rivals": Kept(("link_error_rms_rad",), ("mean",)),
    "paper_testbed": Kept(_ENDS),
}
"""Comparisons whose tables pages show, by the name of their configuration."""


def condense(episodes: Rows, kept: Kept) -> Iterator[list[object]]:
    """Head and rows of the table that is kept of the episodes of a comparison."""
    yield [*_PLACE, "statistic", "episodes", "failed", *kept.metrics]
    played = [row for row in episodes if all(row[name] in own for name, own in kept.only.items())]
    for names, own in group_by(played, lambda row: tuple(row[name] for name in _PLACE)).items():
        stood = [row for row in own if not row["termination"]]
        for statistic in kept.statistics:
            values = (
                _over([row[m] for row in stood], _STATISTICS[statistic]) for m in kept.metrics
            )
            yield [*names, statistic, len(own), len(own) - len(stood), *values]


def _over(values: Sequence[str], statistic: Callable[[Sequence[float]], float]) -> str:
    return (
        f"{statistic([float(value) for value in values]):.5g}"
        if values and "" not in values
        else ""
    )


def keep(run: Path, results: Path) -> Path:
    """Write what is kept of a comparison.

    Raises:
        ConfigurationError: The folder holds no run of a comparison of which anything is kept.
    """
    name = kept_name(run)
    kept = KEPT[name]
    head, *rows = condense(read_rows(run / "episodes.csv"), kept)
    return write_csv([str(title) for title in head], rows, results / f"{kept.table or name}.csv")


def kept_name(run: Path) -> str:
    """Name of the comparison that a folder holds.

    Raises:
        ConfigurationError: It holds none, or none of which anything is kept.
    """
    config = run / "config.yaml"
    if not config.is_file() or not (run / "episodes.csv").is_file():
        raise ConfigurationError(
            f"{run} holds no finished comparison: config.yaml and episodes.csv are expected there"
        )
    name = yaml.safe_load(config.read_text(encoding="utf-8")).get("name")
    if name not in KEPT:
        raise ConfigurationError(
            f"nothing is kept of the comparison {name!r} in {run}; choose one of: {', '.join(KEPT)}"
        )
    return name


def read_rows(table: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


class Cells:
    """A kept table, a figure by its place.

    Args:
        rows: Its rows.
    """

    def __init__(self, rows: Rows) -> None:
        self._rows = {(*(row[name] for name in _PLACE), row["statistic"]): row for row in rows}
        self.statistic = rows[0]["statistic"]

    def names(self, column: str) -> list[str]:
        """Names in a column, in their order."""
        return list(dict.fromkeys(row[column] for row in self._rows.values()))

    def row(
        self, policy: str, reference: str, scenario: str, statistic: str = ""
    ) -> Mapping[str, str]:
        """The row of a cell.

        Raises:
            ConfigurationError: There is none.
        """
        key = policy, reference, scenario, statistic or self.statistic
        if key not in self._rows:
            raise ConfigurationError(f"the results have no cell {', '.join(key)}")
        return self._rows[key]

    def has(self, policy: str, reference: str, scenario: str) -> bool:
        """True if a cell was played."""
        return (policy, reference, scenario, self.statistic) in self._rows


def in_table_unit(row: Mapping[str, str], metric: str) -> float:
    """A metric in the unit of the tables: mrad, mm, ms; nan where there is none."""
    scale = next((scale for suffix, scale in _SCALES.items() if metric.endswith(suffix)), 1.0)
    return scale * float(row[metric]) if row[metric] else math.nan


def format_metrics(row: Mapping[str, str], metrics: Iterable[str], decimals: int) -> str:
    """Metrics side by side with so many decimals, - where there is none."""
    values = (in_table_unit(row, metric) for metric in metrics)
    return " / ".join(
        "-" if math.isnan(value) else minus(f"{round(value, decimals) + 0.0:.{decimals}f}")
        for value in values
    )


def page_table(head: Iterable[str], rows: Iterable[Iterable[str]], words: int = 1) -> str:
    """A table of a page, whose first columns hold words and the others figures."""
    return to_markdown(Table.plain(head, rows, words)) + "\n"


def minus(text: str) -> str:
    """A number with a minus sign in place of a hyphen."""
    return text.replace("-", "−")


def failure_counts(row: Mapping[str, str]) -> tuple[int, int]:
    """Failed episodes, and all."""
    return int(row["failed"]), int(row["episodes"])
