"""The evaluations on the way of a training, read without the code that trained it."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import read_bounded
from elastic_env.core.signals import Array
from train.evaluate.environments import Column

PROGRESS = "progress.csv"
MOST_BYTES = 20_000_000
"""Bytes of the table."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Learning curves of the training seeds of a residual.

    Attributes:
        decisions: Decisions at the evaluations that all of them have, (n,).
        ratios: Metric over the base's, mean over scenarios, (seeds, n), by metric; nan where all
            episodes of a scenario failed.
    """

    decisions: Array
    ratios: dict[str, Array]


def read_progress(
    folder: Path, metrics: Sequence[str] = (), further: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Evaluations on the way of a training seed, as its `progress.csv` has them.

    Args:
        folder: Of the training seed.
        metrics: Scores that are needed, of the policy and of its base.
        further: Other columns that are needed.

    Raises:
        ConfigurationError: The file is missing, is no such table, or lacks a score.
    """
    path = folder / PROGRESS
    bases = [f"base_{metric}" for metric in metrics]
    columns = ["decisions", *metrics, *bases, *further]
    try:
        text = read_bounded(path, MOST_BYTES).decode("utf-8")
        rows = [_evaluation(row, columns) for row in csv.DictReader(text.splitlines())]
    except ConfigurationError:
        raise
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise ConfigurationError(
            f"{path} must be the table of a training, with {', '.join(columns)}: {error}"
        ) from None
    if not rows:
        raise ConfigurationError(f"{path} has no evaluations")
    return rows


def _evaluation(row: Mapping[str, str], columns: Sequence[str]) -> dict[str, Any]:
    """Numbers of a row, and its scenario."""
    found: dict[str, Any] = {"scenario": row["scenario"]}
    found |= {name: float(value) for name, value in row.items() if name != "scenario"}
    for name in columns:
        if found[name] == 0.0 and name.startswith("base_"):
            raise ValueError(f"{name} is zero")
    return found


def learning_curves(folders: Sequence[str], columns: Sequence[Column]) -> Curves | None:
    """Curves of policies that lie beside a whole `progress.csv`; None where one does not.

    Args:
        folders: Folders of the policies, such as runs/NAME/seed_0/last.
        columns: Metrics that training was evaluated by.
    """
    metrics = [column.metric for column in columns]
    runs = [Path(folder).resolve().parent for folder in folders]
    try:
        tables = [read_progress(run, metrics) for run in runs]
    except ConfigurationError:
        return None
    reached = [{row["decisions"] for row in table} for table in tables]
    decisions = sorted(set.intersection(*reached))
    if not decisions:
        return None

    def ratio(table: Sequence[dict[str, Any]], at: float, metric: str) -> float:
        rows = [row for row in table if row["decisions"] == at]
        return float(np.mean([row[metric] / row[f"base_{metric}"] for row in rows]))

    ratios = {
        metric: np.array([[ratio(table, at, metric) for at in decisions] for table in tables])
        for metric in metrics
    }
    return Curves(np.array(decisions), ratios)
