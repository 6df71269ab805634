"""Paired changes as tables: a line per cell for the terminal, every figure for the report, and
as CSV.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from train.evaluate.changes import (
    BEST_ANALYTIC,
    CEILING,
    HELD_OUT,
    PARTLY,
    SAME_ROBOT,
    SIGNS_ARE,
    Change,
    by_line,
    percent_interval,
    signed_interval,
)
from train.evaluate.maps import HeatMap
from train.report.render import Head, Part, Row, Table, print_table, write_table

_SIGNS = {HELD_OUT: "°", PARTLY: "(°)", CEILING: "†", SAME_ROBOT: "‡"}
"""Signs of marks, where there is little room."""


def print_changes(rows: Sequence[Change], console: Console) -> None:
    """Print the changes of the residuals, a line per cell; first against bases, then against
    rivals.
    """
    for is_rival in (False, True):
        shown = [
            row for row in rows if row.is_family and row.is_judged and row.is_rival == is_rival
        ]
        if shown:
            print_table(cells_table(shown), console, "statistics.csv")


def cells_table(rows: Sequence[Change]) -> Table:
    """Changes of residuals against their bases, or against their rivals, a line per cell with all
    metrics.

    Args:
        rows: Changes of families, of one environment, all against bases or all against rivals.
    """
    columns = list(dict.fromkeys(row.column for row in rows))
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    policies = list(dict.fromkeys(row.policy for row in rows))
    marks = {mark for row in rows for mark in row.marks}
    signs = [
        f"{sign} {words}"
        for words, sign in _SIGNS.items()
        if any(mark.startswith(words) for mark in marks)
    ]
    names = (
        ["reference", "scenario"] if len(policies) == 1 else ["residual", "reference", "scenario"]
    )
    heads = [Head(name, is_number=False, wraps=True, titles=name == "reference") for name in names]
    heads += [Head(name.replace("_", " ")) for name in swept]
    heads += [Head(column.title, leaves=1) for column in columns]
    heads += [Head(f"{rows[0].failure} ({'other' if rows[0].is_rival else 'base'})")]
    lines = []
    for line in by_line(rows):
        first = line[0]
        scope = first.scope + _signs(first)
        own = (
            [first.reference, scope]
            if len(policies) == 1
            else [first.policy, first.reference, scope]
        )
        figures = {row.column: signed_interval(row.relative, row.verdict) for row in line}
        cells = [
            *own,
            *_swept(first, swept),
            *(figures[column] for column in columns),
            failed_and_base(first),
        ]
        lines.append(Row(tuple(cells), kind="group" if first.is_group else ""))
    title = f"change against {_opponent(rows)} on the same episodes, {_seeds(rows)}"
    return Table(
        tuple(heads),
        tuple(lines),
        keys=len(names),
        title=title,
        subjects=tuple(policies) if len(policies) == 1 else (),
        caption=". ".join([*signs, SIGNS_ARE]),
    )


def changes_table(rows: Sequence[Change], colours: Mapping[str, str]) -> Table:
    """All figures of paired changes, a row per cell and metric, under a heading per policy and
    base.

    Args:
        rows: Changes of residuals, or of policies without training seeds.
        colours: Colour of every policy.
    """
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    is_family = rows[0].is_family
    heads = [Head(name, is_number=False) for name in ("reference", "scenario")]
    heads += [Head(name.replace("_", " ")) for name in swept]
    heads += [Head("metric", is_number=False)]
    heads += [
        Head(name)
        for name in ("base → policy", "change", "better than base", f"{rows[0].failure} (base)")
    ]
    heads += [Head("what it shows", is_number=False)] * is_family
    lines = []
    previous = ("", "")
    for row in (row for line in by_line(rows) for row in line):
        if (row.policy, row.base) != previous:
            previous = (row.policy, row.base)
            seeds = (
                f", {row.num_seeds} training seed{'s' * (row.num_seeds != 1)}" if is_family else ""
            )
            heading = f"{row.policy} against {row.base}{seeds}"
            lines.append(Row((heading,), kind="heading", dot=colours[row.policy]))
        failed = Part(failed_and_base(row), "failure" if row.falls_more else "")
        cells = [row.reference, _scope(row), *_swept(row, swept), row.column.title, _means(row)]
        cells += [
            (Part(percent_interval(row.relative), row.verdict),),
            percent_interval(row.improvement, signed=False),
        ]
        cells += [(failed,), *([row.sentence] if is_family else [])]
        lines.append(Row(tuple(cells), kind="group" if row.is_group else ""))
    return Table(tuple(heads), tuple(lines), keys=3 + len(swept), kind="changes")


def _scope(row: Change) -> tuple[Part, ...]:
    """Scenario or group, with its marks."""
    pooled = [Part("pooled", "pooled", before=" ")] if row.is_group else []
    marks = (
        Part(mark, "ceiling" if mark == CEILING else "badge", before=" ") for mark in row.marks
    )
    return (Part(row.scope), *pooled, *marks)


def _swept(row: Change, names: Sequence[str]) -> list[str]:
    return [f"{row.swept[name]:g}" if name in row.swept else "-" for name in names]


def _means(row: Change) -> str:
    """Means of base and policy in the unit in which they are shown; - where there is nothing to
    compare.
    """
    if not np.isfinite(row.mine):
        return "-"
    before, after = (
        f"{row.column.scale * value:.{row.column.decimals}f}" for value in (row.theirs, row.mine)
    )
    return f"{before} → {after} {row.column.unit}"


def _seeds(rows: Sequence[Change]) -> str:
    seeds = sorted({row.num_seeds for row in rows})
    if seeds == [1]:
        return "one training seed, no interval"
    return f"interquartile mean and 95 % interval over {'/'.join(map(str, seeds))} training seeds"


def _opponent(rows: Sequence[Change]) -> str:
    """The policy that a table compares residuals with."""
    if not rows[0].is_rival:
        return "the base"
    return f"{', '.join(dict.fromkeys(row.base for row in rows))} ({BEST_ANALYTIC})"


def _signs(row: Change) -> str:
    """Marks of a row as signs, where there is little room."""
    found = [
        sign for words, sign in _SIGNS.items() if any(mark.startswith(words) for mark in row.marks)
    ]
    return f" {''.join(found)}" if found else ""


def failed_and_base(row: Change) -> str:
    """Failed episodes of all, and the base's in brackets; an exclamation mark where there are
    more.
    """
    return (
        f"{'! ' if row.falls_more else ''}{row.falls}/{row.episodes}"
        f" ({row.base_falls}/{row.base_episodes})"
    )


_HEAD = ("policy", "base", "base_is", "kind", "reference", "scope", "pooled", "marks")
_FIGURES = (
    "metric",
    "base_mean",
    "mean",
    "change",
    "change_low",
    "change_high",
    "improvement",
    "improvement_low",
    "improvement_high",
    "training_seeds",
    "pairs",
    "failed",
    "episodes",
    "base_failed",
    "base_episodes",
    "change_per_training_seed",
    "sentence",
)
_MAP_HEAD = (
    "map",
    "x_is",
    "x",
    "y_is",
    "y",
    "metric",
    "policy",
    "mean",
    "mean_low",
    "mean_high",
    "failed",
    "episodes",
    "is_best",
    "is_best_without_learning",
    "best_without_learning",
    "change",
    "change_low",
    "change_high",
    "verdict",
)


def write_statistics(rows: Sequence[Change], path: Path) -> Path:
    """One row per change; metrics in SI units, changes and probabilities as shares of one."""
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    return write_table([*_HEAD, *swept, *_FIGURES], (_record(row, swept) for row in rows), path)


def _record(row: Change, swept: Sequence[str]) -> list[object]:
    role = (
        BEST_ANALYTIC
        if row.is_rival
        else "base of the residual"
        if row.is_family
        else "policy to compare with"
    )
    kind = "residual" if row.is_family else "baseline"
    found = [
        row.policy,
        row.base,
        role,
        kind,
        row.reference,
        row.scope,
        row.is_group,
        "; ".join(row.marks),
    ]
    found += [row.swept.get(name, "") for name in swept]
    found += [row.column.metric, row.theirs, row.mine, *row.relative.cells, *row.improvement.cells]
    found += [
        row.num_seeds,
        row.num_pairs,
        row.falls,
        row.episodes,
        row.base_falls,
        row.base_episodes,
    ]
    return [*found, " ".join(f"{value:.6g}" for value in row.per_seed), row.sentence]


def write_maps(maps: Sequence[HeatMap], path: Path) -> Path:
    """One row per cell, metric and policy; scores in SI units, changes as shares of one, axes as
    they are shown.
    """
    return write_table(_MAP_HEAD, (row for found in maps for row in _map_records(found)), path)


def _map_records(found: HeatMap) -> Iterator[list[object]]:
    for y, row in zip(found.y.ticks(found.known), found.cells, strict=True):
        for x, cell in zip(found.x.ticks(found.known), row, strict=True):
            for title, estimate in cell.levels.items():
                change = cell.learned.get(title)
                against = ("",) * 4 if change is None else (*change.relative.cells, change.verdict)
                own = [found.title, found.x.title, x, found.y.title, y, found.column.metric, title]
                marks = [title == cell.best, title == cell.best_analytic]
                yield [
                    *own,
                    *estimate.cells,
                    *cell.failed[title],
                    *marks,
                    cell.best_analytic,
                    *against,
                ]
