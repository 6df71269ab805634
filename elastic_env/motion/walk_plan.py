"""Plan of a walk as a table: footholds, ZMP, center of mass, pelvis, feet and joint angles.

The pelvis stays level at one height, with the mean heading of the feet. It moves so that the center
of mass of the whole robot follows the preview control.

Swinging legs move the ZMP away from that of the cart-table: 2.5 mm rms in steps of 3 s, 9 mm in
steps of 1.1 s. A second pass of the preview control on the error of the ZMP [Kajita2003]
leaves about a seventh of it. Plans of a robot that does not walk in place have this second pass. A
policy can walk a plan with a further pass (`baselines.walking.refined_plan`).

The plan's world frame: x forward at the start, y left, z up, the origin on the ground halfway
between the feet at the start. The local frame, in which policies read the plan: level, on the
ground halfway between the planned feet, x along their mean heading. It moves and turns by half as
much as a swing foot. Where the robot walks in place, both frames are the same.

[Kajita2003] S. Kajita et al., "Biped Walking Pattern Generation by using Preview Control of
Zero-Moment Point", ICRA.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import Servo
from elastic_env.motion import gait as gaits
from elastic_env.motion.foot_clearance import require_clear_feet
from elastic_env.motion.gait import RIGHT, Footholds, Gait, Timing
from elastic_env.motion.preview_control import PreviewConfig, follow_zmp
from elastic_env.motion.trajectory import derivatives
from elastic_env.motion.walk_dynamics import Feet, walk_dynamics, walk_torque
from elastic_env.rigid.biped import Biped
from elastic_env.rigid.contact_force import load_share
from elastic_env.rigid.leg_kinematics import turn

_COM_TOLERANCE_M = 1e-10
_MAX_ITERATIONS = 50


@dataclass(frozen=True, eq=False)
class LocalPlan:
    """A plan in the local frame of the module, one row per control step.

    Attributes:
        com: Center of mass in the plane, (T, 2) [m].
        com_dot: Its rate relative to the support foot, (T, 2) [m/s].
        pelvis: Position of the pelvis, (T, 3) [m].
        ankles: Left and right ankle, (T, 2, 3) [m].
        foot_yaw: Headings of the feet, (T, 2) [rad].
    """

    com: Array
    com_dot: Array
    pelvis: Array
    ankles: Array
    foot_yaw: Array


@dataclass(frozen=True, eq=False)
class WalkPlan:
    """A walk, one row per control step.

    Row k is the end of control period k, row 0 the start. Positions are in the plan's world frame,
    see the module.

    Attributes:
        gait: Gait of the plan.
        timing: Phases.
        footholds: Footholds by step.
        q, q_dot, q_ddot: Joint angles and their derivatives, (T, 12) [rad], [rad/s], [rad/s²].
        zmp: Reference of the ZMP, (T, 2) [m].
        zmp_of_motion: ZMP of the planned motion by inverse dynamics, (T, 2) [m].
        com, com_dot: Center of mass in the plane, (T, 2) [m], [m/s].
        com_height: Height of the center of mass over the ground while the robot stands [m].
        gravity: Acceleration of gravity [m/s²].
        pelvis: Position of the level pelvis, (T, 3) [m].
        heading, heading_dot: Heading of the pelvis, positive to the left, counted over full turns,
            and its rate, (T,) [rad], [rad/s].
        ankles: Left and right ankle, (T, 2, 3) [m].
        foot_yaw: Headings of the feet, (T, 2) [rad].
        share: Share μ of the weight on the right foot, (T,).
        torque: Joint torques of the motion by inverse dynamics, the contact force shared by μ, (T,
            12) [N·m].
    """

    gait: Gait
    timing: Timing
    footholds: Footholds
    q: Array
    q_dot: Array
    q_ddot: Array
    zmp: Array
    zmp_of_motion: Array
    com: Array
    com_dot: Array
    com_height: float
    gravity: float
    pelvis: Array
    heading: Array
    heading_dot: Array
    ankles: Array
    foot_yaw: Array
    share: Array
    torque: Array

    @property
    def num_steps(self) -> int:
        """Control steps of an episode."""
        return len(self.q) - 1

    @property
    def omega(self) -> float:
        """Natural frequency of the inverted pendulum, √(g/z_c) [1/s]."""
        return float(np.sqrt(self.gravity / self.com_height))

    @cached_property
    def origin(self) -> Array:
        """Origin of the local frame, halfway between the feet, (T, 2) [m]."""
        return self.ankles[..., :2].mean(axis=1)

    @cached_property
    def local(self) -> LocalPlan:
        """The plan in the local frame."""
        origin = np.pad(self.origin, ((0, 0), (0, 1)))
        ankles = turn(self.ankles - origin[:, None], -self.heading[:, None])
        com = turn(self.com - origin[:, :2], -self.heading)
        lever = com - ankles[np.arange(len(com)), self.timing.support, :2]
        across = np.stack([-lever[:, 1], lever[:, 0]], axis=-1)
        turning = self.heading_dot[:, None] * across
        return LocalPlan(
            com=com,
            com_dot=turn(self.com_dot, -self.heading) - turning,
            pelvis=turn(self.pelvis - origin, -self.heading),
            ankles=ankles,
            foot_yaw=self.foot_yaw - self.heading[:, None],
        )


@lru_cache(maxsize=32)
def plan_walk(gait: Gait, biped: Biped, control_period_s: float) -> WalkPlan:
    """Plan a walk; every plan is computed once.

    Args:
        gait: Gait.
        biped: The assumed robot.
        control_period_s: Time between rows [s].

    Raises:
        ConfigurationError: Durations that do not fit the control period.
        ElasticError: A foot out of reach.
    """
    timing = gaits.step_timing(gait, control_period_s)
    footholds = gaits.footholds(gait, biped.footholds)
    if not gait.is_in_place:
        require_clear_feet(footholds, biped.sole_half_size)
    feet = _foot_paths(gait, timing, footholds, biped)
    zmp = gaits.zmp_reference(gait, timing, footholds)
    first = Feet(feet.ankles[:1], feet.yaw[:1], feet.heading[:1])
    standing, com_height = _standing_pelvis(gait, biped, zmp[0], first)
    preview = PreviewConfig(
        com_height_m=com_height, period_s=control_period_s, gravity=biped.gravity
    )
    motion = follow_zmp(preview, zmp, zmp[0])
    start = turn(np.tile(standing, (len(zmp), 1)), feet.heading)
    start[:, :2] += feet.ankles[..., :2].mean(axis=1)
    pelvis = _find_pelvis(motion.com, start, biped, feet, timing.time)
    q = _joint_angles(biped, pelvis, feet, timing.time)
    dynamics = walk_dynamics(biped, pelvis, feet.heading, q, control_period_s)
    q_dot, q_ddot = derivatives(q, control_period_s)
    offsets = turn(gaits.inward_offsets(gait, footholds.positions[0]), feet.yaw)
    share = load_share(zmp, feet.ankles[..., :2] + offsets)
    torque = walk_torque(biped, feet, q, dynamics, share)
    plan = WalkPlan(
        gait=gait,
        timing=timing,
        footholds=footholds,
        q=q,
        q_dot=q_dot,
        q_ddot=q_ddot,
        zmp=zmp,
        zmp_of_motion=dynamics.zmp,
        com=motion.com,
        com_dot=motion.com_dot,
        com_height=com_height,
        gravity=biped.gravity,
        pelvis=pelvis,
        heading=feet.heading,
        heading_dot=derivatives(feet.heading, control_period_s)[0],
        ankles=feet.ankles,
        foot_yaw=feet.yaw,
        share=share,
        torque=torque,
    )
    return plan if gait.is_in_place else refine_plan(plan, biped, control_period_s)


@lru_cache(maxsize=32)
def refine_plan(plan: WalkPlan, biped: Biped, control_period_s: float) -> WalkPlan:
    """Return the plan after another pass of the preview control, with less error of the ZMP.

    Feet and ZMP reference stay as they are. Center of mass, pelvis and legs move differently.

    Args:
        plan: Plan of a walk.
        biped: The assumed robot.
        control_period_s: Time between rows [s].

    Raises:
        ElasticError: A foot out of reach.
    """
    preview = PreviewConfig(
        com_height_m=plan.com_height, period_s=control_period_s, gravity=plan.gravity
    )
    correction = follow_zmp(preview, plan.zmp - plan.zmp_of_motion, np.zeros(2))
    # this robot may carry more than the one of the plan
    from_pelvis = turn(biped.chains.center_of_mass(plan.q), plan.heading)
    com = (plan.pelvis + from_pelvis)[:, :2] + correction.com
    feet = Feet(plan.ankles, plan.foot_yaw, plan.heading)
    pelvis = _find_pelvis(com, plan.pelvis, biped, feet, plan.timing.time)
    q = _joint_angles(biped, pelvis, feet, plan.timing.time)
    q_dot, q_ddot = derivatives(q, control_period_s)
    refined = replace(
        plan,
        q=q,
        q_dot=q_dot,
        q_ddot=q_ddot,
        com=com,
        com_dot=plan.com_dot + correction.com_dot,
        pelvis=pelvis,
    )
    return with_torque(refined, biped, control_period_s)


def with_torque(plan: WalkPlan, biped: Biped, control_period_s: float) -> WalkPlan:
    """Return the same motion with the torques and the ZMP of another robot of the same size."""
    dynamics = walk_dynamics(biped, plan.pelvis, plan.heading, plan.q, control_period_s)
    feet = Feet(plan.ankles, plan.foot_yaw, plan.heading)
    torque = walk_torque(biped, feet, plan.q, dynamics, plan.share)
    return replace(plan, torque=torque, zmp_of_motion=dynamics.zmp)


def require_feasible(plan: WalkPlan, biped: Biped, servos: tuple[Servo, ...]) -> None:
    """Refuse a plan that the robot cannot follow: an error now, instead of a fall later.

    Raises:
        ConfigurationError: A joint leaves its range, or needs more speed or torque than its servo
            has.
    """
    joints = [biped.rigid.joint(name) for name in biped.joint_names]
    low, high = np.array([joint.range for joint in joints]).T
    speed = np.array([servo.speed_limit for servo in servos])
    torque = np.array([servo.torque_limit for servo in servos])
    for needed, allowed, sign, limit, unit in (
        (-plan.q, -low, -1.0, "an angle of at least", "rad"),
        (plan.q, high, 1.0, "an angle of at most", "rad"),
        (np.abs(plan.q_dot), speed, 1.0, "a speed of at most", "rad/s"),
        (np.abs(plan.torque), torque, 1.0, "at most", "N·m"),
    ):
        excess = needed - allowed
        row, joint = np.unravel_index(int(np.argmax(excess)), excess.shape)
        if excess[row, joint] > 0.0:
            raise ConfigurationError(
                f"the walk asks too much of joint {biped.joint_names[joint]!r} at"
                f" {plan.timing.time[row]:.3f} s: it allows {limit} {sign * allowed[joint]:.3f}"
                f" {unit}, the plan needs {sign * needed[row, joint]:.3f} {unit}; use longer"
                " durations, a lower lift or another hip height"
            )


def swing_height(progress: Array) -> Array:
    """Return the height of the swing foot over its lift, 64 s³ (1 − s)³, at rest at both ends."""
    return 64.0 * (progress * (1.0 - progress)) ** 3


def _foot_paths(gait: Gait, timing: Timing, holds: Footholds, biped: Biped) -> Feet:
    """Return the paths of the feet, with the heights of their swings."""
    ankles = np.empty((len(timing.time), 2, 3))
    ankles[..., :2], yaw = holds.paths(timing)
    ankles[..., 2] = biped.ankle_height
    rows = np.arange(len(timing.time))
    ankles[rows, RIGHT - timing.support, 2] += gait.lift_m * swing_height(timing.swing)
    return Feet(ankles, yaw, yaw.mean(axis=1))


def _standing_pelvis(gait: Gait, biped: Biped, zmp: Array, feet: Feet) -> tuple[Array, float]:
    """Return the pelvis over the ZMP at rest, and the height of the center of mass."""
    start = np.array([[*zmp, gait.hip_height_m]])
    begin = np.zeros(1)
    pelvis = _find_pelvis(zmp[None], start, biped, feet, begin)
    q = _joint_angles(biped, pelvis, feet, begin)
    com = pelvis + turn(biped.chains.center_of_mass(q), feet.heading)
    return pelvis[0], float(com[0, 2])


def _find_pelvis(com: Array, start: Array, biped: Biped, feet: Feet, t: Array) -> Array:
    """Find the pelvis of one height that brings the center of mass to its reference."""
    pelvis = np.array(start)
    error = np.full(1, np.inf)
    for _ in range(_MAX_ITERATIONS):
        q = _joint_angles(biped, pelvis, feet, t)
        from_pelvis = turn(biped.chains.center_of_mass(q)[:, :2], feet.heading)
        error = pelvis[:, :2] + from_pelvis - com
        pelvis[:, :2] -= error
        if np.abs(error).max() < _COM_TOLERANCE_M:
            return pelvis
    raise ElasticError(
        f"no pelvis position brings the center of mass within {_COM_TOLERANCE_M} m of its"
        f" reference; {np.abs(error).max():.3g} m are left after {_MAX_ITERATIONS} iterations"
    )


def _joint_angles(biped: Biped, pelvis: Array, feet: Feet, time: Array) -> Array:
    """Solve the inverse kinematics of all rows."""
    try:
        return biped.joint_angles(pelvis, feet.ankles, feet.heading, feet.yaw)
    except ElasticError:
        raise _reach_error(biped, pelvis, feet, time) from None


def _reach_error(biped: Biped, pelvis: Array, feet: Feet, time: Array) -> ConfigurationError:
    """Return the error for the foot that is farthest out of reach, and parameters to lower."""
    from_hip = turn(feet.ankles - pelvis[:, None], -feet.heading[:, None]) - biped.hips
    reach = biped.leg.reach
    distance = np.linalg.norm(from_hip, axis=-1)
    row, leg = np.unravel_index(int(np.argmax(distance)), distance.shape)
    x, y, z = from_hip[row, leg]
    vertical = "lift_m" if z > 0.0 else "hip_height_m"
    is_wide = np.ptp(feet.ankles[0, :, 1]) > np.ptp(biped.hips[:, 1])
    # distance without the part of each parameter: below the reach, the parameter can cure it
    other_parts = {
        vertical: np.hypot(x, y),
        "step_width_m" if is_wide else "hip_half_spacing": np.hypot(x, z),
        "step_length_m": np.hypot(y, z),
    }
    cures = [name for name, rest in other_parts.items() if rest < reach]
    excess = max(float(distance[row, leg]) - reach, np.finfo(np.float64).eps)
    decimals = max(4, -int(np.floor(np.log10(excess))))
    return ConfigurationError(
        f"the {('left', 'right')[leg]} foot is out of reach at {time[row]:.3f} s:"
        f" {distance[row, leg]:.{decimals}f} m from the hip to the ankle, at most"
        f" {reach:g} m; lower {' or '.join(cures or [vertical])}"
    )
