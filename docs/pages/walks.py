"""Tables of the walker's page, from the kept cells of comparisons."""

from collections.abc import Mapping, Sequence

from docs.pages.cells import (
    Cells,
    Rows,
    failure_counts,
    format_metrics,
    in_table_unit,
    minus,
    page_table,
)
from elastic_env.robots.thormang.tables import BLOCKS
from train.evaluate.changes import percent
from train.evaluate.margins import margin_table
from train.evaluate.standings import Standing

PELVIS = "pelvis_error_rms_rad"
ZMP = "zmp_deviation_rms_m"

_ROLL, _PITCH = (
    tuple(f"pelvis_{axis}_{kind}_rad" for kind in ("rms", "peak")) for axis in ("roll", "pitch")
)
_ZMPS = (ZMP, "zmp_deviation_x_rms_m", "zmp_deviation_y_rms_m")
_EARLY = "early_touchdown_mean_s"
_END = ("end_position_error_m", "end_heading_error_rad")
_FRAME = "frame_error_mean_m"
_JUMP = "com_jump_mean_m"
_LARGE = 19.95
"""From here on a figure has no decimal."""
_NEVER_SHOWN = ("zero", "uncompensated_open")
_FAST = ("uncompensated", "input_output", "input_wrench", "dynamic", "oracle")
_PUBLISHED = ("uncompensated", "talos", "thormang")
_MIXTURE = ("nominal", "soft", "spread", "payload", "sensor")


def margins(rows: Rows) -> str:
    """Worst and median edge of every policy and quantity."""
    return page_table(*margin_table(rows))


def twenty_steps(rows: Rows) -> str:
    """Pelvis error and ZMP deviation over all, the first four and the last four steps."""
    cells = Cells(rows)
    places = [
        (reference, scenario, policy)
        for reference in cells.names("reference")
        for scenario in cells.names("scenario")
        for policy in cells.names("policy")
        if cells.has(policy, reference, scenario)
    ]
    spans = [(PELVIS, ZMP)]
    spans += [(f"pelvis_error_{b}_rms_rad", f"zmp_deviation_{b}_rms_m") for b in BLOCKS]
    lines = []
    for reference, scenario, policy in places:
        row = cells.row(policy, reference, scenario)
        fell, episodes = failure_counts(row)
        lines.append(
            [
                reference.removesuffix(" num_steps=20"),
                f"`{scenario}`",
                _robot(policy),
                *(format_metrics(row, span, 2) for span in spans),
                format_metrics(row, ["foot_drift_end_m"], 1),
                f"{fell}/{episodes}",
            ]
        )
    blocks = ["all 20 steps", "steps 1 to 4", "steps 17 to 20"]
    head = ["step", "scenario", "policy", *blocks, "drift at the end", "falls"]
    return page_table(head, lines, words=3)


def last_steps(*tables: Rows) -> str:
    """Pelvis error and ZMP deviation of residuals over the first and the last four steps.

    Args:
        tables: Kept rows of a comparison each.
    """
    first, last = ((f"pelvis_error_{b}_rms_rad", f"zmp_deviation_{b}_rms_m") for b in BLOCKS)
    lines = []
    for rows in tables:
        cells = Cells(rows)
        (reference,) = cells.names("reference")
        for scenario in cells.names("scenario"):
            own, base = (cells.row(name, reference, scenario) for name in ("residual", "foothold"))
            changes = (
                in_table_unit(own, b) / in_table_unit(own, a) - 1.0
                for a, b in zip(first, last, strict=True)
            )
            lines.append(
                [
                    reference.removesuffix(" num_steps=20"),
                    f"`{scenario}`",
                    format_metrics(own, first, 2),
                    format_metrics(own, last, 2),
                    " / ".join(percent(change) for change in changes),
                    format_metrics(base, last, 2),
                ]
            )
    head = ["step", "scenario", "steps 1 to 4", "17 to 20", "change", "`foothold`, 17 to 20"]
    return page_table(head, lines, words=2)


def forty_steps(rows: Rows) -> str:
    """Errors of the walk, and of place and heading at its end, of every policy."""
    cells = Cells(rows)
    lines = []
    for reference in cells.names("reference"):
        walk = "full turn" if "turn_rad" in reference else "forward"
        for scenario in cells.names("scenario"):
            for policy in cells.names("policy"):
                row = cells.row(policy, reference, scenario)
                fell, episodes = failure_counts(row)
                lines.append(
                    [
                        walk,
                        f"`{scenario}`",
                        _robot(policy),
                        format_metrics(row, [PELVIS], 1),
                        *(format_metrics(row, [metric], 0) for metric in (ZMP, *_END)),
                        f"{fell}/{episodes}",
                    ]
                )
    head = ["walk", "scenario", "policy", "pelvis", "ZMP", "place", "heading", "falls"]
    return page_table(head, lines, words=3)


def all_scenarios(rows: Rows) -> str:
    """Pelvis error and ZMP deviation of every policy in every scenario, a table per step period."""
    cells = Cells(rows)
    policies = [policy for policy in cells.names("policy") if policy not in _NEVER_SHOWN]
    tables = []
    for reference in cells.names("reference"):
        lines = [
            [
                f"`{scenario}`",
                *(_walk(cells.row(policy, reference, scenario)) for policy in policies),
            ]
            for scenario in cells.names("scenario")
        ]
        head = [reference, *(f"`{policy}`" for policy in policies)]
        tables.append(page_table(head, lines))
    return "\n".join(tables)


def _walk(row: Mapping[str, str]) -> str:
    fell, episodes = failure_counts(row)
    if fell == episodes:
        return "fell"
    text = f"{in_table_unit(row, PELVIS):.1f}, {in_table_unit(row, ZMP):.0f}"
    return f"{text} ({fell}/{episodes} fell)" if fell else text


def paper_walks(rows: Rows, others: Rows) -> str:
    """Roll, pitch, ZMP deviation and early touch-down of every baseline in the gaits of the
    paper and faster.
    """
    cells = Cells(rows)
    fast = Cells(others)
    places = [
        (cells, policy, reference, scenario)
        for reference in cells.names("reference")
        for scenario in cells.names("scenario")
        for policy in cells.names("policy")
        if cells.has(policy, reference, scenario)
    ]
    places += [
        (fast, policy, reference, "ideal") for reference in ("1.6 s", "1.1 s") for policy in _FAST
    ]
    lines = [
        [
            reference,
            f"`{scenario}`",
            _robot(policy),
            *_paper_walk(own.row(policy, reference, scenario)),
        ]
        for own, policy, reference, scenario in places
    ]
    head = ["step", "scenario", "policy", "roll", "pitch", "ZMP", "early"]
    return page_table(head, lines, words=3)


def _robot(policy: str) -> str:
    return "rigid robot, `zero`" if policy == "rigid" else f"`{policy}`"


def _paper_walk(row: Mapping[str, str]) -> list[str]:
    fell, episodes = failure_counts(row)
    if fell == episodes:
        return [f"{fell} of {episodes} fell" if episodes > 1 else "fell", *["–"] * 3]
    angles = (
        f"{in_table_unit(row, rms):.2f} / {in_table_unit(row, peak):.1f}"
        for rms, peak in (_ROLL, _PITCH)
    )
    return [*angles, format_metrics(row, _ZMPS, 1, ", "), format_metrics(row, [_EARLY], 0)]


def local_frame(rows: Rows) -> str:
    """Error of the local frame, and jump of the estimated center of mass, at the support
    changes.
    """
    cells = Cells(rows)
    lines = []
    references = cells.names("reference")
    for policy in cells.names("policy"):
        found = [cells.row(policy, reference, "nominal") for reference in references]
        if all(row[_FRAME] for row in found) and not policy.endswith("_open"):
            lines.append(
                [
                    f"`{policy}`",
                    *(format_metrics(row, [m], 1) for m in (_FRAME, _JUMP) for row in found),
                ]
            )
    head = ["", *(f"{what}, {reference}" for what in ("e", "jump") for reference in references)]
    return page_table(head, lines)


def sensitivity(rows: Rows) -> str:
    """Effects of changes of robot, gait or controller on the walk, with and without
    compensation.
    """
    cells = Cells(rows)
    changes = list(dict.fromkeys(policy.partition(": ")[2] for policy in cells.names("policy")))
    columns = [
        (policy, scenario)
        for scenario in cells.names("scenario")
        for policy in ("uncompensated", "input_output")
    ]
    lines = []
    for change in changes:
        places = [(f"{policy}: {change}", "3 s", scenario) for policy, scenario in columns]
        lines.append(
            [change, *(_sway(cells.row(*place)) if cells.has(*place) else "–" for place in places)]
        )
    head = ["", *(f"`{policy}`, `{scenario}`" for policy, scenario in columns)]
    return page_table(head, lines)


def _sway(row: Mapping[str, str]) -> str:
    """Roll rms / peak, pitch peak, lateral ZMP deviation rms."""
    if failure_counts(row)[0]:
        return "fell"
    peaks = (in_table_unit(row, metric) for metric in (_ROLL[1], _PITCH[1], _ZMPS[2]))
    return f"{in_table_unit(row, _ROLL[0]):.1f} / " + ", ".join(
        f"{peak:.{0 if peak >= _LARGE else 1}f}" for peak in peaks
    )


def gravity_torques(rows: Rows) -> str:
    """Gravity torque of the stance leg by each reading of Eq. 4."""
    meaning = {
        "com": "contact at the ZMP, all links weigh",
        "ankle": "contact at the ankle axis",
        "lumped": "and the legs weigh nothing, as in published code",
    }
    joints = ("hip_roll", "ankle_roll", "knee")
    lines = []
    for row in rows:
        own = (
            [float(row[f"{place}_{joint}_nm"]) for joint in joints] for place in ("ankle", "inward")
        )
        torques = (
            " / ".join(minus(f"{torque:.1f}").replace("−0.0", "0.0") for torque in leg)
            for leg in own
        )
        lines.append([f"`{row['method']}`: {meaning[row['method']]}", *torques])
    head = ["", "ZMP under the ankle: hip roll / ankle roll / knee", "ZMP 0.02 m inward"]
    return page_table(head, lines)


def drawn_robots(rows: Rows) -> str:
    """Mean, interquartile mean and worst tenth over drawn robots."""
    found: dict[tuple[str, str], dict[str, Mapping[str, str]]] = {}
    for row in rows:
        found.setdefault((row["scenario"], row["policy"]), {})[row["metric"]] = row
    lines = [
        [
            f"`{scenario}`",
            policy if " " in policy else f"`{policy}`",
            *(
                " / ".join(
                    f"{1e3 * float(own[metric][name]):.1f}"
                    for name in ("mean", "interquartile_mean", "worst_tenth")
                )
                for metric in (PELVIS, ZMP)
            ),
            own[PELVIS]["failed"],
            own[PELVIS]["episodes"],
        ]
        for (scenario, policy), own in sorted(found.items(), key=lambda item: item[0][0])
    ]
    head = ["scenario", "policy", "pelvis error", "ZMP deviation", "falls", "robots"]
    return page_table(head, lines, words=2)


def imu_errors(rows: Rows) -> str:
    """Pelvis error, ZMP deviation and error of the IMU without and with the errors of the
    device.
    """
    cells = Cells(rows)
    metrics = (PELVIS, ZMP, "imu_error_rms_rad")
    lines = []
    for policy in cells.names("policy"):
        own = [cells.row(policy, "3 s", scenario) for scenario in ("nominal", "imu")]
        lines.append(
            [
                f"`{policy}`",
                *(format_metrics(row, metrics, 2) for row in own),
                str(sum(failure_counts(row)[0] for row in own)),
            ]
        )
    head = ["policy", "`nominal`: pelvis / ZMP / IMU", "`imu`: pelvis / ZMP / IMU", "falls"]
    return page_table(head, lines)


def published_controllers(standings: Sequence[Standing]) -> str:
    """Controllers that two teams published for their robots, beside no compensation."""
    found = {(s.policy, s.scope, s.metric): s for s in standings if s.reference == "3 s"}
    lines = [
        [
            f"`{policy}`",
            *(
                _mean([found[policy, scope, metric] for metric in (PELVIS, ZMP)])
                for scope in _MIXTURE
            ),
        ]
        for policy in _PUBLISHED
    ]
    head = ["policy", *(f"`{scope}`" for scope in _MIXTURE)]
    return page_table(head, lines)


def learned_in_ten_walks(standings: Sequence[Standing]) -> str:
    """Scores of `iterative` on each robot, beside its base."""
    found = {
        (s.policy, s.scope, s.metric): s
        for s in standings
        if s.reference == "3 s" and not s.is_group
    }
    scopes = [scope for policy, scope, metric in found if (policy, metric) == ("iterative", PELVIS)]
    lines = [
        [
            f"`{scope}`",
            *(
                _mean([found[policy, scope, metric] for metric in (PELVIS, ZMP)], 2)
                for policy in ("adaptive_posture", "iterative")
            ),
        ]
        for scope in scopes
    ]
    return page_table(["scenario", "without learning", "after ten walks"], lines)


def _mean(pair: Sequence[Standing], decimals: int = 1) -> str:
    """Pelvis error in mrad with some decimals, and ZMP deviation in mm."""
    pelvis, zmp = pair
    if pelvis.failed == pelvis.episodes:
        return "all fall"
    return f"{1e3 * pelvis.score.value:.{decimals}f} / {1e3 * zmp.score.value:.1f}"
