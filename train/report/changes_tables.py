"""Paired changes as a table for the terminal and as CSV."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from train.evaluate.changes import (
    BEST_ANALYTIC,
    CEILING,
    HELD_OUT,
    PARTLY,
    SAME_ROBOT,
    SIGNS_ARE,
    Change,
    by_line,
    signed_interval,
)
from train.evaluate.environments import Column
from train.evaluate.maps import HeatMap
from train.report.fitting import has_room, print_fitting
from train.runs.escaping import write_csv


def write_statistics(rows: Sequence[Change], path: Path) -> Path:
    """One row per change; metrics in SI units, changes and probabilities as shares of one."""
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    return write_csv([*_HEAD, *swept, *_FIGURES], (_record(row, swept) for row in rows), path)


def write_maps(maps: Sequence[HeatMap], path: Path) -> Path:
    """One row per cell, metric and policy; scores in SI units, changes as shares of one, axes as they are shown."""
    return write_csv(_MAP_HEAD, (row for found in maps for row in _rows_of(found)), path)


def _rows_of(found: HeatMap) -> Iterator[list[object]]:
    ticks = found.x.ticks(found.known), found.y.ticks(found.known)
    for y, row in zip(ticks[1], found.cells, strict=True):
        for x, cell in zip(ticks[0], row, strict=True):
            for title, estimate in cell.levels.items():
                change = cell.learned.get(title)
                against = ("",) * 4 if change is None else (*change.relative.cells, change.verdict)
                own = [found.title, found.x.title, x, found.y.title, y, found.column.metric, title]
                marks = [title == cell.best, title == cell.best_analytic]
                yield [*own, *estimate.cells, *cell.failed[title], *marks, cell.best_analytic, *against]


_MAP_HEAD = (
    "map", "x_is", "x", "y_is", "y", "metric", "policy", "mean", "mean_low", "mean_high", "failed", "episodes",
    "is_best", "is_best_without_learning", "best_without_learning", "change", "change_low", "change_high", "verdict",
)  # fmt: skip
_HEAD = ("policy", "base", "base_is", "kind", "reference", "scope", "pooled", "marks")
_FIGURES = (
    "metric", "base_mean", "mean", "change", "change_low", "change_high", "improvement", "improvement_low",
    "improvement_high", "training_seeds", "pairs", "failed", "episodes", "base_failed", "base_episodes",
    "change_per_training_seed", "sentence",
)  # fmt: skip


def _record(row: Change, swept: Sequence[str]) -> list[object]:
    return [
        row.policy, row.base, _role(row), "residual" if row.is_family else "baseline", row.reference, row.scope,
        row.is_group, "; ".join(row.marks), *(row.swept.get(name, "") for name in swept), row.column.metric,
        row.theirs, row.mine,
        *row.relative.cells, *row.improvement.cells, row.num_seeds, row.num_pairs, row.falls, row.episodes,
        row.base_falls, row.base_episodes, " ".join(f"{value:.6g}" for value in row.per_seed), row.sentence,
    ]  # fmt: skip


def _role(row: Change) -> str:
    """What the other policy of a row is."""
    return BEST_ANALYTIC if row.is_rival else "base of the residual" if row.is_family else "policy to compare with"


def print_changes(rows: Sequence[Change], console: Console) -> None:
    """Print the changes of the residuals, a line per cell; first against bases, then against rivals.

    Where there is little room, the title names the reference, and then the last metrics are left out.
    """
    for is_rival in (False, True):
        shown = [row for row in rows if row.is_family and row.is_judged and row.is_rival == is_rival]
        if not shown:
            continue

        def of(columns: Sequence[Column], shown: Sequence[Change] = shown) -> list[Change]:
            return [row for row in shown if row.column in columns]

        def table(columns: Sequence[Column], of: Callable[..., list[Change]] = of) -> Table:
            usual = changes_table(of(columns))
            return usual if has_room(console, usual) else changes_table(of(columns), reference_in_title=True)

        def narrow(columns: Sequence[Column], of: Callable[..., list[Change]] = of) -> Table:
            return changes_table(of(columns), breaks_words=True)

        print_fitting(
            console,
            list(dict.fromkeys(row.column for row in shown)),
            table,
            title=lambda column: column.title,
            file="statistics.csv",
            narrow=narrow,
        )


def changes_table(rows: Sequence[Change], breaks_words: bool = False, reference_in_title: bool = False) -> Table:
    """Changes of residuals against their bases, or against their rivals, a line per cell with all judged metrics.

    Args:
        rows: Changes of families, of one environment, all against bases or all against rivals.
        breaks_words: Whether names may be broken, where there is little room.
        reference_in_title: Whether the title names the reference, if there is but one.
    """
    columns = list(dict.fromkeys(row.column for row in rows))
    swept = list(dict.fromkeys(name for row in rows for name in row.swept))
    seeds = sorted({row.num_seeds for row in rows})
    over = "one training seed, no interval"
    if seeds != [1]:
        over = f"interquartile mean and 95 % interval over {'/'.join(map(str, seeds))} training seeds"
    marks = {mark for row in rows for mark in row.marks}
    signs = [f"{sign} {words}" for words, sign in _SIGNS.items() if any(mark.startswith(words) for mark in marks)]
    policies = list(dict.fromkeys(row.policy for row in rows))
    references = list(dict.fromkeys(row.reference for row in rows))
    in_title = {"residual": len(policies) == 1, "reference": reference_in_title and len(references) == 1}
    named = [name for name, is_in_title in in_title.items() if not is_in_title]
    titled = [
        text for text, is_in_title in zip((policies[0], references[0]), in_title.values(), strict=True) if is_in_title
    ]
    whose = f"{escape(', '.join(titled))}: " if titled else ""
    table = Table(
        title=f"{whose}change against {_opponent(rows)} on the same episodes, {over}",
        caption=". ".join([*signs, SIGNS_ARE]),
        box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0),
    )  # fmt: skip
    words = {
        "residual": policies,
        "reference": references,
        "scenario": [row.scope + _signs(row) for row in rows],
    }
    for name in (*named, "scenario", *swept):
        longest = max(len(word) for text in (name.replace("_", " "), *words.get(name, ())) for word in text.split())
        least = None if breaks_words else longest
        table.add_column(name.replace("_", "\n"), vertical="bottom", overflow="fold", min_width=least)
    other = "other" if rows[0].is_rival else "base"
    figures = {column.title: [_figure(row) for row in rows if row.column == column] for column in columns}
    figures[f"{rows[0].failure}\n({other})"] = [falls(row) for row in rows]
    for title, texts in figures.items():
        least = max(map(len, [*title.splitlines(), *texts]))
        table.add_column(title, justify="right", no_wrap=True, vertical="bottom", min_width=least)
    previous: tuple[str, ...] = ()
    for line in by_line(rows):
        first = line[0]
        if previous and previous[0] != first.policy:
            table.add_section()
        own = (first.policy, first.reference)
        of_names = {"residual": first.policy, "reference": first.reference}
        shown = ["" if own == previous else of_names[name] for name in named]
        previous = own
        values = {row.column: _figure(row) for row in line}
        table.add_row(
            *map(escape, shown), escape(first.scope) + _signs(first),
            *(f"{first.swept[name]:g}" if name in first.swept else "-" for name in swept),
            *(escape(values[column]) for column in columns), falls(first),
            style="bold" if first.is_group else "",
        )  # fmt: skip
    return table


def _figure(row: Change) -> str:
    return signed_interval(row.relative, row.verdict)


def _opponent(rows: Sequence[Change]) -> str:
    """Whom a table compares residuals with."""
    if not rows[0].is_rival:
        return "the base"
    return f"{escape(', '.join(dict.fromkeys(row.base for row in rows)))} ({BEST_ANALYTIC})"


_SIGNS = {HELD_OUT: "°", PARTLY: "(°)", CEILING: "†", SAME_ROBOT: "‡"}


def _signs(row: Change) -> str:
    """Marks of a row as signs, where there is little room."""
    found = [sign for words, sign in _SIGNS.items() if any(mark.startswith(words) for mark in row.marks)]
    return f" {''.join(found)}" if found else ""


def falls(row: Change) -> str:
    """Failed episodes of all, and the base's in brackets; an exclamation mark where there are more."""
    return f"{'! ' if row.falls_more else ''}{row.falls}/{row.episodes} ({row.base_falls}/{row.base_episodes})"
