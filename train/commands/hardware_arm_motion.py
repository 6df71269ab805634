"""Motion of an arm by a command: check, consent, targets, logs and summary."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np
from rich.console import Console

from elastic_env.core.signals import Array
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.emulator.virtual import VirtualBus
from elastic_env.hardware.live.arm import Arm, Compensator, Uncompensated
from elastic_env.hardware.live.arm_state import ArmLog, ArmState, live_table, state_message
from elastic_env.hardware.live.consent import require_consent
from elastic_env.hardware.live.target_streams import Socket, Stream
from elastic_env.hardware.live.targets import Poses, Targets
from elastic_env.hardware.safety import realtime
from elastic_env.hardware.safety.supervised_bus import SupervisedBus
from elastic_env.robots.robot.joints import STIFF_OVER_SERVO
from train.commands import hardware_arm_dry_run as dry_run
from train.commands.hardware_arm import RAMP_S, ArmSetup
from train.commands.hardware_arm_checks import check_joints, check_servos
from train.commands.hardware_arm_display import rest_table, throttled_display
from train.commands.hardware_arm_logs import write_servo_logs
from train.runs.console import print_files
from train.runs.folders import run_folder

MakeTargets: TypeAlias = Callable[[Array], Targets]
"""Makes targets from the angles at which the arm starts, (n,) [rad]."""


def move_arm(
    setup: ArmSetup, compensator: Compensator, make_targets: MakeTargets, console: Console
) -> tuple[Path, dict[int, ArmState]]:
    """Check an arm, let it follow targets, and write its logs.

    Args:
        setup: The arm.
        compensator: Computes its commands.
        make_targets: Makes its targets.
        console: Gets the tables.

    Returns:
        Folder of the logs, and the last state at each target by its number.

    Raises:
        HardwareError: A check fails, nobody agrees, or the motion was stopped.
    """
    options = setup.options
    recorded = options.model_dump(mode="json", exclude={"output"})
    with contextlib.ExitStack() as stack:
        pairs = zip(setup.servos.ids, setup.joints, strict=True)
        servos = ", ".join(f"{i} {name}" for i, name in pairs)
        place = "emulated servos" if options.dry_run else f"servos at {setup.settings.port}"
        console.print(f"{len(setup.joints)} {place}: {servos}")
        simulation = None
        if options.dry_run:
            config = dry_run.emulator_config(setup)
            bus = simulation = stack.enter_context(VirtualBus(config))
            if dry_run.stiffened_joints(setup):
                console.print(f"rigid joints are emulated with K = {STIFF_OVER_SERVO:g} k_p")
            check_servos(setup, bus.driver, console)
        else:
            bus = stack.enter_context(_real_bus(setup, console))
        arm = Arm(bus, setup.settings, setup.servos, compensator, setup.ranges)
        folder = stack.enter_context(run_folder("hardware", recorded, None, options.output))
        if simulation is None:
            realtime.prefer_realtime(realtime.Priority.LOOP)
            stack.callback(realtime.give_up_realtime)
        start = arm.begin()
        if options.check:
            check_joints(arm, setup, console)
            arm.resume()
        for _ in arm.approach_start(RAMP_S, options.nudge_rad if options.check else 0.0):
            pass
        arm.hold()
        targets = make_targets(start)
        stack.callback(targets.close)
        if isinstance(targets, Socket):
            console.print(f"listening at {targets.address[0]}:{targets.address[1]}")
        if simulation is not None and isinstance(targets, Stream):
            simulation.keep_pace()
        rests = _follow_targets(arm, targets, setup, folder, console, simulation)
    is_complete = isinstance(targets, Poses) and targets.number == len(targets.poses)
    if options.dry_run and is_complete and not isinstance(compensator, Uncompensated):
        error = dry_run.uncompensated_error(setup, make_targets)
        console.print(f"without compensation the tip would be off by {1e3 * error:.2f} mm")
    return folder, rests


def _real_bus(setup: ArmSetup, console: Console) -> SupervisedBus:
    """Servos at a port, after their check and the consent to move them."""
    settings = setup.settings
    with BUSES[settings.protocol](settings.port, settings.baudrate) as driver:
        check_servos(setup, driver, console)
    if settings.confirm and not setup.options.yes:
        require_consent(_consent_question(setup), settings.port)
    ports = {settings.port: setup.servos.ids}
    return SupervisedBus(ports, settings.baudrate, settings.protocol)


def _consent_question(setup: ArmSetup) -> str:
    """Question before the first motion: what will move, and whether it may."""
    options = setup.options
    nudges = (
        f"move each joint by ±{options.nudge_rad:g} rad, away from a stop, then all together, then "
    )
    return (
        f"The {len(setup.joints)} servos at {setup.settings.port} will"
        f" {nudges if options.check else ''}follow the targets with up to"
        f" {setup.settings.speed_rad_s:g} rad/s. Is the way free, and the power switch"
        " in reach?"
    )


def _follow_targets(
    arm: Arm,
    targets: Targets,
    setup: ArmSetup,
    folder: Path,
    console: Console,
    simulation: VirtualBus | None,
) -> dict[int, ArmState]:
    """Follow the targets and go back; write the logs, also of an interrupted motion."""
    rests: dict[int, ArmState] = {}
    true_links: dict[int, Array] = {}
    is_interrupted = False
    path = folder / "log.csv"
    with path.open("w", newline="", encoding="utf-8") as file, throttled_display(console) as show:
        log = ArmLog(file, setup.joints)
        arm.resume()
        try:
            for state in arm.play(targets):
                log.write(state, targets.number)
                if np.isfinite(state.link).all():
                    rests[targets.number] = state
                    if simulation is not None:
                        true_links[targets.number] = simulation.links
                targets.report_state(state_message(state, setup.joints))
                show(lambda now=state: live_table(now, setup.joints, arm.counts, targets))
            for state in arm.go(arm.start):
                log.write(state, targets.number)
        except KeyboardInterrupt:
            is_interrupted = True
            rests.pop(targets.number, None)  # on its way
            true_links.pop(targets.number, None)
            console.print("stopped; torque falls")
        finally:
            try:
                arm.close()  # before the logs, which take longer
            finally:
                file.flush()
                files = [path, *write_servo_logs(path, setup)]
    if targets.refused:
        console.print(f"{targets.refused} lines refused; the last: {targets.problem}", markup=False)
    at_poses = rests if isinstance(targets, Poses) else {}
    _print_summary(arm, at_poses, true_links, setup, console)
    print_files(folder, files, console)
    if is_interrupted and not isinstance(targets, Stream):
        raise KeyboardInterrupt
    return rests


def _print_summary(
    arm: Arm,
    rests: dict[int, ArmState],
    true_links: dict[int, Array],
    setup: ArmSetup,
    console: Console,
) -> None:
    """Print how many cycles went wrong, and the errors of joints and tip at the poses.

    Args:
        arm: After its motion.
        rests: Last state at each pose, by its number; none if the targets were no poses.
        true_links: True link angles in these states, (n,) [rad]; none of a real arm.
        setup: The arm.
        console: Gets the summary.
    """
    counts = arm.counts
    console.print(
        f"{counts.cycles} cycles at {arm.settings.rate_hz:g} Hz: {counts.late} late,"
        f" {counts.held} without all replies, {counts.limited} with a command that a limit changed"
    )
    if not rests:
        return
    console.print(rest_table(list(rests.values()), setup.joints))
    desired = np.array([state.target for state in rests.values()])
    links = {"estimated": np.array([state.link for state in rests.values()])}
    if true_links:
        links["true"] = np.array(list(true_links.values()))
    errors = [f"{1e3 * setup.tip_error(desired, q):.2f} mm {kind}" for kind, q in links.items()]
    console.print(f"tip from its poses, rms: {', '.join(errors)}")
