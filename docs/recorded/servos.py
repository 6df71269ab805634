"""Figures from logs of two small servos with a pendulum, recorded by others.

A Dynamixel XL330-M288 (0.49 kg at 0.1 m, four values of its gain register) and a Feetech STS3250
(1.13 kg at 0.12 m), from the public repository Rhoban/bam. Each kind of motion is left out in turn
and replayed by a fit to the others.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.servo_fit import fit_servo
from baselines.identification.servo_holdout import PREDICTIONS, ServoHoldout, judge_servo
from baselines.identification.servo_log import ServoLog, read_servo_log
from baselines.identification.servo_result import describe_servo
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.json_text import parse_json
from train.figures.identification_plots import draw_servo

LEFT_OUT = {
    "xl330": (("sin_time_square", "lift_and_drop"), ("up_and_down",), ("sin_sin",)),
    "sts3250": (("up_and_down",), ("sin_sin",), ("lift_and_drop",), ("sin_time_square",)),
}
"""Motions of each servo that are left out together, in turn. The first ones of the XL330 are those
of the source's figures. The last one of the STS3250 is faster than those that are left."""
FURTHER_SEEDS = (1, 2, 3)
"""Seeds of further starts of the first fit of the XL330."""
COLUMNS = ("goal_mrad", "offset_mrad", "line_mrad", "replay_mrad")
"""Errors of the rivals and of the replay in the table."""
_LARGEST_JSON = 20_000_000

Recordings = Sequence[tuple[str, ServoLog]]
"""Logs of a servo with their motions."""


def servo_figures(
    files: Sequence[Path],
    pictures: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
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
    recorded = read_recordings(files)
    figures = {}
    for motor, groups in LEFT_OUT.items():
        own = recorded.get(motor)
        if own is None:
            raise ConfigurationError(f"there is no log of the {motor} among {len(files)} files")
        held_out = []
        for group in groups:
            say(f"{motor}: fit without {', '.join(group)}")
            inner, outer = _split(own, group)
            fit = fit_servo(inner)
            held_out.append(judge_servo(fit, outer))
            if group == groups[0] and pictures is not None:
                played = [fit.replay(log) for log in outer]
                draw_servo(outer, played, pictures / f"{motor}.png", is_held_out=True)
        say(f"{motor}: fit to all")
        all_logs = fit_servo([log for _, log in own])
        figures[motor] = {
            "held_out": [
                {"motions": list(group), **part.model_dump(mode="json")}
                for group, part in zip(groups, held_out, strict=True)
            ],
            "sag": sag_by_gain(held_out),
            "identified": describe_servo(all_logs).model_dump(mode="json"),
        }
        if motor == "xl330":
            figures[motor] |= _varied(own, say)
    return figures


def _split(logs: Recordings, group: Sequence[str]) -> tuple[list[ServoLog], list[ServoLog]]:
    """Logs of other motions than those of a group, and of these."""
    inner = [log for motion, log in logs if motion not in group]
    return inner, [log for motion, log in logs if motion in group]


def _varied(logs: Recordings, say: Callable[[str], None]) -> dict[str, Any]:
    """The first motions that are left out, by fits without priors and from other starts."""
    inner, outer = _split(logs, LEFT_OUT["xl330"][0])

    def judged(what: str, **options: Any) -> dict[str, Any]:
        say(f"xl330: fit {what}")
        return judge_servo(fit_servo(inner, **options), outer).model_dump(mode="json")

    return {
        "without_priors": judged("without priors", priors=False),
        "other_starts": [
            judged(f"from other starts, seed {seed}", seed=seed) for seed in FURTHER_SEEDS
        ],
    }


def read_recordings(files: Sequence[Path]) -> dict[str, list[tuple[str, ServoLog]]]:
    """Motions and logs by servo, in the order of gain and name.

    Raises:
        ConfigurationError: One cannot be read.
    """
    found: dict[str, list[tuple[str, ServoLog]]] = {}
    for path in files:
        facts = parse_json(path.read_text(encoding="utf-8"), most=_LARGEST_JSON)
        log = read_servo_log(path)
        found.setdefault(str(facts["motor"]), []).append((str(facts["trajectory"]), log))
    for own in found.values():
        own.sort(key=lambda recording: (recording[1].gain, recording[1].name))
    return found


def num_fits() -> int:
    """How often `servo_figures` says what is being done."""
    return sum(len(groups) + 1 for groups in LEFT_OUT.values()) + 1 + len(FURTHER_SEEDS)


def servo_rows(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The errors as a table, `recorded_servos.csv`: replays of motions, and slow motion by gain.

    Rivals and `replay_mrad` are judged over the same rows, those with the torque on.
    `replay_all_mrad` adds the rows with the torque off; slow motion has none.
    """
    rows = []
    for motor, figure in figures.items():
        first = {"motions": figure["held_out"][0]["motions"]}
        others = [figure["without_priors"]] if "without_priors" in figure else []
        measures = {
            "replay": figure["held_out"],
            "replay without priors": [own | first for own in others],
            "replay from other starts": [own | first for own in figure.get("other_starts", ())],
        }
        for measure, parts in measures.items():
            for part in parts:
                row = {"servo": motor, "measure": measure, "of": ", ".join(part["motions"])}
                errors = [error["rms_mrad"] for error in part["errors"]]
                row |= zip(COLUMNS, errors, strict=True)
                rows.append({**row, "replay_all_mrad": part["replay_mrad"]})
        for gain in figure["sag"]:
            row = {"servo": motor, "measure": "slow", "of": f"{gain['gain']:g}"}
            row |= zip(COLUMNS, (gain[name] for name in PREDICTIONS), strict=True)
            rows.append(row)
    return rows


def sag_by_gain(held_out: Sequence[ServoHoldout]) -> list[dict[str, float]]:
    """Errors in slow motion of all predictions, over all logs of a gain [mrad]."""
    logs = [log for part in held_out for log in part.logs if log.slow_mrad is not None]
    table = []
    for gain in sorted({log.gain for log in logs}):
        own = [log for log in logs if log.gain == gain]
        rows = np.array([log.slow_rows for log in own])
        errors = np.array([log.slow_mrad for log in own])
        mean = np.sqrt(rows @ errors**2 / rows.sum())
        figures = dict(zip(PREDICTIONS, map(float, mean), strict=True))
        table.append({"gain": gain, "rows": float(rows.sum()), **figures})
    return table
