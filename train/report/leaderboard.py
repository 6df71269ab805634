"""The leaderboard as tables for the report, as CSV and as Markdown."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from baselines.catalogue import Track
from elastic_env.core.errors import ConfigurationError, shortened
from elastic_env.core.files import write_whole
from train.evaluate.changes import BEST_ANALYTIC, SIGNS_ARE, signed_interval
from train.evaluate.environments import Column
from train.evaluate.episodes import group_by
from train.evaluate.maps import best_of
from train.evaluate.standings import Paired, Standing
from train.evaluate.statistics import Estimate
from train.report.fitting import print_fitting
from train.runs.escaping import markdown_table, markdown_text, write_csv

_BASE = ("base", "change", "change_low", "change_high", "verdict")
_RIVAL = ("best_without_learning", "change_to_best", "change_to_best_low", "change_to_best_high", "verdict_to_best")
_HEAD = (
    "track", "policy", "reference", "scope", "pooled", "column", "title", "metric", "mean", "low", "high", "failed",
    "episodes", "training_seeds", *_BASE, *_RIVAL, "step_us",
)  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """What stands in one cell of the leaderboard.

    Attributes:
        figures: A figure per metric; "-" where there is none.
        is_best: Whether each is the best of its track.
        intervals: Interval of each over training seeds; empty without them.
        failed: Failed episodes of all; empty where none failed.
    """

    figures: tuple[str, ...]
    is_best: tuple[bool, ...]
    intervals: tuple[str, ...]
    failed: str


@dataclass(frozen=True)
class Row:
    """A policy on the leaderboard.

    Attributes:
        policy: Its title.
        entries: One per column.
        failed: Failed episodes of all that it played.
        step: Time per step [µs], as it is shown; empty where it is not shown.
    """

    policy: str
    entries: tuple[Entry, ...]
    failed: str
    step: str


@dataclass(frozen=True)
class Board:
    """A table of the leaderboard.

    Attributes:
        columns: Scope and motion of every column.
        tracks: Name of each track, and its policies, the best first.
        what: What a cell holds, in words.
    """

    columns: tuple[tuple[str, str], ...]
    tracks: tuple[tuple[str, tuple[Row, ...]], ...]
    what: str


def board(found: Sequence[Standing]) -> Board:
    """The leaderboard: groups of scenarios, and with each motion what is in no group."""
    return _board([s for s in found if s.is_column], found)


def scenarios_board(found: Sequence[Standing]) -> Board | None:
    """The single scenarios behind the groups of the first motion; None where there are none."""
    first = found[0].reference
    single = [s for s in found if s.reference == first and not s.is_group and not s.is_column]
    return _board(single, []) if single else None


def _board(shown: Sequence[Standing], everything: Sequence[Standing]) -> Board:
    columns = tuple(dict.fromkeys((s.scope, s.reference) for s in shown))
    metrics = list(dict.fromkeys(s.metric for s in shown))
    at = {(s.policy, s.scope, s.reference, s.metric): s for s in shown}
    tracks = []
    for track in Track:
        policies = list(dict.fromkeys(s.policy for s in shown if s.track is track))
        if not policies:
            continue
        best = {
            (column, metric): best_of(
                {p: _scored(at[p, *column, metric]) for p in policies if (p, *column, metric) in at}
            )
            for column in columns
            for metric in metrics
        }
        rows = [
            Row(
                policy,
                tuple(_entry([at.get((policy, *column, m)) for m in metrics],
                             tuple(best[column, m] == policy for m in metrics)) for column in columns),
                *_totals(policy, everything),
            )
            for policy in policies
        ]  # fmt: skip
        order = {p: _order(at.get((p, *columns[0], metrics[0]))) for p in policies}
        tracks.append((str(track), tuple(sorted(rows, key=lambda row: order[row.policy]))))
    of_a_metric = {s.metric: f"{s.title} [{_column(s).unit}]" for s in shown}
    return Board(columns, tuple(tracks), " / ".join(of_a_metric.values()))


def _scored(standing: Standing) -> tuple[Estimate, tuple[int, int]]:
    return standing.score, (standing.failed, standing.episodes)


def _order(standing: Standing | None) -> float:
    return math.inf if standing is None or math.isnan(standing.score.value) else standing.score.value


def _totals(policy: str, everything: Sequence[Standing]) -> tuple[str, str]:
    """Failed episodes of all, and time per step; empty in a table without totals."""
    own = [s for s in everything if s.policy == policy]
    if not own:
        return "", ""
    single = [s for s in own if not s.is_group and s.metric == own[0].metric]
    failed, episodes, step = sum(s.failed for s in single), sum(s.episodes for s in single), own[0].step_us
    return f"{failed}/{episodes}", "-" if math.isnan(step) else f"{step:.0f}"


def _entry(own: Sequence[Standing | None], is_best: tuple[bool, ...]) -> Entry:
    found = [s for s in own if s is not None]
    if not found:
        return Entry(("not played",), (False,), (), "")
    factors = [_column(s).scale for s in found]
    scores = [s.score.scaled(factor) for s, factor in zip(found, factors, strict=True)]
    intervals = tuple(_interval(score.low, score.high) for score in scores if score.has_interval)
    failed = f"✕{found[0].failed}/{found[0].episodes}" if found[0].failed else ""
    figures = tuple(three_digits(score.value) for score in scores)
    return Entry(figures, is_best, intervals, failed)


def _interval(low: float | None, high: float | None) -> str:
    return "" if low is None or high is None else f"[{three_digits(low)}, {three_digits(high)}]"


def three_digits(value: float) -> str:
    """A number with three digits: 2.48, 11.2, 123; - where there is none."""
    if not math.isfinite(value):
        return "-"
    size = abs(float(f"{value:.2e}"))
    return f"{value:.{max(0, 2 - math.floor(math.log10(size))) if size else 2}f}"


def _column(standing: Standing) -> Column:
    return Column(standing.title, standing.metric)


def paired_rows(found: Sequence[Standing]) -> tuple[list[str], list[list[str]]]:
    """What learning adds: head and rows of the residuals' paired changes in every column; no rows without residuals."""
    learned = [s for s in found if s.is_column and s.training_seeds]
    titles = dict.fromkeys(s.title for s in learned)
    rows = [
        [
            policy,
            f"{scope}, {reference}",
            *(text for s in own for text in (said(s.base), _said_beside(s.rival, s.base))),
        ]
        for (policy, scope, reference), own in group_by(learned, lambda s: (s.policy, s.scope, s.reference)).items()
    ]
    changes = (f"{title}, against {other}" for title in titles for other in ("its base", f"the {BEST_ANALYTIC}"))
    return ["residual", "where", *changes], rows


def _said_beside(rival: Paired | None, base: Paired | None) -> str:
    """A change against a rival, once where that is the base."""
    return "the same" if rival is not None and base is not None and rival.to == base.to else said(rival)


def said(paired: Paired | None) -> str:
    """A paired change in words: as `changed`, and whom it compares with."""
    return "-" if paired is None else f"{changed(paired)} ({paired.to})"


def changed(paired: Paired | None) -> str:
    """A paired change: its value, its interval, and a sign where nothing is shown."""
    return "-" if paired is None else signed_interval(paired.change, paired.verdict)


LEGEND = (
    "Lower is better. Each cell is a mean over scenarios of means over the episodes that did not fail. Bold is the "
    "best of its track. A residual has the interquartile mean over training seeds, with the 95 % interval below. ✕ "
    "counts episodes that failed, such as by a fall. A policy that fails less often ranks first. The column µs is the "
    "processor time of the policy alone for a control step of one world on one thread. It is a median of one "
    "interleaved run."
)
PAIRED = (
    "Paired changes on the same episodes: interquartile mean over training seeds with its 95 % interval. Below zero, "
    f"learning is ahead. {SIGNS_ARE} The best policy without learning is "
    "the best of the first track in that column and metric, on the same episodes, which favours it."
)


def legend(found: Sequence[Standing]) -> str:
    """What a cell holds, and of how many episodes."""
    what = board(found).what
    counts = sorted({s.episodes // max(s.training_seeds, 1) for s in found if not s.is_group})
    span = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else str(counts[0])
    return f"{what[:1].upper()}{what[1:]}; episodes of a scenario, per training seed: {span}. {LEGEND}"


def leaderboard_markdown(found: Sequence[Standing]) -> str:
    """The tables of the leaderboard."""
    main, single = board(found), scenarios_board(found)
    parts = [legend(found), _board_markdown(main)]
    if any(s.training_seeds for s in found):
        parts += ["### What learning adds", claims_markdown(found).rstrip()]
    if single is not None:
        parts += [f"### Single scenarios, {main.columns[0][1]}", _board_markdown(single)]
    return "\n\n".join(parts) + "\n"


def claims_markdown(found: Sequence[Standing]) -> str:
    """What learning adds, as a table."""
    head, rows = paired_rows(found)
    return "\n\n".join([PAIRED, markdown_table(head, ["---"] * 2 + ["---:"] * (len(head) - 2), rows)]) + "\n"


def _board_markdown(shown: Board) -> str:
    """A table; Markdown of its own, with bold figures and small intervals."""
    totals = ["failed", "µs"] if any(row.failed for _, rows in shown.tracks for row in rows) else []
    head = ["policy", *(f"{scope}, {reference}" for scope, reference in shown.columns), *totals]
    lines = [_line(map(markdown_text, head)), _line(["---", *["---:"] * (len(head) - 1)])]
    for track, rows in shown.tracks:
        lines.append(_line([f"**{markdown_text(track)}**", *[""] * (len(head) - 1)]))
        for row in rows:
            cells = [markdown_text(row.policy), *map(_entry_markdown, row.entries)]
            lines.append(_line([*cells, *([row.failed, row.step] if totals else [])]))
    return "\n".join(lines)


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _entry_markdown(entry: Entry) -> str:
    figures = [f"**{text}**" if best else text for text, best in zip(entry.figures, entry.is_best, strict=True)]
    failed = f" {entry.failed}" if entry.failed else ""
    return " / ".join(figures) + failed + "".join(f"<br><sub>{interval}</sub>" for interval in entry.intervals)


def print_leaderboard(found: Sequence[Standing], console: Console) -> None:
    """Print the leaderboard with as many columns as the terminal has room for."""
    main = board(found)
    print_fitting(
        console,
        range(len(main.columns)),
        lambda places: _board_table(main, places),
        lambda place: ", ".join(main.columns[place]),
        "leaderboard.md",
    )


def _board_table(main: Board, places: Sequence[int]) -> Table:
    """Some of its columns for the terminal, the best of each track in bold."""
    table = Table(title=f"leaderboard, {escape(main.what)}", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("policy", no_wrap=True, vertical="bottom")
    for name in [",\n".join(main.columns[at]) for at in places] + ["failed", "µs"]:
        table.add_column(escape(name), justify="right", no_wrap=True, vertical="bottom")
    for track, rows in main.tracks:
        table.add_section()
        table.add_row(Text(track, style="italic"))
        for row in rows:
            table.add_row(
                Text(f"  {row.policy}"), *(_entry_text(row.entries[at]) for at in places), row.failed, row.step
            )
    return table


def _entry_text(entry: Entry) -> Text:
    parts = [
        Text(figure, style="bold" if best else "") for figure, best in zip(entry.figures, entry.is_best, strict=True)
    ]
    return Text(" / ").join(parts) + Text(f" {entry.failed}" if entry.failed else "")


def write_leaderboard(found: Sequence[Standing], folder: Path) -> list[Path]:
    """Write `leaderboard.csv` and `leaderboard.md`; the latter from the former, so that they agree."""
    table, text = folder / "leaderboard.csv", folder / "leaderboard.md"
    write_csv(_HEAD, map(_record, found), table)
    write_whole(text, f"# Leaderboard\n\n{leaderboard_markdown(read_leaderboard(table))}")
    return [table, text]


def _record(s: Standing) -> list[Any]:
    return [
        str(s.track), s.policy, s.reference, s.scope, s.is_group, s.is_column, s.title, s.metric, *_cells(s.score),
        s.failed, s.episodes, s.training_seeds, *_paired_cells(s.base), *_paired_cells(s.rival), f"{s.step_us:.3g}",
    ]  # fmt: skip


def _cells(estimate: Estimate) -> list[str]:
    return ["" if value is None else f"{value:.6g}" for value in (estimate.value, estimate.low, estimate.high)]


def _paired_cells(paired: Paired | None) -> list[str]:
    return [""] * 5 if paired is None else [paired.to, *_cells(paired.change), paired.verdict]


def read_leaderboard(path: Path) -> list[Standing]:
    """The rows of a `leaderboard.csv`.

    Raises:
        ConfigurationError: It is none.
    """
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != _HEAD:
            raise ConfigurationError(f"{shortened(path)} is no leaderboard.csv: its columns must be {', '.join(_HEAD)}")
        found = [_standing(row) for row in reader]
    if not found:
        raise ConfigurationError(f"{shortened(path)} has no rows")
    return found


def _standing(row: Mapping[str, str]) -> Standing:
    return Standing(
        track=Track(row["track"]), policy=row["policy"], reference=row["reference"], scope=row["scope"],
        is_group=row["pooled"] == "True", is_column=row["column"] == "True", title=row["title"], metric=row["metric"],
        score=_estimate(row["mean"], row["low"], row["high"]), failed=int(row["failed"]),
        episodes=int(row["episodes"]), training_seeds=int(row["training_seeds"]),
        base=_read_paired([row[name] for name in _BASE]), rival=_read_paired([row[name] for name in _RIVAL]),
        step_us=float(row["step_us"]),
    )  # fmt: skip


def _read_paired(cells: Sequence[str]) -> Paired | None:
    to, value, low, high, verdict = cells
    return Paired(to, _estimate(value, low, high), verdict) if to else None


def _estimate(value: str, low: str, high: str) -> Estimate:
    return Estimate(float(value), float(low) if low else None, float(high) if high else None)
