"""`elastic identify --log run.csv`: a servo from logs in time."""

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from rich import box
from rich.console import Console

from baselines.identification.servo_file import AngleUnit, is_servo_log
from baselines.identification.servo_fit import STAGES, fit_servo
from baselines.identification.servo_holdout import ServoHoldout, judge_servo, split_logs
from baselines.identification.servo_load import Load
from baselines.identification.servo_log import ServoLog, read_servo_log
from baselines.identification.servo_result import ServoIdentification, describe_servo
from elastic_env.core.config import Locator, Model, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.model_file import compiled_model
from train.figures import plots
from train.figures.plots import FigureFormat
from train.figures.servo_plots import draw_servo
from train.runs.console import make_table
from train.runs.folders import run_folder
from train.runs.progress import show_progress


class ServoOptions(Model):
    """Logs in time of one servo: its load, and what the logs do not say."""

    mass_kg: float | None = quantity("kg", None, gt=0)
    """Mass of a pendulum on the servo, whose logs have time, goal and position [kg]."""
    lever_m: float | None = quantity("m", None, gt=0)
    """Distance of its mass from the axis [m]."""
    gain: float | None = quantity("1", None, gt=0)
    """Value of the servo's gain register, where the logs do not say it [1]."""
    angles: AngleUnit | None = None
    """Unit of angles in the logs in time; default what they say, or radians."""
    unfitted: tuple[Locator, ...] = ()
    """Logs in time to replay without a fit; default a share of --log, by --holdout."""


def are_servo_logs(paths: Sequence[str]) -> bool:
    """True if the first of some files is a log in time."""
    return bool(paths) and is_servo_log(Path(paths[0]))


def identify_servo(
    options: ServoOptions,
    paths: Sequence[str],
    console: Console,
    *,
    robot: str | None = None,
    joint: str | None = None,
    holdout: float = 0.3,
    seed: int = 0,
    output: Path | None = None,
    figure_format: FigureFormat = "png",
) -> ServoIdentification:
    """Identify a servo, write files and picture, print tables.

    Args:
        options: Load, gain and units.
        paths: Logs of one servo.
        console: Where progress and tables go.
        robot: Model whose links load the joint; None for a pendulum or a known torque.
        joint: Name of the joint in model and files.
        holdout: Share of the logs that is replayed without a fit; 0 for none.
        seed: Seed of the draw of these logs.
        output: Folder for the results; default runs/identify, numbered if taken.
        figure_format: Of the picture.

    Raises:
        ConfigurationError: A log or an option cannot be used.
        ElasticError: The joint hardly moves.
    """
    plots.require_matplotlib()
    load = known_load(options, robot, joint)
    paths = fitted_logs(paths, options.unfitted, console)
    logs = [_read(options, path, load, joint) for path in paths]
    further = [_read(options, path, load, joint) for path in options.unfitted]
    _require_alike("supply voltage", [log.supply for log in (*logs, *further)])
    _require_alike("gain", [log.gain for log in (*logs, *further) if log.enabled.any()])
    inner, outer = (logs, further) if further or not holdout else split_logs(logs, holdout, seed)
    recorded = {**options.model_dump(mode="json"), "log": list(paths), "seed": seed}
    with run_folder("identify", recorded, seed, output) as folder:
        fits = 1 if inner is logs else 2
        with show_progress(console, {"fits, stages": fits * STAGES}, transient=True) as show:
            fit = fit_servo(inner, lambda done: show(0, done), seed)
            held_out = judge_servo(fit, outer) if outer else None
            shown = outer or logs
            played = [fit.replay(log) for log in shown]
            if inner is not logs:
                fit = fit_servo(logs, lambda done: show(0, STAGES + done), seed)
        result = describe_servo(fit, joint or "*", held_out)
        files = result.save(folder)
        picture = folder / f"identification.{figure_format}"
        files.append(draw_servo(shown, played, picture, is_held_out=bool(outer)))
    show_result(result, console)
    for path in files:
        console.print(f"wrote {path}", soft_wrap=True)
    return result


def known_load(options: ServoOptions, robot: str | None, joint: str | None) -> Load | None:
    """What hangs on the joint; None if the logs say it.

    Raises:
        ConfigurationError: Half a pendulum, a pendulum beside a robot, or a robot without a joint.
    """
    given = [options.mass_kg is not None, options.lever_m is not None]
    if any(given) and not all(given):
        raise ConfigurationError("a pendulum needs both --mass-kg and --lever-m")
    if robot is None:
        if options.mass_kg is None or options.lever_m is None:
            return None
        return Load.pendulum(options.mass_kg, options.lever_m)
    if any(given):
        raise ConfigurationError("give a pendulum by --mass-kg and --lever-m, or --robot, not both")
    if joint is None:
        raise ConfigurationError("say by --joints which joint of the robot the log is of")
    return Load.of_joint(compiled_model(robot), joint)


def show_result(result: ServoIdentification, console: Console) -> None:
    """Print held-out errors, parameters, and what the logs do not tell."""
    if result.held_out is not None:
        console.print(verdict(result.held_out), highlight=False)
        rows = [
            [error.name, f"{error.rms_mrad:.1f}", _number(error.slow_mrad, ".1f")]
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
    rows = [
        [
            f"k_p{_register(one.register_value)}{_volts(one.supply_v)}",
            f"{one.position_gain_nm_per_rad:.4g}",
            _width(one.half_width),
            "N·m/rad",
            "",
        ]
        for one in result.gains
    ]
    for one in result.parameters:
        if one.name != "position_gain" and one.value is not None:
            width = _width(one.half_width)
            name = one.name
            if name == "torque_limit" and result.supply_v is not None:
                name += f" at {result.supply_v:.4g} V"
            rows.append([name, f"{one.value:.4g}", width, one.unit, one.remark])
    title = f"servo from {len(result.logs)} logs, replayed within {result.rms_mrad:.1f} mrad rms"
    head = ["parameter", "value", "95 %", "unit", "follows from"]
    console.print(make_table(title, head, rows, box=box.SIMPLE))
    console.print("the logs do not tell:")
    for line in result.untold:
        console.print(f"  {line}", highlight=False)


def verdict(held_out: ServoHoldout) -> str:
    """Held-out errors in a sentence; a rival that is ahead comes first.

    A replay that goes wrong once the torque is off is named too.
    """
    own = held_out.errors[-1]
    rival = held_out.best_rival
    swing = ""
    if held_out.has_torque_off and held_out.replay_mrad > _MUCH_WORSE * rival.rms_mrad:
        swing = f"; with the torque off included the replay has {held_out.replay_mrad:.1f}"
    if own.rms_mrad < rival.rms_mrad:
        return (
            f"not fitted: the replay is {own.rms_mrad:.1f} mrad off, {rival.name}"
            f" {rival.rms_mrad:.1f}, the goal itself {held_out.errors[0].rms_mrad:.1f}{swing}"
        )
    return (
        f"{rival.name} is ahead: {rival.rms_mrad:.1f} mrad at logs that were not fitted, where the"
        f" replay has {own.rms_mrad:.1f}{swing}: use that, or log more motions"
    )


_MUCH_WORSE = 1.5


def fitted_logs(paths: Sequence[str], unfitted: Sequence[str], console: Console) -> list[str]:
    """Logs of `--log` that are fitted: those that `--unfitted` names too are left out, and named.

    Logs are the same by their path or by their content.

    Raises:
        ConfigurationError: An option names one twice, or nothing is left to fit.
    """
    logs, further = (_each_once(given) for given in (paths, unfitted))
    left_out = [path for path, keys in logs.items() if any(keys & own for own in further.values())]
    if len(left_out) == len(logs):
        raise ConfigurationError(
            f"--unfitted names all logs of --log, {', '.join(left_out)}: leave one to fit"
        )
    if left_out:
        console.print(f"not fitted, as --unfitted says: {', '.join(left_out)}", highlight=False)
    return [path for path in paths if path not in left_out]


def _each_once(paths: Sequence[str]) -> dict[str, set[Path | str]]:
    """Path and digest of each log.

    Raises:
        ConfigurationError: One is named twice.
    """
    seen: dict[str, set[Path | str]] = {}
    for path in paths:
        file = Path(path)
        keys: set[Path | str] = {file.resolve()}
        with suppress(OSError):  # the reader says why it cannot be read
            if file.is_file():
                with file.open("rb") as content:
                    keys.add(hashlib.file_digest(content, "sha256").hexdigest())
        for other, own in seen.items():
            if keys & own:
                raise ConfigurationError(f"{other} and {path} are the same log; name each once")
        seen[path] = keys
    return seen


def _read(options: ServoOptions, path: str, load: Load | None, joint: str | None) -> ServoLog:
    return read_servo_log(Path(path), load, options.gain, options.angles, joint)


def _require_alike(what: str, values: Sequence[float]) -> None:
    """Refuse logs of which only some say a value; it is 1 where they do not."""
    if len({value == 1.0 for value in values}) > 1:
        raise ConfigurationError(
            f"some logs say their {what} and some do not; give it in all or in none"
        )


def _register(value: float | None) -> str:
    return "" if value is None else f" at gain {value:g}"


def _volts(supply: float | None) -> str:
    return "" if supply is None else f", {supply:.4g} V"


def _width(half: float | None) -> str:
    return "–" if half is None else f"± {half:.2g}"


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)
