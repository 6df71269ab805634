"""The elastic joints of a robot: what is given by name or pattern, what the model says, and defaults for the rest."""

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.config import Model, quantity, read_mapping
from elastic_env.core.errors import ConfigurationError, shown, unknown_name
from elastic_env.core.signals import Array
from elastic_env.dynamics.tree.end_effector import outermost_body
from elastic_env.dynamics.tree.torque import TreeTorque
from elastic_env.joint.elasticity import ElasticJoint, Servo
from elastic_env.joint.frozen import home_of

GivenJoints = str | Path | Mapping[str, Any]
"""A YAML file, or a mapping from joint names or patterns to `JointSettings`, to K alone [N·m/rad], or to "held"."""
HELD = "held"
"""Value of a joint that a pattern names and that is not elastic all the same."""

ROTOR_FREQUENCY_RAD_S = 100.0
"""An assumption for rotors that nobody knows: with the link blocked they swing on their spring at 16 Hz [rad/s]."""
DAMPING_RATIO = 0.17
"""Of rotor and link on the spring between them; about that of the testbed's joint, K 1001, B 0.839, D 10 [1]."""
_SERVO_TO_SPRING = 50.0
"""k_p of a servo that nobody knows over K: stiff enough to add little to the deflection while its integrator acts."""
_SPEED_LIMIT_RAD_S = 2.0 * np.pi
"""An assumption: position servos of arms turn about once a second."""
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_TORQUE_RESERVE, _RESERVE_RAD_S2 = 3.0, 20.0
_POSES, _MASS_POSES = 200, 20


class ServoSettings(Model):
    """What is known of a servo; the rest comes from the model's actuator, or from defaults."""

    position_gain: float | None = quantity(
        "N·m/rad", None, gt=0, description="k_p; default that of the model's position actuator, else 50 K"
    )
    velocity_gain: float | None = quantity(
        "N·m·s/rad", None, ge=0, description="k_v; default that of the actuator, else critical damping of the rotor"
    )
    integral_gain: float | None = quantity(
        "N·m/(rad·s)",
        None,
        ge=0,
        description="k_i; default 0 where the model has an actuator, which MuJoCo's have not, else k_p per second",
    )
    torque_limit: float | None = quantity(
        "N·m",
        None,
        gt=0,
        description="default the model's force range, else what holds three times the weight and gives 20 rad/s²",
    )
    speed_limit: float | None = quantity("rad/s", None, gt=0, description="no-load speed; default a turn a second")


class JointSettings(Model):
    """What is known of an elastic joint; all but K has a default."""

    stiffness: float = quantity("N·m/rad", gt=0, description="K, stiffness of the transmission, without a default")
    damping: float | None = quantity(
        "N·m·s/rad", None, ge=0, description="D; default a damping ratio of 0.17 of rotor and link, as the testbed has"
    )
    rotor_inertia: float | None = quantity(
        "kg·m²", None, gt=0, description="B; default the model's armature, where it has none K/(100 rad/s)², assumed"
    )
    coulomb_friction: float | None = quantity(
        "N·m", None, ge=0, description="dry friction on the link; default the model's frictionloss"
    )
    viscous_friction: float | None = quantity(
        "N·m·s/rad", None, ge=0, description="viscous friction on the link; default the model's damping of the joint"
    )
    backlash: float = quantity("rad", 0.0, ge=0, description="dead band; default none, as the scenario has one")
    encoder_counts_per_turn: int | None = quantity(
        "1", None, gt=0, description="motor encoder, counts per turn of the output; default continuous"
    )
    servo: ServoSettings = ServoSettings()


def read_joints(given: GivenJoints, names: list[str]) -> dict[str, JointSettings]:
    """Settings of the joints that are elastic, by name, in the order of the model.

    A name goes before patterns, and a later pattern before an earlier one. Joints that nothing names, those whose value
    is "held", and rigid ones, whose stiffness is infinite, are left out.

    Args:
        given: File or mapping.
        names: Hinges of the model.

    Raises:
        ConfigurationError: No file or mapping, a name or pattern of no hinge, or a value that cannot be.
    """
    if not names:
        raise ConfigurationError(
            "the model has no hinge, and elastic joints are hinges; give a robot with rotary joints"
        )
    mapping = _mapping(given)
    for key in mapping:
        if not isinstance(key, str) or not any(fnmatchcase(name, key) for name in names):
            raise unknown_name("joint or pattern of joints", key, names)
    found: dict[str, JointSettings] = {}
    for name in names:
        fitting = [key for key in mapping if fnmatchcase(name, key)]
        value = mapping[name if name in mapping else fitting[-1]] if fitting else HELD
        if value != HELD and not _is_rigid(value):
            found[name] = _settings(name, value)
    if not found:
        raise ConfigurationError(
            f"joints gives no joint its stiffness K [N·m/rad]; choose from {', '.join(names)}, or '*' for all. {_CURE}"
        )
    return found


def _is_rigid(value: Any) -> bool:
    """Whether a joint is given an infinite K, as `elastic identify` writes it for a rigid joint."""
    K = value.get("stiffness") if isinstance(value, Mapping) else value
    return isinstance(K, float) and np.inf == K


def _mapping(given: GivenJoints) -> Mapping[str, Any]:
    if isinstance(given, Mapping):
        return given
    if not isinstance(given, str | Path):
        raise ConfigurationError(
            f"joints must be a YAML file or a mapping such as {{'*': {{'stiffness': 1000}}}}, got {shown(given)}. "
            f"{_CURE}"
        )
    return read_mapping(Path(given))


_CURE = (
    "K has no default. `elastic identify --robot MODEL --log poses.csv` identifies it from static poses and writes a "
    "file for `joints`; `elastic identify --robot MODEL --plan 20` proposes poses"
)


def _settings(name: str, value: Any) -> JointSettings:
    own = value if isinstance(value, Mapping) else {"stiffness": value}
    if own.get("stiffness") is None:
        raise ConfigurationError(f"joint {name!r} needs its stiffness K [N·m/rad]. {_CURE}")
    try:
        return JointSettings(**dict(own))
    except ConfigurationError as error:
        raise ConfigurationError(f"joint {name!r}: {error}") from None


def elastic_joints(
    spec: mujoco.MjSpec, settings: Mapping[str, JointSettings], load_kg: float
) -> dict[str, ElasticJoint]:
    """Elastic joints from what is given, what the model says, and defaults.

    Args:
        spec: The model, in which only these joints move.
        settings: What is given, by name.
        load_kg: Load on the outermost body that servos of unknown limits have to be good for [kg].

    Raises:
        ConfigurationError: An actuator of a joint is no position servo and none is given in its place.
    """
    model, names = spec.copy().compile(), list(settings)
    poses, links = drawn_poses(model, names), TreeTorque(model, names)
    links.set_load(model.body(outermost_body(model)).id, load_kg, np.zeros(3))
    torque = np.abs(links.gravity_torque(poses)).max(axis=0)
    least, most = _inertias(model, names, poses)
    return {
        name: _elastic(model, name, own, _Links(*map(float, of_links)))
        for (name, own), *of_links in zip(settings.items(), torque, least, most, strict=True)
    }


@dataclass(frozen=True)
class _Links:
    """What a joint moves, over poses: largest torque at rest [N·m], least inertia of free links and most of held ones.

    The inertias are without armature [kg·m²].
    """

    torque: float
    least: float
    most: float


def _inertias(model: mujoco.MjModel, names: list[str], poses: Array) -> tuple[Array, Array]:
    """Least and most inertia as `_Links` has them, (n,) each [kg·m²]."""
    data, at = mujoco.MjData(model), [int(model.joint(name).id) for name in names]
    dofs, least, most = model.jnt_dofadr[at], np.full(len(names), np.inf), np.zeros(len(names))
    mass = np.empty((model.nv, model.nv))
    for pose in poses[:_MASS_POSES]:
        data.qpos[model.jnt_qposadr[at]] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_crb(model, data)
        mujoco.mj_fullM(model, data, mass)
        links = mass[np.ix_(dofs, dofs)] - np.diag(model.dof_armature[dofs])
        least = np.minimum(least, 1.0 / np.diag(np.linalg.inv(links)))
        most = np.maximum(most, np.diag(links))
    return least, most


def _elastic(model: mujoco.MjModel, name: str, own: JointSettings, links: _Links) -> ElasticJoint:
    dof = int(model.joint(name).dofadr[0])
    K = own.stiffness
    B = _first(own.rotor_inertia, float(model.dof_armature[dof]) or None, K / ROTOR_FREQUENCY_RAD_S**2)
    return ElasticJoint(
        stiffness=K,
        rotor_inertia=B,
        damping=_first(own.damping, 2.0 * DAMPING_RATIO * np.sqrt(K * B * links.least / (B + links.least))),
        coulomb_friction=_first(own.coulomb_friction, float(model.dof_frictionloss[dof])),
        viscous_friction=_first(own.viscous_friction, float(model.dof_damping[dof])),
        backlash=own.backlash,
        encoder_counts_per_turn=own.encoder_counts_per_turn,
        servo=_servo(model, name, own.servo, (K, B), links),
    )


def _servo(model: mujoco.MjModel, name: str, own: ServoSettings, rotor: tuple[float, float], links: _Links) -> Servo:
    """The servo of a joint whose K and B are given."""
    K, B = rotor
    found = ServoSettings() if own.position_gain is not None else _position_actuator(model, name)
    kp = _first(own.position_gain, found.position_gain, _SERVO_TO_SPRING * K)
    enough = _TORQUE_RESERVE * links.torque + _RESERVE_RAD_S2 * (B + links.most)
    limits = [found.torque_limit, _force_limit(model, name)]
    modelled = min((value for value in limits if value is not None), default=None)
    return Servo(
        position_gain=kp,
        velocity_gain=_first(own.velocity_gain, found.velocity_gain, 2.0 * np.sqrt(kp * B)),
        integral_gain=_first(own.integral_gain, found.integral_gain, kp),
        torque_limit=_first(own.torque_limit, modelled, enough),
        speed_limit=_first(own.speed_limit, _SPEED_LIMIT_RAD_S),
    )


def _actuators(model: mujoco.MjModel, name: str) -> list[int]:
    """Actuators that act on a joint."""
    joint = model.joint(name).id
    return [
        i for i in range(model.nu) if model.actuator_trntype[i] in _ON_JOINT and model.actuator_trnid[i, 0] == joint
    ]


def _position_actuator(model: mujoco.MjModel, name: str) -> ServoSettings:
    """What the model's position actuator of a joint says, by its gear on the joint; nothing where there is none.

    Raises:
        ConfigurationError: There are several, or it has a law that a `Servo` has not.
    """
    position = [i for i in _actuators(model, name) if model.actuator_biasprm[i, 1] != 0.0]
    if not position:
        return ServoSettings()  # a motor or a velocity servo: a position servo takes its place
    i, gear = position[0], float(model.actuator_gear[position[0], 0])
    gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
    is_pid = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_PID
    kp, kv, ki = -float(bias[1]), -float(bias[2]), float(gain[0]) if is_pid else 0.0
    is_filtered = not is_pid and model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE
    is_plain = is_pid or (model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED and np.isclose(gain[0], kp))
    if len(position) > 1 or is_filtered or not is_plain or bias[0] != 0.0 or kp <= 0.0 or kv < 0.0:
        raise ConfigurationError(
            f"the actuators of joint {name!r} are no single position servo of the form kp (u - q) - kv q_dot; say its "
            "position_gain, velocity_gain and integral_gain under `servo` of this joint in `joints`"
        )
    return ServoSettings(
        position_gain=gear**2 * kp, velocity_gain=gear**2 * kv, integral_gain=gear**2 * ki,
        torque_limit=_bound(abs(gear), model.actuator_forcelimited[i], model.actuator_forcerange[i]),
    )  # fmt: skip


def _force_limit(model: mujoco.MjModel, name: str) -> float | None:
    """What the joint, or a motor that a servo replaces, can deliver [N·m]; None where the model does not say it."""
    joint = model.joint(name).id
    found = [_bound(1.0, model.jnt_actfrclimited[joint], model.jnt_actfrcrange[joint])]
    for i in _actuators(model, name):
        gear = abs(float(model.actuator_gear[i, 0]))
        found.append(_bound(gear, model.actuator_forcelimited[i], model.actuator_forcerange[i]))
        if model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE and model.actuator_dyntype[i] == 0:
            gain = abs(float(model.actuator_gainprm[i, 0]))
            found.append(_bound(gear * gain, model.actuator_ctrllimited[i], model.actuator_ctrlrange[i]))
    return min((value for value in found if value is not None), default=None)


def _bound(scale: float, is_limited: bool, interval: Array) -> float | None:
    """The smaller end of an interval about zero, where it is a limit and not empty."""
    value = scale * float(np.abs(interval).min())
    return value if is_limited and value > 0.0 else None


def _first(*values: float | None) -> float:
    """The first value that is known."""
    return next(float(value) for value in values if value is not None)


def drawn_poses(model: mujoco.MjModel, joints: list[str], count: int = _POSES, seed: int = 0) -> Array:
    """Poses within the ranges of the joints, or within half a turn about home, (count, n) [rad]."""
    lowest, highest = joint_ranges(model, joints)
    home = home_of_joints(model, joints)
    lowest, highest = np.maximum(lowest, home - np.pi / 2), np.minimum(highest, home + np.pi / 2)
    generator = np.random.default_rng(seed)
    return generator.uniform(lowest, highest, (count, len(joints)))


def joint_ranges(model: mujoco.MjModel, joints: list[str]) -> tuple[Array, Array]:
    """Lowest and highest angle of every joint, infinite where there is no limit, (n,) each [rad]."""
    at = [model.joint(name).id for name in joints]
    limited = model.jnt_limited[at].astype(bool)
    return (np.where(limited, model.jnt_range[at, end], bound) for end, bound in ((0, -np.inf), (1, np.inf)))  # pyright: ignore[reportReturnType]


def home_of_joints(model: mujoco.MjModel, joints: list[str]) -> Array:
    """The first keyframe, or the model's reference, moved inside the joint ranges by a tenth of them, (n,) [rad]."""
    lowest, highest = joint_ranges(model, joints)
    home = home_of(model)[[model.jnt_qposadr[model.joint(name).id] for name in joints]]
    with np.errstate(invalid="ignore"):
        margin = np.where(np.isfinite(highest - lowest), 0.1 * (highest - lowest), 0.0)
    return np.clip(home, lowest + margin, highest - margin)
