"""Result of an identification from logs in time: JSON, and an entry of `joints.yaml`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.identification.servo_fit import ServoFit
from baselines.identification.servo_holdout import ServoHoldout
from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_problem import USUAL_LOSS
from baselines.identification.servo_replay import PARAMETERS
from elastic_env.core.config import Model
from elastic_env.core.yaml_text import yaml_line

_TOLD = 0.5
_TOLD_WITHIN = {"zero_offset": 0.02, "delay": 0.005, "switch_lead": 0.005, "load_friction": 0.1}
"""Half-widths at which a parameter counts as told whatever its value is."""
_FRICTION = ("coulomb_friction", "viscous_friction", "load_friction", "static_friction")
_SAME_SUPPLY = 0.1
"""Share of a voltage within which logs have one supply."""
_SMALL_SHARE = 0.02
"""Share of the largest load below which a dry friction is as good as told."""


class ServoParameter(Model):
    """One parameter and its 95 % interval."""

    name: str
    unit: str
    value: float | None = None
    """None where it was not sought."""
    half_width: float | None = None
    """Half of the interval; None where it follows from an assumption, or was not sought."""
    is_told: bool
    """True if the logs tell it, to half its value or better."""
    remark: str = ""


class RegisterGain(Model):
    """Position gain of the servo at one value of its gain register."""

    register_value: float | None
    """None where the logs do not say it."""
    position_gain_nm_per_rad: float
    half_width: float | None
    """Half of the 95 % interval; None where the logs do not tell the gain."""
    supply_v: float | None = None
    """Voltage at which the servo has this gain; None where the logs do not say it."""


class ServoIdentification(Model):
    """Result of an identification from logs in time; written as `identification.json`."""

    joint: str
    logs: tuple[str, ...]
    rows: int
    rms_mrad: float
    """Of the replay at the logs that were fitted."""
    gains: tuple[RegisterGain, ...]
    parameters: tuple[ServoParameter, ...]
    untold: tuple[str, ...]
    """What the logs cannot tell, in words."""
    supply_v: float | None
    """Voltage of the position gain and the torque limit among the parameters."""
    held_out: ServoHoldout | None = None

    def value(self, name: str) -> float | None:
        """An estimate by its name, as in `servo_replay.NAMES`."""
        return next(one.value for one in self.parameters if one.name == name)

    def settings(self) -> dict[str, Any]:
        """The joint as `JointSettings` takes it; of the first gain, without a spring."""
        own: dict[str, Any] = {"stiffness": math.inf}
        inertia = self.value("rotor_inertia")
        if inertia:
            own["rotor_inertia"] = _rounded(inertia)
        own |= {name: _rounded(self.value(name) or 0.0) for name in _FRICTION}
        if own["static_friction"]:
            own["stribeck_speed"] = _rounded(self.value("stribeck_speed") or 0.0)
        if self.gains:
            own["servo"] = {
                "position_gain": _rounded(self.gains[0].position_gain_nm_per_rad),
                "velocity_gain": _rounded(self.value("motor_damping") or 0.0),
            }
            limit = self.value("torque_limit")
            if limit is not None:
                own["servo"]["torque_limit"] = _rounded(limit)
        return own

    def save(self, folder: Path) -> list[Path]:
        """Write `identification.json` and `joints.yaml`."""
        files = [folder / name for name in ("identification.json", "joints.yaml")]
        files[0].write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")
        head = "# by elastic identify from logs in time; the logs do not tell the gear's stiffness"
        said = "no servo"
        if self.gains:
            volts = self.gains[0].supply_v
            at = "" if volts is None else f" at {volts:g} V"
            register = self.gains[0].register_value
            said = f"gain register {'as in the logs' if register is None else f'{register:g}'}{at}"
        text = f"{head}\n{yaml_line(self.joint, self.settings(), said)}\n"
        files[1].write_text(text, encoding="utf-8")
        return files


def describe_servo(
    fit: ServoFit, joint: str = "*", held_out: ServoHoldout | None = None
) -> ServoIdentification:
    """The result of a fit.

    Args:
        fit: A fit to all logs.
        joint: Name for `joints.yaml`, or a pattern.
        held_out: Errors of another fit at logs that it did not see.
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
        untold=tuple(_untold(fit, parameters)),
        supply_v=None if supply == 1.0 else supply,
        held_out=held_out,
    )


def _registers(logs: Sequence[ServoLog]) -> list[tuple[float | None, float]]:
    """Each value of the register at each supply, with the mean voltage of its logs [1], [V].

    Voltages that were measured differ a little from log to log, and count as one supply.
    """
    found: list[tuple[float | None, list[float]]] = []
    for log in logs:
        if not log.enabled.any():
            continue
        alike = [
            volts
            for register, volts in found
            if register == log.gain and abs(log.supply / volts[0] - 1.0) < _SAME_SUPPLY
        ]
        if alike:
            alike[0].append(log.supply)
        else:
            found.append((log.gain, [log.supply]))
    return [(register, float(np.mean(volts))) for register, volts in found]


def _parameter(fit: ServoFit, name: str, supply: float) -> ServoParameter:
    scale = supply if name in ("position_gain", "torque_limit") else 1.0
    value = fit.value(name) * scale
    half = fit.half(name) * scale
    is_known = name in fit.tied or bool(fit.sought[list(PARAMETERS).index(name)])
    if not is_known or not np.isfinite(value):
        return ServoParameter(name=name, unit=PARAMETERS[name], is_told=False)
    has_interval = bool(np.isfinite(half))
    within = _TOLD_WITHIN.get(name, 0.0)
    if name in ("coulomb_friction", "static_friction"):
        within = _SMALL_SHARE * max(
            float(np.abs(log.external_torque(log.position)).max()) for log in fit.logs
        )
    told = has_interval and half <= max(_TOLD * abs(value), within)
    return ServoParameter(
        name=name,
        unit=PARAMETERS[name],
        value=value,
        half_width=half if has_interval else None,
        is_told=told,
        remark=fit.tied.get(name, ""),
    )


def _untold(fit: ServoFit, parameters: Sequence[ServoParameter]) -> list[str]:
    """What the logs cannot tell, each with its reason and its cure."""
    said = []
    has_torque = any(log.enabled.any() for log in fit.logs)
    if not has_torque:
        said.append("the servo: its torque is never on")
    elif all(log.gain is None for log in fit.logs):
        said.append(
            "at which value of the gain register k_p holds: log a column gain, or say it by --gain"
        )
    if has_torque and "viscous_friction" in fit.tied:
        said.append(
            f"viscous friction apart from the motor's back-EMF ({fit.tied['viscous_friction']}):"
            " log a swing with the torque off"
        )
    by_name = {one.name: one for one in parameters}
    if has_torque and by_name["torque_limit"].value is None:
        said.append("the torque limit: the servo never reaches it; log a fast motion or the PWM")
    wide = [
        f"{one.name} (± {one.half_width:.2g} {one.unit})"
        for one in parameters
        if one.value is not None and one.half_width is not None and not one.is_told
    ]
    if wide:
        said.append(
            f"with less than half their value: {', '.join(wide)}; log faster motions, both sides of"
            " approach, and a swing with the torque off"
        )
    without = [
        one.name for one in parameters if one.value is not None and np.isinf(fit.half(one.name))
    ]
    if without:
        said.append(f"{', '.join(without)}: nothing in these logs depends on it alone")
    if by_name["static_friction"].value is None:
        said.append("Stribeck friction: it does not lower the error")
    if fit.half("load_friction") > _TOLD * USUAL_LOSS[1]:
        said.append(
            f"load friction without its prior of {USUAL_LOSS[0]} ± {USUAL_LOSS[1]}: let the load"
            " drive the joint back slowly"
        )
    said.append("stiffness and backlash of the gear: one encoder shows one side of it only")
    return said


def _rounded(value: float) -> float:
    return float(f"{max(value, 0.0):.4g}")
