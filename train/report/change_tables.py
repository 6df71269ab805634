"""Paired changes as tables for the terminal, for the report, and as CSV."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from train.evaluate import change_text
from train.evaluate.change_text import percent_interval, signed_interval
from train.evaluate.changes import Change, group_lines
from train.evaluate.episodes import group_by
from train.evaluate.maps import HeatMap
from train.evaluate.statistics import Estimate, named_intervals
from train.report.tables import Cell, Head, Part, Row, Table, number_interval
from train.report.terminal import print_table
from train.runs.escaping import write_records

_SIGNS = {
    "°": change_text.HELD_OUT,
    "(°)": change_text.PARTLY,
    "†": change_text.CEILING,
    "‡": change_text.SAME_ROBOT,
}
"""Marks by the signs that stand for them on a terminal."""
_MAX_LINES = 40
"""Largest number of changes of policies without training on a terminal."""


def print_changes(rows: Sequence[Change], console: Console) -> None:
    """Print a line per cell: residuals against bases, residuals against rivals, then others."""
    judged = [row for row in rows if row.is_judged]

    def kind(row: Change) -> tuple[bool, bool, str]:
        # all residuals against their own bases share a table
        return not row.is_family, row.is_rival, "" if row.is_family else row.base

    for _, group in sorted(group_by(judged, kind).items()):
        lines = len(group) // len({row.column for row in group})
        if group[0].is_family or lines <= _MAX_LINES:
            print_table(cells_table(group), console, "statistics.csv")
        else:
            title = f"{lines} changes of policies without training against"
            console.print(f"{title} {group[0].base}: see statistics.csv and report.md")


def cells_table(rows: Sequence[Change]) -> Table:
    """Return a table of changes against one kind of opponent: a line per cell with all metrics.

    Args:
        rows: Changes of one environment: residuals, all against bases or all against rivals; or
            policies without training, all against one policy.
    """
    columns = list(dict.fromkeys(row.column for row in rows))
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    policies = tuple(dict.fromkeys(row.policy for row in rows))
    is_one = len(policies) == 1
    kind = "residual" if rows[0].is_family else "policy"
    names = [*([] if is_one else [kind]), "reference", "scenario"]
    heads = [Head(name, titles=name == "reference", is_number=False, wraps=True) for name in names]
    heads += [Head(name.replace("_", " ")) for name in swept]
    heads += [Head(column.title, leaves=1) for column in columns]
    heads += [Head(f"{rows[0].failure} ({'other' if rows[0].is_rival else 'base'})")]
    lines = []
    for line in group_lines(rows):
        first = line[0]
        scope = " ".join(filter(None, [first.scope, "".join(_signs(first.marks))]))
        labels = [*([] if is_one else [first.policy]), first.reference, scope]
        figures = [signed_interval(row.relative, row.verdict) for row in line]
        cells = (*labels, *first.first.swept_values(swept), *figures, _failures(first))
        lines.append(Row(cells, "group" if first.is_group else ""))
    used = _signs([mark for row in rows for mark in row.marks])
    return Table(
        tuple(heads),
        tuple(lines),
        keys=len(names),
        title=f"change against {_opponent(rows)} on the same episodes, {_statistic(rows)}",
        subjects=policies if is_one else (),
        caption=". ".join([*(f"{s} {_SIGNS[s]}" for s in used), change_text.SIGNS_ARE]),
    )


def changes_table(rows: Sequence[Change], colours: Mapping[str, str]) -> Table:
    """Return a table of all figures of paired changes: a row per cell and metric, with headings.

    Args:
        rows: Changes, either all of residuals, or all of policies without training seeds.
        colours: Colour of every policy.
    """
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    is_family = rows[0].is_family
    heads = [Head(name, is_number=False) for name in ("reference", "scenario")]
    heads += [Head(name.replace("_", " ")) for name in swept]
    heads += [Head("metric", is_number=False)]
    heads += [Head(name) for name in ("base → policy", "change", "better than base")]
    heads += [Head("95 % over"), Head(f"{rows[0].failure} (base)")]
    heads += [Head("what it shows", is_number=False)] * is_family
    lines = []
    blocks = group_by(rows, lambda row: (row.policy, row.base))
    for (policy, base), block in blocks.items():
        number = block[0].num_seeds
        seeds = f", {number} training seed{'s' * (number != 1)}" if is_family else ""
        title = f"{policy} against {base}{seeds}"
        lines.append(Row((title,), kind="heading", dot=colours[policy]))
        for row in (row for line in group_lines(block) for row in line):
            failed = Part(_failures(row), "failure" if row.falls_more else "")
            cells: list[Cell] = [row.reference, _scope(row)]
            cells += [*row.first.swept_values(swept), row.column.title, _means(row)]
            cells += [(Part(percent_interval(row.relative), row.verdict),)]
            cells += [percent_interval(row.improvement, signed=False)]
            cells += [row.relative.over or "-", (failed,), *[row.sentence] * is_family]
            lines.append(Row(tuple(cells), kind="group" if row.is_group else ""))
    return Table(tuple(heads), tuple(lines), keys=3 + len(swept), kind="changes")


def _scope(row: Change) -> tuple[Part, ...]:
    """Return scenario or group, with its marks."""
    parts = [Part(row.scope)]
    if row.is_group:
        parts.append(Part("pooled", "pooled", before=" "))
    for mark in row.marks:
        parts.append(Part(mark, "ceiling" if mark == change_text.CEILING else "badge", before=" "))
    return tuple(parts)


def _means(row: Change) -> str:
    """Return the means of base and policy in the displayed unit; "-" without a comparison."""
    column = row.column
    if not np.isfinite(row.mine):
        return "-"
    means = (Estimate(row.theirs), Estimate(row.mine))
    before, after = (number_interval(mean, column) for mean in means)
    return f"{before} → {after} {column.unit}"


def _statistic(rows: Sequence[Change]) -> str:
    """Return what the figures of a table are, and what their intervals are over."""
    over = named_intervals(row.relative for row in rows) or "no interval"
    if not rows[0].is_family:
        return over
    is_one = {row.num_seeds for row in rows} == {1}
    return f"{'one training seed' if is_one else 'interquartile mean with interval'}, {over}"


def _opponent(rows: Sequence[Change]) -> str:
    """Return the policy with which a table compares others."""
    if not rows[0].is_family:
        return rows[0].base
    if not rows[0].is_rival:
        return "the base"
    return f"{', '.join(dict.fromkeys(row.base for row in rows))} ({change_text.BEST_ANALYTIC})"


def _signs(marks: Sequence[str]) -> list[str]:
    """Return the signs that stand for some marks."""
    return [s for s, mark in _SIGNS.items() if any(m.startswith(mark) for m in marks)]


def _failures(row: Change) -> str:
    """Return failed episodes of all, the base's in brackets, with "!" if the base has fewer."""
    mark = "! " if row.falls_more else ""
    base = f"{row.base_falls}/{row.base_episodes}"
    return f"{mark}{row.falls}/{row.episodes} ({base})"


def write_statistics(rows: Sequence[Change], path: Path) -> Path:
    """Write a CSV row per change: metrics in SI units, changes and probabilities as shares."""
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    return write_records([_record(row, swept) for row in rows], path)


def _record(row: Change, swept: Sequence[str]) -> dict[str, object]:
    opponent = change_text.BEST_ANALYTIC if row.is_rival else "base of the residual"
    return {
        "policy": row.policy,
        "base": row.base,
        "base_is": opponent if row.is_family else "policy to compare with",
        "kind": "residual" if row.is_family else "baseline",
        "reference": row.reference,
        "scope": row.scope,
        "pooled": row.is_group,
        "marks": "; ".join(row.marks),
        **{name: row.swept.get(name, "") for name in swept},
        "metric": row.column.metric,
        "base_mean": row.theirs,
        "mean": row.mine,
        **row.relative.record("change"),
        **row.improvement.record("improvement"),
        "interval_over": row.relative.over,
        "training_seeds": row.num_seeds,
        "pairs": row.num_pairs,
        "failed": row.falls,
        "episodes": row.episodes,
        "base_failed": row.base_falls,
        "base_episodes": row.base_episodes,
        "change_per_training_seed": " ".join(f"{value:.6g}" for value in row.per_seed),
        "sentence": row.sentence,
    }


def write_maps(maps: Sequence[HeatMap], path: Path) -> Path:
    """Write a CSV row per cell, metric and policy: scores in SI units, changes as shares."""
    return write_records([row for grid in maps for row in _map_records(grid)], path)


_CHANGE_COLUMNS = (*Estimate(0.0).record("change"), "verdict")
"""Columns of a map that are empty for policies without training."""


def _map_records(heat_map: HeatMap) -> Iterator[dict[str, object]]:
    x_ticks, y_ticks = heat_map.ticks
    for y, row in zip(y_ticks, heat_map.cells, strict=True):
        for x, cell in zip(x_ticks, row, strict=True):
            for title, estimate in cell.levels.items():
                change = cell.learned.get(title)
                change_record: dict[str, object] = dict.fromkeys(_CHANGE_COLUMNS, "")
                if change is not None:
                    change_record = change.relative.record("change")
                    change_record["verdict"] = change.verdict
                failed, episodes = cell.failed[title]
                yield {
                    "map": heat_map.title,
                    "x_is": heat_map.axes.x.title,
                    "x": x,
                    "y_is": heat_map.axes.y.title,
                    "y": y,
                    "metric": heat_map.column.metric,
                    "policy": title,
                    **estimate.record("mean"),
                    "interval_over": estimate.over,
                    "failed": failed,
                    "episodes": episodes,
                    "is_best": title == cell.best,
                    "is_best_without_learning": title == cell.best_analytic,
                    "best_without_learning": cell.best_analytic or "",
                    **change_record,
                }
