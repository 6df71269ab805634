"""Dry run of a command that moves an arm: the arm is emulated from its files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware.buses.servo_models import model_number
from elastic_env.hardware.emulator.joints import EmulatedArm
from elastic_env.hardware.emulator.launch import EmulatorConfig
from elastic_env.hardware.emulator.virtual import VirtualBus
from elastic_env.hardware.live.arm import Arm, Uncompensated
from elastic_env.hardware.live.targets import Targets
from elastic_env.robots.robot.joints import STIFF_OVER_SERVO
from train.commands.hardware_arm import ArmSetup

_DEFAULT_SERVOS = {"feetech": "STS3215", "dynamixel": "XM430-W350"}
"""Servos of an emulated arm, by protocol, where the mounting names none."""


def emulator_config(setup: ArmSetup) -> EmulatorConfig:
    """Emulator of the arm: the joints of the file on the servos of the mounting."""
    names = [name for name in setup.servos.models if name is not None]
    name = names[0] if names else _DEFAULT_SERVOS[setup.settings.protocol]
    arm = EmulatedArm(
        model=str(Path(setup.options.robot).resolve()),
        joints={**setup.mapping, **stiffened_joints(setup)},
        order=setup.joints,
        direction=tuple(int(sign) for sign in setup.servos.direction),
        zero_rad=tuple(setup.servos.zero.tolist()),
    )
    return EmulatorConfig(
        model_number=model_number(name),
        ids=tuple(setup.servos.ids),
        baudrate=setup.settings.baudrate,
        arm=arm,
    )


def stiffened_joints(setup: ArmSetup) -> dict[str, Any]:
    """Settings by name of rigid joints with a soft servo: they are emulated with a stiff spring.

    The simulation has no rigid joint whose servo gives way.
    """
    stiffened: dict[str, Any] = {}
    for name, joint in setup.compensator.settings.items():
        gain = joint.servo.sagging_gain(name)
        if joint.is_rigid and np.isfinite(gain):
            stiff = joint.replace(stiffness=STIFF_OVER_SERVO * gain)
            stiffened[name] = stiff.model_dump(exclude_defaults=True)
    return stiffened


def uncompensated_error(setup: ArmSetup, make_targets: Callable[[Array], Targets]) -> float:
    """True error of an emulated arm's tip at its poses without compensation, rms [m]."""
    with VirtualBus(emulator_config(setup)) as bus:
        compensator = Uncompensated(setup.compensator)
        arm = Arm(bus, setup.settings, setup.servos, compensator, setup.ranges)
        targets = make_targets(arm.begin())
        ends: dict[int, tuple[Array, Array]] = {}
        for state in arm.play(targets):
            ends[targets.number] = (state.target, bus.links)
    desired, links = np.array(list(ends.values())).swapaxes(0, 1)
    return setup.tip_error(desired, links)
