"""Paired changes as tables: a line per cell for the terminal, all for the report, and CSV."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from train.evaluate import terms
from train.evaluate.changes import Change, group_lines
from train.evaluate.episodes import group_by
from train.evaluate.maps import HeatMap
from train.evaluate.statistics import Estimate, named_intervals
from train.evaluate.terms import percent_interval, signed_interval
from train.report.table_formats import Cell, Head, Part, Row, Table, number_interval, print_table
from train.runs.escaping import write_records

_SIGNS = {
    **{"°": terms.HELD_OUT, "(°)": terms.PARTLY},
    **{"†": terms.CEILING, "‡": terms.SAME_ROBOT},
}
"""Marks by their signs, where there is little room."""


def print_changes(rows: Sequence[Change], console: Console) -> None:
    """Print the changes, a line per cell: residuals against bases, against rivals, then others."""
    judged = [row for row in rows if row.is_judged]

    def kind(row: Change) -> tuple[bool, bool, str]:
        # residuals against each their own base share a table
        return not row.is_family, row.is_rival, "" if row.is_family else row.base

    for _, own in sorted(group_by(judged, kind).items()):
        lines = len(own) // len({row.column for row in own})
        if own[0].is_family or lines <= _MOST_LINES:
            print_table(cells_table(own), console, "statistics.csv")
        else:
            title = f"{lines} changes of policies without training against {own[0].base}"
            console.print(f"{title}: see statistics.csv and report.md")


_MOST_LINES = 40
"""Changes of policies without training that a terminal shows."""


def cells_table(rows: Sequence[Change]) -> Table:
    """Changes against one kind of opponent, a line per cell with all metrics.

    Args:
        rows: Changes of one environment: of residuals, all against bases or all against rivals, or
            of policies without training against one policy.
    """
    columns = list(dict.fromkeys(row.column for row in rows))
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    policies = tuple(dict.fromkeys(row.policy for row in rows))
    is_one = len(policies) == 1
    named = "residual" if rows[0].is_family else "policy"
    names = [*([] if is_one else [named]), "reference", "scenario"]
    words: dict[str, Any] = {"is_number": False, "wraps": True}
    heads = [Head(name, titles=name == "reference", **words) for name in names]
    heads += [Head(name.replace("_", " ")) for name in swept]
    heads += [Head(column.title, leaves=1) for column in columns]
    heads += [Head(f"{rows[0].failure} ({'other' if rows[0].is_rival else 'base'})")]
    lines = []
    for line in group_lines(rows):
        first = line[0]
        scope = " ".join(filter(None, [first.scope, "".join(_signs(first.marks))]))
        own = [*([] if is_one else [first.policy]), first.reference, scope]
        figures = [signed_interval(row.relative, row.verdict) for row in line]
        cells = [*own, *first.first.swept_values(swept), *figures]
        kind = "group" if first.is_group else ""
        lines.append(Row((*cells, failed_and_base(first)), kind))
    signs = _signs([mark for row in rows for mark in row.marks])
    return Table(
        tuple(heads),
        tuple(lines),
        keys=len(names),
        title=f"change against {_opponent(rows)} on the same episodes, {_seeds(rows)}",
        subjects=policies if is_one else (),
        caption=". ".join([*(f"{sign} {_SIGNS[sign]}" for sign in signs), terms.SIGNS_ARE]),
    )


def changes_table(rows: Sequence[Change], colours: Mapping[str, str]) -> Table:
    """All figures of paired changes, a row per cell and metric, with headings.

    Args:
        rows: Changes of residuals, or of policies without training seeds.
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
    for (policy, base), own in blocks.items():
        number = own[0].num_seeds
        seeds = f", {number} training seed{'s' * (number != 1)}" if is_family else ""
        title = f"{policy} against {base}{seeds}"
        lines.append(Row((title,), kind="heading", dot=colours[policy]))
        for row in (row for line in group_lines(own) for row in line):
            failed = Part(failed_and_base(row), "failure" if row.falls_more else "")
            cells: list[Cell] = [row.reference, _scope(row)]
            cells += [*row.first.swept_values(swept), row.column.title, _means(row)]
            cells += [(Part(percent_interval(row.relative), row.verdict),)]
            cells += [percent_interval(row.improvement, signed=False)]
            cells += [row.relative.over or "-", (failed,)]
            cells += [row.sentence] if is_family else []
            lines.append(Row(tuple(cells), kind="group" if row.is_group else ""))
    return Table(tuple(heads), tuple(lines), keys=3 + len(swept), kind="changes")


def _scope(row: Change) -> tuple[Part, ...]:
    """Scenario or group, with its marks."""
    parts = [Part(row.scope)]
    if row.is_group:
        parts.append(Part("pooled", "pooled", before=" "))
    for mark in row.marks:
        parts.append(Part(mark, "ceiling" if mark == terms.CEILING else "badge", before=" "))
    return tuple(parts)


def _means(row: Change) -> str:
    """Means of base and policy in the shown unit; - where there is nothing to compare."""
    column = row.column
    if not np.isfinite(row.mine):
        return "-"
    means = (Estimate(row.theirs), Estimate(row.mine))
    before, after = (number_interval(mean, column) for mean in means)
    return f"{before} → {after} {column.unit}"


def _seeds(rows: Sequence[Change]) -> str:
    over = named_intervals(row.relative for row in rows) or "no interval"
    if not rows[0].is_family:
        return over
    is_one = {row.num_seeds for row in rows} == {1}
    return f"{'one training seed' if is_one else 'interquartile mean with interval'}, {over}"


def _opponent(rows: Sequence[Change]) -> str:
    """The policy that a table compares others with."""
    if not rows[0].is_family:
        return rows[0].base
    if not rows[0].is_rival:
        return "the base"
    return f"{', '.join(dict.fromkeys(row.base for row in rows))} ({terms.BEST_ANALYTIC})"


def _signs(marks: Sequence[str]) -> list[str]:
    """Signs of some marks, where there is little room."""
    return [s for s, words in _SIGNS.items() if any(m.startswith(words) for m in marks)]


def failed_and_base(row: Change) -> str:
    """Failed episodes of all, the base's in brackets; an exclamation mark where there are more."""
    mark = "! " if row.falls_more else ""
    base = f"{row.base_falls}/{row.base_episodes}"
    return f"{mark}{row.falls}/{row.episodes} ({base})"


def write_statistics(rows: Sequence[Change], path: Path) -> Path:
    """One row per change; metrics in SI units, changes and probabilities as shares of one."""
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    return write_records([_record(row, swept) for row in rows], path)


def _record(row: Change, swept: Sequence[str]) -> dict[str, object]:
    of_residual = terms.BEST_ANALYTIC if row.is_rival else "base of the residual"
    return {
        "policy": row.policy,
        "base": row.base,
        "base_is": of_residual if row.is_family else "policy to compare with",
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
    """One row per cell, metric and policy; scores in SI units, changes as shares of one."""
    return write_records([row for found in maps for row in _map_records(found)], path)


_AGAINST = (*Estimate(0.0).record("change"), "verdict")
"""Columns of a map that only residuals fill."""


def _map_records(found: HeatMap) -> Iterator[dict[str, object]]:
    x_ticks, y_ticks = found.ticks
    for y, row in zip(y_ticks, found.cells, strict=True):
        for x, cell in zip(x_ticks, row, strict=True):
            for title, estimate in cell.levels.items():
                change = cell.learned.get(title)
                against: dict[str, object] = dict.fromkeys(_AGAINST, "")
                if change is not None:
                    against = change.relative.record("change")
                    against["verdict"] = change.verdict
                failed, episodes = cell.failed[title]
                yield {
                    "map": found.title,
                    "x_is": found.axes.x.title,
                    "x": x,
                    "y_is": found.axes.y.title,
                    "y": y,
                    "metric": found.column.metric,
                    "policy": title,
                    **estimate.record("mean"),
                    "interval_over": estimate.over,
                    "failed": failed,
                    "episodes": episodes,
                    "is_best": title == cell.best,
                    "is_best_without_learning": title == cell.best_analytic,
                    "best_without_learning": cell.best_analytic or "",
                    **against,
                }
