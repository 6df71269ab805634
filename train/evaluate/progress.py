"""What a training says of itself on the way, read without what trained it."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from train.evaluate.environments import Column

PROGRESS = "progress.csv"


@dataclass(frozen=True, eq=False)
class Curves:
    """Learning curves of the training seeds of a residual.

    Attributes:
        decisions: Decisions at the evaluations that all of them have, (n,).
        ratios: Metric over the base's, mean over scenarios, (seeds, n), by metric; nan where all episodes of
            a scenario failed.
    """

    decisions: Array
    ratios: dict[str, Array]


def read_progress(folder: Path) -> list[dict[str, Any]]:
    """Evaluations on the way of a training seed, as its `progress.csv` has them."""
    with (folder / PROGRESS).open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{key: value if key == "scenario" else float(value) for key, value in row.items()} for row in rows]


def learning_curves(folders: Sequence[str], columns: Sequence[Column]) -> Curves | None:
    """Curves of policies that lie in their training runs, beside `progress.csv`; None where one of them does not.

    Args:
        folders: Folders of the policies, such as runs/NAME/seed_0/last.
        columns: Metrics that training was evaluated by.
    """
    runs = [Path(folder).resolve().parent for folder in folders]
    if not all((run / PROGRESS).is_file() for run in runs):
        return None
    tables = [read_progress(run) for run in runs]
    if any(column.metric not in row for table in tables for row in table for column in columns):
        return None
    decisions = sorted(set.intersection(*({row["decisions"] for row in table} for table in tables)))
    if not decisions:
        return None
    ratios = {
        column.metric: np.array([[_ratio(table, at, column.metric) for at in decisions] for table in tables])
        for column in columns
    }
    return Curves(np.array(decisions), ratios)


def _ratio(table: Sequence[dict[str, Any]], decisions: float, metric: str) -> float:
    found = [row[metric] / row[f"base_{metric}"] for row in table if row["decisions"] == decisions]
    return float(np.mean(found))
