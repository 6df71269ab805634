"""Named inputs of a base policy: its own quantities in which a residual may act.

Every input has a unit, one column per joint or per axis, and an image in the mirror. Zero gives the
bits of the base. An input acts on the quantity that the base itself plans or feeds back, so that
its feedback does not work against it: a policy with a shifted center of mass also expects it there.

Columns per joint are in the order of the robot's joints. Axes: x forward, y to the left, on the
walker in the plan's local frame (`elastic_env.motion.walk_plan`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from elastic_env.core.signals import Mirrored, Signal
from elastic_env.world.robot_model import RobotModel

COMMAND = "command"
DEFLECTION = "deflection"


@dataclass(frozen=True)
class InputKind:
    """Unit, bounds and columns of an input.

    Attributes:
        unit, meaning: Text for tables and errors.
        default: Bound where none is given.
        limit: Every bound must be below it.
        axes: Columns that are no joints, and the sign of each in the mirror; None for an input with
            a column per joint.
    """

    unit: str
    meaning: str
    default: float
    limit: float
    axes: Mapping[str, Mirrored] | None = None

    def columns(self, joint_names: list[str]) -> list[str]:
        """Names of the columns."""
        return joint_names if self.axes is None else list(self.axes)


_PLANE: Mapping[str, Mirrored] = {"x": "same", "y": "opposite"}
_TILT: Mapping[str, Mirrored] = {"roll": "opposite", "pitch": "same"}
_LENGTH: Mapping[str, Mirrored] = {"difference": "opposite"}
_GAIN: Mapping[str, Mirrored] = {"all": "same"}

INPUTS: Mapping[str, InputKind] = {  # unit, meaning, default, limit, axes
    COMMAND: InputKind("rad", "offset of the command", 0.02, 1e3),
    DEFLECTION: InputKind("1", "change of the compensated deflection", 0.6, 1e3),
    "zmp": InputKind("m", "shift of the planned ZMP", 0.02, 0.05, _PLANE),
    "com": InputKind("m", "shift of the planned center of mass", 0.02, 0.05, _PLANE),
    "leg_length": InputKind("m", "left less right leg length", 0.005, 0.05, _LENGTH),
    "hip": InputKind("rad", "offset of both hip rolls or pitches", 0.02, 0.2, _TILT),
    "posture_gain": InputKind("1", "change of the posture's gains", 0.5, 1.0, _GAIN),
    "balance_gain": InputKind("1", "change of the balance's gains", 0.5, 1.0, _GAIN),
}
"""All inputs by name.

Every policy has `command`; its attribute `inputs` names the others.
"""


def input_signals(name: str, model: RobotModel) -> tuple[Signal, ...]:
    """Columns of an input as signals, with their signs in the mirror."""
    kind = INPUTS[name]
    columns: dict[str, Mirrored | None] = {**(kind.axes or {})}
    if kind.axes is None:  # a relative change has no sign in the mirror
        columns = dict.fromkeys(model.joint_names, "same")
    if name == COMMAND:
        commands = model.observation_table.signals_of("last_command")
        columns = {c: s.mirrored for c, s in zip(columns, commands, strict=True)}
    return tuple(
        Signal(f"{name}.{column}", kind.unit, kind.meaning, mirrored=mirrored)
        for column, mirrored in columns.items()
    )


def inputs_of(policy: Any) -> tuple[str, ...]:
    """Names of the inputs that a policy has."""
    return (COMMAND, *getattr(policy, "inputs", ()))
