"""Tables of the testbed's page, from the kept cells of comparisons and from
`docs.pages.statics`.
"""

from collections.abc import Mapping, Sequence

from docs.pages.cells import Cells, Rows, failure_counts, in_table_unit, minus, page_table

ERROR = "link_error_rms_rad"
_AT_REST = ("link_error_imu_min_rad", "link_error_imu_max_rad")
_PAPER = {"r": "0.9775", "uncompensated": "−56.2 to +41.7 mrad", "input": "−3.7 to +7.1 mrad"}
_NOT_PLAYED = "–"
_RIVALS = ("input", "dynamic", "friction", "disturbance_observer")


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
    """Stiffness, friction and dead band that the static experiment finds, and how often the
    interval is right.
    """
    lines = []
    for row in rows:
        if _is_of_damping(row):
            continue
        seeds = int(row["seeds"])
        low = float(row["identified_min"])
        high = float(row["identified_max"])
        found = f"{float(row['identified_median']):.1f}" + (
            f" ({low:.1f} to {high:.1f})" if seeds > 1 else ""
        )
        scenario = f"`{row['scenario']}`, {seeds} seeds" if seeds > 1 else f"`{row['scenario']}`"
        line = f"{float(row['line_stiffness_nm_per_rad']):.1f}"
        friction = f"{float(row['friction_nm']):.2f}"
        truth = f"{float(row['stiffness_nm_per_rad']):g}"
        band = f"{1e3 * float(row['dead_band_rad']):.2f}"
        lines.append([scenario, truth, found, line, friction, band])
    head = [
        "scenario",
        "true K [N·m/rad]",
        "identified K",
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
        "largest deflection [mrad]",
        "error of Eq. 12 against Newton, rms [mrad]",
        "largest [mrad]",
    ]
    return page_table(head, lines, words=0)


def damping(rows: Rows, identified: Rows) -> str:
    """Effects of the damping of the transmission: the identification, the errors at rest and
    those in motion.
    """
    cells = Cells(rows)
    lines = []
    for row in identified:
        if not _is_of_damping(row):
            continue
        d = f"{float(row['damping_nms_per_rad']):g}"
        motion = (
            in_table_unit(cells.row(f"{policy}: {d}", "sine", "nominal"), ERROR)
            for policy in ("uncompensated", "input", "dynamic", "oracle")
        )
        lines.append(
            [
                d,
                f"{float(row['identified_median']):.1f}",
                f"{float(row['friction_nm']):.2f}",
                f"{float(row['pearson_r']):.3f}",
                _range(cells, f"uncompensated: {d}"),
                _range(cells, f"input: {d}"),
                ", ".join(f"{value:.1f}" for value in motion),
            ]
        )
    head = [
        "D [N·m·s/rad]",
        "identified K",
        "friction [N·m]",
        "r",
        "error at rest, uncompensated [mrad]",
        "`input` [mrad]",
        "sine rms: uncompensated, input, dynamic, oracle [mrad]",
    ]
    return page_table(head, lines, words=0)


def scenarios(rows: Rows) -> str:
    """Link error of every policy in every motion and scenario."""
    return _link_errors(Cells(rows), ("uncompensated", "input", "dynamic", "oracle"))


def rivals(rows: Rows) -> str:
    """Link error of the policies that know or observe the friction."""
    return _link_errors(Cells(rows), _RIVALS)


def _link_errors(cells: Cells, policies: Sequence[str]) -> str:
    lines = []
    for reference in cells.names("reference"):
        for scenario in cells.names("scenario"):
            own = [_rms(cells, policy, reference, scenario) for policy in policies]
            if any(figure != _NOT_PLAYED for figure in own):
                lines.append([reference, f"`{scenario}`", *own])
    head = ["reference", "scenario", *(f"`{policy}`" for policy in policies)]
    return page_table(head, lines, words=2)


def _rms(cells: Cells, policy: str, reference: str, scenario: str) -> str:
    """Three digits."""
    if not cells.has(policy, reference, scenario):
        return _NOT_PLAYED
    row = cells.row(policy, reference, scenario)
    if failure_counts(row)[0]:
        return "{} of {} failed".format(*failure_counts(row))
    value = in_table_unit(row, ERROR)
    return f"{value:.{1 if value >= 9.995 else 2}f}"
