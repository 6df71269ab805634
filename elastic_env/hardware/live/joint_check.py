"""Check of an arm's joints: a small move of each shows its gain, its load and its sign."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware.arm_settings import ServoMap
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live.arm import Arm
from elastic_env.joint.joint_settings import JointSettings

LEAST_LOAD_NM = 0.05
"""Load by the model that shows the sign of a joint; a smaller one may be no load [N·m]."""
_LEAST_FOLLOWED = 0.2
"""Share of a small move that a servo must follow; friction and sag take the rest [1]."""
_LEAST_SAG_RAD = 0.01
"""Sag from which a gain can be computed [rad]."""
_FLIPPED_SHARE = 0.35
"""Misfit of the loads with one sign flipped, over that without, below which that sign is wrong."""
_MISFIT = 0.5
"""Misfit of the loads, as a share of them, above which something is wrong."""
_LOAD_ERROR = 0.2
"""Share by which a servo's load may differ from the model's, in addition to friction [1]."""
_COUNTS_PER_TURN = 4096
"""Encoder counts assumed where the joint file gives none."""


@dataclass(frozen=True)
class JointCheck:
    """Result of moving a joint a little to both sides, with a rest at each.

    Attributes:
        first_move: First move, from where the joint stood [rad].
        follow_ratio: Share of the commanded move that the joint made [1].
        torque: Load of its servo, mean of both sides [N·m].
        gain: That load over the sag of the servo, k_p [N·m/rad]; nan where the sag is small.
        theta: Encoders of all joints, mean of both sides, (n,) [rad].
    """

    first_move: float
    follow_ratio: float
    torque: float
    gain: float
    theta: Array


def check_joint(arm: Arm, joint: int, way_rad: float) -> JointCheck:
    """Move a joint a little to both sides, away from a stop that is near.

    Friction holds it back on either side, so that the mean is the load. A stop would carry the
    load.

    Args:
        arm: Arm under torque.
        joint: Index of the joint.
        way_rad: Move to either side [rad].

    Raises:
        HardwareError: The joint hardly moves.
    """
    off_stops = arm.displacement_off_stops(joint, way_rad)
    side = -way_rad if off_stops < 0.0 else way_rad
    far, theta_far = arm.nudge(joint, off_stops + side)
    near, theta_near = arm.nudge(joint, off_stops - side)
    arm.nudge(joint, 0.0)
    follow_ratio = float((far - near)[1] / (far - near)[0])
    if not follow_ratio > _LEAST_FOLLOWED:
        start = arm.start[joint]
        near_end = f"; it stands at {start:+.4g} rad, near an end of its range" if off_stops else ""
        raise HardwareError(
            f"joint {arm.servos.joints[joint]!r} follows {100.0 * follow_ratio:.0f} % of a move by"
            f" ±{way_rad:g} rad about {start + off_stops:+.3g} rad: it is blocked, or its servo has"
            f" no strength; look at torque limit, gain and supply{near_end}"
        )
    command, theta, torque = 0.5 * (far + near)
    sag = command - theta
    return JointCheck(
        first_move=off_stops + side,
        follow_ratio=follow_ratio,
        torque=float(torque),
        gain=float(torque / sag if abs(sag) > _LEAST_SAG_RAD else np.nan),
        theta=0.5 * (theta_far + theta_near),
    )


def require_signs(
    servos: ServoMap,
    checks: Sequence[JointCheck],
    gravity_torque: Callable[[Array], Array],
    settings: dict[str, JointSettings],
) -> None:
    """Check the direction of every joint by its load.

    Args:
        servos: Servos of the joints.
        checks: Check of each joint.
        gravity_torque: Loads by the model at angles, (n,) [rad] to (n,) [N·m].
        settings: Friction of the joints, by name.

    Raises:
        HardwareError: A direction is wrong.
    """
    theta = checks[-1].theta
    expected = gravity_torque(theta)
    measured = np.array([check.torque for check in checks])
    loads = zip(servos.joints, expected.tolist(), strict=True)
    bounds = [friction_torque_bound(settings[name], load) for name, load in loads]
    wrong = wrong_sign(measured, theta, gravity_torque, np.array(bounds))
    if wrong is not None:
        raise HardwareError(
            f"joint {servos.joints[wrong]!r} holds {measured[wrong]:+.2f} N·m where the model says"
            f" {expected[wrong]:+.2f}, and all loads fit if its sign is turned: write direction:"
            f" {-int(servos.direction[wrong])} for it in the mounting"
        )


def wrong_sign(
    measured: Array, theta: Array, gravity_torque: Callable[[Array], Array], tolerance: Array
) -> int | None:
    """Index of the joint whose direction is wrong, by the loads of the servos; None if none is.

    A wrong direction flips the sign of that joint's angle and load, and so changes the model's
    loads of all joints. Each joint is flipped in turn, and the model's loads are compared with the
    measured ones.

    Args:
        measured: Loads, (n,) [N·m]; nan where a servo gives none.
        theta: Angles of the joints, (n,) [rad].
        gravity_torque: Loads by the model at angles, (n,) [rad] to (n,) [N·m].
        tolerance: Largest part of the loads that friction may carry, (n,) [N·m].
    """

    def misfit(flipped: int | None) -> tuple[float, float]:
        """Squared difference of measured and expected loads, and squared expected loads."""
        sign = np.ones(len(theta))
        if flipped is not None:
            sign[flipped] = -1.0
        expected = np.asarray(gravity_torque(sign * theta))
        excess = np.maximum(np.abs(sign * measured - expected) - tolerance, 0.0)
        valid = np.isfinite(measured)
        return float(np.sum(excess[valid] ** 2)), float(np.sum(expected[valid] ** 2))

    unflipped, size = misfit(None)
    if unflipped <= _MISFIT**2 * size or size == 0.0:
        return None
    flipped = [misfit(joint)[0] for joint in range(len(theta))]
    best = int(np.argmin(flipped))
    return best if flipped[best] < _FLIPPED_SHARE * unflipped else None


def friction_torque_bound(joint: JointSettings, load: float) -> float:
    """Largest part of a load that friction may carry [N·m]."""
    at_rest = (joint.coulomb_friction or 0.0) + joint.static_friction
    return at_rest + joint.load_friction * abs(load)


def torque_tolerance(joint: JointSettings, load: float, gain: float) -> float:
    """Largest difference between a load and the torque that a sound servo measures [N·m].

    Friction carries a part, the masses are not exact, and a servo measures in encoder counts.
    """
    count_rad = 2.0 * math.pi / (joint.encoder_counts_per_turn or _COUNTS_PER_TURN)
    resolution = gain * count_rad if math.isfinite(gain) else 0.0
    friction = friction_torque_bound(joint, load)
    return friction + _LOAD_ERROR * abs(load) + max(resolution, LEAST_LOAD_NM)
