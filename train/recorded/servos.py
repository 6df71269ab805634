"""Figures from logs of two small servos with a pendulum, recorded by others.

A Dynamixel XL330-M288 (0.49 kg at 0.1 m, four values of its gain register) and a Feetech STS3250
(1.13 kg at 0.12 m), from the public repository Rhoban/bam. Each kind of motion is left out in turn
and replayed by a fit to the others.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.servo_fit import ServoFit, fit_servo
from baselines.identification.servo_holdout import PREDICTIONS, ServoHoldout, judge_servo
from baselines.identification.servo_log import ServoLog, read_servo_log
from baselines.identification.servo_result import describe_servo
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.json_text import parse_json
from train.figures.servo_plots import draw_servo

XL330_LEFT_OUT = (("sin_time_square", "lift_and_drop"), ("up_and_down",), ("sin_sin",))
"""Motions of the XL330 that are left out together; the first are those of the source's figures."""
STS3250_LEFT_OUT = (("up_and_down",), ("sin_sin",), ("lift_and_drop",), ("sin_time_square",))
"""Motions of the STS3250 that are left out in turn; the last is faster than those that are left."""
FURTHER_SEEDS = (1, 2, 3)
"""Seeds of further starts of the first fit of the XL330."""
_LARGEST_JSON = 20_000_000


@dataclass(frozen=True)
class RecordedLog:
    """A log with the servo and the motion that its file names."""

    motor: str
    trajectory: str
    log: ServoLog


def servo_figures(
    files: Sequence[Path],
    pictures: Path | None = None,
    say: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """All figures of the two servos.

    Args:
        files: Logs of both servos in JSON.
        pictures: Folder for a picture of each servo's replay; None for none.
        say: Called with what is being done.

    Returns:
        For `xl330` and `sts3250`: `held_out`, a list with one `ServoHoldout` for each group of
        motions that was left out; `sag`, for each gain the error in slow motion over all groups
        [mrad]; and `identified`, the parameters from all logs. For `xl330` also `without_priors`
        and `other_starts`, the first of `held_out` by fits without priors and from other starts.

    Raises:
        ConfigurationError: A servo has no log.
    """
    tell = say or (lambda text: None)  # noqa: ARG005
    recorded = read_recordings(files)
    figures = {}
    for motor, groups in (("xl330", XL330_LEFT_OUT), ("sts3250", STS3250_LEFT_OUT)):
        own = [one for one in recorded if one.motor == motor]
        if not own:
            raise ConfigurationError(f"there is no log of the {motor} among {len(files)} files")
        held_out = []
        for number, group in enumerate(groups):
            tell(f"{motor}: fit without {', '.join(group)}")
            outer = [one.log for one in own if one.trajectory in group]
            fit = fit_servo([one.log for one in own if one.trajectory not in group])
            held_out.append(judge_servo(fit, outer))
            if number == 0 and pictures is not None:
                played = [fit.replay(log) for log in outer]
                draw_servo(outer, played, pictures / f"{motor}.png", is_held_out=True)
        tell(f"{motor}: fit to all")
        all_logs = fit_servo([one.log for one in own])
        figures[motor] = _described(all_logs, groups, held_out)
        if motor == "xl330":
            figures[motor] |= _varied(own, tell)
    return figures


def _varied(logs: Sequence[RecordedLog], tell: Callable[[str], None]) -> dict[str, Any]:
    """The first motions that are left out, by fits without priors and from other starts."""
    group = XL330_LEFT_OUT[0]
    outer = [one.log for one in logs if one.trajectory in group]
    inner = [one.log for one in logs if one.trajectory not in group]
    tell("xl330: fit without priors")
    figures: dict[str, Any] = {
        "without_priors": judge_servo(fit_servo(inner, priors=False), outer).model_dump(mode="json")
    }
    figures["other_starts"] = []
    for seed in FURTHER_SEEDS:
        tell(f"xl330: fit from other starts, seed {seed}")
        judged = judge_servo(fit_servo(inner, seed=seed), outer)
        figures["other_starts"].append(judged.model_dump(mode="json"))
    return figures


def read_recordings(files: Sequence[Path]) -> list[RecordedLog]:
    """Logs by gain and name.

    Raises:
        ConfigurationError: One cannot be read.
    """
    found = []
    for path in files:
        log = read_servo_log(path)
        facts: Mapping[str, Any] = parse_json(path.read_text(encoding="utf-8"), most=_LARGEST_JSON)
        found.append(RecordedLog(str(facts["motor"]), str(facts["trajectory"]), log))
    return sorted(found, key=lambda one: (one.log.gain, one.log.name))


def num_fits() -> int:
    """How often `servo_figures` says what is being done."""
    return len(XL330_LEFT_OUT) + len(STS3250_LEFT_OUT) + 2 + 1 + len(FURTHER_SEEDS)


def servo_rows(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The errors as a table, `recorded_servos.csv`: replays of motions, and slow motion by gain.

    Rivals and `replay_mrad` are judged over the same rows, those with the torque on.
    `replay_all_mrad` adds the rows with the torque off; slow motion has none.
    """
    rows = []
    for motor, figure in figures.items():
        replays = [("replay", part) for part in figure["held_out"]]
        first = {"motions": figure["held_out"][0]["motions"]}
        if "without_priors" in figure:
            replays.append(("replay without priors", {**figure["without_priors"], **first}))
        replays += [
            ("replay from other starts", {**part, **first})
            for part in figure.get("other_starts", ())
        ]
        for measure, part in replays:
            errors = dict(
                zip(_COLUMNS, (error["rms_mrad"] for error in part["errors"]), strict=True)
            )
            of = ", ".join(part["motions"])
            row = {"servo": motor, "measure": measure, "of": of, **errors}
            rows.append({**row, "replay_all_mrad": part["replay_mrad"]})
        for gain in figure["sag"]:
            errors = dict(zip(_COLUMNS, (gain[name] for name in PREDICTIONS), strict=True))
            rows.append({"servo": motor, "measure": "slow", "of": f"{gain['gain']:g}", **errors})
    return rows


_COLUMNS = ("goal_mrad", "offset_mrad", "line_mrad", "replay_mrad")


def sag_by_gain(held_out: Sequence[ServoHoldout]) -> list[dict[str, float]]:
    """Errors in slow motion of all predictions, over all logs of a gain [mrad]."""
    logs = [log for part in held_out for log in part.logs if log.slow_mrad is not None]
    table = []
    for gain in sorted({log.gain for log in logs}):
        own = [log for log in logs if log.gain == gain]
        rows = np.array([log.slow_rows for log in own])
        errors = np.array([log.slow_mrad for log in own])
        mean = np.sqrt(rows @ errors**2 / rows.sum())
        table.append(
            {
                "gain": gain,
                "rows": float(rows.sum()),
                **dict(zip(PREDICTIONS, map(float, mean), strict=True)),
            }
        )
    return table


def _described(
    fit: ServoFit, groups: Sequence[Sequence[str]], held_out: Sequence[ServoHoldout]
) -> dict[str, Any]:
    return {
        "held_out": [
            {"motions": list(group), **part.model_dump(mode="json")}
            for group, part in zip(groups, held_out, strict=True)
        ],
        "sag": sag_by_gain(held_out),
        "identified": describe_servo(fit).model_dump(mode="json"),
    }
