"""Signals of every robot of elastic joints: its action, and what it observes of its joints."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

from elastic_env.core.signals import Kind, Mirrored, SignalGroup, SignalTable

Mirrors: TypeAlias = Mapping[str, Mirrored | None]
"""Joints in order, and what an angle of each is in the mirror."""

ACTION_BOUND_RAD = 0.3
"""Largest command offset [rad]."""

_OBSERVED: Mapping[str, tuple[str, str, Kind]] = {
    "encoder_angle": ("rad", "motor encoder, θ in whole counts", "measured"),
    "encoder_rate": ("rad/s", "its change over the last control period", "measured"),
    "reference_angle": ("rad", "q_ref at the end of the coming control period", "reference"),
    "reference_rate": ("rad/s", "its rate", "reference"),
    "reference_acceleration": ("rad/s²", "its acceleration", "reference"),
    "last_command": ("rad", "θ_cmd of the last control period", "command"),
}
JOINT_COLUMNS = tuple(_OBSERVED)
"""Groups of an observation that have a column for every joint."""


def action_table(joints: Sequence[str], bound_rad: float = ACTION_BOUND_RAD) -> SignalTable:
    """The action: an offset for every joint, within ± a bound."""
    parts = dict.fromkeys(joints)
    group = SignalGroup.of("command_offset", "rad", "θ_cmd − q_ref", parts, "command")
    ends = {"low": -bound_rad, "high": bound_rad}
    return SignalTable(tuple(replace(own, **ends) for own in group.signals))


def joint_groups(joints: Mirrors) -> dict[str, SignalGroup]:
    """The groups `JOINT_COLUMNS` by name."""
    return {
        name: SignalGroup.of(name, unit, meaning, joints, kind)
        for name, (unit, meaning, kind) in _OBSERVED.items()
    }
