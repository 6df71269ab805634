"""Tables of the testbed's page, from the kept cells of comparisons and from
`docs.pages.statics`.
"""

from collections.abc import Mapping, Sequence

from docs.pages.cells import Cells, Rows, failure_counts, in_table_unit, minus, page_table

ERROR = "link_error_rms_rad"
_AT_REST = ("link_error_imu_min_rad", "link_error_imu_max_rad")
_PAPER = {"r": "0.9775", "uncompensated": "−56.2 to +41.7 mrad", "input": "−3.7 to +7.1 mrad"}
_SHOWN = ("nominal", "soft")
"""Scenarios of the tables in motion: the right K, and a wrong one."""
_RIVALS = ("dynamic", "friction", "disturbance_observer")
_RIVALS_MOTIONS = ("sine", "steps")
_BETWEEN = "20"
"""Motions of the table of rivals, and the damping that no table shows; the CSV files have all."""


def paper_testbed(rows: Rows, identified: Rows) -> str:
    """Figs. 5 and 6 of the paper, beside the paper's figures."""
    cells = Cells(rows)
    (nominal,) = (
        row for row in identified if row["scenario"] == "nominal" and int(row["seeds"]) > 1
    )
    lines = [
        [
            f"Pearson r, median of {nominal['seeds']} seeds",
            f"{float(nominal['pearson_r']):.4f}",
            _PAPER["r"],
        ]
    ]
    for policy in ("uncompensated", "input"):
        lines.append(
            [f"link error at rest, `{policy}`", f"{_range(cells, policy)} mrad", _PAPER[policy]]
        )
    return page_table(["figure", "here", "paper"], lines)


def _range(cells: Cells, policy: str) -> str:
    row = cells.row(policy, "hold", "nominal")
    return " to ".join(minus(f"{in_table_unit(row, metric):+.1f}") for metric in _AT_REST)


def identification(rows: Rows) -> str:
    """Stiffness, friction and dead band that the static experiment finds over seeds, and how often
    the interval is right.
    """
    lines = []
    for row in rows:
        seeds = int(row["seeds"])
        if seeds == 1:
            continue
        low = float(row["identified_min"])
        high = float(row["identified_max"])
        found = f"{float(row['identified_median']):.1f} ({low:.1f} to {high:.1f})"
        scenario = f"`{row['scenario']}`, {seeds} seeds"
        line = f"{float(row['line_stiffness_nm_per_rad']):.1f}"
        friction = f"{float(row['friction_nm']):.2f}"
        band = f"{1e3 * float(row['dead_band_rad']):.2f}"
        lines.append([scenario, found, line, friction, band])
    head = [
        "scenario",
        "identified K [N·m/rad]",
        "plain line",
        "friction [N·m]",
        "dead band [mrad]",
    ]
    (nominal,) = (row for row in rows if row["scenario"] == "nominal" and not _is_of_damping(row))
    return (
        f"{page_table(head, lines)}\nIn `nominal` the 95 % interval holds the true K in"
        f" {nominal['covered']} of {nominal['seeds']} seeds. Its half-width is at most"
        f" {100 * float(nominal['half_width_most']):.2f} %.\n"
    )


def _is_of_damping(row: Mapping[str, str]) -> bool:
    return row["scenario"] == "nominal" and row["seeds"] == "1"


def output_compensators(rows: Rows) -> str:
    """Error of Eq. 12 against Newton's method on Eq. 10."""
    angles = {"deflection_peak_rad": "3g", "error_rms_rad": "2g", "error_peak_rad": "2g"}
    lines = [
        [
            f"{float(row['stiffness_nm_per_rad']):g}",
            *(f"{1e3 * float(row[name]):.{form}}" for name, form in angles.items()),
        ]
        for row in rows
    ]
    head = [
        "K [N·m/rad]",
        "deflection [mrad]",
        "error of Eq. 12 rms [mrad]",
        "largest [mrad]",
    ]
    return page_table(head, lines, words=0)


def damping(rows: Rows, identified: Rows) -> str:
    """Effects of the damping of the transmission on the identification and in motion."""
    cells = Cells(rows)
    lines = []
    for row in identified:
        if not _is_of_damping(row) or row["damping_nms_per_rad"] == _BETWEEN:
            continue
        d = f"{float(row['damping_nms_per_rad']):g}"
        motion = (
            _rms(cells, f"{policy}: {d}", "sine", "nominal")
            for policy in ("input", "dynamic", "oracle")
        )
        lines.append([d, f"{float(row['identified_median']):.1f}", *motion])
    head = ["D [N·m·s/rad]", "identified K", "`input`", "`dynamic`", "`oracle`"]
    return page_table(head, lines, words=0)


def scenarios(rows: Rows) -> str:
    """Link error with and without compensation."""
    policies = ("uncompensated", "input", "dynamic", "oracle")
    cells = Cells(rows)
    return _link_errors(cells, policies, cells.names("reference"))


def rivals(rows: Rows) -> str:
    """Link error of the policies that know or observe the friction."""
    return _link_errors(Cells(rows), _RIVALS, _RIVALS_MOTIONS)


def _link_errors(cells: Cells, policies: Sequence[str], motions: Sequence[str]) -> str:
    lines = [
        [
            f"{reference}, `{scenario}`",
            *(_rms(cells, policy, reference, scenario) for policy in policies),
        ]
        for reference in motions
        for scenario in _SHOWN
    ]
    return page_table(["", *(f"`{policy}`" for policy in policies)], lines)


def _rms(cells: Cells, policy: str, reference: str, scenario: str) -> str:
    """Three digits."""
    row = cells.row(policy, reference, scenario)
    if failure_counts(row)[0]:
        return "{} of {} failed".format(*failure_counts(row))
    value = in_table_unit(row, ERROR)
    return f"{value:.{1 if value >= 9.995 else 2}f}"
