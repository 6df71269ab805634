"""Elastic joints of a robot: given by name or pattern, read from the model, or by default."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import MjModel, MjSpec

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import ElasticJoint, Servo
from elastic_env.joint.joint_settings import (
    CURE,
    GivenJoints,
    JointSettings,
    ServoSettings,
    read_joints,
)
from elastic_env.joint.model_joints import home_of, mass_matrix
from elastic_env.joint.model_servo import force_limit, position_servo, rotor_inertia
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.rigid.tree.end_effector import outermost_body
from elastic_env.world.robot_model import joint_ranges

ROTOR_FREQUENCY_RAD_S = 100.0
"""An assumption for rotors that nobody knows: with the link blocked they swing on their spring
at 16 Hz [rad/s].
"""
DAMPING_RATIO = 0.17
"""Of rotor and link on the spring between them; about that of the testbed's joint, K 1001, B
0.839, D 10 [1].
"""
STIFF_OVER_SERVO = 20.0
"""K over k_p of a joint that is as good as rigid and can still be simulated."""

_SERVO_TO_SPRING = 50.0
"""k_p of a servo that nobody knows over K: stiff enough to add little to the deflection while
its integrator acts.
"""
_LEAST_SERVO_TO_SPRING = 5.0
_SERVO_RAD_S = 1000.0
"""The same where the rotor is as light as its links: by the frequency of the rotor on its servo,
at least 5 K.
"""
_FAR_STIFFER = 10.0
"""k_p over K from which on a servo moves its rotor alone, and the spring keeps the links from
it.
"""
_FASTEST_PER_S = 2500.0
"""Rate of assumed dampers, which a physics step of 0.5 ms follows [1/s]."""
_SPEED_LIMIT_RAD_S = 2.0 * np.pi
"""An assumption: position servos of arms turn about once a second."""
DECAY_RATE_PER_S = 5.0
"""At which links and servos come to rest, where nobody knows their damping: to 0.06 % within 1.5
s [1/s].
"""
_TORQUE_RESERVE = 3.0
_RESERVE_RAD_S2 = 20.0
_POSES = 200
_MASS_POSES = 20


def elastic_settings(
    given: GivenJoints, hinges: Sequence[str], others: Sequence[str] = ()
) -> dict[str, JointSettings]:
    """Settings of the joints that move on springs, by name, in the order of the model.

    Joints that nothing names, that are held, or that are rigid are left out: they stay at home.

    Args:
        given: As of `read_joints`.
        hinges: Hinges of the model.
        others: Its further joints.

    Raises:
        ConfigurationError: As of `read_joints`; no joint is elastic; or a rigid joint has a servo
            that gives way.
    """
    found: dict[str, JointSettings] = {}
    for name, own in read_joints(given, hinges, others).items():
        if own is None:
            continue
        gain = own.servo.sagging_gain(name)
        if not own.is_rigid:
            found[name] = own
        elif np.isfinite(gain):
            raise ConfigurationError(
                f"joint {name!r} is rigid and its servo gives way, which is not simulated; give it"
                f" a stiffness K [N·m/rad] well above its position_gain of {gain:g}, such as"
                f" {STIFF_OVER_SERVO * gain:g}"
            )
    if not found:
        raise ConfigurationError(
            f"joints gives no joint its stiffness K [N·m/rad]; choose from {', '.join(hinges)}, or"
            f" '*' for all. {CURE}"
        )
    return found


def elastic_joints(
    spec: MjSpec, settings: Mapping[str, JointSettings], load_kg: float
) -> dict[str, ElasticJoint]:
    """Elastic joints from what is given, what the model says, and defaults.

    Args:
        spec: The model, in which only these joints move.
        settings: What is given, by name.
        load_kg: Load on the outermost body that servos of unknown limits have to be good for [kg].

    Raises:
        ConfigurationError: An actuator of a joint is no position servo and none is given in its
            place, or limits and gains contradict each other.

    Warns:
        UserWarning: A value is assumed otherwise than by default, as the default is out of scale
            with the model.
    """
    model = spec.copy().compile()
    names = list(settings)
    poses = drawn_poses(model, names)
    links = RigidBody(model, names)
    links.set_load(model.body(outermost_body(model)).id, load_kg, np.zeros(3))
    torque = np.abs(links.gravity_torque(poses)).max(axis=0)
    inertias = _inertias(model, names, poses)
    found: dict[str, ElasticJoint] = {}
    said: list[str] = []
    for (name, own), *of_links in zip(settings.items(), torque, *inertias, strict=True):
        links = _Links(*map(float, of_links))
        found[name] = _Assumed(model, name, own, links, said).elastic()
    if said:
        assumed = "; ".join(said)
        reason = "as neither `joints` nor the model says it"
        warnings.warn(f"assumed, {reason}: {assumed}", stacklevel=4)
    return found


@dataclass(frozen=True)
class _Links:
    """The links that a joint moves, over poses; inertias are without rotors.

    Attributes:
        torque: Largest torque at rest [N·m].
        least: Least inertia about the joint, where the other joints are free [kg·m²].
        most: Largest inertia about it, where the others are held [kg·m²].
        together: Largest inertia about it, where all joints turn by the same angle, to whatever
            side [kg·m²].
    """

    torque: float
    least: float
    most: float
    together: float


def _inertias(model: MjModel, names: list[str], poses: Array) -> tuple[Array, Array, Array]:
    """Least and most inertia, and that of all together, as `_Links` has them, (n,) each [kg·m²]."""
    data = mujoco.MjData(model)
    at = [int(model.joint(name).id) for name in names]
    dofs = model.jnt_dofadr[at]
    rotors = np.diag([rotor_inertia(model, name) for name in names])
    least = np.full(len(names), np.inf)
    most = np.zeros(len(names))
    together = np.zeros(len(names))
    for pose in poses[:_MASS_POSES]:
        data.qpos[model.jnt_qposadr[at]] = pose
        links = mass_matrix(model, data)[np.ix_(dofs, dofs)] - rotors
        least = np.minimum(least, 1.0 / np.diag(np.linalg.inv(links)))
        most = np.maximum(most, np.diag(links))
        together = np.maximum(together, np.abs(links).sum(axis=1))
    return least, most, together


def lightest_links(model: MjModel, joints: Mapping[str, ElasticJoint]) -> tuple[str, float]:
    """The joint whose links swing fastest on its spring, and their least inertia [kg·m²]."""
    names = list(joints)
    least, *_ = _inertias(model, names, drawn_poses(model, names))
    stiffness = np.array([joint.stiffness for joint in joints.values()])
    fastest = int((stiffness / least).argmax())
    return names[fastest], float(least[fastest])


@dataclass(frozen=True)
class _Assumed:
    """One elastic joint: given, read from the model, or assumed within the scale of the model.

    Attributes:
        model, name: The joint's.
        own: What is given of it.
        links: That it moves.
        said: To be added to: assumptions that the default would not lead one to expect, with their
            values.
    """

    model: MjModel
    name: str
    own: JointSettings
    links: _Links
    said: list[str]

    def elastic(self) -> ElasticJoint:
        """The joint.

        Raises:
            ConfigurationError: See `elastic_joints`.
        """
        own = self.own
        dof = int(self.model.joint(self.name).dofadr[0])
        damping = float(self.model.dof_damping[dof])
        friction = float(self.model.dof_frictionloss[dof])
        is_given = own.servo.position_gain is not None
        actuator = None if is_given else position_servo(self.model, self.name)
        if actuator is not None and own.servo.velocity_gain is None:
            damping -= actuator.joint_damping
        read = ServoSettings() if actuator is None else actuator.settings
        servo = own.servo.over(read)
        rotor = own.rotor_inertia or rotor_inertia(self.model, self.name)
        ratio = _SERVO_TO_SPRING
        if not rotor:
            rotor = self._rotor_inertia(servo.velocity_gain or 0.0)
            ratio = self._servo_to_spring(rotor)
        return ElasticJoint(
            stiffness=own.stiffness,
            rotor_inertia=rotor,
            damping=_first(own.damping, self._damping(rotor)),
            coulomb_friction=_first(own.coulomb_friction, friction),
            viscous_friction=_first(own.viscous_friction, damping),
            load_friction=own.load_friction,
            static_friction=own.static_friction,
            stribeck_speed=own.stribeck_speed,
            backlash=own.backlash,
            encoder_counts_per_turn=own.encoder_counts_per_turn,
            servo=self._servo(servo, rotor, ratio, is_given),
        )

    def _rotor_inertia(self, velocity_gain: float) -> float:
        """B of a rotor that nobody knows: by its frequency, at most that of its links.

        A servo of a known velocity gain needs a rotor that is not too light for it.
        """
        by_frequency = self.own.stiffness / ROTOR_FREQUENCY_RAD_S**2
        most = max(self.links.most, velocity_gain / _FASTEST_PER_S)
        if by_frequency <= most:
            return by_frequency
        is_of_links = most == self.links.most
        scale = "its links have" if is_of_links else "its velocity gain needs"
        self.said.append(
            f"rotor_inertia of {self.name} {most:.3g} kg·m², as much as {scale}, as K/(100 rad/s)²"
            f" would be {by_frequency:.3g}"
        )
        return most

    def _servo_to_spring(self, rotor: float) -> float:
        """k_p over K of a servo that nobody knows, on a rotor whose inertia is assumed."""
        K = self.own.stiffness
        if rotor == K / ROTOR_FREQUENCY_RAD_S**2:
            return _SERVO_TO_SPRING
        ratio = rotor * _SERVO_RAD_S**2 / K
        return min(max(ratio, _LEAST_SERVO_TO_SPRING), _SERVO_TO_SPRING)

    def _damping(self, rotor: float) -> float:
        r"""D of a transmission that nobody knows [N·m·s/rad].

        Rotor and lightest links swing with the damping ratio of the testbed's. All links that swing
        together come to rest, too: with :math:`m_j = \sum_i |M_{ji}|` every mode of the links on
        their springs has :math:`\varphi^T M \varphi \le \sum_j m_j \varphi_j^2`, so that :math:`D_j
        \ge 2 \sigma m_j` lets it decay by :math:`\sigma`. A soft spring is damped critically at
        most, and light links no faster than a physics step follows.
        """
        K = self.own.stiffness
        least = self.links.least
        together = self.links.together
        of_lightest = DAMPING_RATIO * np.sqrt(K * rotor * least / (rotor + least))
        of_slowest = min(DECAY_RATE_PER_S * together, np.sqrt(K * together))
        fastest = _FASTEST_PER_S / 2.0 * rotor * least / (rotor + least)
        return float(2.0 * max(of_lightest, min(of_slowest, fastest)))

    def _servo(self, known: ServoSettings, rotor: float, ratio: float, is_given: bool) -> Servo:
        """The servo of which some is known."""
        links = self.links
        kp = _first(known.position_gain, ratio * self.own.stiffness)
        kv = known.velocity_gain
        motor = known.motor
        back_emf = 0.0 if motor is None else motor.damping
        if kv is None and motor is not None and is_given:
            kv = 0.0
        elif kv is None:
            is_soft = kp < _FAR_STIFFER * self.own.stiffness
            carries_links = known.position_gain is not None and is_soft
            critical = 2.0 * float(np.sqrt(kp * (rotor + links.most * carries_links)))
            kv = max(critical - back_emf, 0.0)
            if known.position_gain is not None and not is_given:
                self.said.append(
                    f"velocity_gain of {self.name} {kv:.3g} N·m·s/rad, critical damping, as"
                    " nothing in the model damps its servo"
                )
        enough = _TORQUE_RESERVE * links.torque + _RESERVE_RAD_S2 * (rotor + links.most)
        limit = known.torque_limit
        if limit is None:
            limit = force_limit(self.model, self.name)
        if limit is None and motor is not None:
            limit = motor.stall_torque
        # an integrator lets go of what it gathered in a motion at the rate k_i/k_p, which Routh
        # bounds by k_v/(B + M)
        rate = min(DECAY_RATE_PER_S, (kv + back_emf) / (4.0 * (rotor + links.most)))
        return Servo(
            position_gain=kp,
            velocity_gain=kv,
            integral_gain=_first(known.integral_gain, rate * kp),
            torque_limit=_first(limit, enough),
            speed_limit=_first(
                known.speed_limit,
                None if motor is None else motor.no_load_speed,
                _SPEED_LIMIT_RAD_S,
            ),
            motor=motor,
        )


def _first(*values: float | None) -> float:
    """The first value that is known."""
    return next(float(value) for value in values if value is not None)


def drawn_poses(model: MjModel, joints: list[str]) -> Array:
    """Poses within the ranges of the joints, or within half a turn about home, (200, n) [rad]."""
    lowest, highest = joint_ranges(model, joints)
    home = home_of_joints(model, joints)
    lowest = np.maximum(lowest, home - np.pi / 2)
    highest = np.minimum(highest, home + np.pi / 2)
    return np.random.default_rng(0).uniform(lowest, highest, (_POSES, len(joints)))


def home_of_joints(model: MjModel, joints: list[str]) -> Array:
    """The first keyframe or the model's reference, a tenth inside the joint ranges, (n,) [rad].

    That is 0.1 rad where only one side has a limit.
    """
    lowest, highest = joint_ranges(model, joints)
    home = home_of(model)[[model.jnt_qposadr[model.joint(name).id] for name in joints]]
    with np.errstate(invalid="ignore"):
        margin = np.where(np.isfinite(highest - lowest), 0.1 * (highest - lowest), 0.1)
    return np.clip(home, lowest + margin, highest - margin)
