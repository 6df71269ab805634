r"""Compensation on a live robot: arrays in, arrays out, no environment.

The command leads the link by the deflection of its spring, and by the sag of the servo itself:

.. math:: u = q + \left(K^{-1} + k_p^{-1}\right) \tau(q, \dot q, \ddot q)

Eq. 9 is this equation at rest, for a servo that holds its angle. τ is the torque that the joints
have to deliver: gravity, inertia, a payload, springs of the model's joints; `gravcomp` of its
bodies lowers it. It excludes damping and friction of the model. Eq. 10 turns the angle of a motor
encoder into the link angle.

Where dry friction grows with the load, or falls from rest, the joints have to overcome it, too:
τ_J = τ + s (F + c |τ_J|), with the direction s of the last motion. s changes its sign with the
desired motion, keeps its value at rest, and ignores small motion within a dead zone, see
`baselines.compensation.dry_friction`. Such a joint stays where it stops, so that the lag of its
servo is compensated, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from baselines.compensation.command_warnings import CommandWarnings
from baselines.compensation.dry_friction import FrictionCompensation
from baselines.compensation.joint_arguments import (
    PerJoint,
    make_friction,
    read_joint_file,
    read_stiffness,
    servo_gains,
)
from baselines.compensation.largest_torque import largest_gravity_torque
from elastic_env.core.config import Model, quantity
from elastic_env.core.errors import ActionError, ElasticError, quote, require_known
from elastic_env.core.signals import Array, BoolArray
from elastic_env.joint.default_hinges import commanded_hinges
from elastic_env.joint.load_continuation import follow_load
from elastic_env.joint.model_file import GivenModel, compiled_model
from elastic_env.joint.model_joints import held_positions
from elastic_env.joint.supported_models import require_robot
from elastic_env.motion.trajectory import minimum_jerk
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.world.robot_model import joint_ranges

Rates = ArrayLike | None
"""Rates or accelerations of a motion; None at rest."""
_Motion = tuple[Array, Array | None, Array | None]
"""Angles, rates and accelerations of the links, (n,) each; None for none."""
_LAST_STEP_RAD = 1e-8
"""A Newton step below this is the last one: the error behind it is much smaller [rad]."""
_MAX_ITERATIONS = 50
_LARGEST_STEP_RAD = 1e6
"""Newton steps beyond this do not converge [rad]."""
_FAR_RAD = 0.5
"""Deflection beyond which there may be other equilibria [rad]."""
_LAST_RESIDUAL_RAD = 1e-12
_SAME_RAD = 1e-6
"""Largest distance of two results that count as one equilibrium [rad]."""


@dataclass(frozen=True)
class CompensatorConstants:
    """Constants of a compensator, also for programs in other languages.

    Attributes:
        model: Compiled rigid model.
        body: Its links and springs; without a load they are `body.tree`.
        tip: Number of the body that carries a payload where none is named.
        compliance: 1/K, zero for a rigid joint, (n,) [rad/(N·m)].
        of_command: Sum of `compliance` and 1/k_p of the servo, (n,) [rad/(N·m)].
        lowest, highest: Joint ranges, infinite without one, (n,) each [rad].
        limit_rad: Largest offset [rad].
        ramp_steps: Commands within which an offset or a payload grows; 0 for at once.
        period_s: Time between two commands [s].
        friction: Dry friction; None where it is not compensated.
        viscous: Viscous friction, (n,) [N·m·s/rad]. It and the next three are used only with
            `friction`.
        lag_s: Lag of the servos, (n,) [s].
        fastest: No-load speed of the servos, infinite where it is not known, (n,) [rad/s].
        rotor_s2: Lag behind an acceleration, B/k_p, (n,) [s²].
    """

    model: mujoco.MjModel
    body: RigidBody
    tip: int
    compliance: Array
    of_command: Array
    lowest: Array
    highest: Array
    limit_rad: float
    ramp_steps: int
    period_s: float
    friction: FrictionCompensation | None
    viscous: Array
    lag_s: Array
    fastest: Array
    rotor_s2: Array


class PositionCompensator:
    """Commands and link angles of a robot with elastic joints, see the module.

    A value that is no angle raises `ActionError` and changes nothing: keep the last command then.

    Attributes:
        joints: Names of the joints, in the order of all arrays.
        settings: Settings of each joint by name, read from `stiffness`.
        constants: Constants of its equations.
        clipped: True for joints whose last command met a limit, (n,).
        needed: Largest offsets that the weight needs within the joint ranges, (n,) [rad].

    Args:
        model: Compiled rigid model on a fixed base.
        stiffness: K [N·m/rad]; infinite for a rigid joint. By name or pattern a value is a number,
            `rigid`, `held`, or a mapping as `elastic_env.joint.joint_settings` reads it. Such a
            mapping gives K and the servo's k_p and k_i. With `friction` it also gives dry and
            viscous friction, and the lag of the servo by k_v, the back-EMF and the rotor. Without,
            these do not change where the joint rests, as damping does not. Backlash is refused.
        joints: Hinges that are commanded, in the order of the arrays; None for all that are not
            held, in the order of the model. The other joints are held where the model's first
            keyframe has them, or at its reference.
        position_gain: k_p of servos that give way under a load [N·m/rad], infinite for servos that
            hold their angle; None for the servos in `stiffness`. Where neither gives it and the
            model has position actuators, a warning names their k_p.
        limit_rad: Largest offset between command and desired angle [rad].
        ramp_s: Time within which offsets grow from zero after the start, and within which a
            payload grows [s]. With dry friction, begin to move after it: friction holds a link
            that has come to rest before.
        period_s: Time between two commands, for the ramp, and for the rate of desired angles
            without one [s].
        friction: True to compensate the dry friction in `stiffness`, False not to; None to do so
            where any of it grows with the load or falls from rest.

    Raises:
        ConfigurationError: The model or a value cannot be used; the message names it.

    Warns:
        UserWarning: Once each: the weight needs more than `limit_rad`, a command meets a limit, a
            payload moves the command at once, or servos of the model give way and no argument gives
            their k_p.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        stiffness: PerJoint,
        *,
        joints: Sequence[str] | None = None,
        position_gain: PerJoint | None = None,
        limit_rad: float = 0.2,
        ramp_s: float = 0.0,
        period_s: float = 0.01,
        friction: bool | None = None,
    ) -> None:
        require_robot(model)
        leaves_out_held = joints is None
        if joints is None:
            named = stiffness if isinstance(stiffness, Mapping) else ()
            joints = commanded_hinges(model, named)
        self.settings = read_stiffness(model, stiffness, joints, leaves_out_held)
        self.joints = tuple(self.settings)
        settings = list(self.settings.values())
        lowest, highest = joint_ranges(model, self.joints)
        compliance = 1.0 / np.array([joint.stiffness for joint in settings])
        gains = servo_gains(model, self.settings, position_gain)
        limits = CommandLimits(limit_rad=limit_rad, ramp_s=ramp_s, period_s=period_s)
        self.constants = CompensatorConstants(
            model=model,
            body=RigidBody(model, self.joints, held_positions(model, self.joints)),
            tip=max(int(model.joint(name).bodyid[0]) for name in self.joints),
            compliance=compliance,
            of_command=compliance + 1.0 / gains,
            lowest=lowest,
            highest=highest,
            limit_rad=limits.limit_rad,
            ramp_steps=int(np.ceil(limits.ramp_s / limits.period_s)),
            period_s=limits.period_s,
            friction=make_friction(self.settings, friction),
            viscous=np.array([j.viscous_friction or 0.0 for j in settings]),
            lag_s=np.array([j.servo.braking for j in settings]) / gains,
            fastest=np.array([j.servo.fastest for j in settings]),
            rotor_s2=np.array([j.rotor_inertia or 0.0 for j in settings]) / gains,
        )
        from scipy import linalg  # late, see `elastic_env.motion.preview_control`

        # without the checks of lu_factor, which take longer
        self._lu_factor, self._lu_solve = linalg.get_lapack_funcs(("getrf", "getrs"))
        self._warnings = CommandWarnings(self.joints, lowest, highest, limits.limit_rad)
        self.reset()
        torque = largest_gravity_torque(self.constants.body, lowest, highest)
        if self.constants.friction is not None:
            torque = self.constants.friction.largest_joint_torque(torque)
        self.needed = self.constants.of_command * torque
        if (self.needed > limits.limit_rad).any():
            self._warnings.warn_of_limit(self.needed, "at some pose within the joint ranges")

    @classmethod
    def from_model(
        cls, model: GivenModel, stiffness: PerJoint | str | Path, **options: Any
    ) -> Self:
        """Make a compensator from a file of MJCF or URDF, its text, or a compiled model of MuJoCo.

        Further arguments are those of the class.

        `stiffness` may be a YAML file, such as the `joints.yaml` of `elastic identify --robot`.
        Hinges that such a file does not name were not identified, and are rigid.

        Raises:
            ConfigurationError: The file or a value cannot be used.

        Warns:
            UserWarning: See the class; or hinges are taken for rigid.
        """
        compiled = compiled_model(model)
        require_robot(compiled)
        by_joint = read_joint_file(compiled, stiffness, options.get("joints"))
        return cls(compiled, by_joint, **options)

    def reset(self) -> None:
        """Begin again: the ramp starts at zero, without a payload."""
        self._count = 0
        self._last_motion: _Motion | None = None
        self._payload_kg = self._wanted_kg = self._step_kg = 0.0
        self._carrier = self.constants.tip
        self._place = np.zeros(3)
        self.constants.body.set_load(self._carrier, 0.0, self._place)
        if self.constants.friction is not None:
            self._friction_memory = self.constants.friction.begin((len(self.joints),))
        self.clipped: BoolArray = np.zeros(len(self.joints), dtype=np.bool_)

    def set_payload(
        self, mass_kg: float, at: ArrayLike = (0, 0, 0), body: str | None = None
    ) -> None:
        """Let the robot carry another point mass.

        Its mass grows from the last one within the time of the ramp. At another place or on another
        body it grows from zero, and the last mass is dropped at once.

        Args:
            mass_kg: Mass, 0 for none [kg].
            at: Its place in the frame of the body or site, (3,) [m].
            body: Body or site that carries it; None for the body of the last joint.

        Raises:
            ConfigurationError: No mass, no place, or no such body or site.
        """
        payload = Payload(mass_kg=mass_kg, at=at)  # pyright: ignore[reportArgumentType]
        carrier, place = self._find_carrier(np.array(payload.at), body)
        torque_before = self._last_joint_torque()
        if (carrier, *place) != (self._carrier, *self._place):
            self._payload_kg = 0.0
            self._carrier = carrier
            self._place = place
        self._wanted_kg = payload.mass_kg
        steps = self.constants.ramp_steps
        self._step_kg = abs(payload.mass_kg - self._payload_kg) / max(steps, 1)
        if steps == 0:
            self._payload_kg = payload.mass_kg
        self.constants.body.set_load(self._carrier, self._payload_kg, self._place)
        jump = self.constants.of_command * (self._last_joint_torque() - torque_before)
        self._warnings.warn_of_jump(jump, has_ramp=steps > 0)

    def torque(self, q: ArrayLike, q_dot: Rates = None, q_ddot: Rates = None) -> Array:
        """Torque that the joints have to deliver, (n,) [N·m]; arguments and errors as `command`."""
        return self._torque(*self._read_motion(q, q_dot, q_ddot))

    def command(self, q_desired: ArrayLike, q_dot: Rates = None, q_ddot: Rates = None) -> Array:
        """Servo command that brings the links to their desired angles.

        Args:
            q_desired: Link angles, (n,) [rad].
            q_dot: Their rates, (n,) [rad/s]; None at rest. Dry friction then takes them from the
                last call, unless they are faster than a servo turns, as for a new pose.
            q_ddot: Their accelerations, (n,) [rad/s²]; None for none.

        Returns:
            Commands within the offset's limit and the model's joint ranges, (n,) [rad].

        Raises:
            ActionError: A wrong number of values, or one that is not finite.
        """
        motion = self._read_motion(q_desired, q_dot, q_ddot)
        self._ramp_payload()
        offset = self._offset(motion)
        constants = self.constants
        if self._count < constants.ramp_steps:
            self._count += 1
            offset *= minimum_jerk(np.array(self._count / constants.ramp_steps))
        wanted = offset + motion[0]
        limit = constants.limit_rad
        limited = np.minimum(np.maximum(offset, -limit), limit) + motion[0]
        command = np.minimum(np.maximum(limited, constants.lowest), constants.highest)
        self.clipped = command != wanted
        self._last_motion = motion
        if self.clipped.any():
            if np.abs(offset).max() > limit:
                self._warnings.warn_of_limit(np.abs(offset), "now")
            self._warnings.warn_of_range(wanted)
        return command

    def link_angle(self, theta: ArrayLike) -> Array:
        """Link angles at rest for motor encoders at θ: Eq. 10.

        Compensated friction holds the link back against the direction of the last commands.

        Args:
            theta: Motor side, (n,) [rad].

        Returns:
            q, (n,) [rad].

        Raises:
            ActionError: A wrong number of values, or one that is not finite.
            ElasticError: The load overcomes a spring: there is no equilibrium that a growing load
                leads to, or there are several.
        """
        encoder = self._read_vector("theta", theta, "rad")
        compliance = self.constants.compliance
        jacobian = compliance[:, None] * self._joint_torque_gradient(encoder)
        size = jacobian.ravel()
        # by the Frobenius norm, which is fast: there may be other equilibria
        is_soft = size.dot(size) >= 1.0
        jacobian.flat[:: len(encoder) + 1] += 1.0
        # as `static_link_angle`, but by 1/K, so that a joint may be rigid, and with the gradient at
        # θ alone, for speed; the first step is Eq. 12
        factors, pivots, is_singular = self._lu_factor(jacobian)
        if is_singular:
            return self._soft_link_angle(encoder, None)
        q = encoder
        for _ in range(_MAX_ITERATIONS):
            residual = q - encoder + compliance * self._joint_torque_at_rest(q)
            step, _ = self._lu_solve(factors, pivots, residual)
            q = q - step
            squared = residual.dot(residual)
            if squared < _LAST_STEP_RAD**2:
                deflection = q - encoder
                if is_soft or deflection.dot(deflection) > _FAR_RAD**2:
                    return self._soft_link_angle(encoder, q)
                return q
            if not squared < _LARGEST_STEP_RAD**2:
                break
        return self._soft_link_angle(encoder, None)

    def _offset(self, motion: _Motion) -> Array:
        """Offset along a motion, (n,) [rad]; the memory of the friction follows the motion."""
        constants = self.constants
        torque = self._torque(*motion)
        if constants.friction is None:
            return constants.of_command * torque
        q, q_dot, q_ddot = motion
        last = self._last_motion
        displacement = np.zeros_like(q) if last is None else q - last[0]
        before = self._friction_memory
        after = self._friction_memory = constants.friction.follow(displacement, before)
        if q_dot is None:  # without motion in the dead zone
            q_dot = (displacement + before.slack - after.slack) / constants.period_s
            q_dot[np.abs(q_dot) > constants.fastest] = 0.0  # a new pose, no motion
        lag = constants.lag_s * q_dot
        if q_ddot is not None:
            lag = lag + constants.rotor_s2 * q_ddot
        return constants.of_command * self._joint_torque(torque, q_dot) + lag

    def _joint_torque(self, torque: Array, q_dot: Array) -> Array:
        """τ_J that moves links against compensated friction, (n,) [N·m].

        Args:
            torque: τ that the links need, (n,) [N·m].
            q_dot: Their rates, (n,) [rad/s].
        """
        friction = self.constants.friction
        if friction is None:
            return torque
        torque = torque + self.constants.viscous * q_dot
        return friction.joint_torque(torque, q_dot, self._friction_memory)

    def _last_joint_torque(self) -> Array:
        """τ_J along the last motion, under the present payload, (n,) [N·m]; zero before any."""
        if self._last_motion is None:
            return np.zeros(len(self.joints))
        q, q_dot, _ = self._last_motion
        rate = np.zeros_like(q) if q_dot is None else q_dot
        return self._joint_torque(self._torque(*self._last_motion), rate)

    def _joint_torque_at_rest(self, q: Array) -> Array:
        """τ_J of links at rest, (..., n) [rad] to (..., n) [N·m]."""
        torque = self.constants.body.gravity_torque(q)
        friction = self.constants.friction
        if friction is None:
            return torque
        return friction.joint_torque(torque, np.zeros_like(q), self._friction_memory)

    def _joint_torque_gradient(self, q: Array) -> Array:
        """Gradient of τ_J at rest, (..., n) [rad] to (..., n, n) [N·m/rad]."""
        gradient = self.constants.body.gravity_gradient(q)
        friction = self.constants.friction
        if friction is None:
            return gradient
        torque = self.constants.body.gravity_torque(q)
        share = friction.share(torque, np.zeros_like(q), self._friction_memory)
        return share[..., None] * gradient

    def _soft_link_angle(self, theta: Array, guess: Array | None) -> Array:
        """Link angle on a spring that bends far, by a growing load; `guess` where it agrees."""
        constants = self.constants
        result = follow_load(
            theta,
            constants.compliance,
            self._joint_torque_at_rest,
            self._joint_torque_gradient,
            tolerance=_LAST_RESIDUAL_RAD,
            within=(constants.lowest, constants.highest),
        )
        if result.lost.any():
            reason = result.reason(constants.compliance, self.joints)
            raise ElasticError(f"no link angles for {theta} rad: {reason}")
        if guess is not None and np.abs(guess - result.q).max() < _SAME_RAD:
            return guess
        return result.q

    def _find_carrier(self, place: Array, name: str | None) -> tuple[int, Array]:
        """Number of the body that carries a payload, and the payload's place in it, (3,) [m].

        Args:
            place: Place in the frame of the named body or site, (3,) [m].
            name: Body or site; None for the body of the last joint.
        """
        if name is None:
            return self.constants.tip, place
        model = self.constants.model
        bodies = {model.body(i).name: i for i in range(model.nbody)}
        sites = [model.site(i).name for i in range(model.nsite)]
        require_known("body or site", [name], [*bodies, *sites])
        if name in bodies:
            return bodies[name], place
        site = model.site(name)
        mujoco.mju_rotVecQuat(place, place.copy(), site.quat)
        return int(site.bodyid[0]), place + site.pos

    def _read_motion(self, q: Any, q_dot: Any, q_ddot: Any) -> _Motion:
        q = self._read_vector("q_desired", q, "rad")
        if q_dot is not None:
            q_dot = self._read_vector("q_dot", q_dot, "rad/s")
        if q_ddot is not None:
            q_ddot = self._read_vector("q_ddot", q_ddot, "rad/s²")
        return q, q_dot, q_ddot

    def _read_vector(self, name: str, argument: Any, unit: str) -> Array:
        """An argument of a public method, as (n,)."""
        n = len(self.joints)
        try:
            values = np.asarray(argument, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (n,):
            is_array = isinstance(argument, np.ndarray)
            size = f", an array of shape {values.shape}" if is_array else ""
            needed = f"{n} numbers [{unit}], of {', '.join(self.joints)}"
            raise ActionError(f"{name} must be {needed}; got {quote(argument)}{size}")
        if not np.isfinite(values).all():
            joints = np.array(self.joints)[~np.isfinite(values)]
            got = f"{quote(values.tolist())}; see {', '.join(joints)}"
            raise ActionError(f"{name} must be finite [{unit}], got {got}")
        return values

    def _torque(self, q: Array, q_dot: Array | None, q_ddot: Array | None) -> Array:
        if q_dot is None and q_ddot is None:
            return self.constants.body.gravity_torque(q)
        q_dot = np.zeros(len(q)) if q_dot is None else q_dot
        q_ddot = np.zeros(len(q)) if q_ddot is None else q_ddot
        return self.constants.body.inverse_dynamics(q, q_dot, q_ddot)

    def _ramp_payload(self) -> None:
        """Move the payload one step towards the wanted one."""
        if self._payload_kg != self._wanted_kg:
            missing = self._wanted_kg - self._payload_kg
            if abs(missing) <= self._step_kg:
                self._payload_kg = self._wanted_kg
            else:
                self._payload_kg += np.copysign(self._step_kg, missing)
            self.constants.body.set_load(self._carrier, self._payload_kg, self._place)


class CommandLimits(Model):
    """Limit, ramp and period of commands."""

    limit_rad: float = quantity("rad", gt=0)
    """Largest offset between command and desired angle [rad]."""
    ramp_s: float = quantity("s", ge=0)
    """Time in which offsets grow from zero [s]."""
    period_s: float = quantity("s", gt=0)
    """Time between two commands [s]."""


class Payload(Model):
    """A point mass that the robot carries."""

    mass_kg: float = quantity("kg", ge=0)
    """Mass [kg]."""
    at: list[float] = quantity("m", min_length=3, max_length=3)
    """Place in the frame of what carries it [m]."""
