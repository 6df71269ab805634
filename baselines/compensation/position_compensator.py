r"""Compensation on a live robot: arrays in, arrays out, no environment.

The command leads the link by the deflection of its spring, and by what the servo itself gives way:

.. math:: u = q + \left(K^{-1} + k_p^{-1}\right) \tau(q, \dot q, \ddot q)

Eq. 9 is the case at rest of a servo that holds its angle. τ is the torque that the joints have to deliver: gravity,
inertia, a payload, springs of the model's joints; `gravcomp` of its bodies lowers it. Damping and friction of the model
are not in it. What a motor encoder shows is turned into the link angle by Eq. 10.
"""

import warnings
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.linalg import get_lapack_funcs

from elastic_env.core.config import read_mapping
from elastic_env.core.errors import ActionError, ConfigurationError, ElasticError, require_known, shown, unknown_name
from elastic_env.core.signals import Array, BoolArray
from elastic_env.dynamics.tree.torque import TreeTorque
from elastic_env.joint.load_path import follow_load
from elastic_env.joint.model_file import compiled_model
from elastic_env.motion.trajectory import minimum_jerk

PerJoint = float | Sequence[float] | Mapping[str, Any] | npt.NDArray[Any]
"""A number for all joints, one per joint in order, or by name or pattern, such as {"*": 1000, "wrist_*": 300}."""

_LAST_STEP_RAD = 1e-8
"""A step below this is the last one: what it leaves is smaller by the factor with which Newton's steps shrink."""
_MOST_ITERATIONS = 50
_LARGEST_STEP_RAD = 1e6
"""Steps beyond this lead nowhere."""
_FAR_RAD = 0.5
"""Deflection beyond which there may be other equilibria."""
_LAST_RESIDUAL_RAD = 1e-12
_SAME_RAD = 1e-6
"""Largest distance of two results that count as one equilibrium."""
_FILES = (".yaml", ".yml")
_HOW_TO_GIVE = "give a number for all joints, one per joint, a mapping by name, or a YAML file (.yaml) of that"
_factored, _solved = get_lapack_funcs(("getrf", "getrs"))  # without the checks of lu_factor, which take longer


class PositionCompensator:
    """Commands and link angles of a robot whose joints give way, see the module.

    A value that is no angle raises `ActionError` and changes nothing: keep the last command then.

    Attributes:
        joints: Names of the joints, in the order of all arrays.
        clipped: Which joints of the last command met a limit, (n,).

    Args:
        model: Compiled rigid model on a fixed base.
        stiffness: K [N·m/rad]; infinite for a rigid joint. By name or pattern a value is a number, or a mapping that
            has `stiffness`. A name goes before patterns, and a later pattern before an earlier one.
        joints: Hinges that are commanded, in the order of the arrays; None for all in the order of the model. The other
            joints are held where the model's first keyframe has them, or at its reference.
        position_gain: k_p of servos that give way under a load [N·m/rad]; None or infinite for servos that hold their
            angle. Where the model has position actuators and it is None, a warning says their k_p.
        limit_rad: Largest offset between command and desired angle [rad].
        ramp_s: Time in which offsets grow from zero after the start, and in which a payload is taken over [s].
        period_s: Time between two commands, for the ramp [s].

    Raises:
        ConfigurationError: The model or a value cannot be used; the message says which.
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
    ) -> None:
        self._model = model
        self.joints = tuple(_hinges(model) if joints is None else joints)
        held = _held(model, self.joints)
        _require_known_torque(model, held)
        self._links = TreeTorque(model, self.joints, held)
        at = [int(model.joint(name).id) for name in self.joints]
        limited = model.jnt_limited[at].astype(bool)
        self._lowest = np.where(limited, model.jnt_range[at, 0], -np.inf)
        self._highest = np.where(limited, model.jnt_range[at, 1], np.inf)
        for given in (stiffness, position_gain):
            _require_patterns_that_fit(given, [*self.joints, *held])
        self._compliance = 1.0 / _per_joint("stiffness", stiffness, self.joints)
        self._of_command = self._compliance.copy()
        if position_gain is None:
            _warn_of_servos(model, self.joints)
        else:
            self._of_command += 1.0 / _per_joint("position_gain", position_gain, self.joints)
        self._limit, self._ramp = _number("limit_rad", limit_rad, "rad"), _number("ramp_s", ramp_s, "s", least=0.0)
        self._steps = max(int(np.ceil(self._ramp / _number("period_s", period_s, "s"))), 1)
        self._tip = int(model.jnt_bodyid[max(at, key=lambda j: int(model.jnt_bodyid[j]))])
        self.reset()

    @classmethod
    def from_model(
        cls, model: str | Path | mujoco.MjSpec | mujoco.MjModel, stiffness: PerJoint | str | Path, **options: Any
    ) -> Self:
        """From a file of MJCF or URDF, or from what MuJoCo made of one; further arguments as of the class.

        `stiffness` may be a YAML file, such as the `joints.yaml` of `elastic identify --robot`.

        Raises:
            ConfigurationError: The file or a value cannot be used.
        """
        is_file = isinstance(stiffness, str | Path) and Path(stiffness).suffix in _FILES
        return cls(compiled_model(model), read_mapping(Path(stiffness)) if is_file else stiffness, **options)  # type: ignore[arg-type]

    def reset(self) -> None:
        """Begin anew: the ramp starts at zero, without a payload."""
        self._count = 0
        self._load = self._load_wanted = self._load_step = 0.0
        self._carrier, self._place = self._tip, np.zeros(3)
        self._links.set_load(self._carrier, 0.0, self._place)
        self.clipped: BoolArray = np.zeros(len(self.joints), dtype=np.bool_)

    def set_payload(self, mass_kg: float, at: npt.ArrayLike = (0.0, 0.0, 0.0), body: str | None = None) -> None:
        """Let the robot carry another point mass; commands take it over within the time of the ramp.

        In another place or on another body it is taken over from zero: the command lets go of the last one at once.

        Args:
            mass_kg: Mass, 0 for none [kg].
            at: Its place in the frame of the body or site, (3,) [m].
            body: Body or site that carries it; None for the body of the last joint.

        Raises:
            ConfigurationError: No mass, no place, or no such body or site.
        """
        mass = _number("mass_kg", mass_kg, "kg", least=0.0)
        place = np.array(_finite("at", at, 3, "m"))
        carrier = self._tip
        if body is not None:
            bodies = {self._model.body(i).name: i for i in range(self._model.nbody)}
            sites = {self._model.site(i).name: i for i in range(self._model.nsite)}
            require_known("body or site", [body], bodies | sites)
            carrier = bodies[body] if body in bodies else int(self._model.site_bodyid[sites[body]])
            if body not in bodies:
                place = _in_body(self._model, sites[body], place)
        if (carrier, *place) != (self._carrier, *self._place):
            self._load, self._carrier, self._place = 0.0, carrier, place
        self._load_wanted, self._load_step = mass, abs(mass - self._load) / self._steps
        if self._ramp == 0.0:
            self._load = mass
        self._links.set_load(self._carrier, self._load, self._place)

    def torque(
        self, q: npt.ArrayLike, q_dot: npt.ArrayLike | None = None, q_ddot: npt.ArrayLike | None = None
    ) -> Array:
        """Torque that the joints have to deliver, (n,) [N·m]; arguments and errors as `command`."""
        return self._torque(*self._motion(q, q_dot, q_ddot))

    def command(
        self, q_desired: npt.ArrayLike, q_dot: npt.ArrayLike | None = None, q_ddot: npt.ArrayLike | None = None
    ) -> Array:
        """Servo command that brings the links to where they should be.

        Args:
            q_desired: Link angles, (n,) [rad].
            q_dot: Their rates, (n,) [rad/s]; None at rest.
            q_ddot: Their accelerations, (n,) [rad/s²]; None for none.

        Returns:
            Commands within the offset's limit and the model's joint ranges, (n,) [rad].

        Raises:
            ActionError: A wrong number of values, or one that is not finite.
        """
        motion = self._motion(q_desired, q_dot, q_ddot)
        self._take_load()
        offset = self._of_command * self._torque(*motion)
        if self._count < self._steps and self._ramp > 0.0:
            self._count += 1
            offset *= minimum_jerk(np.array(self._count / self._steps))
        within = np.minimum(np.maximum(offset, -self._limit), self._limit) + motion[0]
        command = np.minimum(np.maximum(within, self._lowest), self._highest)
        self.clipped = command != offset + motion[0]
        return command

    def link_angle(self, theta: npt.ArrayLike) -> Array:
        """Where the links are when the motor encoders show θ, at rest: Eq. 10.

        Args:
            theta: Motor side, (n,) [rad].

        Returns:
            q, (n,) [rad].

        Raises:
            ActionError: A wrong number of values, or one that is not finite.
            ElasticError: The load overcomes a spring: there is no equilibrium that a growing load leads to, or there
                are several.
        """
        shown_angle = self._checked("theta", theta, "rad")
        gradient = self._compliance[:, None] * self._links.gravity_gradient(shown_angle)
        size = gradient.ravel()
        is_soft = size.dot(size) >= 1.0  # by the Frobenius norm, which is fast: there may be other equilibria
        gradient.flat[:: len(shown_angle) + 1] += 1.0
        # as `static_link_angle`, but by 1/K, so that a joint may be rigid, and with the gradient at θ alone, for speed;
        # the first step is Eq. 12
        factors, pivots, is_singular = _factored(gradient)
        if is_singular:
            return self._soft_link_angle(shown_angle, None)
        q = shown_angle
        for _ in range(_MOST_ITERATIONS):
            residual = q - shown_angle + self._compliance * self._torque(q, None, None)
            step, _ = _solved(factors, pivots, residual)
            q = q - step
            missing = residual.dot(residual)
            if missing < _LAST_STEP_RAD**2:
                way = q - shown_angle
                return self._soft_link_angle(shown_angle, q) if is_soft or way.dot(way) > _FAR_RAD**2 else q
            if not missing < _LARGEST_STEP_RAD**2:
                break
        return self._soft_link_angle(shown_angle, None)

    def _soft_link_angle(self, theta: Array, guess: Array | None) -> Array:
        """The same where the load bends a spring far: by a load that grows; the guess if it is the same pose."""
        found = follow_load(
            theta,
            self._compliance,
            lambda q: self._torque(q, None, None),
            self._links.gravity_gradient,
            tolerance=_LAST_RESIDUAL_RAD,
            within=(self._lowest, self._highest),
        )
        if found.lost.any():
            raise ElasticError(f"no link angles for {theta} rad: {found.reason(self._compliance, self.joints)}")
        return guess if guess is not None and np.abs(guess - found.q).max() < _SAME_RAD else found.q

    def _motion(self, q: Any, q_dot: Any, q_ddot: Any) -> tuple[Array, Array | None, Array | None]:
        return (
            self._checked("q_desired", q, "rad"),
            None if q_dot is None else self._checked("q_dot", q_dot, "rad/s"),
            None if q_ddot is None else self._checked("q_ddot", q_ddot, "rad/s²"),
        )

    def _checked(self, name: str, given: Any, unit: str) -> Array:
        """What a robot is asked for, as (n,)."""
        n = len(self.joints)
        values = _array(given)
        if values.shape != (n,):
            size = f", an array of shape {values.shape}" if isinstance(given, np.ndarray) else ""
            raise ActionError(
                f"{name} must be {n} numbers [{unit}], of {', '.join(self.joints)}; got {shown(given)}{size}"
            )
        if not np.isfinite(values).all():
            bad = [name for name, value in zip(self.joints, values, strict=True) if not np.isfinite(value)]
            raise ActionError(f"{name} must be finite [{unit}], got {shown(values.tolist())}; see {', '.join(bad)}")
        return values

    def _torque(self, q: Array, q_dot: Array | None, q_ddot: Array | None) -> Array:
        if q_dot is None and q_ddot is None:
            return self._links.gravity_torque(q)
        rest = np.zeros(len(q))
        return self._links.inverse_dynamics(q, rest if q_dot is None else q_dot, rest if q_ddot is None else q_ddot)

    def _take_load(self) -> None:
        """One step towards the payload that is wanted."""
        if self._load != self._load_wanted:
            way = self._load_wanted - self._load
            self._load = (
                self._load_wanted if abs(way) <= self._load_step else self._load + np.copysign(self._load_step, way)
            )
            self._links.set_load(self._carrier, self._load, self._place)


def _in_body(model: mujoco.MjModel, site: int, place: Array) -> Array:
    """A place in the frame of a site in that of its body, (3,) [m]."""
    turned = np.empty(3)
    mujoco.mju_rotVecQuat(turned, place, model.site_quat[site])
    return model.site_pos[site] + turned


def _hinges(model: mujoco.MjModel) -> list[str]:
    names = [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    if not names:
        raise ConfigurationError("the model has no hinge; a compensator needs a robot with rotary joints")
    if not all(names):
        raise ConfigurationError("a hinge of the model has no name; give each one, the stiffness is by name")
    return names


def _held(model: mujoco.MjModel, joints: Sequence[str]) -> dict[str, float]:
    """Positions of the joints that are not commanded [rad], [m]."""
    known = [model.joint(j).name for j in range(model.njnt)]
    require_known("joint", joints, known)
    if len(set(joints)) != len(joints) or not joints:
        raise ConfigurationError(f"joints must name at least one joint, and each once, got {shown(list(joints))}")
    home = model.key_qpos[0] if model.nkey else model.qpos0
    held = {}
    for j, name in enumerate(known):
        if int(model.jnt_type[j]) in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
            raise ConfigurationError(
                f"joint {name!r} is free or a ball joint; a compensator needs a fixed base and hinges: the torque of a "
                "floating robot depends on its contacts"
            )
        if name not in joints:
            held[name] = float(home[model.jnt_qposadr[j]])
    return held


def _require_known_torque(model: mujoco.MjModel, held: Mapping[str, float]) -> None:
    """Refuse what adds to the torque and is not in it: closed loops, springs of tendons, non-linear springs."""
    for j in np.flatnonzero(model.jnt_stiffnesspoly.any(axis=-1)):
        if (name := model.joint(int(j)).name) not in held:
            raise ConfigurationError(
                f"joint {name!r} has a spring whose torque is not linear, which is not compensated; give it one number"
            )
    for i in range(model.neq):
        of_joints = model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT
        names = (
            [model.joint(int(j)).name for j in (model.eq_obj1id[i], model.eq_obj2id[i]) if j >= 0] if of_joints else []
        )
        if not of_joints or any(name not in held for name in names):
            which = f"of {' and '.join(names)}" if names else "of bodies or tendons"
            raise ConfigurationError(
                f"the model has an equality constraint {which}, whose torque is not known in advance; take it out, or "
                "leave its joints out of `joints`"
            )
    if model.tendon_stiffness.any() or model.tendon_stiffnesspoly.any():
        raise ConfigurationError("the model has tendons with stiffness, whose torque is not compensated; take them out")


def _warn_of_servos(model: mujoco.MjModel, joints: Sequence[str]) -> None:
    """Warn where the model has position actuators, which give way under a load, at joints that are commanded."""
    gains = {}
    for i in range(model.nu):
        joint = int(model.actuator_trnid[i, 0])
        is_at_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.joint(joint).name in joints
        kp, is_pid = -float(model.actuator_biasprm[i, 1]), model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_PID
        if is_at_joint and kp > 0.0 and not is_pid:
            gains[model.joint(joint).name] = float(model.actuator_gear[i, 0]) ** 2 * kp
    if gains:
        given = ", ".join(f"{name}: {kp:g}" for name, kp in gains.items())
        warnings.warn(
            f"the model has position servos that give way under a load, which is not compensated; give "
            f"position_gain={{{given}}} [N·m/rad], or position_gain=math.inf for servos that hold their angle",
            stacklevel=4,
        )


def _per_joint(name: str, given: Any, joints: Sequence[str]) -> Array:
    """Positive numbers of all joints, (n,) [N·m/rad]."""
    if given is None:
        raise ConfigurationError(f"{name} is missing; {_HOW_TO_GIVE}")
    if isinstance(given, Mapping):
        values = [_of_joint(name, given, joint) for joint in joints]
    elif isinstance(given, str | Path):
        raise ConfigurationError(f"{name} must be numbers [N·m/rad], got {shown(str(given))}; {_HOW_TO_GIVE}")
    elif isinstance(given, list | tuple | np.ndarray):
        values = list(given)
        if len(values) != len(joints):
            raise ConfigurationError(
                f"{name} must be {len(joints)} numbers [N·m/rad], of {', '.join(joints)}, got {len(values)}"
            )
    else:
        values = [given] * len(joints)
    return np.array(
        [
            _number(f"{name} of {joint}", value, "N·m/rad", finite=False)
            for joint, value in zip(joints, values, strict=True)
        ]
    )


def _require_patterns_that_fit(given: Any, joints: Sequence[str]) -> None:
    """Refuse a name or a pattern that is of no joint, such as a misspelt one."""
    for key in given if isinstance(given, Mapping) else ():
        if not isinstance(key, str) or not any(fnmatchcase(joint, key) for joint in joints):
            raise unknown_name("joint or pattern of joints", key, joints)


def _of_joint(name: str, given: Mapping[str, Any], joint: str) -> Any:
    """The value of a joint by its name or the last pattern that fits it."""
    fitting = [key for key in given if fnmatchcase(joint, key)]
    if not fitting:
        raise ConfigurationError(
            f"{name} of joint {joint!r} is missing; give {joint!r} or a pattern such as '*', and inf for a rigid "
            "joint. It is measured by a known torque and the deflection under it"
        )
    value = given[joint if joint in given else fitting[-1]]
    if not isinstance(value, Mapping) or name != "stiffness":
        return value
    if "stiffness" not in value:
        raise ConfigurationError(
            f"stiffness of joint {joint!r} is missing beside {shown(list(value))}; write 'stiffness: K' [N·m/rad]"
        )
    return value["stiffness"]


def _number(name: str, value: Any, unit: str, least: float | None = None, finite: bool = True) -> float:
    """A positive number, or one from `least` on."""
    if isinstance(value, bool | str) or not isinstance(value, int | float | np.integer | np.floating):
        raise ConfigurationError(f"{name} must be a number [{unit}], got {shown(value)}")
    number = float(value)
    if np.isnan(number) or (finite and np.isinf(number)) or not (number > 0.0 if least is None else number >= least):
        bound = "> 0" if least is None else f">= {least:g}"
        raise ConfigurationError(f"{name} must be {'finite and ' if finite else ''}{bound} [{unit}], got {number:g}")
    return number


def _array(given: Any) -> Array:
    """What was given as an array; empty where it is none of numbers."""
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


def _finite(name: str, given: Any, size: int, unit: str) -> Array:
    values = _array(given)
    if values.shape != (size,) or not np.isfinite(values).all():
        raise ConfigurationError(f"{name} must be {size} finite numbers [{unit}], got {shown(given)}")
    return values
