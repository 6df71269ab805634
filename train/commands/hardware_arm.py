"""A live arm on the command line: what its commands share, from the check to the logs."""

import contextlib
import csv
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import mujoco
import numpy as np
import pandas as pd
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from baselines import PositionCompensator
from baselines.identification.servo_log import known_loads
from elastic_env.core.config import Locator, Model, load_yaml, quantity, read_mapping
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.hardware.arm_settings import ArmSettings, ServoMap
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.buses.servo_models import servo_models
from elastic_env.hardware.emulator.joints import EmulatedArm
from elastic_env.hardware.emulator.launch import EmulatorConfig
from elastic_env.hardware.emulator.virtual import VirtualBus
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live.arm import Arm, ArmState, Compensator, Weighed, weigh, wrong_sign
from elastic_env.hardware.live.consent import answers_yes, require_consent
from elastic_env.hardware.live.target_sources import Poses, Socket, Stream, Targets
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.checks import check_bus
from elastic_env.hardware.safety.supervised_bus import SupervisedBus
from elastic_env.hardware.settings import PATIENT_LIMITS
from elastic_env.joint.joint_settings import JointSettings
from elastic_env.joint.model_file import compiled_model
from elastic_env.joint.model_joints import held_positions
from elastic_env.joint.small_servos import SMALL_SERVOS
from elastic_env.rigid.tree.end_effector import EndEffector, outermost_body
from elastic_env.robots.robot.joints import STIFF_OVER_SERVO
from train.runs.console import can_redraw, make_table, print_files
from train.runs.folders import run_folder

_SHOWN_S = 0.5
_PLAIN_SHOWN_S = 5.0
"""Between two pictures of the live table: at a terminal, and where lines go into a file [s]."""
_RAMP_S = 1.0
_EMULATED = {"feetech": "STS3215", "dynamixel": "XM430-W350"}
_FAR_GAIN = 1.4
"""A gain that is so many times another one is worth a word."""
_OFF = 0.2
"""Share by which the load of a servo may differ from that of the model, beside friction."""
_COUNTS_PER_TURN = 4096
"""Of servos whose encoder nobody has said."""
_TOLD_NM = 0.05
"""Load by the model from which it tells the sign of a joint; less may be no load [N·m]."""
_LOGGED = ("target", "desired", "command", "theta", "link", "torque", "temperature")
_UNITS = {"torque": "N·m", "temperature": "°C"}
_MOST_ROWS = 200_000
_FEWEST_ROWS = 10
"""Of a log of which a servo can be identified."""
_MOST_OFFSET_RAD = 1.0
"""Largest `limit_rad`."""


class OnArm(Model):
    """Options of commands that move an arm."""

    robot: Locator
    """Rigid model of the arm, MJCF (.xml) or URDF (.urdf)."""
    mounting: Path
    """YAML file of ids, signs, zeros and limits, see docs/hardware.md."""
    port: str | None = None
    """Port of the servos, such as /dev/ttyACM0; default that of the mounting."""
    end_effector: str | None = None
    """Site or body whose way is told in questions; default the outermost body."""
    check: bool = True
    """Move every joint a little first, to check its sign and its load."""
    nudge_rad: float = quantity("rad", 0.08, ge=0.02, le=0.2)
    """How far, to either side; from a stop that is near, away by up to three times that [rad]."""
    dry_run: bool = False
    """Play against an emulated arm, in its own time, and tell the true error of its tip."""
    yes: bool = False
    """Begin to move without asking."""
    patient: bool = False
    """Bear ten missing replies in a row: for emulators, whose pseudo-terminals stall where the
    computer is busy."""
    output: Path | None = None
    """Folder for logs and configuration, new or empty; default runs/hardware, numbered if taken."""


class Plain:
    """Commands that are the targets."""

    def __init__(self, compensator: PositionCompensator) -> None:
        self.link_angle = compensator.link_angle

    def command(self, q_desired: Any, q_dot: Any = None, q_ddot: Any = None) -> Array:
        """The desired angles."""
        del q_dot, q_ddot
        return np.array(q_desired, dtype=np.float64)


class KnownArm:
    """What files say of an arm.

    Args:
        options: Its model and its mounting.
        joints: File of its joints; None for what is typical of the servos that the mounting names.
        limit_rad: Largest offset between command and target [rad].

    Raises:
        ConfigurationError: A file cannot be used.
    """

    def __init__(self, options: OnArm, joints: Path | None, limit_rad: float = 0.3) -> None:
        self.options = options
        self.model = compiled_model(options.robot)
        given = {"port": options.port} if options.port is not None else {}
        if options.dry_run:
            if options.port is not None:
                problem = "--dry-run plays against an emulated arm: leave --port out"
                raise ConfigurationError(problem)
            given = {"port": "emulated"}
        self.settings = load_yaml(options.mounting, ArmSettings, given)
        if options.patient:
            limits = self.settings.limits.replace(**PATIENT_LIMITS)
            self.settings = self.settings.replace(limits=limits)
        require_known_servos(self.settings, self.model)
        self.mapping: dict[str, Any] = (
            _typical(self.settings) if joints is None else dict(read_mapping(joints))
        )
        self.compensator = PositionCompensator.from_model(
            self.model,
            self.mapping if joints is None else joints,
            limit_rad=limit_rad,
            ramp_s=_RAMP_S,
            period_s=1.0 / self.settings.rate_hz,
        )
        self.joints = self.compensator.joints
        needed = self.compensator.needed
        if needed.max() > _MOST_OFFSET_RAD:
            raise ConfigurationError(
                f"joint {self.joints[needed.argmax()]!r} would give way by {needed.max():.3g} rad"
                f" under the weight, and at most {_MOST_OFFSET_RAD:g} rad can be compensated: give"
                " stiffness and position_gain in N·m/rad"
            )
        self.servos = self.settings.servos(self.joints)
        self.lowest = self.compensator.constants.lowest
        self.highest = self.compensator.constants.highest
        self.ranges = self.servos.servo_ranges(self.lowest, self.highest, self.settings.limits)
        self.links = self.compensator.constants.body
        tool = options.end_effector or outermost_body(self.model)
        held = held_positions(self.model, self.joints)
        self.tool = EndEffector(self.model, self.joints, tool, held)

    def tip_error(self, desired: Array, links: Array) -> float:
        """Distance of the tip at links from where desired angles put it, rms over rows [m]."""
        return float(np.sqrt(np.mean(self.tool.errors(desired, links)[0] ** 2)))

    @property
    def middle(self) -> Array:
        """Middles of the joints' ranges, (n,) [rad]; where one has none, zero."""
        ends = np.stack([self.lowest, self.highest])
        return np.where(np.isfinite(ends).all(axis=0), ends, 0.0).mean(axis=0)


def require_known_servos(settings: ArmSettings, model: mujoco.MjModel) -> None:
    """Refuse a mounting that names what nobody knows, before a port is opened.

    Raises:
        ConfigurationError: A joint that is not in the model, or an unknown servo.
    """
    names = [model.joint(j).name for j in range(model.njnt)]
    for name, place in settings.joints.items():
        if name not in names:
            raise ConfigurationError(
                f"the mounting names joint {name!r}, which the model does not have; it has"
                f" {', '.join(names)}"
            )
        if place.model is not None:
            _number(place.model)


def _typical(settings: ArmSettings) -> dict[str, Any]:
    """Names of the servos, which stand for what is typical of them.

    Raises:
        ConfigurationError: The mounting does not name one, or nobody knows it.
    """
    unknown = [name for name, own in settings.joints.items() if own.model not in SMALL_SERVOS]
    if unknown:
        raise ConfigurationError(
            f"the servo of joint {unknown[0]!r} is {settings.joints[unknown[0]].model}, of which"
            f" nothing is known; say its `model` in the mounting ({', '.join(SMALL_SERVOS)}), or"
            " give --joints"
        )
    return {name: own.model for name, own in settings.joints.items()}


MakeTargets = Callable[[Array], Targets]
"""Makes targets, given where the arm stands, (n,) [rad]."""


def move_arm(
    known: KnownArm, compensator: Compensator, make_targets: MakeTargets, console: Console
) -> tuple[Path, dict[int, ArmState]]:
    """Check an arm, let it follow targets, and write its logs.

    Args:
        known: The arm.
        compensator: Makes its commands.
        make_targets: Makes its targets.
        console: Where tables go.

    Returns:
        The folder of the logs, and the last state at each target by its number.

    Raises:
        HardwareError: Something of the arm is not as it must be; the message says what.
    """
    options = known.options
    recorded = options.model_dump(mode="json", exclude={"output"})
    with contextlib.ExitStack() as stack:
        pairs = zip(known.servos.ids, known.joints, strict=True)
        servos = ", ".join(f"{i} {name}" for i, name in pairs)
        console.print(f"{len(known.joints)} servos at {known.settings.port}: {servos}")
        truth = None
        if options.dry_run:
            bus = truth = stack.enter_context(VirtualBus(emulator_config(known)))
            if stiffen_joints(known):
                console.print(f"rigid joints are emulated with K = {STIFF_OVER_SERVO:g} k_p")
            _check_servos(known, bus.driver, console)
        else:
            bus = stack.enter_context(_real_bus(known, console))
        arm = Arm(bus, known.settings, known.servos, compensator, known.ranges)
        folder = stack.enter_context(run_folder("hardware", recorded, None, options.output))
        if truth is None:
            realtime.prefer_realtime(realtime.Priority.LOOP)
            stack.callback(realtime.give_up_realtime)
        start = arm.begin()
        if options.check:
            _check_joints(arm, known, console)
        arm.hold()
        targets = make_targets(start)
        stack.callback(targets.close)
        if isinstance(targets, Socket):
            console.print(f"listening at {targets.address[0]}:{targets.address[1]}")
        if truth is not None and isinstance(targets, Stream):
            truth.keep_pace()
        rests = _play(arm, targets, known, folder, console, truth)
    is_whole = isinstance(targets, Poses) and targets.number == len(targets.poses)
    if options.dry_run and is_whole and not isinstance(compensator, Plain):
        error = plain_error(known, make_targets)
        console.print(f"without compensation the tip would be off by {1e3 * error:.2f} mm")
    return folder, rests


def plain_error(known: KnownArm, make_targets: MakeTargets) -> float:
    """True error of an emulated arm's tip at its poses without compensation, rms [m]."""
    with VirtualBus(emulator_config(known)) as bus:
        arm = Arm(bus, known.settings, known.servos, Plain(known.compensator), known.ranges)
        targets = make_targets(arm.begin())
        ends: dict[int, tuple[Array, Array]] = {}
        for state in arm.play(targets):
            ends[targets.number] = (state.target, bus.links)
    desired, links = np.array(list(ends.values())).swapaxes(0, 1)
    return known.tip_error(desired, links)


def _real_bus(known: KnownArm, console: Console) -> SupervisedBus:
    """The servos at a port, which have been looked at, and may move."""
    settings = known.settings
    with BUSES[settings.protocol](settings.port, settings.baudrate) as driver:
        _check_servos(known, driver, console)
    if settings.confirm and not known.options.yes:
        require_consent(_question(known), settings.port)
    ports = {settings.port: known.servos.ids}
    return SupervisedBus(ports, settings.baudrate, settings.protocol)


def _play(
    arm: Arm,
    targets: Targets,
    known: KnownArm,
    folder: Path,
    console: Console,
    truth: VirtualBus | None,
) -> dict[int, ArmState]:
    """Follow the targets and go back; keep log and table, whatever ends the motion."""
    rests: dict[int, ArmState] = {}
    true_links: dict[int, Array] = {}
    is_interrupted = False
    path = folder / "log.csv"
    with path.open("w", newline="", encoding="utf-8") as file, _shown(console) as show:
        log = Log(file, known.joints)
        arm.resume()
        try:
            for state in arm.play(targets):
                log.write(state, targets.number)
                if np.isfinite(state.link).all():
                    rests[targets.number] = state
                    if truth is not None:
                        true_links[targets.number] = truth.links
                targets.tell(_told(state, known.joints))
                show(lambda now=state: live_table(now, known.joints, arm, targets))
            for state in arm.go(arm.start):
                log.write(state, targets.number)
        except KeyboardInterrupt:
            is_interrupted = True
            rests.pop(targets.number, None)  # on its way
            true_links.pop(targets.number, None)
            console.print("stopped; torque falls")
        finally:
            try:
                arm.close()  # before what takes its time
            finally:
                file.flush()
                files = [path, *write_servo_logs(path, known)]
    counts = arm.counts
    console.print(
        f"{counts.cycles} cycles at {arm.settings.rate_hz:g} Hz: {counts.late} late,"
        f" {counts.held} without all replies, {counts.limited} with a command that a limit changed"
    )
    if isinstance(targets, Poses) and rests:
        console.print(rest_table(list(rests.values()), known.joints))
        desired = np.array([state.target for state in rests.values()])
        links = {"estimated": np.array([state.link for state in rests.values()])}
        if true_links:
            links["true"] = np.array(list(true_links.values()))
        told = [f"{1e3 * known.tip_error(desired, q):.2f} mm {how}" for how, q in links.items()]
        console.print(f"tip from its poses, rms: {', '.join(told)}")
    print_files(folder, files, console)
    if is_interrupted and not isinstance(targets, Stream | Socket):
        raise KeyboardInterrupt
    return rests


def stiffen_joints(known: KnownArm) -> dict[str, Any]:
    """Rigid joints whose servo gives way, which are not simulated, made stiff, by name."""
    found: dict[str, Any] = {}
    for joint, own in known.compensator.settings.items():
        gain = own.servo.sagging_gain(joint)
        if own.is_rigid and np.isfinite(gain):
            found[joint] = own.replace(stiffness=STIFF_OVER_SERVO * gain).model_dump(
                exclude_defaults=True
            )
    return found


def emulator_config(known: KnownArm) -> EmulatorConfig:
    """The emulated arm of a dry run: the joints of the file on servos of the mounting."""
    names = [name for name in known.servos.models if name is not None]
    name = names[0] if names else _EMULATED[known.settings.protocol]
    arm = EmulatedArm(
        model=str(Path(known.options.robot).resolve()),
        joints={**known.mapping, **stiffen_joints(known)},
        order=known.joints,
        direction=tuple(int(sign) for sign in known.servos.direction),
        zero_rad=tuple(known.servos.zero.tolist()),
    )
    return EmulatorConfig(
        model_number=_number(name),
        ids=tuple(known.servos.ids),
        baudrate=known.settings.baudrate,
        arm=arm,
    )


def _number(name: str) -> int:
    """The model number of a named servo.

    Raises:
        ConfigurationError: There is no such servo.
    """
    by_name = {model.name: number for number, model in servo_models().items()}
    if name not in by_name:
        problem = f"no servo {name!r}, as the mounting has it"
        raise ConfigurationError(f"{problem}; choose from {', '.join(by_name)}")
    return by_name[name]


def _check_servos(known: KnownArm, bus: ServoBus, console: Console) -> None:
    """Look at all servos, nothing moves.

    Raises:
        HardwareError: A servo is another one than the mounting says, or may not move.
    """
    found = check_bus(bus, known.servos.ids)
    for servo_id, joint, wanted in zip(
        known.servos.ids, known.joints, known.servos.models, strict=True
    ):
        model = bus.models[servo_id]
        if wanted is not None and model.number != _number(wanted):
            raise HardwareError(
                f"joint {joint!r} has a {wanted} by the mounting, and servo {servo_id} at"
                f" {bus.name} is a {model.name}: correct its id or its model"
            )
    bad = [one for one in found if not one.is_good]
    if not bad:
        console.print(f"{len(found)} checks of the servos: all fine")
        return
    rows = [(one.what, one.value, one.cure) for one in bad]
    console.print(make_table("to mend", ["", "", "what to do"], rows, left=3))
    if vital := [one for one in bad if one.is_vital]:
        one = vital[0]
        raise HardwareError(f"nothing can move yet: {one.what} is {one.value}: {one.cure}")


def _check_joints(arm: Arm, known: KnownArm, console: Console) -> None:
    """Move every joint a little; its sign and load must be those of the model.

    Raises:
        HardwareError: A joint hardly moves, or its sign is wrong.
    """
    n = len(known.joints)
    console.print(f"moving each joint by ±{known.options.nudge_rad:g} rad")
    weighed: list[Weighed] = []
    for joint in range(n):
        weighed.append(weigh(arm, joint, known.options.nudge_rad))
        weighed_torque = abs(float(known.links.gravity_torque(arm.start)[joint]))
        if weighed_torque < _TOLD_NM:
            _ask(arm, known, joint, weighed[-1].first)
    arm.hold()  # while tables are drawn
    require_signs(known.servos, weighed, known.links.gravity_torque, known.compensator.settings)
    rows = []
    for joint, own in enumerate(weighed):
        name = known.joints[joint]
        load = float(known.links.gravity_torque(own.theta)[joint])
        gain = known.compensator.settings[name].servo.sagging_gain(name)
        is_far = max(own.gain / gain, gain / own.gain) > _FAR_GAIN if own.gain > 0.0 else False
        remark = "" if abs(load) >= _TOLD_NM else "light"
        if abs(own.torque - load) > _explained(known.compensator.settings[name], load, gain):
            remark = "load"
        if is_far:
            remark = "k_p"
        gains = ["-" if not math.isfinite(one) else f"{one:.3g}" for one in (own.gain, gain)]
        moved = f"{100.0 * own.moved:.0f} %"
        rows.append([name, moved, f"{own.torque:+.2f}", f"{load:+.2f}", *gains, remark])
    head = ["joint", "follows", "load [N·m]", "model", "k_p", "file", ""]
    console.print(make_table("each joint moved a little", head, rows))
    remarks = {row[-1] for row in rows}
    if "light" in remarks:
        console.print("light: its load does not tell the sign; see whether it turns as the model")
    if "load" in remarks:
        console.print(
            "load: the servo holds another torque than the model says; look at zero_rad, at the"
            " masses of the model, and at what the arm touches"
        )
    if "k_p" in remarks:
        console.print(
            "k_p: the servo gives way otherwise than the file of joints says [N·m/rad]; is that"
            " a register in place of N·m/rad? elastic identify --log finds it"
        )


def _hidden(joint: JointSettings, load: float) -> float:
    """Torque of a load that friction may hide [N·m]."""
    at_rest = (joint.coulomb_friction or 0.0) + joint.static_friction
    return at_rest + joint.load_friction * abs(load)


def _explained(joint: JointSettings, load: float, gain: float) -> float:
    """How far a right servo may seem to hold another torque than a load [N·m].

    Friction hides some, the masses are not exact, and a servo measures in counts of its encoder.
    """
    count_rad = 2.0 * math.pi / (joint.encoder_counts_per_turn or _COUNTS_PER_TURN)
    resolution = gain * count_rad if math.isfinite(gain) else 0.0
    return _hidden(joint, load) + _OFF * abs(load) + max(resolution, _TOLD_NM)


def require_signs(
    servos: ServoMap,
    weighed: Sequence[Weighed],
    torque: Callable[[Array], Array],
    settings: dict[str, JointSettings],
) -> None:
    """Refuse a direction that contradicts the loads.

    Args:
        servos: The servos of the joints.
        weighed: Each joint, moved a little.
        torque: Loads that the model says for angles, (n,) [rad] to (n,) [N·m].
        settings: Friction of the joints, by name.

    Raises:
        HardwareError: A direction is wrong.
    """
    theta = weighed[-1].theta
    known = torque(theta)
    held = np.array([own.torque for own in weighed])
    loads = zip(servos.joints, known.tolist(), strict=True)
    hidden = np.array([_hidden(settings[name], load) for name, load in loads])
    wrong = wrong_sign(held, theta, torque, hidden)
    if wrong is not None:
        name = servos.joints[wrong]
        raise HardwareError(
            f"joint {name!r} holds {held[wrong]:+.2f} N·m where the model says"
            f" {known[wrong]:+.2f}, and all loads fit if its sign is turned: write direction:"
            f" {-int(servos.direction[wrong])} for it in the mounting"
        )


def _ask(arm: Arm, known: KnownArm, joint: int, way: float) -> None:
    """Ask whether a joint first turned by a way as the model does, if somebody can see it."""
    if known.options.yes or known.options.dry_run or not sys.stdin.isatty():
        return
    moved = 1e3 * way * known.tool.jacobian(arm.start[None])[0][0, :, joint]
    name = known.joints[joint]
    x, y, z = moved
    arm.hold()
    saw = answers_yes(
        f"joint {name!r} was turned by {way:+g} rad, back and beyond; by the model the end went"
        f" first by x {x:+.0f}, y {y:+.0f}, z {z:+.0f} mm. Did it? Type the whole word yes: "
    )
    arm.resume()
    if not saw:
        raise HardwareError(
            f"joint {name!r} turns the other way: write direction:"
            f" {-int(arm.servos.direction[joint])} for it in the mounting"
        )


def _question(known: KnownArm) -> str:
    options = known.options
    nudges = f"move each joint by ±{options.nudge_rad:g} rad, away from a stop, then "
    return (
        f"The {len(known.joints)} servos at {known.settings.port} will"
        f" {nudges if options.check else ''}follow the targets"
        f" with up to {known.settings.speed_rad_s:g} rad/s. Is the way free, and the power switch"
        " in reach?"
    )


class Log:
    """Every cycle of a motion as a row of a CSV file.

    Args:
        file: Where it goes.
        joints: Names of the joints.
    """

    def __init__(self, file: TextIO, joints: Sequence[str]) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        columns = [
            f"{what}.{joint} [{_UNITS.get(what, 'rad')}]" for what in _LOGGED for joint in joints
        ]
        self._writer.writerow(["time [s]", *columns, "late [s]", "held [1]", "target [1]"])

    def write(self, state: ArmState, number: int) -> None:
        """One cycle."""
        values = np.concatenate([getattr(state, what) for what in _LOGGED])
        cells = [f"{value:.6g}" for value in values.tolist()]
        end = [f"{state.late_s:.6f}", int(state.is_held), number]
        self._writer.writerow([f"{state.time_s:.6f}", *cells, *end])


def write_servo_logs(log: Path, known: KnownArm) -> list[Path]:
    """A log of each servo for `elastic identify --log`: time, goal, position, and its load.

    Servos that no weight loads are left out: nothing tells their torque. Known is the torque of the
    weight and of the other joints' motion, by the model at the encoders' angles.
    """
    table = pd.read_csv(log, nrows=_MOST_ROWS)
    columns = [f"theta.{joint} [rad]" for joint in known.joints]
    theta = table[columns].to_numpy(dtype=np.float64)
    told = np.isfinite(theta).all(axis=1)
    if told.sum() < _FEWEST_ROWS:
        return []
    table = table.loc[told]
    angles = np.ascontiguousarray(theta[told])
    time_s = table["time [s]"].to_numpy()
    inertia, load = known_loads(known.links, time_s, angles)
    weight = known.links.gravity_torque(angles)
    files = []
    for column, joint in enumerate(known.joints):
        if np.abs(weight[:, column]).max() < _TOLD_NM:
            continue
        content = {
            "time [s]": time_s,
            "goal [rad]": table[f"command.{joint} [rad]"],
            "position [rad]": angles[:, column],
            "inertia [kg·m²]": inertia[column],
            f"tau_known.{joint} [N·m]": load[:, column],
        }
        files.append(log.with_name(f"servo_{joint}.csv"))
        pd.DataFrame(content).to_csv(files[-1], index=False, float_format="%.9g")
    return files


def rest_table(rests: Sequence[ArmState], joints: Sequence[str]) -> Table:
    """How far the links, as they are estimated, were from the poses in the end of each."""
    errors = 1e3 * np.array([state.link - state.target for state in rests])
    rms = np.sqrt(np.mean(errors**2, axis=0))
    most = np.abs(errors).max(axis=0)
    rows = [[name, f"{a:.1f}", f"{b:.1f}"] for name, a, b in zip(joints, rms, most, strict=True)]
    title = f"estimated link from its target at {len(errors)} poses [mrad]"
    return make_table(title, ["joint", "rms", "largest"], rows)


def live_table(state: ArmState, joints: Sequence[str], arm: Arm, targets: Targets) -> str:
    """What an arm does, a line for each joint."""
    width = max(map(len, joints))
    lines = [f"{'':{width}}   target     link  error   load  temp"]
    lines[0] += f"\n{'':{width}}      rad      rad   mrad    N·m    °C"
    for i, name in enumerate(joints):
        error = 1e3 * (state.link[i] - state.target[i])
        mark = " *" if state.is_limited[i] else ""
        lines.append(
            f"{name:{width}} {state.target[i]:+8.4f} {state.link[i]:+8.4f} {error:+6.0f}"
            f" {state.torque[i]:+6.2f} {state.temperature[i]:5.0f}{mark}"
        )
    counts = arm.counts
    lines.append(
        f"{state.time_s:.1f} s, target {targets.number}, {counts.cycles} cycles, {counts.late}"
        f" late, {counts.held} without all replies, {counts.limited} limited *"
        + (f", {targets.refused} lines refused" if targets.refused else "")
    )
    return "\n".join(lines)


@contextlib.contextmanager
def _shown(console: Console) -> Iterator[Callable[[Callable[[], str]], None]]:
    """Shows a text now and then: in place at a terminal, else below the last one."""
    is_redrawn = can_redraw(console)
    period_s = _SHOWN_S if is_redrawn else _PLAIN_SHOWN_S
    next_s = time.monotonic()
    live = Live(console=console, auto_refresh=False) if is_redrawn else None

    def show(text: Callable[[], str]) -> None:
        nonlocal next_s
        if time.monotonic() < next_s:
            return
        next_s = time.monotonic() + period_s
        if live is None:
            console.print(text())
        else:
            live.update(Text(text()), refresh=True)

    with live or contextlib.nullcontext():
        yield show


def _told(state: ArmState, joints: Sequence[str]) -> dict[str, object]:
    """The state for a client."""

    def by_joint(values: Iterable[float]) -> dict[str, float | None]:
        pairs = zip(joints, values, strict=True)
        return {name: float(value) if math.isfinite(value) else None for name, value in pairs}

    return {
        "time_s": state.time_s,
        "theta": by_joint(state.theta),
        "link": by_joint(state.link),
        "torque": by_joint(state.torque),
        "temperature": by_joint(state.temperature),
    }
