"""`elastic identify --log run.csv`: a servo from logs in time."""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from rich import box
from rich.console import Console

from baselines.identification.servo_fit import STAGES, fit_servo
from baselines.identification.servo_holdout import ServoHoldout, judge_servo, split_logs
from baselines.identification.servo_load import Load
from baselines.identification.servo_log import read_servo_log
from baselines.identification.servo_result import ServoIdentification, describe_servo
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.files import digest_of
from elastic_env.hardware.buses.servo_models import servo_models
from elastic_env.joint.model_file import compiled_model
from train.commands.held_out import number_or_dash
from train.commands.identify_options import (
    ArmOptions,
    GeometryOptions,
    IdentificationRun,
    ServoOptions,
)
from train.commands.options import given_options
from train.figures import plots
from train.figures.identification_plots import draw_servo
from train.runs.console import make_table
from train.runs.progress import show_progress


def identify_servo(
    options: ArmOptions, run: IdentificationRun, console: Console
) -> ServoIdentification:
    """Identify a servo from logs in time, write files and picture, print tables.

    Args:
        options: Logs of one servo, and its load: robot and joint, or a pendulum.
        run: Seed of the draw of logs that are not fitted, and folder of the results.
        console: Console for progress and tables.

    Raises:
        ConfigurationError: A log or an option cannot be used, or is for poses only.
        ElasticError: The joint hardly moves.
    """
    _require_no_poses(options)
    plots.require_matplotlib()
    servo = options.servo
    joint = options.joints[0] if options.joints else None
    load = known_load(servo, options.robot, joint)
    paths = fitted_logs(options.log, servo.unfitted, console)

    logs, unfitted = (
        [read_servo_log(Path(path), load, servo.gain, servo.angles, joint) for path in group]
        for group in (paths, servo.unfitted)
    )
    all_logs = [*logs, *unfitted]
    _require_all_or_none("supply voltage", [log.supply == 1.0 for log in all_logs])
    powered = [log for log in all_logs if log.enabled.any()]
    _require_all_or_none("gain", [log.gain is None for log in powered])
    inner = logs
    outer = unfitted
    if not unfitted and options.judged.holdout:
        inner, outer = split_logs(logs, options.judged.holdout, run.seed)
    with run.folder(options.model_dump(mode="json")) as folder:
        fits = 1 if inner is logs else 2
        with show_progress(console, {"fits, stages": fits * STAGES}, transient=True) as show:
            fit = fit_servo(inner, partial(show, 0), run.seed)
            held_out = judge_servo(fit, outer) if outer else None
            drawn = outer or logs
            replays = [fit.replay(log) for log in drawn]
            if inner is not logs:
                fit = fit_servo(logs, lambda done: show(0, STAGES + done), run.seed)
        result = describe_servo(fit, joint or "*", held_out)
        files = result.save(folder)
        picture = folder / f"identification.{run.figure_format}"
        files.append(draw_servo(drawn, replays, picture, is_held_out=bool(outer)))
    show_result(result, console)
    for path in files:
        console.print(f"wrote {path}")
    return result


def _require_no_poses(options: ArmOptions) -> None:
    """Refuse options that are for poses only, and several joints."""
    used = ("log", "robot", "joints", "servo", "markers", "judged")
    others = [name for name in ArmOptions.model_fields if name not in used]
    unused = given_options(options, others)
    if options.markers != GeometryOptions():
        unused.append("those of --geometry")
    unused += given_options(options.judged, ["folds"])
    if unused:
        raise ConfigurationError(
            f"{', '.join(unused)}: for poses only, and {options.log[0]} is a log in time; leave it"
            " out"
        )
    if len(options.joints) > 1:
        raise ConfigurationError(
            f"logs in time are of one joint, got --joints {' '.join(options.joints)}; name one"
        )


def known_load(options: ServoOptions, robot: str | None, joint: str | None) -> Load | None:
    """Load of the joint by the options; None if the logs contain it.

    Raises:
        ConfigurationError: Half a pendulum, a pendulum besides a robot, or a robot without a joint.

    Warns:
        UserWarning: No known servo holds the pendulum.
    """
    if (options.mass_kg is None) != (options.lever_m is None):
        raise ConfigurationError("a pendulum needs both --mass-kg and --lever-m")
    if robot is None:
        if options.mass_kg is None or options.lever_m is None:
            return None
        load = Load.pendulum(options.mass_kg, options.lever_m)
        _warn_of_weight(load)
        return load
    if options.mass_kg is not None:
        raise ConfigurationError("give a pendulum by --mass-kg and --lever-m, or --robot, not both")
    if joint is None:
        raise ConfigurationError("say by --joints which joint of the robot the log is of")
    return Load.from_model(compiled_model(robot), joint)


def _warn_of_weight(pendulum: Load) -> None:
    """Warn of a weight that no known servo holds, such as a mass in grams."""
    strongest = max(servo_models().values(), key=lambda servo: servo.largest_torque)
    if pendulum.torque > strongest.largest_torque:
        warnings.warn(
            f"the pendulum pulls with up to {pendulum.torque:.4g} N·m, and {strongest.name}, the"
            f" strongest known servo, gives {strongest.largest_torque:g} N·m; check --mass-kg [kg]"
            " and --lever-m [m]",
            stacklevel=3,
        )


def show_result(result: ServoIdentification, console: Console) -> None:
    """Print held-out errors, parameters, and what the logs do not determine."""
    if result.held_out is not None:
        console.print(verdict(result.held_out))
        rows = [
            [error.name, f"{error.rms_mrad:.1f}", number_or_dash(error.slow_mrad, ".1f")]
            for error in result.held_out.errors
        ]
        head = ["prediction", "torque on", "slow motion"]
        if result.held_out.has_torque_off:
            head.append("all rows, torque off included")
            rows = [[*row, "–"] for row in rows]
            rows[-1][-1] = f"{result.held_out.replay_mrad:.1f}"
        title = (
            f"error of the angle at {len(result.held_out.logs)} logs that were not fitted [mrad]"
        )
        console.print(make_table(title, head, rows, box=box.SIMPLE))
    rows = []
    for gain in result.gains:
        register = "" if gain.register_value is None else f" at gain {gain.register_value:g}"
        supply = "" if gain.supply_v is None else f", {gain.supply_v:.4g} V"
        value = f"{gain.position_gain_nm_per_rad:.4g}"
        width = _width(gain.half_width)
        rows.append([f"k_p{register}{supply}", value, width, "N·m/rad", ""])
    for parameter in result.parameters:
        if parameter.name != "position_gain" and parameter.value is not None:
            name = parameter.name
            if name == "torque_limit" and result.supply_v is not None:
                name += f" at {result.supply_v:.4g} V"
            width = _width(parameter.half_width)
            value = f"{parameter.value:.4g}"
            rows.append([name, value, width, parameter.unit, parameter.remark])
    error = f"{result.rms_mrad:.1f} mrad rms"
    title = f"servo from {len(result.logs)} logs, replayed within {error}"
    head = ["parameter", "value", "95 %", "unit", "follows from"]
    console.print(make_table(title, head, rows, box=box.SIMPLE))
    console.print("the logs do not tell:")
    for line in result.untold:
        console.print(f"  {line}")


def verdict(held_out: ServoHoldout) -> str:
    """Held-out errors in a sentence; a rival that is ahead comes first.

    A replay that is far worse with the torque off is named too.
    """
    identified = held_out.errors[-1]
    rival = held_out.best_rival
    swing = ""
    if held_out.has_torque_off and held_out.replay_mrad > _WORSE_RATIO * rival.rms_mrad:
        swing = f"; with the torque off included the replay has {held_out.replay_mrad:.1f}"
    if identified.rms_mrad < rival.rms_mrad:
        return (
            f"not fitted: the replay is {identified.rms_mrad:.1f} mrad off, {rival.name}"
            f" {rival.rms_mrad:.1f}, the goal itself {held_out.errors[0].rms_mrad:.1f}{swing}"
        )
    return (
        f"{rival.name} is ahead: {rival.rms_mrad:.1f} mrad at logs that were not fitted, where the"
        f" replay has {identified.rms_mrad:.1f}{swing}: use that, or log more motions"
    )


_WORSE_RATIO = 1.5
"""Error of the replay with the torque off over the best rival's, from which it is named."""


def fitted_logs(paths: Sequence[str], unfitted: Sequence[str], console: Console) -> list[str]:
    """Logs of `--log` to fit. Logs that `--unfitted` names too are left out, and printed.

    Two logs are the same if their paths or their contents are equal.

    Raises:
        ConfigurationError: An option names a log twice, or no log is left to fit.
    """
    logs, others = (_log_keys(group) for group in (paths, unfitted))
    excluded = set().union(*others.values())
    left_out = [path for path, keys in logs.items() if keys & excluded]
    if len(left_out) == len(logs):
        raise ConfigurationError(
            f"--unfitted names all logs of --log, {', '.join(left_out)}: leave one to fit"
        )
    if left_out:
        console.print(f"not fitted, as --unfitted says: {', '.join(left_out)}")
    return [path for path in paths if path not in left_out]


def _log_keys(paths: Sequence[str]) -> dict[str, set[Path | str]]:
    """Absolute path and digest of each log.

    Raises:
        ConfigurationError: A log is named twice.
    """
    keys_of: dict[str, set[Path | str]] = {}
    for path in paths:
        file = Path(path)
        keys: set[Path | str] = {file.resolve()}
        with suppress(OSError):  # the reader reports why it cannot be read
            if file.is_file():
                keys.add(digest_of(file))
        for other, other_keys in keys_of.items():
            if keys & other_keys:
                raise ConfigurationError(f"{other} and {path} are the same log; name each once")
        keys_of[path] = keys
    return keys_of


def _require_all_or_none(quantity: str, is_missing: Sequence[bool]) -> None:
    """Refuse logs of which only some contain a quantity."""
    if len(set(is_missing)) > 1:
        raise ConfigurationError(
            f"some logs say their {quantity} and some do not; give it in all or in none"
        )


def _width(half: float | None) -> str:
    return "–" if half is None else f"± {half:.2g}"
