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
from train.evaluate.environments import Column
from train.evaluate.episodes import group_by
from train.evaluate.maps import best_of
from train.evaluate.standings import PairedChange, Standing
from train.evaluate.statistics import Estimate
from train.evaluate.terms import BEST_ANALYTIC, SIGNS_ARE, signed_interval
from train.report.page import TEXTS, Page
from train.report.report_text import capital
from train.report.table_formats import Head, Part, Row, Table, print_table
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
"""Columns of `leaderboard.csv` by fields of a `Standing`; of the others they have the same name."""


def board(found: Sequence[Standing]) -> Table:
    """The leaderboard: groups of scenarios, and with each motion what is in no group."""
    return _board([s for s in found if s.is_column], found)


def scenarios_board(found: Sequence[Standing]) -> Table | None:
    """The single scenarios behind the groups of the first motion; None where there are none."""
    there = [s for s in found if s.reference == found[0].reference]
    single = [s for s in there if not s.is_group and not s.is_column]
    return _board(single, []) if single else None


def _board(shown: Sequence[Standing], everything: Sequence[Standing]) -> Table:
    """A table of some standings, with the totals of all where there are any."""
    columns = list(dict.fromkeys((s.scope, s.reference) for s in shown))
    metrics = list(dict.fromkeys(s.metric for s in shown))
    rows = []
    for track in Track:
        own = [s for s in shown if s.track is track]
        if own:
            rows.append(Row((str(track),), kind="heading"))
        places = {(s.policy, s.scope, s.reference, s.metric): s for s in own}
        best = {}
        entries = group_by(own, lambda s: (s.scope, s.reference, s.metric))
        for key, some in entries.items():
            scores = {s.policy: (s.score, (s.failed, s.episodes)) for s in some}
            best[key] = best_of(scores)
        order = dict.fromkeys((s.policy for s in own), math.inf)
        for s in own:
            if (s.scope, s.reference, s.metric) == (*columns[0], metrics[0]) and s.score.is_known:
                order[s.policy] = s.score.value
        for policy in sorted(order, key=order.__getitem__):
            entries = []
            for column in columns:
                found = [places.get((policy, *column, metric)) for metric in metrics]
                entries.append(_entry([s for s in found if s is not None], best))
            is_published = any(s.is_published for s in own if s.policy == policy)
            name = f"{policy} (published)" if is_published else policy
            rows.append(Row((name, *entries, *_totals(policy, everything))))
    heads = [Head("policy", is_number=False)]
    heads += [Head(scope, second=reference, leaves=1) for scope, reference in columns]
    heads += [Head("failed"), Head("µs")] if everything else []
    title = f"leaderboard, {_meaning(shown)}"
    return Table(tuple(heads), tuple(rows), title=title, kind="board")


def _meaning(shown: Sequence[Standing]) -> str:
    """Metrics that a cell of the leaderboard holds."""
    return " / ".join(dict.fromkeys(f"{s.title} [{_column(s).unit}]" for s in shown))


def _totals(policy: str, everything: Sequence[Standing]) -> list[str]:
    """Failed episodes of all, and time per step; nothing in a table without totals."""
    own = [s for s in everything if s.policy == policy]
    if not own:
        return []
    single = [s for s in own if not s.is_group and s.metric == own[0].metric]
    step_us = own[0].step_us
    failed = f"{sum(s.failed for s in single)}/{sum(s.episodes for s in single)}"
    return [failed, "-" if math.isnan(step_us) else f"{step_us:.0f}"]


def _entry(
    found: Sequence[Standing], best: Mapping[tuple[str, str, str], str | None]
) -> tuple[Part, ...]:
    """Figures of all metrics, failures, and the intervals below."""
    if not found:
        return (Part("not played"),)
    parts = []
    intervals = []
    for s in found:
        score = s.score.times(_column(s).scale)
        look = "bold" if best[s.scope, s.reference, s.metric] == s.policy else ""
        before = " / " if parts else ""
        parts.append(Part(three_digits(score.value), look, before))
        if score.has_interval:
            low, high = map(three_digits, score.ends)
            intervals.append(Part(f"[{low}, {high}]", "small"))
    if found[0].failed:
        failed = f"✕{found[0].failed}/{found[0].episodes}"
        parts.append(Part(failed, "failure", before=" "))
    return (*parts, *intervals)


def three_digits(value: float) -> str:
    """A number with three digits: 2.48, 11.2, 123; - where there is none."""
    if not math.isfinite(value):
        return "-"
    size = abs(float(f"{value:.2e}"))
    return f"{value:.{max(0, 2 - math.floor(math.log10(size))) if size else 2}f}"


def _column(standing: Standing) -> Column:
    return Column(standing.title, standing.metric)


def claims_table(found: Sequence[Standing]) -> Table:
    """The paired changes of residuals in every column; no rows without residuals."""
    learned = [s for s in found if s.is_column and s.training_seeds]
    rows = []
    lines = group_by(learned, lambda s: (s.policy, s.scope, s.reference))
    for (policy, scope, reference), own in lines.items():
        cells = [policy, f"{scope}, {reference}"]
        for s in own:
            base = None if s.base is None else s.base.opponent
            is_same = s.rival is not None and s.rival.opponent == base
            cells += [_change(s.base), "the same" if is_same else _change(s.rival)]
        rows.append(cells)
    head = ["residual", "where"]
    for title in dict.fromkeys(s.title for s in learned):
        head += [f"{title}, against its base", f"{title}, against the {BEST_ANALYTIC}"]
    return Table.plain(head, rows, words=2)


def _change(paired: PairedChange | None) -> str:
    """A paired change: value, interval, a sign where nothing is shown, and the opponent."""
    if paired is None:
        return "-"
    return f"{signed_interval(paired.change, paired.verdict)} ({paired.opponent})"


_MOST_NAMED = 3
"""Kinds of intervals that a legend names."""


def legend(found: Sequence[Standing]) -> str:
    """Meaning of a cell, and its number of episodes."""
    meaning = _meaning([s for s in found if s.is_column])
    single = [s for s in found if not s.is_group]
    counts = sorted({s.episodes // max(s.training_seeds, 1) for s in single})
    span = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else str(counts[0])
    episodes = f"episodes of a scenario, per training seed: {span}"
    over = dict.fromkeys(s.interval_over for s in found if s.interval_over)
    within = f" over {', or '.join(over)}"
    if len(over) > _MOST_NAMED:
        within = ", and column `interval_over` of leaderboard.csv says over what"
    intervals = f" Intervals are 95 %{within}." if over else ""
    published = TEXTS["published"] if any(s.is_published for s in found) else ""
    return f"{capital(meaning)}; {episodes}. {TEXTS['leaderboard']}{intervals}{published}"


def add_leaderboard(page: Page, found: Sequence[Standing]) -> None:
    """Add the leaderboard to a page, with what learning adds and the single scenarios."""
    page.section("Leaderboard", legend(found))
    page.add("table", board(found))
    claims = claims_table(found)
    if claims.rows:
        page.add("text", TEXTS["paired"].format(signs=SIGNS_ARE), "What learning adds")
        page.add("table", claims)
    single = scenarios_board(found)
    if single is not None:
        title = f"Single scenarios, {found[0].reference}"
        page.add("table", single, title, is_folded=True)


def leaderboard_markdown(found: Sequence[Standing]) -> str:
    """The tables of the leaderboard, without a title."""
    page = Page("", "")
    add_leaderboard(page, found)
    return "\n\n".join(page.sections[0].as_markdown[1:]) + "\n"


def print_leaderboard(found: Sequence[Standing], console: Console) -> None:
    """Print the leaderboard with as many columns as the terminal has room for."""
    print_table(board(found), console, "leaderboard.md")


def write_leaderboard(found: Sequence[Standing], folder: Path) -> list[Path]:
    """Write `leaderboard.csv` and `leaderboard.md`."""
    table = write_records(list(map(_record, found)), folder / "leaderboard.csv")
    text = folder / "leaderboard.md"
    board = leaderboard_markdown(found)
    write_whole(text, f"# Leaderboard\n\n{board}")
    return [table, text]


def _record(standing: Standing) -> dict[str, str]:
    record = {}
    for name, value in vars(standing).items():
        columns = COLUMNS.get(name, (name,))
        record |= dict(zip(columns, _cells(value, len(columns)), strict=True))
    return {**record, "step_us": f"{standing.step_us:.3g}"}


def _cells(value: Any, number: int) -> list[str]:
    """A field as cells of a CSV file, empty where there is nothing."""
    if isinstance(value, PairedChange):
        return [value.opponent, *_cells(value.change, 3), value.verdict]
    if isinstance(value, Estimate):
        figures = (value.value, value.low, value.high)
        return ["" if figure is None else f"{figure:.6g}" for figure in figures]
    return [""] * number if value is None else [str(value)]


def find_published(given: Path) -> Path:
    """A leaderboard of the user's, or the one of the package that is called `leaderboard`.

    Raises:
        ConfigurationError: There is neither.
    """
    shipped = Path(str(resources.files("train") / "published" / f"{given}.csv"))
    if given.is_file():
        return given
    if not given.suffix and shipped.is_file():
        return shipped
    cure = "give a leaderboard.csv, or the name of the published one: leaderboard"
    raise ConfigurationError(f"no published leaderboard at {shorten(given)}; {cure}")


def read_leaderboard(path: Path) -> list[Standing]:
    """The rows of a `leaderboard.csv`.

    Raises:
        ConfigurationError: It is none.
    """
    with path.open(newline="", encoding="utf-8") as file:
        try:
            found = [_standing(row) for row in csv.DictReader(file)]
        except ValidationError as error:
            said = error.errors()[0]["msg"]
            raise ConfigurationError(f"{shorten(path)} is no leaderboard.csv: {said}") from None
        except (KeyError, TypeError, ValueError, csv.Error) as error:
            problem = f"{shorten(path)} is no leaderboard.csv: {error!r}"
            raise ConfigurationError(problem) from None
    if not found:
        raise ConfigurationError(f"{shorten(path)} has no rows")
    return found


def _standing(row: Mapping[str, str]) -> Standing:
    fields = {}
    for name in Standing.__dataclass_fields__:
        columns = COLUMNS.get(name, (name,))
        if name in _NEW and columns[0] not in row:
            continue  # of a leaderboard that was written before there was one
        cells = [row[column] for column in columns]
        fields[name] = _FIELDS[len(cells)](*cells)
    return _STANDING.validate_python(fields)


def _estimate(value: str, low: str, high: str) -> Estimate:
    if not low:
        return Estimate(float(value))
    return Estimate(float(value), float(low), float(high))


def _paired(to: str, value: str, low: str, high: str, verdict: str) -> PairedChange | None:
    return PairedChange(to, _estimate(value, low, high), verdict) if to else None


_NEW = ("interval_over", "origin", "is_published")
_FIELDS: Mapping[int, Callable[..., Any]] = {1: str, 3: _estimate, 5: _paired}
"""Fields from so many columns."""
_STANDING = TypeAdapter(Standing)
