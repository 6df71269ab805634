"""Signals of every robot of elastic joints: its action, and its joints' part of the observation."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from elastic_env.core.errors import ActionError
from elastic_env.core.signals import Kind, Mirrored, SignalGroup, SignalTable

Mirrors: TypeAlias = Mapping[str, Mirrored | None]
"""Joints in order, and the sign of each angle in the mirror image; None without one."""

ACTION_BOUND_RAD = 0.3
"""Largest command offset [rad]."""

_JOINT_GROUPS: Mapping[str, tuple[str, str, Kind]] = {
    "encoder_angle": ("rad", "motor encoder, θ in whole counts", "measured"),
    "encoder_rate": ("rad/s", "its change over the last control period", "measured"),
    "reference_angle": ("rad", "q_ref at the end of the coming control period", "reference"),
    "reference_rate": ("rad/s", "its rate", "reference"),
    "reference_acceleration": ("rad/s²", "its acceleration", "reference"),
    "last_command": ("rad", "θ_cmd of the last control period", "command"),
}
JOINT_COLUMNS = tuple(_JOINT_GROUPS)
"""Groups of an observation with a column for every joint."""


def action_table(joints: Sequence[str], bound_rad: float = ACTION_BOUND_RAD) -> SignalTable:
    """Table of the action: an offset for every joint, within ± a bound."""
    parts = dict.fromkeys(joints)
    group = SignalGroup.of("command_offset", "rad", "θ_cmd − q_ref", parts, "command")
    bounds = {"low": -bound_rad, "high": bound_rad}
    return SignalTable(tuple(replace(signal, **bounds) for signal in group.signals))


def action_error(
    action: npt.NDArray[Any], shape: tuple[int, ...], bound_rad: float, is_scalar: bool
) -> ActionError:
    """Error that describes the fault of an action.

    Args:
        action: The action that was given.
        shape: Shape that it must have, (num_worlds, n).
        bound_rad: Largest offset [rad].
        is_scalar: True for an environment of one world, which adds the axis of worlds itself.
    """
    bounds = f"within ±{bound_rad:g} rad"
    if action.dtype.kind not in "fiub":
        problem = f"be real numbers, {bounds}, got an array of {action.dtype}"
    elif action.shape != shape:
        first = int(is_scalar)
        got = f"got shape {action.shape[first:]}"
        problem = f"have shape {shape[first:]} [rad], {bounds}; {got}"
    else:
        world = np.flatnonzero(~np.isfinite(action).all(axis=1))[0]
        got = f"got {action[world]} in world {world}"
        problem = f"be finite, {bounds}, shape {shape[1:]} a world; {got}"
    return ActionError(f"an action must {problem}")


def joint_groups(joints: Mirrors) -> dict[str, SignalGroup]:
    """Groups `JOINT_COLUMNS` by name."""
    return {
        name: SignalGroup.of(name, unit, meaning, joints, kind)
        for name, (unit, meaning, kind) in _JOINT_GROUPS.items()
    }
