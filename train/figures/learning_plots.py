"""How a policy that learns on the robot gets better from trial to trial."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.adaptation.iterative import Trial
from train.evaluate.conditions import Condition
from train.evaluate.environments import Column
from train.figures.plots import require_matplotlib, save


def draw_trials(trials: Sequence[Trial], columns: Sequence[Column], condition: Condition, path: Path) -> Path:
    """The judged metrics over the trials, a thin line per robot and their mean; a failed trial leaves a gap.

    Args:
        trials: In order, the first without offsets.
        columns: Metrics, a panel for each.
        condition: Where it was learned.
        path: File to write.
    """
    plt = require_matplotlib()
    figure, axes = plt.subplots(len(columns), 1, figsize=(7.0, 2.6 * len(columns)), sharex=True, squeeze=False)
    numbers = [trial.number for trial in trials]
    for axis, column in zip(axes[:, 0], columns, strict=True):
        values = column.scale * np.array([_values(trial, column.metric) for trial in trials])
        axis.plot(numbers, values, color="#8fbbd9", lw=0.9)
        counts = np.isfinite(values).sum(axis=1)
        means = np.where(counts > 0, np.nansum(values, axis=1) / np.maximum(counts, 1), np.nan)
        axis.plot(numbers, means, color="#2a6f97", lw=2.0, marker="o", ms=4)
        axis.set_ylabel(column.label)
        axis.set_ylim(bottom=0.0)
    axes[0, 0].set_title(f"Learned on the robot, {condition.scenario}")
    axes[-1, 0].set_xlabel("trials learned from")
    axes[-1, 0].set_xticks(numbers if len(numbers) <= 25 else numbers[:: len(numbers) // 10])
    return save(figure, path)


def _values(trial: Trial, metric: str) -> list[Any]:
    """A metric of every robot, nan where it failed."""
    pairs = zip(trial.metrics, trial.failed, strict=True)
    return [np.nan if failed else metrics[metric] for metrics, failed in pairs]
