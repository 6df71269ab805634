"""Gains by learning as tables of a page, from the `statistics.csv` or the `map.csv` that a
comparison wrote.
"""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from docs.pages.cells import Rows, page_table
from elastic_env.core.errors import ConfigurationError
from train.evaluate.change_text import (
    BEST_ANALYTIC,
    FEWEST_SEEDS,
    add_sign,
    percent,
    percent_interval,
)
from train.evaluate.episodes import group_by
from train.evaluate.statistics import Estimate

_METRICS = {
    "pelvis_error_rms_rad": ("pelvis error", "mrad"),
    "zmp_deviation_rms_m": ("ZMP deviation", "mm"),
    "link_error_rms_rad": ("link error", "mrad"),
    "end_effector_error_rms_m": ("end effector error", "mm"),
}
"""Metrics that pages show, with the unit of their tables."""
_JUDGED = ("pelvis_error_rms_rad", "zmp_deviation_rms_m", "link_error_rms_rad")
ARM = ("end_effector_error_rms_m", "link_error_rms_rad")
"""Metrics of an arm."""
MAPS = ("map_stiffness_imu", "map_payload_slope")
"""Configurations of the maps that pages show."""
_SHORT = ("mixture", "held out")
"""Groups of scenarios that say in short what learning adds."""
_TELLING = ("soft", "slope", "joined", "drawn")
"""Scenarios and groups of the walker that say where a residual gains, beside those in short."""
MOTIONS = ("nominal", "held out")
ARM_SCENARIOS = ("nominal", "soft", "payload")
"""Scenarios and groups of testbed and arm."""
_BASE = "base of the residual"
_SMALL = 2.0
"""Below it an angle has two decimals [mrad]."""


@dataclass(frozen=True)
class LearnedMap:
    """The change by a residual against the best policy without learning, over two axes, in one
    metric.

    Attributes:
        policy: Title of the residual.
        metric: Column of the episodes.
        cells: Row of the CSV by the values of both axes, as they are shown.
    """

    policy: str
    metric: str
    cells: Mapping[tuple[str, str], Mapping[str, str]]

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, str]]) -> "LearnedMap":
        """From the rows of one map, metric and residual."""
        first = rows[0]
        return cls(
            first["policy"],
            first["metric"],
            {(row["x"], row["y"]): row for row in rows},
        )

    @property
    def row(self) -> list[str]:
        """Metric, policy, cells ahead and behind, range of the change, and the opponent."""
        cells = list(self.cells.values())
        verdicts = [cell["verdict"] for cell in cells]
        opponents = [cell["best_without_learning"] or "none" for cell in cells]
        common = max(dict.fromkeys(opponents), key=opponents.count)
        changes = [float(cell["change"]) for cell in cells if cell["change"]]
        failed = sum(int(cell["failed"] or 0) for cell in cells)
        title, _ = _METRICS[self.metric]
        return [
            title,
            self.policy,
            f"{verdicts.count('lower')} of {len(cells)}",
            str(verdicts.count("higher")),
            f"{percent(min(changes))} to {percent(max(changes))}",
            str(failed),
            f"{common} ({opponents.count(common)})",
        ]


def learned_maps(path: Path) -> list[LearnedMap]:
    """The maps of all residuals in a `map.csv`.

    Raises:
        ConfigurationError: It is missing, or has no residual.
    """
    if not path.is_file():
        raise ConfigurationError(
            f"{path} is missing; copy it from the run of elastic compare configs/{path.stem}.yaml"
        )
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    learned = {row["policy"] for row in rows if row["verdict"]}
    if not learned:
        raise ConfigurationError(
            f"{path} compares no residual; a map of learning needs one among its policies"
        )
    keys = dict.fromkeys(
        (row["map"], row["metric"], row["policy"]) for row in rows if row["policy"] in learned
    )
    return [
        LearnedMap.of([row for row in rows if (row["map"], row["metric"], row["policy"]) == key])
        for key in keys
    ]


def maps_markdown(maps: Iterable[LearnedMap]) -> str:
    """A row for each map."""
    head = ["", "residual", "ahead", "behind", "change", "failed", "most often best without"]
    return page_table(head, [each.row for each in maps], words=2)


def changes_table(rows: Rows, metrics: Sequence[str] = _JUDGED, scopes: Sequence[str] = ()) -> str:
    """Paired changes of residuals against their base, from the rows of a `statistics.csv`.

    Args:
        rows: Its rows.
        metrics: The metrics that are shown, where the table has them.
        scopes: The scenarios and groups that are shown; empty for all.
    """
    own = _residuals(rows, metrics, scopes, _BASE)
    titles = {
        metric: _METRICS[metric]
        for metric in metrics
        if any(row["metric"] == metric for row in own)
    }
    names = [name for name in ("policy", "reference") if len({row[name] for row in own}) > 1]
    places = group_by(own, lambda row: (*(row[name] for name in names), row["scope"]))
    lines = []
    for place, found in places.items():
        by_metric = {row["metric"]: row for row in found}
        cells = (
            part
            for metric, (_, unit) in titles.items()
            for part in _over_base(by_metric[metric], unit)
        )
        lines.append([*place[:-1], _scope(found[0]), *cells])
    figures = (
        text for title, unit in titles.values() for text in (f"base: {title} [{unit}]", "change")
    )
    return page_table([*names, "", *figures], lines, words=len(names) + 1)


_TWENTY = " num_steps=20"
"""End of the name of a walk of twenty steps."""


def twenty_steps(*tables: Rows) -> str:
    """Paired changes against the best policy without learning, over walks of twenty steps.

    Args:
        tables: Rows of a `statistics.csv` each.
    """
    lines = []
    for rows in tables:
        walks = [row for row in rows if row["reference"].endswith(_TWENTY)]
        own = _residuals(walks, _JUDGED[:2], ("mixture", "drawn"), BEST_ANALYTIC)
        places = group_by(own, lambda row: (row["reference"], row["scope"]))
        for (reference, _), found in places.items():
            by_metric = {row["metric"]: row for row in found}
            changes = (_over_base(by_metric[metric], "")[1] for metric in _JUDGED[:2])
            lines.append([reference.removesuffix(_TWENTY), _scope(found[0]), *changes])
    titles = (_METRICS[metric][0] for metric in _JUDGED[:2])
    return page_table(["step", "", *titles], lines, words=2)


def both_opponents(*tables: Rows) -> str:
    """Paired changes of residuals of the walker, against the best policy without learning and
    against their base.

    Args:
        tables: Rows of a `statistics.csv` each.
    """
    rows = [row for table in tables for row in table]
    opponents = (BEST_ANALYTIC, _BASE)
    own = {against: _residuals(rows, _JUDGED, _TELLING, against) for against in opponents}
    cells = {
        (against, row["reference"], row["scope"], row["metric"]): row
        for against, found in own.items()
        for row in found
    }
    columns = [(against, metric) for metric in _JUDGED[:2] for against in opponents]
    places = group_by(own[_BASE], lambda row: (row["reference"], row["scope"]))
    lines = [
        [
            reference,
            _scope(found[0]),
            *(
                _over_base(cells[against, reference, scope, metric], "")[1]
                for against, metric in columns
            ),
        ]
        for (reference, scope), found in places.items()
    ]
    head = [
        f"{_METRICS[metric][0]}, against `{own[against][0]['base']}`" for against, metric in columns
    ]
    return page_table(["walk", "", *head], lines, words=2)


def _residuals(
    rows: Rows, metrics: Sequence[str], scopes: Sequence[str], against: str
) -> list[Mapping[str, str]]:
    """The rows of residuals: in some metrics and scopes, compared with one opponent."""
    return [
        row
        for row in rows
        if row["kind"] == "residual"
        and row["base_is"] == against
        and row["metric"] in metrics
        and (row["scope"] in scopes or not scopes)
    ]


def learning_in_short(*tables: Rows) -> str:
    """Gains of residuals over the best policy without learning, in groups of scenarios, on the
    motions that they are compared on.

    Args:
        tables: Rows of a `statistics.csv` each.
    """
    metrics = _JUDGED[:2]
    lines = []
    for rows in tables:
        own = _residuals(rows, metrics, _SHORT, BEST_ANALYTIC)
        for (reference,), found in group_by(own, lambda row: (row["reference"],)).items():
            cells = {(row["scope"], row["metric"]): row for row in found}
            changes = [
                _over_base(cells[scope, metric], "")[1] if (scope, metric) in cells else "-"
                for metric in metrics
                for scope in _SHORT
            ]
            lines.append([reference, *changes])
    head = [
        "walk",
        *(f"{_METRICS[metric][0]}, {scope}" for metric in metrics for scope in _SHORT),
    ]
    return page_table(head, lines)


def _scope(row: Mapping[str, str]) -> str:
    """A group in bold letters, or a scenario."""
    return f"**{row['scope']}**" if row["pooled"] == "True" else f"`{row['scope']}`"


def _over_base(row: Mapping[str, str], unit: str) -> tuple[str, str]:
    """Mean of the base in mrad or mm, and the change with its interval; a sign where it is not
    told from chance.
    """
    if not row["change"]:
        return f"falls, {row['base_failed']} of {row['base_episodes']}", "-"
    change, low, high = (float(row[name]) for name in ("change", "change_low", "change_high"))
    verdict = (
        "unclear"
        if int(row["training_seeds"]) < FEWEST_SEEDS
        else "none"
        if low <= 0.0 <= high
        else "shown"
    )
    base = 1e3 * float(row["base_mean"])
    return (
        f"{base:.{2 if unit == 'mrad' and base < _SMALL else 1}f}",
        add_sign(_without_breaks(percent_interval(Estimate(change, low, high))), verdict),
    )


def _without_breaks(interval: str) -> str:
    """A change whose interval stays on one line in a narrow table."""
    change, _, ends = interval.partition(" [")
    return "{} [{}".format(*(part.replace(" ", "\N{NO-BREAK SPACE}") for part in (change, ends)))
