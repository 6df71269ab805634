r"""Compensation on a live robot: arrays in, arrays out, no environment.

The command leads the link by the deflection of its spring, and by what the servo itself gives way:

.. math:: u = q + \left(K^{-1} + k_p^{-1}\right) \tau(q, \dot q, \ddot q)

Eq. 9 is the case at rest of a servo that holds its angle. τ is the torque that the joints have to
deliver: gravity, inertia, a payload, springs of the model's joints; `gravcomp` of its bodies lowers
it. Damping and friction of the model are not in it. What a motor encoder shows is turned into the
link angle by Eq. 10.

Where dry friction grows with the load, or falls from rest, the joints have to deliver that, too:
τ_J = τ + s (F + c |τ_J|), with the direction s of the last motion. It turns round with the desired
angles, stays at rest, and leaves out a dead zone in which these may tremble, see
`baselines.compensation.dry_friction`. Such a joint stays where it stops, so that the lag of its
servo is taken off, too.
"""

import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.linalg import get_lapack_funcs

from baselines.compensation.dry_friction import FrictionCompensation
from elastic_env.core.config import Model, quantity, read_mapping
from elastic_env.core.errors import (
    ActionError,
    ConfigurationError,
    ElasticError,
    quote,
    require_known,
    unknown_name,
)
from elastic_env.core.signals import Array, BoolArray
from elastic_env.joint.commanded_joints import commanded_hinges
from elastic_env.joint.joint_settings import (
    HELD,
    RIGID,
    SOFTEST,
    JointSettings,
    ServoSettings,
    key_of,
    read_joints,
)
from elastic_env.joint.load_continuation import follow_load
from elastic_env.joint.model_file import GivenModel, compiled_model
from elastic_env.joint.model_joints import held_positions, hinges_of
from elastic_env.joint.model_servo import position_servo
from elastic_env.joint.supported_models import require_known_torque, require_robot
from elastic_env.motion.trajectory import minimum_jerk
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.world.robot_model import joint_ranges

PerJoint = float | Sequence[float] | Mapping[str, Any] | npt.NDArray[Any]
"""A number for all joints, one per joint in order, or by name or pattern, such as {"*": 1000,
"wrist_*": 300}.
"""

Rates = npt.ArrayLike | None
"""Rates or accelerations of a motion; None at rest."""
_Settings = Mapping[str, JointSettings]
_Motion = tuple[Array, Array | None, Array | None]
"""Angles, rates and accelerations of the links, (n,) each; None for none."""
_LAST_STEP_RAD = 1e-8
"""A step below this is the last one: what it leaves is smaller by the factor with which Newton's
steps shrink.
"""
_MOST_ITERATIONS = 50
_LARGEST_STEP_RAD = 1e6
"""Steps beyond this lead nowhere."""
_FAR_RAD = 0.5
"""Deflection beyond which there may be other equilibria."""
_LAST_RESIDUAL_RAD = 1e-12
_SAME_RAD = 1e-6
"""Largest distance of two results that count as one equilibrium."""
_FILES = (".yaml", ".yml")
_POSES = 500
_TRIES = 33
"""Poses at which the weight is looked at, and angles of a joint beside the heaviest of them."""
_JUMP_RAD = 1e-3
_CALM_RAD_S = 0.02
"""Jump of a command that is worth a word, and a rate of the command that is not [rad], [rad/s]."""
# without the checks of lu_factor, which take longer
_factored, _solved = get_lapack_funcs(("getrf", "getrs"))


@dataclass(frozen=True)
class CompensatorConstants:
    """What a compensator computes with, for programs in other languages.

    Attributes:
        model: Compiled rigid model.
        body: Its links and springs; without a load they are `body.tree`.
        tip: Number of the body that carries a payload where none is named.
        compliance: 1/K, zero for a rigid joint, (n,) [rad/(N·m)].
        of_command: The same and 1/k_p of the servo, (n,) [rad/(N·m)].
        lowest, highest: Joint ranges, infinite without one, (n,) each [rad].
        limit_rad: Largest offset [rad].
        ramp_steps: Commands in which an offset or a payload is taken over; 0 for at once.
        period_s: Time between two commands [s].
        friction: What is known of dry friction; None where it is not compensated.
        viscous: Viscous friction, used with dry friction alone, (n,) [N·m·s/rad].
        lag_s: Lag of the servos, likewise, (n,) [s].
        fastest: No-load speed of the servos, infinite where it is not known, (n,) [rad/s].
        rotor_s2: Lag behind an acceleration, B/k_p, likewise, (n,) [s²].
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
        settings: Of each joint by name, as `stiffness` says them.
        constants: What it computes with.
        clipped: Which joints of the last command met a limit, (n,).
        needed: Largest offsets that the weight needs within the joint ranges, (n,) [rad].

    Args:
        model: Compiled rigid model on a fixed base.
        stiffness: K [N·m/rad]; infinite for a rigid joint. By name or pattern a value is a number,
            `rigid`, `held`, or a mapping as `elastic_env.joint.joint_settings` reads it. Of such a
            mapping K and the servo's k_p and k_i are used; with `friction` also dry and viscous
            friction, and by how much k_v, the back-EMF and the rotor let the servo lag. Otherwise
            these act on the way to rest alone, as damping does. Backlash is refused.
        joints: Hinges that are commanded, in the order of the arrays; None for all that are not
            held, in the order of the model. The other joints are held where the model's first
            keyframe has them, or at its reference.
        position_gain: k_p of servos that give way under a load [N·m/rad], infinite for servos that
            hold their angle; None for what `stiffness` says of the servos. Where neither says it
            and the model has position actuators, a warning says their k_p.
        limit_rad: Largest offset between command and desired angle [rad].
        ramp_s: Time in which offsets grow from zero after the start, and in which a payload is
            taken over [s].
        period_s: Time between two commands, for the ramp, and for the rate of desired angles
            without one [s].
        friction: True to compensate the dry friction that `stiffness` says; None where any of it
            grows with the load or falls from rest.

    Raises:
        ConfigurationError: The model or a value cannot be used; the message says which.

    Warns:
        UserWarning: Once each: the weight needs more than `limit_rad`, a command meets a limit, a
            payload moves the command at once, or servos of the model give way and nobody says their
            k_p.
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
        is_free = joints is None
        if joints is None:
            named = stiffness if isinstance(stiffness, Mapping) else ()
            joints = commanded_hinges(model, named)
        settings = _read_stiffness(model, stiffness, joints, is_held_left_out=is_free)
        self.settings = settings
        self.joints = tuple(settings)
        own = list(settings.values())
        lowest, highest = joint_ranges(model, self.joints)
        compliance = 1.0 / np.array([one.stiffness for one in own])
        gains = _servo_gains(model, settings, position_gain)
        limits = CommandLimits(limit_rad=limit_rad, ramp_s=ramp_s, period_s=period_s)
        self.constants = CompensatorConstants(
            model=model,
            body=RigidBody(model, self.joints, held_positions(model, self.joints)),
            tip=max(int(model.jnt_bodyid[model.joint(name).id]) for name in self.joints),
            compliance=compliance,
            of_command=compliance + 1.0 / gains,
            lowest=lowest,
            highest=highest,
            limit_rad=limits.limit_rad,
            ramp_steps=int(np.ceil(limits.ramp_s / limits.period_s)),
            period_s=limits.period_s,
            friction=_friction(settings, friction),
            viscous=np.array([one.viscous_friction or 0.0 for one in own]),
            lag_s=np.array([one.servo.braking for one in own]) / gains,
            fastest=np.array([one.servo.fastest for one in own]),
            rotor_s2=np.array([one.rotor_inertia or 0.0 for one in own]) / gains,
        )
        self._said: set[str] = set()
        self.reset()
        heaviest = self._heaviest()
        if self.constants.friction is not None:
            heaviest = self.constants.friction.most_passed(heaviest)
        self.needed = self.constants.of_command * heaviest
        if (self.needed > limits.limit_rad).any():
            self._warn_of_offset(self.needed, "at some pose within the joint ranges")

    @classmethod
    def from_model(
        cls, model: GivenModel, stiffness: PerJoint | str | Path, **options: Any
    ) -> Self:
        """From a file of MJCF or URDF, its text, or what MuJoCo made of one.

        Further arguments are those of the class.

        `stiffness` may be a YAML file, such as the `joints.yaml` of `elastic identify --robot`.
        Hinges that such a file does not name are rigid, as those are that were not identified.

        Raises:
            ConfigurationError: The file or a value cannot be used.

        Warns:
            UserWarning: See the class; or hinges are taken for rigid.
        """
        compiled = compiled_model(model)
        require_robot(compiled)
        given: Any = stiffness
        if isinstance(stiffness, str | Path) and Path(stiffness).suffix in _FILES:
            given = _of_file(compiled, Path(stiffness), options.get("joints"))
        return cls(compiled, given, **options)

    def reset(self) -> None:
        """Begin anew: the ramp starts at zero, without a payload."""
        self._count = 0
        self._asked: _Motion | None = None
        self._load = self._load_wanted = self._load_step = 0.0
        self._carrier = self.constants.tip
        self._place = np.zeros(3)
        self.constants.body.set_load(self._carrier, 0.0, self._place)
        if self.constants.friction is not None:
            self._rubbed = self.constants.friction.begin((len(self.joints),))
        self.clipped: BoolArray = np.zeros(len(self.joints), dtype=np.bool_)

    def set_payload(
        self, mass_kg: float, at: npt.ArrayLike = (0, 0, 0), body: str | None = None
    ) -> None:
        """Let the robot carry another point mass.

        Commands take it over within the time of the ramp.

        In another place or on another body it is taken over from zero: the command lets go of the
        last one at once.

        Args:
            mass_kg: Mass, 0 for none [kg].
            at: Its place in the frame of the body or site, (3,) [m].
            body: Body or site that carries it; None for the body of the last joint.

        Raises:
            ConfigurationError: No mass, no place, or no such body or site.
        """
        payload = Payload(mass_kg=mass_kg, at=at)  # pyright: ignore[reportArgumentType]
        place = np.array(payload.at)
        carrier = self.constants.tip
        if body is not None:
            model = self.constants.model
            bodies = {model.body(i).name: i for i in range(model.nbody)}
            sites = [model.site(i).name for i in range(model.nsite)]
            require_known("body or site", [body], [*bodies, *sites])
            if body in bodies:
                carrier = bodies[body]
            else:
                site = model.site(body)
                carrier = int(site.bodyid[0])
                mujoco.mju_rotVecQuat(place, np.array(payload.at), site.quat)
                place += site.pos
        asked = self._asked
        before = None if asked is None else self._passed_along(asked)
        if (carrier, *place) != (self._carrier, *self._place):
            self._load = 0.0
            self._carrier = carrier
            self._place = place
        self._load_wanted = payload.mass_kg
        steps = self.constants.ramp_steps
        self._load_step = abs(payload.mass_kg - self._load) / max(steps, 1)
        if steps == 0:
            self._load = payload.mass_kg
        self.constants.body.set_load(self._carrier, self._load, self._place)
        if asked is not None and before is not None:
            jump = self._passed_along(asked) - before
            self._warn_of_jump(self.constants.of_command * jump)

    def torque(self, q: npt.ArrayLike, q_dot: Rates = None, q_ddot: Rates = None) -> Array:
        """Torque that the joints have to deliver, (n,) [N·m]; arguments and errors as `command`."""
        return self._torque(*self._motion(q, q_dot, q_ddot))

    def command(self, q_desired: npt.ArrayLike, q_dot: Rates = None, q_ddot: Rates = None) -> Array:
        """Servo command that brings the links to where they should be.

        Args:
            q_desired: Link angles, (n,) [rad].
            q_dot: Their rates, (n,) [rad/s]; None at rest. For dry friction they are then taken
                from the last call, but for what is faster than a servo turns: a new pose.
            q_ddot: Their accelerations, (n,) [rad/s²]; None for none.

        Returns:
            Commands within the offset's limit and the model's joint ranges, (n,) [rad].

        Raises:
            ActionError: A wrong number of values, or one that is not finite.
        """
        motion = self._motion(q_desired, q_dot, q_ddot)
        self._take_load()
        offset = self._lead(motion)
        known = self.constants
        if self._count < known.ramp_steps:
            self._count += 1
            offset *= minimum_jerk(np.array(self._count / known.ramp_steps))
        wanted = offset + motion[0]
        limit = known.limit_rad
        within = np.minimum(np.maximum(offset, -limit), limit) + motion[0]
        command = np.minimum(np.maximum(within, known.lowest), known.highest)
        self.clipped = command != wanted
        self._asked = motion
        if self.clipped.any():
            if np.abs(offset).max() > limit:
                self._warn_of_offset(np.abs(offset), "now")
            self._warn_of_range(wanted)
        return command

    def link_angle(self, theta: npt.ArrayLike) -> Array:
        """Link angles for motor encoders that show θ, at rest: Eq. 10.

        Friction that is compensated holds the link back from the side of the last commands.

        Args:
            theta: Motor side, (n,) [rad].

        Returns:
            q, (n,) [rad].

        Raises:
            ActionError: A wrong number of values, or one that is not finite.
            ElasticError: The load overcomes a spring: there is no equilibrium that a growing load
                leads to, or there are several.
        """
        shown_angle = self._checked("theta", theta, "rad")
        compliance = self.constants.compliance
        gradient = compliance[:, None] * self._passed_gradient(shown_angle)
        size = gradient.ravel()
        # by the Frobenius norm, which is fast: there may be other equilibria
        is_soft = size.dot(size) >= 1.0
        gradient.flat[:: len(shown_angle) + 1] += 1.0
        # as `static_link_angle`, but by 1/K, so that a joint may be rigid, and with the gradient at
        # θ alone, for speed;
        # the first step is Eq. 12
        factors, pivots, is_singular = _factored(gradient)
        if is_singular:
            return self._soft_link_angle(shown_angle, None)
        q = shown_angle
        for _ in range(_MOST_ITERATIONS):
            residual = q - shown_angle + compliance * self._passed_at_rest(q)
            step, _ = _solved(factors, pivots, residual)
            q = q - step
            missing = residual.dot(residual)
            if missing < _LAST_STEP_RAD**2:
                way = q - shown_angle
                if is_soft or way.dot(way) > _FAR_RAD**2:
                    return self._soft_link_angle(shown_angle, q)
                return q
            if not missing < _LARGEST_STEP_RAD**2:
                break
        return self._soft_link_angle(shown_angle, None)

    def _lead(self, motion: _Motion) -> Array:
        """Offset along a motion, (n,) [rad]; the friction follows its direction."""
        torque = self._torque(*motion)
        if self.constants.friction is None:
            return self.constants.of_command * torque
        q, q_dot, q_ddot = motion
        displacement = np.zeros_like(q) if self._asked is None else q - self._asked[0]
        slack = self._rubbed.slack
        self._rubbed = self.constants.friction.follow(displacement, self._rubbed)
        if q_dot is None:  # without what trembles
            q_dot = (displacement + slack - self._rubbed.slack) / self.constants.period_s
            q_dot[np.abs(q_dot) > self.constants.fastest] = 0.0  # a pose of its own, no motion
        passed = self.constants.friction.joint_torque(
            torque + self.constants.viscous * q_dot, q_dot, self._rubbed
        )
        lag = self.constants.lag_s * q_dot
        if q_ddot is not None:
            lag = lag + self.constants.rotor_s2 * q_ddot
        return self.constants.of_command * passed + lag

    def _passed_along(self, motion: _Motion) -> Array:
        """Torque that is passed to links at a motion, by the side of the last commands, (n,)."""
        torque = self._torque(*motion)
        if self.constants.friction is None:
            return torque
        rate = np.zeros_like(torque) if motion[1] is None else motion[1]
        return self.constants.friction.joint_torque(
            torque + self.constants.viscous * rate, rate, self._rubbed
        )

    def _passed_at_rest(self, q: Array) -> Array:
        """Torque that is passed to links at rest, (..., n) [rad] to (..., n) [N·m]."""
        torque = self.constants.body.gravity_torque(q)
        if self.constants.friction is None:
            return torque
        return self.constants.friction.joint_torque(torque, np.zeros_like(q), self._rubbed)

    def _passed_gradient(self, q: Array) -> Array:
        """Its gradient, (..., n) [rad] to (..., n, n) [N·m/rad]."""
        gradient = self.constants.body.gravity_gradient(q)
        if self.constants.friction is None:
            return gradient
        torque = self.constants.body.gravity_torque(q)
        share = self.constants.friction.share(torque, np.zeros_like(q), self._rubbed)
        return share[..., None] * gradient

    def _soft_link_angle(self, theta: Array, guess: Array | None) -> Array:
        """Link angle on a spring that bends far, by a growing load; `guess` for the same pose."""
        known = self.constants
        found = follow_load(
            theta,
            known.compliance,
            self._passed_at_rest,
            self._passed_gradient,
            tolerance=_LAST_RESIDUAL_RAD,
            within=(known.lowest, known.highest),
        )
        if found.lost.any():
            reason = found.reason(known.compliance, self.joints)
            raise ElasticError(f"no link angles for {theta} rad: {reason}")
        if guess is not None and np.abs(guess - found.q).max() < _SAME_RAD:
            return guess
        return found.q

    def _heaviest(self) -> Array:
        """Largest torques by weight over the joint ranges, at most a turn wide, (n,) [N·m]."""
        known = self.constants
        lowest = np.where(np.isfinite(known.lowest), known.lowest, -np.pi)
        highest = np.where(np.isfinite(known.highest), known.highest, np.pi)
        generator = np.random.default_rng(0)
        poses = generator.uniform(lowest, highest, (_POSES, len(self.joints)))
        torque = np.abs(known.body.gravity_torque(poses))
        found = torque.max(axis=0)
        for joint, pose in enumerate(poses[torque.argmax(axis=0)]):
            for i in range(len(pose)):  # by one joint after the other, uphill
                tried = np.repeat(pose[None], _TRIES, axis=0)
                tried[:, i] = np.linspace(lowest[i], highest[i], _TRIES)
                there = np.abs(known.body.gravity_torque(tried)[:, joint])
                if there.max() > found[joint]:
                    found[joint] = there.max()
                    pose = tried[there.argmax()]
        return found

    def _warn_of_range(self, wanted: Array) -> None:
        """Say once that a command, (n,) [rad], met a joint range."""
        known = self.constants
        over = np.maximum(known.lowest - wanted, wanted - known.highest)
        if over.max() > 0.0:
            worst = int(over.argmax())
            ends = f"{known.lowest[worst]:.4g} to {known.highest[worst]:.4g} rad"
            self._warn_once(
                "range",
                f"joint {self.joints[worst]!r} needs the command {wanted[worst]:.4g} rad, beyond"
                f" its range of {ends} in the model: its link stays {over[worst]:.2g} rad short;"
                " keep q_desired that far from the end",
            )

    def _warn_of_offset(self, offsets: Array, when: str) -> None:
        """Say once that `limit_rad` is too small for offsets, (n,) [rad]."""
        needed = float(offsets.max())
        joint = self.joints[offsets.argmax()]
        digit = 10.0 ** (np.floor(np.log10(needed)) - 1.0)
        enough = np.ceil(1.05 * needed / digit) * digit
        self._warn_once(
            "limit_rad",
            f"the load needs an offset of {needed:.3g} rad of joint {joint!r} {when},"
            f" and commands are cut at limit_rad = {self.constants.limit_rad:g}: the link ends"
            f" short of where it should be; limit_rad={enough:.3g} is enough",
        )

    def _warn_of_jump(self, jump: Array) -> None:
        """Say once that a payload moved the command at once, by `jump`, (n,) [rad]."""
        worst = int(np.abs(jump).argmax())
        size = float(np.abs(jump[worst]))
        if size <= _JUMP_RAD:
            return
        calm_s = max(np.ceil(size / _CALM_RAD_S * 10.0) / 10.0, 0.5)
        cure = f"ramp_s={calm_s:.3g} takes it over in that time"
        if self.constants.ramp_steps > 0:
            cure = "set the payload to 0 where it was, and let ramp_s pass before"
        self._warn_once(
            "jump",
            f"the payload moves the command of joint {self.joints[worst]!r} by {1e3 * size:.3g}"
            f" mrad at once; {cure}",
        )

    def _warn_once(self, about: str, text: str) -> None:
        """Warn the caller of a public method, unless it was warned about the same before."""
        if about not in self._said:
            self._said.add(about)
            _warn(text)

    def _motion(self, q: Any, q_dot: Any, q_ddot: Any) -> _Motion:
        q = self._checked("q_desired", q, "rad")
        if q_dot is not None:
            q_dot = self._checked("q_dot", q_dot, "rad/s")
        if q_ddot is not None:
            q_ddot = self._checked("q_ddot", q_ddot, "rad/s²")
        return q, q_dot, q_ddot

    def _checked(self, name: str, given: Any, unit: str) -> Array:
        """An argument of a public method, as (n,)."""
        n = len(self.joints)
        try:
            values = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (n,):
            is_array = isinstance(given, np.ndarray)
            size = f", an array of shape {values.shape}" if is_array else ""
            needed = f"{n} numbers [{unit}], of {', '.join(self.joints)}"
            raise ActionError(f"{name} must be {needed}; got {quote(given)}{size}")
        if not np.isfinite(values).all():
            bad = np.array(self.joints)[~np.isfinite(values)]
            found = f"{quote(values.tolist())}; see {', '.join(bad)}"
            raise ActionError(f"{name} must be finite [{unit}], got {found}")
        return values

    def _torque(self, q: Array, q_dot: Array | None, q_ddot: Array | None) -> Array:
        if q_dot is None and q_ddot is None:
            return self.constants.body.gravity_torque(q)
        q_dot = np.zeros(len(q)) if q_dot is None else q_dot
        q_ddot = np.zeros(len(q)) if q_ddot is None else q_ddot
        return self.constants.body.inverse_dynamics(q, q_dot, q_ddot)

    def _take_load(self) -> None:
        """One step towards the payload that is wanted."""
        if self._load != self._load_wanted:
            way = self._load_wanted - self._load
            if abs(way) <= self._load_step:
                self._load = self._load_wanted
            else:
                self._load += np.copysign(self._load_step, way)
            self.constants.body.set_load(self._carrier, self._load, self._place)


def _warn(message: str) -> None:
    """Warn at the line of the program that called this module."""
    level = 2
    frame = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename == __file__:
        frame = frame.f_back
        level += 1
    warnings.warn(message, stacklevel=level)


def _of_file(model: mujoco.MjModel, file: Path, commanded: Any) -> dict[str, Any]:
    """Content of a file of joints, in which the hinges that it leaves out are rigid."""
    mapping = read_mapping(file)
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    names = [model.joint(int(j)).name for j in hinges]
    left_out = [name for name in names if name and key_of(mapping, name) is None]
    said = [name for name in left_out if commanded is None or name in commanded]
    if not said or len(left_out) == len(names):
        return mapping
    _warn(
        f"{file} leaves out {', '.join(said)}, taken for rigid; say {said[0]}: {RIGID}, {said[0]}:"
        f" {HELD} or its stiffness K [N·m/rad] there"
    )
    return mapping | dict.fromkeys(said, RIGID)


class CommandLimits(Model):
    """How far commands lead, and how offsets begin."""

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


class PositionGain(Model):
    """A servo that gives way under a load, or holds its angle."""

    position_gain: float = quantity("N·m/rad", ge=SOFTEST, allow_inf_nan=True)
    """k_p, infinite for a servo that holds its angle [N·m/rad]."""


def _read_stiffness(
    model: mujoco.MjModel, given: Any, joints: Sequence[str], is_held_left_out: bool
) -> dict[str, JointSettings]:
    """Settings of the joints that are commanded, in order.

    Args:
        model: Compiled rigid model.
        given: Argument `stiffness`.
        joints: Hinges that may be commanded.
        is_held_left_out: Whether those that are held are left out, or refused.
    """
    hinges = hinges_of(model)
    known: dict[str, JointSettings | None] = {}
    if isinstance(given, Mapping):
        known = read_joints(given, hinges, set(_joint_names(model)) - set(hinges))
    held = [name for name, own in known.items() if own is None]
    if is_held_left_out:
        joints = [name for name in joints if name not in held]
        if not joints:
            raise ConfigurationError(
                f"all joints are {HELD}; give at least one of them its stiffness K [N·m/rad]"
            )
    for name in joints:
        if name in held:
            raise ConfigurationError(
                f"joint {name!r} is named by `joints`, and stiffness says that it is {HELD}; give"
                " it a stiffness K [N·m/rad], or leave it out of `joints`"
            )
    require_known_torque(model, joints)
    if not isinstance(given, Mapping):
        known = read_joints(_by_joint("stiffness", given, joints), joints)
    found: dict[str, JointSettings] = {}
    for joint in joints:
        own = known.get(joint)
        if own is None:
            raise ConfigurationError(
                f"stiffness of joint {joint!r} is missing; give {joint!r} or a pattern such as '*',"
                " and inf for a rigid joint. It is measured by a known torque and the deflection"
                " under it"
            )
        if own.backlash > 0.0:
            raise ConfigurationError(
                f"backlash of joint {joint!r} is {own.backlash:g} rad, which this compensator"
                f" cannot take away: at rest {own.backlash / 2.0:g} rad remain to either side;"
                " leave the key out of what you give it"
            )
        found[joint] = own
    return found


def _servo_gains(model: mujoco.MjModel, settings: _Settings, given: Any) -> Array:
    """k_p of servos that give way, infinite for those that hold their angle, (n,) [N·m/rad].

    Args:
        model: Its actuators say it where nothing else does.
        settings: Joints that are commanded.
        given: Argument `position_gain`.
    """
    if given is not None:
        return _given_gains(model, settings, given)
    gains: list[float] = []
    unsaid: dict[str, float] = {}
    for joint, own in settings.items():
        servo = own.servo
        is_known = servo.position_gain is not None
        found = None if is_known else position_servo(model, joint)
        of_model = ServoSettings() if found is None else found.settings
        if _is_said(servo):
            gains.append(servo.over(of_model).sagging_gain(joint))
            continue
        gains.append(np.inf)
        if np.isfinite(gain := of_model.sagging_gain(joint)):
            unsaid[joint] = gain
    if unsaid:
        listed = ", ".join(f"{name}: {gain:g}" for name, gain in unsaid.items())
        _warn(
            "the model has position servos that give way under a load, which is not compensated;"
            f" give position_gain={{{listed}}} [N·m/rad], or position_gain=math.inf for servos that"
            " hold their angle"
        )
    return np.array(gains)


def _friction(
    settings: Mapping[str, JointSettings], wanted: bool | None
) -> FrictionCompensation | None:
    """Compensation of the dry friction of joints; None where it is not wanted."""
    joints = list(settings.values())
    if wanted is None:
        wanted = any(one.load_friction > 0.0 or one.static_friction > 0.0 for one in joints)
    if not wanted:
        return None
    return FrictionCompensation(
        coulomb=np.array([one.coulomb_friction or 0.0 for one in joints]),
        load_ratio=np.array([one.load_friction for one in joints]),
        static=np.array([one.static_friction for one in joints]),
        stribeck_speed=np.array([one.stribeck_speed for one in joints]),
    )


def _is_said(servo: ServoSettings) -> bool:
    return servo.position_gain is not None or servo.integral_gain is not None


def _given_gains(model: mujoco.MjModel, settings: _Settings, given: Any) -> Array:
    """The argument `position_gain`, (n,) [N·m/rad]."""
    by_joint = _by_joint("position_gain", given, list(settings))
    names = _joint_names(model)
    for key in by_joint:
        if not isinstance(key, str) or not any(key_of([key], name) for name in names):
            raise unknown_name("joint or pattern of joints", key, names)
    gains: list[float] = []
    for joint, own in settings.items():
        if _is_said(own.servo):
            raise ConfigurationError(
                f"the servo of joint {joint!r} is said twice, under `servo` in stiffness and by"
                " position_gain; keep one of them"
            )
        key = key_of(by_joint, joint)
        if key is None:
            raise ConfigurationError(
                f"position_gain of joint {joint!r} is missing; give {joint!r} or a pattern such as"
                " '*', and inf for a servo that holds its angle"
            )
        try:
            gains.append(PositionGain(position_gain=by_joint[key]).position_gain)
        except ConfigurationError as error:
            raise ConfigurationError(f"joint {joint!r}: {error}") from None
    return np.array(gains)


def _by_joint(name: str, given: Any, joints: Sequence[str]) -> Mapping[str, Any]:
    """Numbers of joints by their names or patterns."""
    if given is None or isinstance(given, str | Path):
        raise ConfigurationError(
            f"{name} must be numbers [N·m/rad], got {quote(given)}; give a number for all joints,"
            " one per joint, a mapping by name, or a YAML file (.yaml) of that"
        )
    if isinstance(given, Mapping):
        return given
    if not isinstance(given, list | tuple | np.ndarray):
        return dict.fromkeys(joints, given)
    if len(given) != len(joints):
        needed = f"{len(joints)} numbers [N·m/rad], of {', '.join(joints)}"
        raise ConfigurationError(f"{name} must be {needed}, got {len(given)}")
    return dict(zip(joints, given, strict=True))


def _joint_names(model: mujoco.MjModel) -> list[str]:
    return [name for j in range(model.njnt) if (name := model.joint(j).name)]
