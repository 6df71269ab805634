"""Checks that a robot on a fixed base can follow its reference: joint ranges, torque, offsets."""

import warnings
from collections.abc import Sequence

import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.friction import passed_torque
from elastic_env.motion import arm_references
from elastic_env.motion.arm_references import Workspace
from elastic_env.motion.trajectory import Motion
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.world import joint_config
from elastic_env.world.joint_config import JointConfig
from elastic_env.world.robot_model import RobotModel, joint_ranges

_USABLE_SHARE = 0.8
"""Share of the servos' torque that poses may need at rest."""


def torque_shortage(robot: RobotModel, body: RigidBody, q: Array) -> Array:
    """Torque that servos lack to hold poses with a fifth to spare, over their torque [1].

    Args:
        robot: The true robot.
        body: Its links.
        q: Poses, (..., n) [rad].

    Returns:
        Sum over the joints, (...).
    """
    limits = robot.largest_torque(np.zeros_like(q))
    needed = robot.needed_torque(body.gravity_torque(q))
    return np.maximum(needed / limits - _USABLE_SHARE, 0.0).sum(axis=-1)


def home_error(robot: RobotModel, body: RigidBody, home: Array) -> ConfigurationError:
    """Error for servos that do not hold the robot at its home."""
    limits = robot.largest_torque(np.zeros_like(home))
    needed = robot.needed_torque(body.gravity_torque(home))
    weakest = int((needed / limits).argmax())
    return arm_references.WeakServosError(
        f"at home the weight takes {needed[weakest]:.4g} N·m of the servo of joint"
        f" {robot.joint_names[weakest]!r}, which is limited to {limits[weakest]:.4g}"
        " N·m, and no pose near home was found that is held with a fifth to spare: a"
        " simulated robot would sink; raise its torque_limit, or choose another home"
    )


def plan_motion(
    config: JointConfig, robot: RobotModel, body: RigidBody, workspace: Workspace
) -> tuple[Motion, Array]:
    """Plan the motion of a robot, and check it; also return angles along it, (T, n) [rad].

    Raises:
        ConfigurationError: The motion leaves the joint ranges, or needs more torque than the servos
            have.
    """
    motion = arm_references.motion_of(config.reference, workspace)
    plan = motion.plan(np.random.default_rng(0), config.control_period_s)
    rows = slice(None, None, max(plan.num_steps // 500, 1))
    q = np.ascontiguousarray(plan.q[rows])
    _require_range(config, robot, q)
    _require_torque(config, robot, body, (q, plan.q_dot[rows], plan.q_ddot[rows]))
    return motion, q


def _require_range(config: JointConfig, robot: RobotModel, q: Array) -> None:
    """Refuse a reference that presses a joint against its limit."""
    ranges = joint_ranges(robot.rigid, robot.joint_names)
    for name, low, high, angle in zip(robot.joint_names, *ranges, q.T, strict=True):
        if angle.min() < low or angle.max() > high:
            raise ConfigurationError(
                f"the reference {config.reference.kind!r} moves joint {name!r} from"
                f" {angle.min():.3f} to {angle.max():.3f} rad, and its range is"
                f" {low:.3f} to {high:.3f} rad; lower the amplitude, or choose another home"
            )


def _require_torque(
    config: JointConfig, robot: RobotModel, body: RigidBody, motion: tuple[Array, Array, Array]
) -> None:
    """Refuse a reference that the servos cannot follow.

    `motion` has its angles, rates and accelerations.
    """
    q, q_dot, q_ddot = motion
    torque = body.inverse_dynamics(*motion) + robot.rotor_inertia * q_ddot
    # other draws have their largest torque at other speeds
    if config.reference.is_random:
        torque = np.abs(torque).max(axis=0)
        q_dot = np.abs(q_dot).max(axis=0)
    needed, limits = robot.demand(torque, q_dot)
    if not isinstance(config.reference, arm_references.OfArm):
        joint_config.require_torque(config.reference, needed, limits)
    elif np.any(needed > limits):
        weakest = np.unravel_index(np.argmax(needed - limits), needed.shape)
        weight = body.gravity_torque(q)
        needed_at_rest, limits_at_rest = robot.demand(weight, np.zeros_like(q))
        cure = "make its moves slower"
        if np.any((needed_at_rest > limits_at_rest)[:, weakest[-1]]):
            cure = "the weight alone is too much: raise its torque_limit, or choose other poses"
        raise arm_references.WeakServosError(
            f"the reference {config.reference.kind!r} can need {needed[weakest]:.4g}"
            f" N·m of the servo of joint {robot.joint_names[weakest[-1]]!r}, which is"
            f" limited to {limits[weakest]:.4g} N·m; {cure}"
        )


def warn_of_near_poses(
    names: Sequence[str],
    near: arm_references.Poses | arm_references.Moves,
    old_home: Sequence[float] | None,
    home: Array,
) -> None:
    """Warn that poses or home are changed because the servos are too weak for the usual ones."""
    changes = []
    shift = np.abs(home - (0.0 if old_home is None else np.array(old_home)))
    most = int(shift.argmax())
    if shift[most] > 0.0:
        changes.append(
            "home is moved to where the servos hold it, by up to"
            f" {shift[most]:.3g} rad (joint {names[most]!r})"
        )
    if near.within_rad < type(near)().within_rad:
        changes.append(f"poses are drawn within {near.within_rad:.3g} rad of home")
    warnings.warn(
        f"the servos are too weak for the usual {near.kind!r}; {' and '.join(changes)}."
        " To choose them, give within_rad, move_s or home",
        stacklevel=4,
    )


def warn_of_action_bound(config: JointConfig, assumed: RobotModel, torque: Array) -> None:
    """Warn where the weight along a reference bends joints by more than an action can compensate.

    Args:
        config: Configuration with the reference.
        assumed: The robot as a compensator may know it.
        torque: Gravity torque along the reference, (T, n) [N·m].
    """
    stiffness = assumed.rest_stiffness(config.form)
    most = passed_torque(np.abs(torque).max(axis=0), 1.0, 0.0, assumed.load_friction)
    needed = most / stiffness
    worst = int(needed.argmax())
    bound = config.action_bound_rad
    if needed[worst] > bound:
        warnings.warn(
            f"the weight along the reference {config.reference.kind!r} bends joint"
            f" {assumed.joint_names[worst]!r} by up to {needed[worst]:.3g} rad, and actions are"
            f" cut at ±{bound:g} rad: no policy can take all of it back. Spring and servo"
            f" together need {most[worst] / bound:.3g} N·m/rad and have {stiffness[worst]:.3g};"
            " give them more, raise action_bound_rad, or choose poses with less load",
            stacklevel=4,
        )
