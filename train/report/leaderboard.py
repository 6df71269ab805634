"""The leaderboard as tables for the report, as CSV and as Markdown."""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from rich.console import Console

from baselines.catalogue import Track
from elastic_env.core.errors import ConfigurationError, shorten
from elastic_env.core.files import write_whole
from train.evaluate.change_text import BEST_ANALYTIC, SIGNS_ARE, signed_interval
from train.evaluate.environments import Column
from train.evaluate.episodes import group_by
from train.evaluate.leaderboard_rows import PairedChange, Standing
from train.evaluate.scores import best_of
from train.evaluate.statistics import Estimate
from train.report.page import TEXTS, Page
from train.report.report_text import capital, span
from train.report.tables import Head, Part, Row, Table
from train.report.terminal import print_table
from train.runs.escaping import write_records

COLUMNS = {
    "is_group": ("pooled",),
    "is_column": ("column",),
    "is_published": ("published",),
    "score": ("mean", "low", "high"),
    "base": ("base", "change", "change_low", "change_high", "verdict"),
    "rival": (
        *("best_without_learning", "change_to_best", "change_to_best_low"),
        *("change_to_best_high", "verdict_to_best"),
    ),
}
"""Columns of `leaderboard.csv` by fields of a `Standing`; other fields have one column each."""


def leaderboard_table(standings: Sequence[Standing]) -> Table:
    """Return the leaderboard: for each motion the groups, and scenarios that are in no group."""
    return _table([s for s in standings if s.is_column], standings)


def scenarios_table(standings: Sequence[Standing]) -> Table | None:
    """Return the single scenarios in the groups of the first motion; None if there are none."""
    of_motion = [s for s in standings if s.reference == standings[0].reference]
    single = [s for s in of_motion if not s.is_group and not s.is_column]
    return _table(single, []) if single else None


def _table(shown: Sequence[Standing], all_standings: Sequence[Standing]) -> Table:
    """Return a table of the shown standings, with totals over all standings if there are any."""
    columns = list(dict.fromkeys((s.scope, s.reference) for s in shown))
    metrics = list(dict.fromkeys(s.metric for s in shown))
    rows = []
    for track in Track:
        standings = [s for s in shown if s.track is track]
        if standings:
            rows.append(Row((str(track),), kind="heading"))
        places = {(s.policy, s.scope, s.reference, s.metric): s for s in standings}
        best = {}
        cells = group_by(standings, lambda s: (s.scope, s.reference, s.metric))
        for key, rivals in cells.items():
            scores = {s.policy: (s.score, (s.failed, s.episodes)) for s in rivals}
            best[key] = best_of(scores)
        order = dict.fromkeys((s.policy for s in standings), math.inf)
        for s in standings:
            if (s.scope, s.reference, s.metric) == (*columns[0], metrics[0]) and s.score.is_known:
                order[s.policy] = s.score.value
        for policy in sorted(order, key=order.__getitem__):
            entries = []
            for column in columns:
                figures = [places.get((policy, *column, metric)) for metric in metrics]
                entries.append(_entry([s for s in figures if s is not None], best))
            is_published = any(s.is_published for s in standings if s.policy == policy)
            name = f"{policy} (published)" if is_published else policy
            rows.append(Row((name, *entries, *_totals(policy, all_standings))))
    heads = [Head("policy", is_number=False)]
    heads += [Head(scope, second=reference, leaves=1) for scope, reference in columns]
    heads += [Head("failed"), Head("µs")] if all_standings else []
    title = f"leaderboard, {_metric_labels(shown)}"
    return Table(tuple(heads), tuple(rows), title=title, kind="board")


def _metric_labels(shown: Sequence[Standing]) -> str:
    """Return the metrics of a cell of the leaderboard, with their units."""
    return " / ".join(dict.fromkeys(f"{s.title} [{_column(s).unit}]" for s in shown))


def _totals(policy: str, standings: Sequence[Standing]) -> list[str]:
    """Return failed episodes of all, and time per step; nothing for a table without totals."""
    chosen = [s for s in standings if s.policy == policy]
    if not chosen:
        return []
    single = [s for s in chosen if not s.is_group and s.metric == chosen[0].metric]
    step_us = chosen[0].step_us
    failed = f"{sum(s.failed for s in single)}/{sum(s.episodes for s in single)}"
    return [failed, "-" if math.isnan(step_us) else f"{step_us:.0f}"]


def _entry(
    standings: Sequence[Standing], best: Mapping[tuple[str, str, str], str | None]
) -> tuple[Part, ...]:
    """Return the figures of all metrics, failures, and intervals below them."""
    if not standings:
        return (Part("not played"),)
    parts = []
    intervals = []
    for s in standings:
        score = s.score.times(_column(s).scale)
        look = "bold" if best[s.scope, s.reference, s.metric] == s.policy else ""
        parts.append(Part(three_digits(score.value), look, " / " if parts else ""))
        if score.has_interval:
            low, high = map(three_digits, score.ends)
            intervals.append(Part(f"[{low}, {high}]", "small"))
    first = standings[0]
    if first.failed:
        parts.append(Part(f"✕{first.failed}/{first.episodes}", "failure", before=" "))
    return (*parts, *intervals)


def three_digits(value: float) -> str:
    """Return a number with three digits: 2.48, 11.2, 123; "-" if it is not finite."""
    if not math.isfinite(value):
        return "-"
    size = abs(float(f"{value:.2e}"))
    return f"{value:.{max(0, 2 - math.floor(math.log10(size))) if size else 2}f}"


def _column(standing: Standing) -> Column:
    return Column(standing.title, standing.metric)


def claims_table(standings: Sequence[Standing]) -> Table:
    """Return the paired changes of residuals in every column; no rows without residuals."""
    learned = [s for s in standings if s.is_column and s.training_seeds]
    rows = []
    lines = group_by(learned, lambda s: (s.policy, s.scope, s.reference))
    for (policy, scope, reference), line in lines.items():
        cells = [policy, f"{scope}, {reference}"]
        for s in line:
            base = None if s.base is None else s.base.opponent
            is_same = s.rival is not None and s.rival.opponent == base
            cells += [_change(s.base), "the same" if is_same else _change(s.rival)]
        rows.append(cells)
    head = ["residual", "where"]
    for title in dict.fromkeys(s.title for s in learned):
        head += [f"{title}, against its base", f"{title}, against the {BEST_ANALYTIC}"]
    return Table.plain(head, rows, words=2)


def _change(paired: PairedChange | None) -> str:
    """Return a paired change: value, interval, a sign for no difference, and the opponent."""
    if paired is None:
        return "-"
    return f"{signed_interval(paired.change, paired.verdict)} ({paired.opponent})"


_MAX_INTERVAL_KINDS = 3
"""Largest number of kinds of intervals that a legend names."""


def _legend(standings: Sequence[Standing]) -> str:
    """Return the meaning of a cell, and its number of episodes."""
    meaning = _metric_labels([s for s in standings if s.is_column])
    single = [s for s in standings if not s.is_group]
    counts = sorted({s.episodes // max(s.training_seeds, 1) for s in single})
    episodes = f"episodes of a scenario, per training seed: {span(counts)}"
    over = dict.fromkeys(s.interval_over for s in standings if s.interval_over)
    within = f" over {', or '.join(over)}"
    if len(over) > _MAX_INTERVAL_KINDS:
        within = ", and column `interval_over` of leaderboard.csv says over what"
    intervals = f" Intervals are 95 %{within}." if over else ""
    published = TEXTS["published"] if any(s.is_published for s in standings) else ""
    return f"{capital(meaning)}; {episodes}. {TEXTS['leaderboard']}{intervals}{published}"


def add_leaderboard(page: Page, standings: Sequence[Standing]) -> None:
    """Add the leaderboard to a page, with changes of residuals, and the single scenarios."""
    page.section("Leaderboard", _legend(standings))
    page.add("table", leaderboard_table(standings))
    claims = claims_table(standings)
    if claims.rows:
        page.add("text", TEXTS["paired"].format(signs=SIGNS_ARE), "What learning adds")
        page.add("table", claims)
    single = scenarios_table(standings)
    if single is not None:
        title = f"Single scenarios, {standings[0].reference}"
        page.add("table", single, title, is_folded=True)


def leaderboard_markdown(standings: Sequence[Standing]) -> str:
    """Return the tables of the leaderboard, without a title."""
    page = Page("", "")
    add_leaderboard(page, standings)
    return "\n\n".join(page.sections[0].as_markdown[1:]) + "\n"


def print_leaderboard(standings: Sequence[Standing], console: Console) -> None:
    """Print the columns of the leaderboard for which the terminal has room."""
    print_table(leaderboard_table(standings), console, "leaderboard.md")


def write_leaderboard(standings: Sequence[Standing], folder: Path) -> list[Path]:
    """Write `leaderboard.csv` and `leaderboard.md`."""
    table = write_records(list(map(_record, standings)), folder / "leaderboard.csv")
    text = folder / "leaderboard.md"
    write_whole(text, f"# Leaderboard\n\n{leaderboard_markdown(standings)}")
    return [table, text]


def _record(standing: Standing) -> dict[str, str]:
    """Return the row of a standing in `leaderboard.csv`."""
    record = {}
    for name, value in vars(standing).items():
        columns = COLUMNS.get(name, (name,))
        record |= dict(zip(columns, _cells(value, len(columns)), strict=True))
    return {**record, "step_us": f"{standing.step_us:.3g}"}


def _cells(value: Any, number: int) -> list[str]:
    """Return a field as cells of a CSV file; None gives empty cells."""
    if isinstance(value, PairedChange):
        return [value.opponent, *_cells(value.change, 3), value.verdict]
    if isinstance(value, Estimate):
        figures = (value.value, value.low, value.high)
        return ["" if figure is None else f"{figure:.6g}" for figure in figures]
    return [""] * number if value is None else [str(value)]


def find_published(path: Path) -> Path:
    """Return a leaderboard of the user, or the one of the package, whose name is `leaderboard`.

    Raises:
        ConfigurationError: Neither exists.
    """
    shipped = Path(str(resources.files("train") / "published" / f"{path}.csv"))
    if path.is_file():
        return path
    if not path.suffix and shipped.is_file():
        return shipped
    cure = "give a leaderboard.csv, or the name of the published one: leaderboard"
    raise ConfigurationError(f"no published leaderboard at {shorten(path)}; {cure}")


def read_leaderboard(path: Path) -> list[Standing]:
    """Read the rows of a `leaderboard.csv`.

    Raises:
        ConfigurationError: The file is no leaderboard, or has no rows.
    """
    with path.open(newline="", encoding="utf-8") as file:
        try:
            standings = [_standing(row) for row in csv.DictReader(file)]
        except ValidationError as error:
            problem = f"{shorten(path)} is no leaderboard.csv: {error.errors()[0]['msg']}"
            raise ConfigurationError(problem) from None
        except (KeyError, TypeError, ValueError, csv.Error) as error:
            problem = f"{shorten(path)} is no leaderboard.csv: {error!r}"
            raise ConfigurationError(problem) from None
    if not standings:
        raise ConfigurationError(f"{shorten(path)} has no rows")
    return standings


def _standing(row: Mapping[str, str]) -> Standing:
    """Return the standing in a row of `leaderboard.csv`."""
    fields = {}
    for name in Standing.__dataclass_fields__:
        columns = COLUMNS.get(name, (name,))
        if name in _NEW_FIELDS and columns[0] not in row:
            continue  # an older version wrote the leaderboard
        cells = [row[column] for column in columns]
        fields[name] = _PARSERS[len(cells)](*cells)
    return _STANDING.validate_python(fields)


def _parse_estimate(value: str, low: str, high: str) -> Estimate:
    if not low:
        return Estimate(float(value))
    return Estimate(float(value), float(low), float(high))


def _parse_paired(to: str, value: str, low: str, high: str, verdict: str) -> PairedChange | None:
    return PairedChange(to, _parse_estimate(value, low, high), verdict) if to else None


_NEW_FIELDS = ("interval_over", "origin", "is_published")
"""Fields that older leaderboards lack."""
_PARSERS: dict[int, Callable[..., Any]] = {1: str, 3: _parse_estimate, 5: _parse_paired}
"""Functions that make a field from its cells, by the number of cells."""
_STANDING = TypeAdapter(Standing)
