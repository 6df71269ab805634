"""Tables of the page of recorded robots, from what `python -m train.recorded` writes."""

import math
from collections.abc import Mapping

from docs.pages.cells import Rows, page_table
from train.recorded.justin import DRAWN, GUESSED

_SOURCE_MM = {
    "rigid, as given": "21.3",
    "K and encoder offsets": "–",
    "K and geometry": "5.64",
    "K, geometry and lateral compliance": "3.12",
}
"""Mean errors that the source states, fitted and judged on the same 500 poses [mm]."""


def hands(rows: Rows) -> str:
    """Held-out errors from most poses, beside what the source states in-sample."""
    own = _of_masses(rows, GUESSED)
    lines = [
        [
            row["prediction"],
            f"{float(row['mean_mm']):.2f}",
            f"{float(row['least_mm']):.2f} to {float(row['most_mm']):.2f}",
            f"{float(row['rms_mm']):.2f}",
            _SOURCE_MM.get(row["prediction"], "–"),
        ]
        for row in own
        if float(row["poses"]) == _most(rows)
    ]
    head = ["prediction", "mean [mm]", "over the halves", "rms", "source, in-sample mean"]
    return page_table(head, lines)


def by_poses(rows: Rows) -> str:
    """Held-out errors of what was identified, by the number of poses that were fitted."""
    counts = sorted({float(row["poses"]) for row in rows})
    lines = []
    for name in [name for name in _SOURCE_MM if name.startswith("K")]:
        found = {float(row["poses"]): row for row in _of_masses(rows, GUESSED) if _is(row, name)}
        lines.append([name, *(f"{float(found[count]['mean_mm']):.2f}" for count in counts)])
    head = [f"{count:g}" for count in counts]
    return page_table(["mean error [mm] by poses that were fitted", *head], lines)


def by_masses(rows: Rows) -> str:
    """Held-out errors with the guessed masses, and with others."""
    lines = []
    for name in [name for name in _SOURCE_MM if name.startswith("K")]:
        found = [row for row in rows if _is(row, name) and float(row["poses"]) == _most(rows)]
        by_masses = {row["masses"]: float(row["mean_mm"]) for row in found}
        lines.append([name, *(f"{by_masses[masses]:.2f}" for masses in (GUESSED, DRAWN))])
    return page_table(["mean error [mm] by masses", GUESSED, DRAWN], lines)


def in_short(rows: Rows) -> str:
    """The humanoid in one sentence."""
    full = {
        row["prediction"]: float(row["mean_mm"])
        for row in _of_masses(rows, GUESSED)
        if float(row["poses"]) == _most(rows)
    }
    best = min(value for name, value in full.items() if name.startswith("K"))
    rivals = [value for name, value in full.items() if not name.startswith(("K", "rigid"))]
    held_out = rows[0]["held_out"]
    return (
        f"Identification lowers the error of a recorded humanoid's hand from"
        f" {full['rigid, as given']:.1f} to {best:.1f} mm at {held_out} held-out poses. The best"
        f" rival without physics reaches {min(rivals):.1f} mm.\n"
    )


def _of_masses(rows: Rows, masses: str) -> list[Mapping[str, str]]:
    return [row for row in rows if row["masses"] == masses]


def _most(rows: Rows) -> float:
    return max(float(row["poses"]) for row in rows)


def _is(row: Mapping[str, str], name: str) -> bool:
    return row["prediction"] == name


def replays(rows: Rows) -> str:
    """Errors at motions that were not fitted: torque on, and of the replay over all rows too."""
    own = [row for row in rows if row["measure"] == "replay"]
    return _servo_table("motion, not fitted", own, {_ALL_ROWS: "replay_all_mrad"})


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
        f" priors the replay of that row has {on} mrad, and {all_rows}\n  with the torque off"
        f" included. Fits from {len(found)} seeds of the starts agree within {apart:g} mrad.\n"
    )


def coverage(rows: Rows) -> str:
    """How often intervals of made-up servos hold the truth."""
    lines = [
        [
            _PARAMETERS[row["parameter"]],
            row["holds"],
            f"{100.0 * float(row['half_width_median']):.2g} %",
        ]
        for row in rows
    ]
    head = [f"within its 95 % interval, of {rows[0]['trials']}", "half-width, median"]
    return page_table(["parameter", *head], lines)


_PARAMETERS = {
    "position_gain": "position gain",
    "motor_damping": "back-EMF damping",
    "rotor_inertia": "rotor inertia",
    "coulomb_friction": "Coulomb friction",
    "load_friction": "load friction",
    "viscous_friction": "viscous friction",
    "zero_offset": "zero offset",
    "delay": "delay",
    "switch_lead": "lead of a switched torque",
}
_ALL_ROWS = "identified, torque off included"
_PREDICTIONS = {
    "goal itself": "goal_mrad",
    "constant offset": "offset_mrad",
    "line in the goal": "line_mrad",
    "identified": "replay_mrad",
}
"""Columns of both tables, over the same rows."""


def _servo_table(what: str, rows: Rows, further: Mapping[str, str]) -> str:
    columns = {**_PREDICTIONS, **further}
    lines = []
    for row in rows:
        shown = [f"{float(row[name]):.1f}" for name in columns.values()]
        lines.append([row["servo"].upper(), row["of"].replace("_", " "), *shown])
    return page_table(["servo", what, *columns], lines, words=2)
