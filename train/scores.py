"""A training on its way: scores against the base on episodes that it never learns from, best and last policy."""

import csv
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from baselines.residual import ResidualDescription, save_residual
from train.environments import environment
from train.evaluate import evaluate
from train.progress import PROGRESS
from train.runs import provenance
from train.train_config import TrainConfig


class Scores:
    """Evaluations and policies of a training seed.

    Args:
        config: What is trained.
        seed: Training seed.
        folder: Of the seed; `progress.csv`, `best/` and `last/` go there.
        threads: Threads of the physics, 0 for all cores.
    """

    def __init__(self, config: TrainConfig, seed: int, folder: Path, threads: int = 0) -> None:
        self._config, self._folder, self._threads = config, folder, threads
        self._provenance = provenance(seed)
        self._base_scores: dict[str, tuple[list[float], int]] = {}
        self.best = np.inf
        """Score of the best policy so far: mean ratio to the base, and what falls cost."""

    def evaluate(self, decisions: int, policy: tuple[dict[str, Any], ResidualDescription]) -> None:
        """Score a policy after some decisions, and keep it where it is the best so far."""
        current = self.keep("current", decisions, policy)
        columns = [column.metric for column in environment(self._config.env).judged]
        table, ratios = [], []
        for scenario in self._config.scenarios:
            if scenario not in self._base_scores:
                self._base_scores[scenario] = self._score(scenario, self._config.base, columns)
            mine, falls = self._score(scenario, f"residual:{current}", columns)
            base, base_falls = self._base_scores[scenario]
            table.append([decisions, scenario, *mine, *base, falls, base_falls])
            ratios.append(np.nan_to_num(np.array(mine) / base, nan=10.0).mean() + falls)
        header = ["decisions", "scenario", *columns, *(f"base_{name}" for name in columns), "failed", "base_failed"]
        _append(self._folder / PROGRESS, header, table)
        score = float(np.mean(ratios))
        if score < self.best:
            self.best = score
            self.keep("best", decisions, policy)
        shutil.rmtree(current)

    def keep(self, name: str, decisions: int, policy: tuple[dict[str, Any], ResidualDescription]) -> Path:
        """Write a policy as a folder, replacing the one of that name."""
        tensors, description = policy
        training = {"config": self._config.model_dump(mode="json"), "decisions": decisions, **self._provenance}
        fresh = self._folder / f"{name}.new"
        shutil.rmtree(fresh, ignore_errors=True)
        save_residual(fresh, description.replace(training=training), tensors)
        shutil.rmtree(self._folder / name, ignore_errors=True)
        return fresh.rename(self._folder / name)

    def forget_after(self, decisions: int) -> None:
        """Drop evaluations that were made after the checkpoint that is gone on with; they will be made again."""
        path, fresh = self._folder / PROGRESS, self._folder / f"{PROGRESS}.new"
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        kept = [line for line in lines[1:] if line.endswith("\n") and int(line.split(",")[0]) <= decisions]
        if decisions == 0 or not lines:
            path.unlink(missing_ok=True)
            return
        fresh.write_text("".join([lines[0], *kept]))
        fresh.replace(path)

    def _score(self, scenario: str, policy: str, metrics: list[str]) -> tuple[list[float], int]:
        """Means of metrics over the episodes that did not fail, and how many did."""
        result = evaluate(self._config.condition(scenario, policy), num_threads=self._threads)
        values = [result.values(metric) for metric in metrics]
        return [float(np.mean(some)) if len(some) else np.nan for some in values], result.num_failed


def _append(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if is_new:
            writer.writerow(header)
        writer.writerows(rows)
