"""Evaluations during a training, read from its table without the code that trained it."""

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
"""Largest size of the table."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Learning curves of the training seeds of a residual.

    Attributes:
        decisions: Decisions at the evaluations that all training seeds have, (n,).
        ratios: By metric, its ratio to the base's, mean over scenarios, (seeds, n); nan where all
            episodes of a scenario failed.
    """

    decisions: Array
    ratios: dict[str, Array]


def read_progress(
    folder: Path, metrics: Sequence[str] = (), further: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Read the evaluations of a training seed from its `progress.csv`.

    Args:
        folder: Folder of the training seed.
        metrics: Required scores, of the policy and of its base.
        further: Other required columns.

    Raises:
        ConfigurationError: The file is missing, is no such table, or lacks a column.
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
    values: dict[str, Any] = {"scenario": row["scenario"]}
    values |= {name: float(text) for name, text in row.items() if name != "scenario"}
    for name in columns:
        if values[name] == 0.0 and name.startswith("base_"):
            raise ValueError(f"{name} is zero")
    return values


def learning_curves(folders: Sequence[str], columns: Sequence[Column]) -> Curves | None:
    """Curves of policies from the `progress.csv` next to each; None if one is missing or damaged.

    Args:
        folders: Folders of the policies, such as runs/NAME/seed_0/last.
        columns: Metrics of the evaluations during training.
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
