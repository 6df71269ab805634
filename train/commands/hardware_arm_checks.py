"""Checks of an arm before it follows targets: its servos at rest, then a small move per joint."""

import math
import sys

from rich.console import Console

from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.buses.servo_models import model_number
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live import joint_check
from elastic_env.hardware.live.arm import Arm
from elastic_env.hardware.live.consent import answers_yes
from elastic_env.hardware.safety.checks import check_bus
from train.commands.hardware_arm import ArmSetup
from train.runs.console import make_table

_MAX_GAIN_RATIO = 1.4
"""Ratio of measured gain and gain of the file above which a remark is printed [1]."""
_REMARKS = {
    "light": "its load does not show the sign; see whether it turns as the model",
    "load": (
        "the servo holds another torque than the model says; look at zero_rad, at the"
        " masses of the model, and at what the arm touches"
    ),
    "k_p": (
        "the servo gives way otherwise than the file of joints says [N·m/rad]; is that"
        " a register in place of N·m/rad? elastic identify --log finds it"
    ),
}
"""Explanations of the last column of the table of joints."""


def check_servos(setup: ArmSetup, bus: ServoBus, console: Console) -> None:
    """Check all servos and print what is wrong; nothing moves.

    Raises:
        HardwareError: A servo is of another type than the mounting says, or may not move.
    """
    checks = check_bus(bus, setup.servos.ids)
    servos = setup.servos
    for servo_id, joint, name in zip(servos.ids, servos.joints, servos.models, strict=True):
        model = bus.models[servo_id]
        if name is not None and model.number != model_number(name):
            raise HardwareError(
                f"joint {joint!r} has a {name} by the mounting, and servo {servo_id} at"
                f" {bus.name} is a {model.name}: correct its id or its model"
            )
    bad = [check for check in checks if not check.is_good]
    if not bad:
        console.print(f"{len(checks)} checks of the servos: all fine")
        return
    rows = [(check.name, check.value, check.cure) for check in bad]
    console.print(make_table("to mend", ["", "", "what to do"], rows, left=3))
    for check in bad:
        if check.is_vital:
            problem = f"{check.name} is {check.value}: {check.cure}"
            raise HardwareError(f"nothing can move yet: {problem}")


def check_joints(arm: Arm, setup: ArmSetup, console: Console) -> None:
    """Move every joint a little, compare its sign and load with the model, and print a table.

    Raises:
        HardwareError: A joint hardly moves, or its sign is wrong.
    """
    console.print(f"moving each joint by ±{setup.options.nudge_rad:g} rad")
    checks: list[joint_check.JointCheck] = []
    for joint in range(len(setup.joints)):
        checks.append(joint_check.check_joint(arm, joint, setup.options.nudge_rad))
        load = float(setup.links.gravity_torque(arm.start)[joint])
        if abs(load) < joint_check.LEAST_LOAD_NM:
            _ask_direction(arm, setup, joint, checks[-1].first_move)
    arm.hold()  # while tables are drawn
    settings = setup.compensator.settings
    joint_check.require_signs(setup.servos, checks, setup.links.gravity_torque, settings)
    rows = [_joint_row(setup, joint, check) for joint, check in enumerate(checks)]
    head = ["joint", "follows", "load [N·m]", "model", "k_p", "file", ""]
    console.print(make_table("each joint moved a little", head, rows))
    remarks = {row[-1] for row in rows}
    for remark, explanation in _REMARKS.items():
        if remark in remarks:
            console.print(f"{remark}: {explanation}")


def _joint_row(setup: ArmSetup, joint: int, check: joint_check.JointCheck) -> list[str]:
    """Cells of a joint in the table; the last one is its remark."""
    name = setup.joints[joint]
    settings = setup.compensator.settings[name]
    load = float(setup.links.gravity_torque(check.theta)[joint])
    gain = settings.servo.sagging_gain(name)
    remark = "" if abs(load) >= joint_check.LEAST_LOAD_NM else "light"
    if abs(check.torque - load) > joint_check.torque_tolerance(settings, load, gain):
        remark = "load"
    if check.gain > 0.0 and max(check.gain / gain, gain / check.gain) > _MAX_GAIN_RATIO:
        remark = "k_p"
    gains = [f"{k:.3g}" if math.isfinite(k) else "-" for k in (check.gain, gain)]
    follows = f"{100.0 * check.follow_ratio:.0f} %"
    return [name, follows, f"{check.torque:+.2f}", f"{load:+.2f}", *gains, remark]


def _ask_direction(arm: Arm, setup: ArmSetup, joint: int, move_rad: float) -> None:
    """Ask whether a joint first turned as in the model, if somebody is at the terminal.

    Raises:
        HardwareError: It turned the other way.
    """
    if setup.options.yes or setup.options.dry_run or not sys.stdin.isatty():
        return
    x, y, z = 1e3 * move_rad * setup.tip.jacobian(arm.start[None])[0][0, :, joint]
    name = setup.joints[joint]
    arm.hold()
    is_right = answers_yes(
        f"joint {name!r} was turned by {move_rad:+g} rad, back and beyond; by the model the end"
        f" went first by x {x:+.0f}, y {y:+.0f}, z {z:+.0f} mm. Did it? Type the whole word yes: "
    )
    arm.resume()
    if not is_right:
        raise HardwareError(
            f"joint {name!r} turns the other way: write direction:"
            f" {-int(arm.servos.direction[joint])} for it in the mounting"
        )
