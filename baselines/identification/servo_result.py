"""Result of an identification from logs in time: JSON, and an entry of `joints.yaml`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.results import save_result
from baselines.identification.servo_fit import ServoFit
from baselines.identification.servo_holdout import ServoHoldout
from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_problem import USUAL_LOSS
from baselines.identification.servo_replay import PARAMETERS
from elastic_env.core.config import Model
from elastic_env.core.yaml_text import yaml_line

_LARGEST_HALF_WIDTH = 0.5
"""Half-width relative to the value up to which the logs determine a parameter."""
_SMALL_HALF_WIDTHS = {
    "zero_offset": 0.02,
    "delay": 0.005,
    "switch_lead": 0.005,
    "load_friction": 0.1,
}
"""Half-widths at which the logs determine a parameter of any value."""
_FRICTION = ("coulomb_friction", "viscous_friction", "load_friction", "static_friction")
_SAME_SUPPLY = 0.1
"""Relative difference of voltages within which logs have one supply."""
_SMALL_FRICTION_SHARE = 0.02
"""Half-width over the largest load at which the logs determine a dry friction of any value."""


class ServoParameter(Model):
    """One parameter and its 95 % interval."""

    name: str
    unit: str
    value: float | None = None
    """None without an estimate."""
    half_width: float | None = None
    """Half of the interval; None where the value follows from an assumption, or is None."""
    is_told: bool
    """True if the logs determine it, to half its value or better."""
    remark: str = ""


class RegisterGain(Model):
    """Position gain of the servo at one value of its gain register."""

    register_value: float | None
    """None where the logs do not contain it."""
    position_gain_nm_per_rad: float
    half_width: float | None
    """Half of the 95 % interval; None where the logs do not determine the gain."""
    supply_v: float | None = None
    """Voltage at which the servo has this gain; None where the logs do not contain it."""


class ServoIdentification(Model):
    """Result of an identification from logs in time; written as `identification.json`."""

    joint: str
    logs: tuple[str, ...]
    rows: int
    rms_mrad: float
    """Root mean square deviation of the replay from the fitted logs."""
    gains: tuple[RegisterGain, ...]
    parameters: tuple[ServoParameter, ...]
    untold: tuple[str, ...]
    """Sentences on what the logs do not determine."""
    supply_v: float | None
    """Voltage of the position gain and the torque limit among the parameters."""
    held_out: ServoHoldout | None = None

    def value(self, name: str) -> float | None:
        """An estimate by its name, as in `servo_replay.NAMES`."""
        return next(p.value for p in self.parameters if p.name == name)

    def settings(self) -> dict[str, Any]:
        """Settings of the joint for `JointSettings`, with the first gain and without a spring."""
        settings: dict[str, Any] = {"stiffness": math.inf}
        inertia = self.value("rotor_inertia")
        if inertia:
            settings["rotor_inertia"] = _four_digits(inertia)
        settings |= {name: _four_digits(self.value(name)) for name in _FRICTION}
        if settings["static_friction"]:
            settings["stribeck_speed"] = _four_digits(self.value("stribeck_speed"))
        if self.gains:
            settings["servo"] = {
                "position_gain": _four_digits(self.gains[0].position_gain_nm_per_rad),
                "velocity_gain": _four_digits(self.value("motor_damping")),
            }
            limit = self.value("torque_limit")
            if limit is not None:
                settings["servo"]["torque_limit"] = _four_digits(limit)
        return settings

    def save(self, folder: Path) -> list[Path]:
        """Write `identification.json` and `joints.yaml`."""
        head = "# by elastic identify from logs in time; the logs do not tell the gear's stiffness"
        comment = "no servo"
        if self.gains:
            volts = self.gains[0].supply_v
            supply = "" if volts is None else f" at {volts:g} V"
            register = self.gains[0].register_value
            value = "as in the logs" if register is None else f"{register:g}"
            comment = f"gain register {value}{supply}"
        line = yaml_line(self.joint, self.settings(), comment)
        return save_result(self, folder, head, [line])


def describe_servo(
    fit: ServoFit, joint: str = "*", held_out: ServoHoldout | None = None
) -> ServoIdentification:
    """Result of a fit.

    Args:
        fit: A fit to all logs.
        joint: Name for `joints.yaml`, or a pattern.
        held_out: Errors of another fit at logs that it did not use.
    """
    registers = _registers(fit.logs)
    supply = registers[0][1] if registers else fit.logs[0].supply
    parameters = tuple(_parameter(fit, name, supply) for name in PARAMETERS)
    gain = fit.value("position_gain")
    half = fit.half("position_gain")
    return ServoIdentification(
        joint=joint,
        logs=tuple(log.name for log in fit.logs),
        rows=sum(len(log) for log in fit.logs),
        rms_mrad=1e3 * fit.rms,
        gains=tuple(
            RegisterGain(
                register_value=register,
                position_gain_nm_per_rad=gain * (register or 1.0) * volts,
                half_width=half * (register or 1.0) * volts if np.isfinite(half) else None,
                supply_v=None if volts == 1.0 else volts,
            )
            for register, volts in registers
        ),
        parameters=parameters,
        untold=tuple(_limitations(fit, parameters)),
        supply_v=None if supply == 1.0 else supply,
        held_out=held_out,
    )


def _registers(logs: Sequence[ServoLog]) -> list[tuple[float | None, float]]:
    """Each value of the register at each supply, with the mean voltage of its logs [1], [V].

    Voltages that were measured differ a little from log to log, and count as one supply.
    """
    groups: list[tuple[float | None, list[float]]] = []
    for log in logs:
        if not log.enabled.any():
            continue
        alike = [
            volts
            for register, volts in groups
            if register == log.gain and abs(log.supply / volts[0] - 1.0) < _SAME_SUPPLY
        ]
        if alike:
            alike[0].append(log.supply)
        else:
            groups.append((log.gain, [log.supply]))
    return [(register, float(np.mean(volts))) for register, volts in groups]


def _parameter(fit: ServoFit, name: str, supply: float) -> ServoParameter:
    """Result of one parameter at the voltage of a supply [V]."""
    scale = supply if name in ("position_gain", "torque_limit") else 1.0
    value = fit.value(name) * scale
    half = fit.half(name) * scale
    has_value = name in fit.tied or bool(fit.is_estimated[list(PARAMETERS).index(name)])
    if not has_value or not np.isfinite(value):
        return ServoParameter(name=name, unit=PARAMETERS[name], is_told=False)
    has_interval = bool(np.isfinite(half))
    small = _SMALL_HALF_WIDTHS.get(name, 0.0)
    if name in ("coulomb_friction", "static_friction"):
        small = _SMALL_FRICTION_SHARE * max(
            float(np.abs(log.external_torque(log.position)).max()) for log in fit.logs
        )
    return ServoParameter(
        name=name,
        unit=PARAMETERS[name],
        value=value,
        half_width=half if has_interval else None,
        is_told=has_interval and half <= max(_LARGEST_HALF_WIDTH * abs(value), small),
        remark=fit.tied.get(name, ""),
    )


def _limitations(fit: ServoFit, parameters: Sequence[ServoParameter]) -> list[str]:
    """Quantities that the logs do not determine, each with its reason and its cure."""
    lines = []
    has_torque = any(log.enabled.any() for log in fit.logs)
    if not has_torque:
        lines.append("the servo: its torque is never on")
    elif all(log.gain is None for log in fit.logs):
        lines.append(
            "at which value of the gain register k_p holds: log a column gain, or say it by --gain"
        )
    if has_torque and "viscous_friction" in fit.tied:
        lines.append(
            f"viscous friction apart from the motor's back-EMF ({fit.tied['viscous_friction']}):"
            " log a swing with the torque off"
        )
    by_name = {parameter.name: parameter for parameter in parameters}
    estimated = [parameter for parameter in parameters if parameter.value is not None]
    if has_torque and by_name["torque_limit"].value is None:
        lines.append("the torque limit: the servo never reaches it; log a fast motion or the PWM")
    wide = [
        f"{p.name} (± {p.half_width:.2g} {p.unit})"
        for p in estimated
        if p.half_width is not None and not p.is_told
    ]
    if wide:
        lines.append(
            f"with less than half their value: {', '.join(wide)}; log faster motions, both sides of"
            " approach, and a swing with the torque off"
        )
    free = [p.name for p in estimated if np.isinf(fit.half(p.name))]
    if free:
        lines.append(f"{', '.join(free)}: nothing in these logs depends on it alone")
    if by_name["static_friction"].value is None:
        lines.append("Stribeck friction: it does not lower the error")
    if fit.half("load_friction") > _LARGEST_HALF_WIDTH * USUAL_LOSS[1]:
        lines.append(
            f"load friction without its prior of {USUAL_LOSS[0]} ± {USUAL_LOSS[1]}: let the load"
            " drive the joint back slowly"
        )
    lines.append("stiffness and backlash of the gear: one encoder shows one side of it only")
    return lines


def _four_digits(value: float | None) -> float:
    """A value for `joints.yaml`: four digits, not below zero, zero without an estimate."""
    return float(f"{max(value or 0.0, 0.0):.4g}")
