"""The walk as a table: gait, ZMP, center of mass, pelvis, feet and joint angles.

The pelvis stays level at one height and moves so that the center of mass of the whole robot, not
the pelvis, follows the preview control.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import Servo
from elastic_env.motion import gait as gaits
from elastic_env.motion.gait import RIGHT, Gait, Timing
from elastic_env.motion.preview_control import PreviewConfig, follow_zmp
from elastic_env.rigid.biped import Biped
from elastic_env.rigid.contact_force import contact_points, load_share, shares
from elastic_env.rigid.floating_body import FloatingBody

_COM_TOLERANCE_M = 1e-10
_MAX_ITERATIONS = 50


@dataclass(frozen=True, eq=False)
class WalkPlan:
    """A walk in place, one row per control step.

    Row k is the end of control period k, row 0 the start.

    Positions are in the world frame: x forward, y left, z up, the origin on the ground halfway
    between the feet.

    Attributes:
        gait: What was planned.
        timing: Phases.
        q, q_dot, q_ddot: Joint angles and their derivatives, (T, 12) [rad], [rad/s], [rad/s²].
        zmp: Reference of the ZMP, (T, 2) [m].
        zmp_of_motion: ZMP of the planned motion by inverse dynamics, (T, 2) [m].
        com, com_dot: Center of mass in the plane, (T, 2) [m], [m/s].
        com_height: Height of the center of mass over the ground while the robot stands [m].
        gravity: Acceleration of gravity [m/s²].
        pelvis: Position of the level pelvis, (T, 3) [m].
        ankles: Left and right ankle, (T, 2, 3) [m].
        share: Share μ of the weight on the right foot, (T,).
        torque: Joint torques of the motion by inverse dynamics, the contact force shared by μ, (T,
            12) [N·m].
    """

    gait: Gait
    timing: Timing
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
    ankles: Array
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


@lru_cache(maxsize=32)
def plan_walk(gait: Gait, biped: Biped, control_period_s: float) -> WalkPlan:
    """Plan a walk; every plan is computed once.

    Args:
        gait: What to walk.
        biped: The robot as it is assumed.
        control_period_s: Time between rows [s].

    Raises:
        ConfigurationError: Durations that do not fit the control period.
        ElasticError: A foot out of reach.
    """
    timing = gaits.step_timing(gait, control_period_s)
    ankles = _ankle_paths(gait, timing, biped)
    zmp = gaits.zmp_reference(gait, timing, biped.footholds)
    standing, com_height = _standing(gait, biped, zmp[0], ankles[0])
    preview = PreviewConfig(
        com_height_m=com_height, period_s=control_period_s, gravity=biped.gravity
    )
    motion = follow_zmp(preview, zmp, zmp[0])
    start = np.tile(standing, (len(zmp), 1))
    pelvis = _pelvis_under(motion.com, start, biped, ankles, timing.time)
    q = _angles(biped, pelvis, ankles, timing.time)
    dynamics = _dynamics(biped, pelvis, q, control_period_s)
    q_dot, q_ddot = derivatives(q, control_period_s)
    share = load_share(zmp, gaits.support_points(gait, biped.footholds))
    torque = _joint_torque(biped, ankles, q, dynamics, share)
    return WalkPlan(
        gait=gait,
        timing=timing,
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
        ankles=ankles,
        share=share,
        torque=torque,
    )


def with_torque(plan: WalkPlan, biped: Biped, control_period_s: float) -> WalkPlan:
    """The same motion with the torques and the ZMP that it has on another robot of that size."""
    dynamics = _dynamics(biped, plan.pelvis, plan.q, control_period_s)
    torque = _joint_torque(biped, plan.ankles, plan.q, dynamics, plan.share)
    return replace(plan, torque=torque, zmp_of_motion=dynamics.zmp)


def require_feasible(plan: WalkPlan, biped: Biped, servos: tuple[Servo, ...]) -> None:
    """A plan that the robot cannot follow is an error now, not a fall later.

    Raises:
        ConfigurationError: A joint leaves its range or needs more speed or torque than its servo
            has.
    """
    joints = [biped.rigid.joint(name) for name in biped.joint_names]
    low, high = np.array([joint.range for joint in joints]).T
    speed = np.array([servo.speed_limit for servo in servos])
    torque = np.array([servo.torque_limit for servo in servos])
    for needed, allowed, sign, what, unit in (
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
                f" {plan.timing.time[row]:.3f} s: it allows {what} {sign * allowed[joint]:.3f}"
                f" {unit}, the plan needs {sign * needed[row, joint]:.3f} {unit}; use longer"
                " durations, a lower lift or another hip height"
            )


def derivatives(samples: Array, period_s: float) -> tuple[Array, Array]:
    """First and second derivative by central differences, time first; zero at the ends."""
    first = np.zeros_like(samples)
    second = np.zeros_like(samples)
    first[1:-1] = (samples[2:] - samples[:-2]) / (2.0 * period_s)
    second[1:-1] = (samples[2:] - 2.0 * samples[1:-1] + samples[:-2]) / period_s**2
    return first, second


def swing_height(progress: Array) -> Array:
    """Height of the swing foot over its lift, 64 s³ (1 − s)³: it starts and ends at rest."""
    return 64.0 * (progress * (1.0 - progress)) ** 3


def _ankle_paths(gait: Gait, timing: Timing, biped: Biped) -> Array:
    ankles = np.empty((len(timing.time), 2, 3))
    ankles[..., :2] = biped.footholds
    ankles[..., 2] = biped.ankle_height
    rows = np.arange(len(timing.time))
    ankles[rows, RIGHT - timing.support, 2] += gait.lift_m * swing_height(timing.swing)
    return ankles


def _standing(gait: Gait, biped: Biped, zmp: Array, ankles: Array) -> tuple[Array, float]:
    """Pelvis over the ZMP at rest, and the height of the center of mass."""
    start = np.array([[*zmp, gait.hip_height_m]])
    begin = np.zeros(1)
    pelvis = _pelvis_under(zmp[None], start, biped, ankles[None], begin)
    q = _angles(biped, pelvis, ankles[None], begin)
    com = pelvis + biped.chains.center_of_mass(q)
    return pelvis[0], float(com[0, 2])


def _pelvis_under(com: Array, start: Array, biped: Biped, ankles: Array, time: Array) -> Array:
    """Pelvis of one height that puts the center of mass where it belongs."""
    pelvis = np.array(start)
    error = np.full(1, np.inf)
    for _ in range(_MAX_ITERATIONS):
        q = _angles(biped, pelvis, ankles, time)
        error = pelvis[:, :2] + biped.chains.center_of_mass(q)[:, :2] - com
        pelvis[:, :2] -= error
        if np.abs(error).max() < _COM_TOLERANCE_M:
            return pelvis
    raise ElasticError(
        f"no pelvis position brings the center of mass within {_COM_TOLERANCE_M} m of its"
        f" reference; {np.abs(error).max():.3g} m are left after {_MAX_ITERATIONS} iterations"
    )


def _angles(biped: Biped, pelvis: Array, ankles: Array, time: Array) -> Array:
    try:
        return biped.joint_angles(pelvis, ankles)
    except ElasticError:
        from_hip = ankles - pelvis[:, None] - biped.hips
        reach = biped.leg.reach
        distance = np.linalg.norm(from_hip, axis=-1)
        row, leg = np.unravel_index(int(np.argmax(distance)), distance.shape)
        x, y, z = from_hip[row, leg]
        vertical = "lift_m" if z > 0.0 else "hip_height_m"
        # what would bring the foot into reach if its part of the distance were gone
        left = {vertical: np.hypot(x, y), "hip_half_spacing": np.hypot(x, z)}
        helps = [name for name, rest in left.items() if rest < reach]
        excess = max(float(distance[row, leg]) - reach, np.finfo(np.float64).eps)
        decimals = max(4, -int(np.floor(np.log10(excess))))
        raise ConfigurationError(
            f"the {('left', 'right')[leg]} foot is out of reach at {time[row]:.3f} s:"
            f" {distance[row, leg]:.{decimals}f} m from the hip to the ankle, at most {reach:g} m;"
            f" lower {' or '.join(helps or [vertical])}"
        ) from None


@dataclass(frozen=True)
class _Dynamics:
    """Force of the ground, its ZMP and vertical moment; torque of the joints, (T, ...) each."""

    force: Array
    zmp: Array
    moment: Array
    torque: Array


def _dynamics(biped: Biped, pelvis: Array, q: Array, period_s: float) -> _Dynamics:
    """Inverse dynamics of the whole body."""
    body = FloatingBody(biped.rigid, biped.joint_names)
    pelvis_dot, pelvis_ddot = derivatives(pelvis, period_s)
    q_dot, q_ddot = derivatives(q, period_s)
    wrench, torque = body.inverse_dynamics(q, pelvis_dot, q_dot, pelvis_ddot, q_ddot)
    force = wrench[:, :3]
    moment = wrench[:, 3:]
    # the moment of the ground's force about the pelvis has no horizontal part about the ZMP
    height = -pelvis[:, 2]
    x = (-moment[:, 1] + height * force[:, 0]) / force[:, 2]
    y = (moment[:, 0] + height * force[:, 1]) / force[:, 2]
    about_zmp = moment[:, 2] - (x * force[:, 1] - y * force[:, 0])
    zmp = np.stack([x, y], axis=-1) + pelvis[:, :2]
    return _Dynamics(force, zmp, about_zmp, torque)


def _joint_torque(
    biped: Biped, ankles: Array, q: Array, dynamics: _Dynamics, share: Array
) -> Array:
    """Joint torques, the ground's force shared between the feet, (T, 12) [N·m]."""
    weights = shares(share)
    points = np.zeros((len(q), 2, 3))
    points[..., :2] = contact_points(dynamics.zmp, share, biped.footholds)
    forces = weights[..., None] * dynamics.force[:, None]
    moments = np.zeros_like(forces)
    moments[..., 2] = weights * dynamics.moment[:, None]
    arms = points - ankles
    # soles and pelvis are level: the feet's frames are parallel to the world's
    moments += np.cross(arms, forces)
    contact = biped.chains.loads(len(q), wrench=(forces, moments))
    return dynamics.torque + biped.chains.torque(contact, q)
