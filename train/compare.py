"""Policies × scenarios × references × seeds under one protocol: one tidy CSV, a summary table, figures."""

import csv
import multiprocessing
import os
import queue
import re
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.managers import SyncManager
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, field_validator
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from elastic_env.config import Model, quantity
from elastic_env.errors import ConfigurationError
from train import plots
from train.evaluate import (
    Condition,
    Evaluation,
    PolicySpec,
    evaluate,
    make_policy,
    make_vector_env,
    num_steps,
)
from train.runs import run_folder

_SUMMARY = (
    ("rms", "link_error_rms_rad"),
    ("peak", "link_error_peak_rad"),
    ("IMU-", "link_error_imu_min_rad"),
    ("IMU+", "link_error_imu_max_rad"),
    ("est.", "link_estimate_error_rms_rad"),
)


class CompareConfig(Model):
    """A comparison, as read from `configs/*.yaml`."""

    name: str = Field(pattern=r"^[\w.-]*\w$")
    """Name of the result folder under runs/: letters, digits, dots, dashes."""
    env: str = "testbed"
    references: list[str | dict[str, Any]] = Field(default=["hold"], min_length=1)
    """References by name, or mappings with `kind` and parameters."""
    scenarios: list[str] = Field(default=["nominal"], min_length=1)
    policies: list[PolicySpec] = Field(
        default=[PolicySpec(name="uncompensated"), PolicySpec(name="input")], min_length=1
    )
    """Baselines by name, or mappings with name, label and options."""
    episodes: int = quantity("1", 1, ge=1, description="episodes per cell")
    seed: int = quantity("1", 0, ge=0, description="seed of the first episode")
    env_options: dict[str, Any] = {}
    """Further arguments of the environment, such as stiffness."""

    @field_validator("policies", mode="before")
    @classmethod
    def _names_are_policies(cls, value: Any) -> Any:
        return (
            [{"name": item} if isinstance(item, str) else item for item in value] if isinstance(value, list) else value
        )

    def conditions(self) -> list[Condition]:
        """All cells, in the order reference, scenario, policy."""
        return [
            Condition(
                env=self.env, policy=policy, reference=reference, label=label, scenario=scenario,
                env_options=self.env_options,
                episodes=self.episodes, seed=self.seed,
            )
            for reference, label in zip(self.references, _reference_labels(self.references), strict=True)
            for scenario in self.scenarios
            for policy in self.policies
        ]  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """A finished comparison and its files."""

    folder: Path
    evaluations: list[Evaluation]
    files: list[Path]


def compare(config: CompareConfig, console: Console, output: Path | None = None, jobs: int = 0) -> Comparison:
    """Run a comparison, write its folder, and print its table.

    Args:
        config: What to compare.
        console: Where progress and table go.
        output: Folder for the results; default runs/<name>, numbered if taken.
        jobs: Conditions to run at the same time, 0 for one per core.

    Raises:
        ConfigurationError: A name or a parameter does not exist; found before the work begins.
        ResultsExistError: The output folder holds results.
    """
    if jobs < 0:
        raise ConfigurationError(f"jobs must be >= 0, 0 for one per core, got {jobs}")
    plots.require_matplotlib()
    conditions = config.conditions()
    for condition in conditions:
        _try_out(condition)
    with run_folder(config.name, config.model_dump(mode="json"), config.seed, output) as folder:
        evaluations = run_conditions(conditions, console, jobs)
        files = [_write_csv(evaluations, folder / "episodes.csv"), _write_summary(evaluations, folder / "summary.md")]
        files += _draw(evaluations, folder)
    console.print(summary_table(evaluations))
    return Comparison(folder, evaluations, files)


def run_conditions(conditions: Sequence[Condition], console: Console, jobs: int = 0) -> list[Evaluation]:
    """Evaluate conditions in processes of their own, with one progress bar for all.

    The results do not depend on the number of processes.
    """
    jobs = min(jobs or os.cpu_count() or 1, len(conditions))
    total = sum(num_steps(condition) for condition in conditions)
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(_ignore_interrupts)
    with _progress(console) as bar, manager:
        task = bar.add_task("control steps", total=total)
        steps = manager.Queue()
        pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_ignore_interrupts)
        try:
            futures = [pool.submit(_evaluate_in_process, condition, steps) for condition in conditions]
            while not all(future.done() for future in futures):
                for advance in _drain(steps):
                    bar.advance(task, advance)
                _raise_first(futures)
            results = [future.result() for future in futures]
        except BaseException:
            _end(pool)
            raise
        pool.shutdown()
        bar.update(task, completed=total)
    return results


def summary_table(evaluations: Sequence[Evaluation]) -> Table:
    """Median over the episodes of every cell, angles in mrad, failures beside them, never averaged in."""
    table = Table(
        title=escape("link error [mrad], median over episodes"),
        caption="IMU- and IMU+: range by the link's IMU; est.: rms error of the policy's estimate of the link angle",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    for name in ("reference", "scenario", "policy"):
        table.add_column(name, no_wrap=True)
    for title, _ in _SUMMARY:
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("fail", justify="right", no_wrap=True)
    previous = None
    for evaluation in evaluations:
        cell = evaluation.condition.reference_name, evaluation.condition.scenario
        if previous is not None and cell != previous:
            table.add_section()
        shown = ("", "") if cell == previous else cell
        previous = cell
        table.add_row(*shown, evaluation.condition.policy.title, *_medians(evaluation), _failures(evaluation))
    return table


def _medians(evaluation: Evaluation) -> list[str]:
    """Medians of the summary's metrics over the episodes that did not fail [mrad], - where there are none."""
    completed = [episode for episode in evaluation.episodes if not episode["termination"]]
    cells = []
    for _, metric in _SUMMARY:
        values = [episode[metric] for episode in completed if metric in episode]
        cells.append(f"{1e3 * float(np.median(values)):.2f}" if values else "-")
    return cells


def _failures(evaluation: Evaluation) -> str:
    failed = sum(1 for episode in evaluation.episodes if episode["termination"])
    return f"{failed}/{len(evaluation.episodes)}"


def _reference_labels(references: Sequence[str | dict[str, Any]]) -> list[str | None]:
    """Names that tell references of one kind apart by their parameters; None where the kind is enough."""
    kinds = [reference if isinstance(reference, str) else str(reference.get("kind")) for reference in references]
    return [
        " ".join([kind, *(f"{k}={v}" for k, v in reference.items() if k != "kind")])
        if kinds.count(kind) > 1 and isinstance(reference, dict)
        else None
        for kind, reference in zip(kinds, references, strict=True)
    ]


def _try_out(condition: Condition) -> None:
    """Make environment and policy once, so that a wrong name fails before anything runs."""
    env = make_vector_env(condition, 1)
    policy = make_policy(condition.policy, env)
    if not hasattr(policy, "predict"):
        raise ConfigurationError(
            f"policy {condition.policy.name!r} has no method predict(), got {type(policy).__name__}"
        )


def _ignore_interrupts() -> None:
    """In a worker: Ctrl-C reaches the whole process group, but the parent decides what happens."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _raise_first(futures: Sequence[Future[Evaluation]]) -> None:
    """The error of a condition that failed, as soon as it has."""
    for future in futures:
        if future.done():
            future.result()


def _end(pool: ProcessPoolExecutor) -> None:
    """Stop at once: what is queued is dropped, what runs is ended."""
    workers = list(getattr(pool, "_processes", {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for worker in workers:
        worker.terminate()
    for worker in workers:
        worker.join()


def _evaluate_in_process(condition: Condition, steps: "queue.Queue[int]") -> Evaluation:
    return evaluate(condition, progress=steps.put, num_threads=1)


def _drain(steps: "queue.Queue[int]") -> Iterator[int]:
    """What has been put into the queue, waiting a little for the first."""
    try:
        yield steps.get(timeout=0.2)
        while True:
            yield steps.get_nowait()
    except queue.Empty:
        return


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        console=console, transient=True,
    )  # fmt: skip


def _write_csv(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """One row per episode; columns are names with units."""
    records = [episode for evaluation in evaluations for episode in evaluation.episodes]
    columns = list(dict.fromkeys(name for record in records for name in record))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(records)
    return path


def _write_summary(evaluations: Sequence[Evaluation], path: Path) -> Path:
    """The summary table as Markdown."""
    titles = [f"{metric.removesuffix('_rad').replace('_', ' ')} [mrad]" for _, metric in _SUMMARY]
    header = ["reference", "scenario", "policy", *titles, "failed"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for e in evaluations:
        cells = [e.condition.reference_name, e.condition.scenario, e.condition.policy.title, *_medians(e), _failures(e)]
        lines.append("| " + " | ".join(cells) + " |")
    path.write_text("\n".join(lines) + "\n")
    return path


def _draw(evaluations: Sequence[Evaluation], folder: Path) -> list[Path]:
    files = [plots.draw_overview(evaluations, "link_error_rms_rad", folder / "overview.png")]
    for group in _groups(evaluations):
        condition = group[0].condition
        stem = re.sub(r"[^\w.=-]+", "_", f"{condition.reference_name}_{condition.scenario}")
        files.append(plots.draw_time_series(group, folder / f"time_{stem}.png"))
        if group[0].points is not None:
            model = make_vector_env(condition, 1).unwrapped.assumed_model
            files.append(plots.draw_static_errors(group, model, folder / f"static_{stem}.png"))
    return files


def _groups(evaluations: Sequence[Evaluation]) -> list[list[Evaluation]]:
    """Evaluations of the same reference and scenario together."""
    groups: dict[tuple[str, str], list[Evaluation]] = {}
    for evaluation in evaluations:
        groups.setdefault((str(evaluation.condition.reference), evaluation.condition.scenario), []).append(evaluation)
    return list(groups.values())
