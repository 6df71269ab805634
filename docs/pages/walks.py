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
from elastic_env.robots.thormang.walk_signals import BLOCKS
from train.evaluate.leaderboard_rows import Standing
from train.evaluate.margin_search import margin_table

PELVIS = "pelvis_error_rms_rad"
ZMP = "zmp_deviation_rms_m"

_ROLL, _PITCH = (
    tuple(f"pelvis_{axis}_{kind}_rad" for kind in ("rms", "peak")) for axis in ("roll", "pitch")
)
_LATERAL = "zmp_deviation_y_rms_m"
_END = ("end_position_error_m", "end_heading_error_rad")
_METHOD = ("uncompensated", "input", "input_output", "dynamic")
"""The paper's method by halves, and the full torque."""
_JUDGED = ("uncompensated", "input_output", "dynamic", "oracle")
_DRAWN = ("input_output", "adaptive_posture", "foothold", "residual of 3 s")
"""Policies that are judged in all scenarios, and on drawn robots."""
_LONG_WALKERS = ("input_output", "adaptive_posture", "foothold")
"""Policies whose walks of twenty steps are shown; `last_steps` shows those of residuals."""
_LONG = ("nominal", "drawn")
"""Scenarios of walks of twenty steps."""
_LEARNED = ("nominal", "soft", "spread", "payload", "sensor", "push", "slope", "imu", "drawn")
"""Scenarios in which a robot learns from walk to walk."""
_NEAR_NOMINAL = ("ideal", "backlash", "sensor")
"""Scenarios near `nominal`, which the CSV has."""
_LIKE = ("D = 5 N·m·s/rad", "D = 20 N·m·s/rad", "Eq. 4 ankle")
"""Changes that change little, which the CSV has."""
_FAR = ("nominal", "soft")
"""Scenarios of walks of forty steps."""


def margins(rows: Rows) -> str:
    """Worst and median edge of every policy and quantity."""
    return page_table(*margin_table(rows))


def twenty_steps(rows: Rows) -> str:
    """Pelvis error and ZMP deviation over the first and the last four steps at 3 s."""
    cells = Cells(rows)
    reference = "3 s num_steps=20"
    spans = [(f"pelvis_error_{b}_rms_rad", f"zmp_deviation_{b}_rms_m") for b in BLOCKS]
    lines = []
    for scenario in _LONG:
        for policy in _LONG_WALKERS:
            row = cells.row(policy, reference, scenario)
            blocks = (format_metrics(row, span, 1) for span in spans)
            drift = format_metrics(row, ["foot_drift_end_m"], 0)
            lines.append([f"`{scenario}`", _robot(policy), *blocks, drift])
    head = ["scenario", "policy", "steps 1 to 4", "steps 17 to 20", "drift at the end"]
    return page_table(head, lines, words=2)


def walks_in_short(rows: Rows) -> str:
    """Pelvis error and ZMP deviation of some policies over twenty steps of 3 s."""
    cells = Cells(rows)
    reference = "3 s num_steps=20"
    lines = [
        [
            f"`{name}`",
            *(format_metrics(cells.row(name, reference, s), (PELVIS, ZMP), 1) for s in _SHORT),
        ]
        for name in ("input_output", "adaptive_posture", "foothold", "phase_table")
    ]
    return page_table(["policy", *(f"`{scenario}`" for scenario in _SHORT)], lines)


_SHORT = ("nominal", "payload", "drawn")
_LAST_SHOWN = ("nominal", "soft", "drawn")


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
        for scenario in _LAST_SHOWN:
            own, base = (cells.row(name, reference, scenario) for name in ("residual", "foothold"))
            lines.append(
                [
                    reference.removesuffix(" num_steps=20"),
                    f"`{scenario}`",
                    format_metrics(own, first, 2),
                    format_metrics(own, last, 2),
                    format_metrics(base, last, 2),
                ]
            )
    head = ["step", "scenario", "steps 1 to 4", "17 to 20", "`foothold`, 17 to 20"]
    return page_table(head, lines, words=2)


def forty_steps(rows: Rows) -> str:
    """Errors of the walk of `foothold`, and of place and heading at its end."""
    cells = Cells(rows)
    lines = []
    for reference in cells.names("reference"):
        walk = "full turn" if "turn_rad" in reference else "forward"
        for scenario in _FAR:
            row = cells.row("foothold", reference, scenario)
            pelvis = format_metrics(row, [PELVIS], 1)
            others = (format_metrics(row, [metric], 0) for metric in (ZMP, *_END))
            lines.append([f"{walk}, `{scenario}`", pelvis, *others])
    head = ["`foothold`", "pelvis [mrad]", "ZMP [mm]", "place [mm]", "heading [mrad]"]
    return page_table(head, lines)


def all_scenarios(rows: Rows) -> str:
    """Pelvis error and ZMP deviation in every scenario at 3 s."""
    cells = Cells(rows)
    lines = [
        [f"`{scenario}`", *(_walk(cells.row(policy, "3 s", scenario)) for policy in _JUDGED)]
        for scenario in cells.names("scenario")
        if scenario not in _NEAR_NOMINAL
    ]
    return page_table(["scenario", *(f"`{policy}`" for policy in _JUDGED)], lines)


def _walk(row: Mapping[str, str]) -> str:
    fell, episodes = failure_counts(row)
    if fell == episodes:
        return "fell"
    text = f"{in_table_unit(row, PELVIS):.1f} / {in_table_unit(row, ZMP):.0f}"
    return f"{text} ({fell}/{episodes} fell)" if fell else text


def paper_walks(rows: Rows) -> str:
    """Roll, pitch and ZMP deviation in the gaits of the paper."""
    cells = Cells(rows)
    lines = [
        [reference, _robot(policy), *_paper_walk(cells.row(policy, reference, "nominal"))]
        for reference in ("24 s", "3 s")
        for policy in _METHOD
    ]
    return page_table(["walk", "policy", "roll", "pitch", "ZMP"], lines, words=2)


def _robot(policy: str) -> str:
    return policy if " " in policy else f"`{policy}`"


def _paper_walk(row: Mapping[str, str]) -> list[str]:
    fell, episodes = failure_counts(row)
    if fell == episodes:
        return [f"{fell} of {episodes} fell" if episodes > 1 else "fell", *["–"] * 2]
    angles = (format_metrics(row, axis, 1) for axis in (_ROLL, _PITCH))
    return [*angles, format_metrics(row, [ZMP], 1)]


def sensitivity(rows: Rows) -> str:
    """Effects of changes of robot, gait or controller on the compensated walk in `nominal`."""
    cells = Cells(rows)
    policies = [
        policy
        for policy in cells.names("policy")
        if policy.startswith("input_output: ") and policy.split(": ")[1] not in _LIKE
    ]
    lines = [
        [policy.partition(": ")[2], *_sway(cells.row(policy, "3 s", "nominal"))]
        for policy in policies
    ]
    return page_table(["", "roll rms", "pitch peak", "lateral ZMP"], lines)


def _sway(row: Mapping[str, str]) -> list[str]:
    """Roll rms, pitch peak, lateral ZMP deviation rms."""
    if failure_counts(row)[0]:
        return ["fell", "–", "–"]
    return [format_metrics(row, [metric], 1) for metric in (_ROLL[0], _PITCH[1], _LATERAL)]


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
    """Mean and worst tenth over drawn robots."""
    found = {(row["policy"], row["scenario"], row["metric"]): row for row in rows}
    columns = [
        (scenario, metric, title)
        for scenario in ("drawn", "drawn_beyond")
        for metric, title in ((PELVIS, "pelvis"), (ZMP, "ZMP"))
    ]
    lines = []
    for policy in _DRAWN:
        own = (found[policy, scenario, metric] for scenario, metric, _ in columns)
        lines.append([_robot(policy), *map(_mean_and_worst, own)])
    return page_table(["", *(f"`{place}`: {title}" for place, _, title in columns)], lines)


def _mean_and_worst(row: Mapping[str, str]) -> str:
    return " / ".join(f"{1e3 * float(row[name]):.1f}" for name in ("mean", "worst_tenth"))


def learned_in_ten_walks(standings: Sequence[Standing]) -> str:
    """Scores of `iterative` on each robot, and of its base."""
    found = {
        (s.policy, s.scope, s.metric): s
        for s in standings
        if s.reference == "3 s" and not s.is_group
    }
    lines = [
        [
            f"`{scope}`",
            *(
                _mean([found[policy, scope, metric] for metric in (PELVIS, ZMP)], 2)
                for policy in ("adaptive_posture", "iterative")
            ),
        ]
        for scope in _LEARNED
    ]
    return page_table(["scenario", "`adaptive_posture`", "after ten walks"], lines)


def _mean(pair: Sequence[Standing], decimals: int = 1) -> str:
    """Pelvis error in mrad with some decimals, and ZMP deviation in mm."""
    pelvis, zmp = pair
    if pelvis.failed == pelvis.episodes:
        return "all fall"
    return f"{1e3 * pelvis.score.value:.{decimals}f} / {1e3 * zmp.score.value:.1f}"
