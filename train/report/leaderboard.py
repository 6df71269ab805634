"""The leaderboard as tables for the report, as CSV and as Markdown."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from baselines.catalogue import Track
from elastic_env.core.errors import ConfigurationError, shorten
from elastic_env.core.files import write_whole
from train.evaluate.changes import BEST_ANALYTIC, SIGNS_ARE, signed_interval
from train.evaluate.environments import Column
from train.evaluate.episodes import group_by
from train.evaluate.maps import best_of
from train.evaluate.standings import Paired, Standing
from train.evaluate.statistics import Estimate
from train.report.render import Head, Part, Row, Table, print_table, render, write_table

_BASE = ("base", "change", "change_low", "change_high", "verdict")
_RIVAL = (
    "best_without_learning",
    "change_to_best",
    "change_to_best_low",
    "change_to_best_high",
    "verdict_to_best",
)
_HEAD = (
    "track",
    "policy",
    "reference",
    "scope",
    "pooled",
    "column",
    "title",
    "metric",
    "mean",
    "low",
    "high",
    "failed",
    "episodes",
    "training_seeds",
    *_BASE,
    *_RIVAL,
    "step_us",
)


def board(found: Sequence[Standing]) -> Table:
    """The leaderboard: groups of scenarios, and with each motion what is in no group."""
    return _board([s for s in found if s.is_column], found)


def scenarios_board(found: Sequence[Standing]) -> Table | None:
    """The single scenarios behind the groups of the first motion; None where there are none."""
    first = found[0].reference
    single = [s for s in found if s.reference == first and not s.is_group and not s.is_column]
    return _board(single, []) if single else None


def _board(shown: Sequence[Standing], everything: Sequence[Standing]) -> Table:
    """A table of some standings, with the totals of all where there are any."""
    columns = list(dict.fromkeys((s.scope, s.reference) for s in shown))
    metrics = list(dict.fromkeys(s.metric for s in shown))
    rows = []
    for track in Track:
        policies = group_by([s for s in shown if s.track is track], lambda s: s.policy)
        if not policies:
            continue
        rows.append(Row((str(track),), kind="heading"))
        places = {
            (s.policy, s.scope, s.reference, s.metric): s for own in policies.values() for s in own
        }
        best = {
            (scope, reference, metric): best_of(
                {
                    policy: (s.score, (s.failed, s.episodes))
                    for policy in policies
                    if (s := places.get((policy, scope, reference, metric))) is not None
                }
            )
            for scope, reference in columns
            for metric in metrics
        }
        order = {
            policy: _order(places.get((policy, *columns[0], metrics[0]))) for policy in policies
        }
        for policy in sorted(policies, key=lambda policy: order[policy]):
            entries = [
                _entry(
                    [places.get((policy, *column, metric)) for metric in metrics],
                    [best[*column, metric] == policy for metric in metrics],
                )
                for column in columns
            ]
            rows.append(Row((policy, *entries, *_totals(policy, everything))))
    heads = [Head("policy", is_number=False)]
    heads += [Head(scope, second=reference, leaves=1) for scope, reference in columns]
    heads += [Head("failed"), Head("µs")] if everything else []
    title = f"leaderboard, {_meaning(shown)}"
    return Table(tuple(heads), tuple(rows), title=title, kind="board")


def _meaning(shown: Sequence[Standing]) -> str:
    """Metrics that a cell of the leaderboard holds."""
    return " / ".join(dict.fromkeys(f"{s.title} [{_column(s).unit}]" for s in shown))


def _order(standing: Standing | None) -> float:
    return (
        math.inf if standing is None or math.isnan(standing.score.value) else standing.score.value
    )


def _totals(policy: str, everything: Sequence[Standing]) -> list[str]:
    """Failed episodes of all, and time per step; nothing in a table without totals."""
    own = [s for s in everything if s.policy == policy]
    if not own:
        return []
    single = [s for s in own if not s.is_group and s.metric == own[0].metric]
    step_us = own[0].step_us
    failed = f"{sum(s.failed for s in single)}/{sum(s.episodes for s in single)}"
    return [failed, "-" if math.isnan(step_us) else f"{step_us:.0f}"]


def _entry(standings: Sequence[Standing | None], is_best: Sequence[bool]) -> tuple[Part, ...]:
    """Figures of all metrics, failures, and the intervals below."""
    found = [s for s in standings if s is not None]
    if not found:
        return (Part("not played"),)
    scores = [s.score.times(_column(s).scale) for s in found]
    parts = [
        Part(three_digits(score.value), "bold" if best else "", before=" / " if number else "")
        for number, (score, best) in enumerate(zip(scores, is_best, strict=True))
    ]
    if found[0].failed:
        parts.append(Part(f"✕{found[0].failed}/{found[0].episodes}", "failure", before=" "))
    intervals = [score.ends for score in scores if score.has_interval]
    parts += [
        Part(f"[{three_digits(low)}, {three_digits(high)}]", "small") for low, high in intervals
    ]
    return tuple(parts)


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
    titles = dict.fromkeys(s.title for s in learned)
    rows = []
    for (policy, scope, reference), own in group_by(
        learned, lambda s: (s.policy, s.scope, s.reference)
    ).items():
        changes = [text for s in own for text in (_change(s.base), _beside_base(s.rival, s.base))]
        rows.append([policy, f"{scope}, {reference}", *changes])
    others = ("its base", f"the {BEST_ANALYTIC}")
    head = [f"{title}, against {other}" for title in titles for other in others]
    return Table.plain(["residual", "where", *head], rows, words=2)


def _beside_base(rival: Paired | None, base: Paired | None) -> str:
    """A change against a rival, once where that is the base."""
    return (
        "the same"
        if rival is not None and base is not None and rival.to == base.to
        else _change(rival)
    )


def _change(paired: Paired | None) -> str:
    """A paired change: its value, its interval, a sign where nothing is shown, and whom it
    compares with.
    """
    return (
        "-" if paired is None else f"{signed_interval(paired.change, paired.verdict)} ({paired.to})"
    )


LEGEND = (
    "Lower is better. Each cell is a mean over scenarios of means over the episodes that did not"
    " fail. Bold is the best of its track. A residual has the interquartile mean over training"
    " seeds, with the 95 % interval below. ✕ counts episodes that failed, such as by a fall. A"
    " policy that fails less often ranks first. The column µs is the processor time of the policy"
    " alone for a control step of one world on one thread. It is a median of one interleaved run."
)
PAIRED = (
    "Paired changes on the same episodes: interquartile mean over training seeds with its 95 %"
    f" interval. Below zero, learning is ahead. {SIGNS_ARE} The best policy without learning is the"
    " best of the first track in that column and metric, on the same episodes, which favours it."
)


def legend(found: Sequence[Standing]) -> str:
    """Meaning of a cell, and its number of episodes."""
    meaning = _meaning([s for s in found if s.is_column])
    counts = sorted({s.episodes // max(s.training_seeds, 1) for s in found if not s.is_group})
    span = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else str(counts[0])
    return (
        f"{meaning[:1].upper()}{meaning[1:]}; episodes of a scenario, per training seed: {span}."
        f" {LEGEND}"
    )


def leaderboard_markdown(found: Sequence[Standing]) -> str:
    """The tables of the leaderboard."""
    parts = [legend(found), render(board(found), "markdown")]
    if any(s.training_seeds for s in found):
        parts += ["### What learning adds", claims_markdown(found).rstrip()]
    single = scenarios_board(found)
    if single is not None:
        parts += [f"### Single scenarios, {found[0].reference}", render(single, "markdown")]
    return "\n\n".join(parts) + "\n"


def claims_markdown(found: Sequence[Standing]) -> str:
    """The paired changes of residuals, as a table."""
    return f"{PAIRED}\n\n{render(claims_table(found), 'markdown')}\n"


def print_leaderboard(found: Sequence[Standing], console: Console) -> None:
    """Print the leaderboard with as many columns as the terminal has room for."""
    print_table(board(found), console, "leaderboard.md")


def write_leaderboard(found: Sequence[Standing], folder: Path) -> list[Path]:
    """Write `leaderboard.csv` and `leaderboard.md`; the latter from the former, so that they
    agree.
    """
    table = folder / "leaderboard.csv"
    text = folder / "leaderboard.md"
    write_table(_HEAD, map(_record, found), table)
    write_whole(text, f"# Leaderboard\n\n{leaderboard_markdown(read_leaderboard(table))}")
    return [table, text]


def _record(s: Standing) -> list[Any]:
    return [
        str(s.track),
        s.policy,
        s.reference,
        s.scope,
        s.is_group,
        s.is_column,
        s.title,
        s.metric,
        *_cells(s.score),
        s.failed,
        s.episodes,
        s.training_seeds,
        *_paired_cells(s.base),
        *_paired_cells(s.rival),
        f"{s.step_us:.3g}",
    ]


def _cells(estimate: Estimate) -> list[str]:
    return [
        "" if value is None else f"{value:.6g}"
        for value in (estimate.value, estimate.low, estimate.high)
    ]


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
            raise ConfigurationError(
                f"{shorten(path)} is no leaderboard.csv: its columns must be {', '.join(_HEAD)}"
            )
        found = [_standing(row) for row in reader]
    if not found:
        raise ConfigurationError(f"{shorten(path)} has no rows")
    return found


def _standing(row: Mapping[str, str]) -> Standing:
    return Standing(
        track=Track(row["track"]),
        policy=row["policy"],
        reference=row["reference"],
        scope=row["scope"],
        is_group=row["pooled"] == "True",
        is_column=row["column"] == "True",
        title=row["title"],
        metric=row["metric"],
        score=_estimate(row["mean"], row["low"], row["high"]),
        failed=int(row["failed"]),
        episodes=int(row["episodes"]),
        training_seeds=int(row["training_seeds"]),
        base=_read_paired([row[name] for name in _BASE]),
        rival=_read_paired([row[name] for name in _RIVAL]),
        step_us=float(row["step_us"]),
    )


def _read_paired(cells: Sequence[str]) -> Paired | None:
    to, value, low, high, verdict = cells
    return Paired(to, _estimate(value, low, high), verdict) if to else None


def _estimate(value: str, low: str, high: str) -> Estimate:
    return Estimate(float(value), float(low) if low else None, float(high) if high else None)
