"""Named inputs of a base policy: its own quantities in which a residual may act.

Every input has a unit, one column per joint or per axis, and an image in the mirror. Zero gives the
base to the last bit. An input acts on the quantity that the base itself plans or feeds back, so
that its feedback does not work against it: a policy that is told to shift its center of mass also
expects it there.

Columns per joint are in the order of the robot's joints. Axes: x forward, y to the left.
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
        unit, meaning: In words.
        default: Bound where none is given.
        limit: Every bound must be below it.
        axes: Columns that are no joints, and what each is in the mirror; none for an input with a
            column per joint.
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

INPUTS: Mapping[str, InputKind] = {
    COMMAND: InputKind("rad", "offset of the command", default=0.02, limit=1e3),
    DEFLECTION: InputKind(
        "1", "relative change of the deflection that is compensated", default=0.6, limit=1e3
    ),
    "zmp": InputKind("m", "shift of the planned ZMP", default=0.02, limit=0.05, axes=_PLANE),
    "com": InputKind(
        "m", "shift of the planned center of mass", default=0.02, limit=0.05, axes=_PLANE
    ),
    "leg_length": InputKind(
        "m",
        "left less right leg length",
        default=0.005,
        limit=0.05,
        axes={"difference": "opposite"},
    ),
    "hip": InputKind(
        "rad", "offset of both hip rolls, of both hip pitches", default=0.02, limit=0.2, axes=_TILT
    ),
    "posture_gain": InputKind(
        "1",
        "relative change of the posture feedback's gains",
        default=0.5,
        limit=1.0,
        axes={"all": "same"},
    ),
    "balance_gain": InputKind(
        "1",
        "relative change of the gains of foot forces and center of mass",
        default=0.5,
        limit=1.0,
        axes={"all": "same"},
    ),
}
"""All inputs by name.

Every policy has `command`; a policy's `inputs` names the others that it has.
"""


def input_signals(name: str, model: RobotModel) -> tuple[Signal, ...]:
    """The columns of an input as signals, which say what each is in the mirror."""
    kind = INPUTS[name]
    columns: dict[str, Mirrored | None] = {**(kind.axes or {})}
    if kind.axes is None:  # a relative change has no direction
        columns = dict.fromkeys(model.joint_names, "same")
    if name == COMMAND:
        commands = model.observation_table.signals_of("last_command")
        columns = dict(zip(columns, [signal.mirrored for signal in commands], strict=True))
    return tuple(
        Signal(f"{name}.{column}", kind.unit, kind.meaning, mirrored=mirrored)
        for column, mirrored in columns.items()
    )


def inputs_of(policy: Any) -> tuple[str, ...]:
    """Names of the inputs that a policy has."""
    return (COMMAND, *getattr(policy, "inputs", ()))
