"""Tables of the page of recorded robots, from what `python -m docs.recorded` writes."""

import math
from collections.abc import Mapping, Sequence

from docs.pages.cells import Rows, page_table
from docs.recorded.justin import DRAWN, GUESSED

_SOURCE_MM = {
    "rigid, as given": "21.3",
    "K and encoder offsets": "–",
    "K and geometry": "5.64",
    "K, geometry and lateral compliance": "3.12",
}
"""Mean errors that the source states, fitted and judged on the same 500 poses [mm]."""
_BEST = "K, geometry and lateral compliance"


def hands(rows: Rows) -> str:
    """Held-out errors from most poses, beside what the source states in-sample."""
    own = _of_masses(rows, GUESSED)
    lines = [
        [
            row["prediction"],
            f"{float(row['mean_mm']):.2f}",
            _SOURCE_MM.get(row["prediction"], "–"),
        ]
        for row in own
        if float(row["poses"]) == _most(rows)
    ]
    head = ["prediction", "mean error [mm]", "source, in-sample"]
    return page_table(head, lines)


def by_poses(rows: Rows) -> str:
    """Held-out errors of the best identified model, by fitted poses, and with other masses."""
    best = [row for row in rows if _is(row, _BEST)]
    errors = {float(row["poses"]): float(row["mean_mm"]) for row in _of_masses(best, GUESSED)}
    counts = sorted(errors)
    (drawn,) = (float(row["mean_mm"]) for row in _of_masses(best, DRAWN))
    return (
        f"With {_listed([f'{count:g}' for count in counts])} fitted poses the last model reaches"
        f" {_listed([f'{errors[count]:.2f}' for count in counts])} mm.\n"
        f"With masses {DRAWN}, it reaches {drawn:.2f} mm.\n"
    )


def _listed(texts: Sequence[str]) -> str:
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def in_short(rows: Rows) -> str:
    """The humanoid's hand in three predictions."""
    full = {
        row["prediction"]: float(row["mean_mm"])
        for row in _of_masses(rows, GUESSED)
        if float(row["poses"]) == _most(rows)
    }
    best = min(value for name, value in full.items() if name.startswith("K"))
    others = [value for name, value in full.items() if not name.startswith(("K", "rigid"))]
    head = [
        f"recorded hand of a humanoid, {rows[0]['held_out']} held-out poses",
        "rigid model",
        "K identified",
        "best without physics",
    ]
    figures = (full["rigid, as given"], best, min(others))
    return page_table(head, [["mean error [mm]", *(f"{value:.1f}" for value in figures)]])


def _of_masses(rows: Rows, masses: str) -> list[Mapping[str, str]]:
    return [row for row in rows if row["masses"] == masses]


def _most(rows: Rows) -> float:
    return max(float(row["poses"]) for row in rows)


def _is(row: Mapping[str, str], name: str) -> bool:
    return row["prediction"] == name


def replays(rows: Rows) -> str:
    """Errors at motions that were not fitted: torque on, and of the replay over all rows too."""
    own = [row for row in rows if row["measure"] == "replay"]
    return _servo_table("motion, not fitted", own, {"torque off included": "replay_all_mrad"})


def slow_motion(rows: Rows) -> str:
    """Errors in slow motion by the value of the gain register, over all motions."""
    own = [row for row in rows if row["measure"] == "slow"]
    return _servo_table("gain, slow motion, not fitted", own, {})


def priors(rows: Rows) -> str:
    """What priors and starts change of the first motions of the XL330."""
    own = [row for row in rows if row["servo"] == "xl330"]
    without = next(row for row in own if row["measure"] == "replay without priors")
    replays = [row for row in own if row["measure"] == "replay"][:1]
    starts = [row for row in own if row["measure"] == "replay from other starts"]
    found = [float(row["replay_mrad"]) for row in (*replays, *starts)]
    apart = math.ceil(10.0 * (max(found) - min(found))) / 10.0
    on, all_rows = (f"{float(without[name]):.0f}" for name in ("replay_mrad", "replay_all_mrad"))
    return (
        "* **Priors.** Their weight was chosen with the first row of the XL330 in sight. Without"
        f" them that row has {on} mrad, and {all_rows}\n  with the torque off. Fits from"
        f" {len(found)} seeds of the starts agree within {apart:g} mrad.\n"
    )


def coverage(rows: Rows) -> str:
    """How often intervals of made-up servos hold the truth."""
    holds = [round(float(row["holds"])) for row in rows]
    widths = [100.0 * float(row["half_width_median"]) for row in rows]
    return (
        f"The 95 % intervals of {len(rows)} parameters hold the truth in {min(holds)} to"
        f" {max(holds)} of {rows[0]['trials']} servos. Their median half-widths are"
        f" {min(widths):.2g} to {max(widths):.2g} %.\n"
    )


_WITHOUT_PHYSICS = ("goal_mrad", "offset_mrad", "line_mrad")
"""Columns of predictions without physics: the goal itself, a constant offset, a line in the
goal."""


def _servo_table(what: str, rows: Rows, further: Mapping[str, str]) -> str:
    lines = []
    for row in rows:
        best = min(float(row[name]) for name in _WITHOUT_PHYSICS)
        shown = [best, *(float(row[name]) for name in ("replay_mrad", *further.values()))]
        names = [row["servo"].upper(), row["of"].replace("_", " ")]
        lines.append([*names, *(f"{value:.1f}" for value in shown)])
    head = ["servo", what, "best without physics", "identified", *further]
    return page_table(head, lines, words=2)
