"""Inverse kinematics of a path of the end effector, by Newton's method from point to point."""

from collections.abc import Callable
from typing import Any

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.rigid.tree.end_effector import EndEffector

_POINTS = 100
"""Points of a path per unit of its parameter."""
_TOLERANCE = 1e-9
"""Largest error of position [m] and rotation [rad]."""
_MOST_STEPS = 50
_LARGEST_JUMP_RAD = 0.3
"""Largest change between two points of a path; a larger one is a singular posture."""
_DAMPING = 1e-12
_ORIENTATION_JOINTS = 6
"""Joints that a robot needs to keep the orientation of its tool."""


def joint_path(tool: EndEffector, home: Array, place: Callable[[Array], Array], end: float) -> Any:
    """Return a spline of joint angles along a path of the tool, from (...) to (..., n) [rad].

    Args:
        tool: The end effector.
        home: Joint angles at the start, (n,) [rad].
        place: Place of the end effector from its start, from (...) to (..., 3) [m].
        end: Last value of the path's parameter, which starts at 0.

    Raises:
        ConfigurationError: The path leaves the workspace, or leads through a singular posture.
    """
    # imported late: it takes a quarter of a second, and most programs need no spline
    from scipy.interpolate import CubicSpline

    s = np.linspace(0.0, end, int(np.ceil(_POINTS * end)) + 1)
    start, R = tool.pose(home)
    angles = [home]
    for at, offset in zip(s[1:], place(s[1:]), strict=True):
        q = _solve(tool, angles[-1], start + offset, R)
        if q is None or np.abs(q - angles[-1]).max() > _LARGEST_JUMP_RAD:
            raise ConfigurationError(
                f"the end effector cannot follow the path beyond {100 * at / end:.0f} %"
                f" of it, {offset.round(3).tolist()} m from its start: out of reach, or"
                " a singular posture; choose a smaller path or another home"
            )
        angles.append(q)
    return CubicSpline(s, np.array(angles))


def _solve(tool: EndEffector, q: Array, place: Array, R_ref: Array) -> Array | None:
    """Find angles near q that reach a place, or None; six joints or more keep the orientation."""
    from scipy.spatial.transform import Rotation

    keeps_orientation = len(q) >= _ORIENTATION_JOINTS
    for _ in range(_MOST_STEPS):
        position, R = tool.pose(q)
        error = place - position
        if keeps_orientation:
            turn = Rotation.from_matrix(R_ref @ R.T).as_rotvec()
            error = np.concatenate([error, turn])
        if np.abs(error).max() < _TOLERANCE:
            return q
        J, J_rotation = tool.jacobian(q)
        if keeps_orientation:
            J = np.concatenate([J, J_rotation])
        step: Array = J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(len(J)), error)
        q = q + step
    return None
