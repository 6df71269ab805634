"""Elastic joints of a robot from its joint file, from its model, or by assumptions."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import MjModel, MjSpec

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint import joint_settings
from elastic_env.joint.elastic_joint import ElasticJoint, Servo
from elastic_env.joint.joint_settings import JointSettings, ServoSettings
from elastic_env.joint.model_joints import home_of, mass_matrix
from elastic_env.joint.model_servo import force_limit, position_servo, rotor_inertia
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.rigid.tree.end_effector import outermost_body
from elastic_env.world.robot_model import joint_ranges

ROTOR_FREQUENCY_RAD_S = 100.0
"""Assumed frequency of an unknown rotor on its spring with a blocked link: 16 Hz [rad/s]."""
DAMPING_RATIO = 0.17
"""Assumed damping ratio of rotor and link on the spring between them [1]. The testbed's joint has
about the same: K 1001, B 0.839, D 10.
"""
STIFF_OVER_SERVO = 20.0
"""K over k_p of a joint that is almost rigid and can still be simulated [1]."""

_SERVO_TO_SPRING = 50.0
"""Assumed k_p of an unknown servo over K [1]: stiff enough to add little to the deflection while
its integrator acts.
"""
_LEAST_SERVO_TO_SPRING = 5.0
"""Least k_p of an unknown servo over K [1]."""
_SERVO_RAD_S = 1000.0
"""Assumed frequency of a light rotor on its servo, which bounds k_p [rad/s]."""
_STIFF_SERVO_TO_SPRING = 10.0
"""k_p over K above which a servo moves only its rotor: the spring isolates the links [1]."""
_FASTEST_PER_S = 2500.0
"""Largest rate of assumed dampers, which a physics step of 0.5 ms can follow [1/s]."""
_SPEED_LIMIT_RAD_S = 2.0 * np.pi
"""Assumed speed limit [rad/s]: position servos of arms turn about once a second."""
DECAY_RATE_PER_S = 5.0
"""Assumed rate at which links and servos of unknown damping come to rest [1/s]: to 0.06 % within
1.5 s.
"""
_TORQUE_RESERVE = 3.0
"""Assumed torque limit over the largest torque at rest [1]."""
_RESERVE_RAD_S2 = 20.0
"""Acceleration that the assumed torque limit allows in addition [rad/s²]."""
_POSES = 200
_MASS_POSES = 20
"""Numbers of random poses for torques, and for inertias."""


def elastic_settings(
    given: joint_settings.GivenJoints, hinges: Sequence[str], others: Sequence[str] = ()
) -> dict[str, JointSettings]:
    """Settings of the joints with springs, by name, in the order of the model.

    Joints that are not named, held or rigid are left out: they stay at home.

    Args:
        given: Settings of joints, see `read_joints`.
        hinges: Hinges of the model.
        others: Other joints of the model.

    Raises:
        ConfigurationError: `read_joints` fails; no joint is elastic; or a rigid joint has a servo
            that gives way.
    """
    elastic: dict[str, JointSettings] = {}
    for name, settings in joint_settings.read_joints(given, hinges, others).items():
        if settings is None:
            continue
        gain = settings.servo.sagging_gain(name)
        if not settings.is_rigid:
            elastic[name] = settings
        elif np.isfinite(gain):
            raise ConfigurationError(
                f"joint {name!r} is rigid and its servo gives way, which is not"
                " simulated; give it a stiffness K [N·m/rad] well above its"
                f" position_gain of {gain:g}, such as {STIFF_OVER_SERVO * gain:g}"
            )
    if not elastic:
        raise ConfigurationError(
            "joints gives no joint its stiffness K [N·m/rad]; choose from"
            f" {', '.join(hinges)}, or '*' for all. {joint_settings.CURE}"
        )
    return elastic


def elastic_joints(
    spec: MjSpec, settings: Mapping[str, JointSettings], load_kg: float
) -> dict[str, ElasticJoint]:
    """Make elastic joints from their settings, the model, and assumptions.

    Args:
        spec: The model, in which only these joints move.
        settings: Settings by name.
        load_kg: Load on the outermost body that servos of unknown limits can carry [kg].

    Raises:
        ConfigurationError: An actuator of a joint is no position servo and the settings have none,
            or limits and gains contradict each other.

    Warns:
        UserWarning: An assumed value differs from the default, which does not fit the model.
    """
    model = spec.copy().compile()
    names = list(settings)
    poses = random_poses(model, names)
    body = RigidBody(model, names)
    body.set_load(model.body(outermost_body(model)).id, load_kg, np.zeros(3))
    torque = np.abs(body.gravity_torque(poses)).max(axis=0)
    inertias = _link_inertias(model, names, poses)
    joints: dict[str, ElasticJoint] = {}
    notes: list[str] = []
    rows = zip(settings.items(), torque, *inertias, strict=True)
    for (name, values), *figures in rows:
        links = _Links(*map(float, figures))
        joints[name] = _JointBuilder(model, name, values, links, notes).build()
    if notes:
        reason = "as neither `joints` nor the model says it"
        warnings.warn(f"assumed, {reason}: {'; '.join(notes)}", stacklevel=4)
    return joints


@dataclass(frozen=True)
class _Links:
    """Links that a joint moves, over random poses; inertias are without rotors.

    Attributes:
        torque: Largest torque at rest [N·m].
        least: Least inertia about the joint with all other joints free [kg·m²].
        most: Largest inertia about the joint with all other joints held [kg·m²].
        together: Largest inertia about the joint where all joints turn by the same angle, each to
            either side [kg·m²].
    """

    torque: float
    least: float
    most: float
    together: float


def _link_inertias(model: MjModel, names: list[str], poses: Array) -> tuple[Array, Array, Array]:
    """Inertias `least`, `most` and `together` of `_Links`, (n,) each [kg·m²]."""
    data = mujoco.MjData(model)
    ids = [int(model.joint(name).id) for name in names]
    dofs = model.jnt_dofadr[ids]
    rotors = np.diag([rotor_inertia(model, name) for name in names])
    least = np.full(len(names), np.inf)
    most = np.zeros(len(names))
    together = np.zeros(len(names))
    for pose in poses[:_MASS_POSES]:
        data.qpos[model.jnt_qposadr[ids]] = pose
        links = mass_matrix(model, data)[np.ix_(dofs, dofs)] - rotors
        least = np.minimum(least, 1.0 / np.diag(np.linalg.inv(links)))
        most = np.maximum(most, np.diag(links))
        together = np.maximum(together, np.abs(links).sum(axis=1))
    return least, most, together


def lightest_links(model: MjModel, joints: Mapping[str, ElasticJoint]) -> tuple[str, float]:
    """Joint whose links swing fastest on its spring, and their least inertia [kg·m²]."""
    names = list(joints)
    least, *_ = _link_inertias(model, names, random_poses(model, names))
    stiffness = np.array([joint.stiffness for joint in joints.values()])
    fastest = int((stiffness / least).argmax())
    return names[fastest], float(least[fastest])


@dataclass(frozen=True)
class _JointBuilder:
    """Builder of an elastic joint from settings, the model, and assumptions that fit the model.

    Attributes:
        model: Model of the robot.
        name: Name of the joint.
        settings: Settings of the joint.
        links: Links that the joint moves.
        notes: List to which the builder adds assumptions that differ from the default.
    """

    model: MjModel
    name: str
    settings: JointSettings
    links: _Links
    notes: list[str]

    def build(self) -> ElasticJoint:
        """Build the joint.

        Raises:
            ConfigurationError: See `elastic_joints`.
        """
        settings = self.settings
        dof = int(self.model.joint(self.name).dofadr[0])
        damping = float(self.model.dof_damping[dof])
        friction = float(self.model.dof_frictionloss[dof])
        is_given = settings.servo.position_gain is not None
        actuator = None if is_given else position_servo(self.model, self.name)
        if actuator is not None and settings.servo.velocity_gain is None:
            damping -= actuator.joint_damping
        model_servo = ServoSettings() if actuator is None else actuator.settings
        servo = settings.servo.over(model_servo)
        rotor = settings.rotor_inertia or rotor_inertia(self.model, self.name)
        ratio = _SERVO_TO_SPRING
        if not rotor:
            rotor = self._rotor_inertia(servo.velocity_gain or 0.0)
            ratio = self._servo_to_spring(rotor)
        return ElasticJoint(
            stiffness=settings.stiffness,
            rotor_inertia=rotor,
            damping=_first_known(settings.damping, self._damping(rotor)),
            coulomb_friction=_first_known(settings.coulomb_friction, friction),
            viscous_friction=_first_known(settings.viscous_friction, damping),
            load_friction=settings.load_friction,
            static_friction=settings.static_friction,
            stribeck_speed=settings.stribeck_speed,
            backlash=settings.backlash,
            encoder_counts_per_turn=settings.encoder_counts_per_turn,
            servo=self._servo(servo, rotor, ratio, is_given),
        )

    def _rotor_inertia(self, velocity_gain: float) -> float:
        """B of an unknown rotor, from its frequency, at most the inertia of its links [kg·m²].

        A servo with a known velocity gain needs a rotor that is not too light for it.
        """
        by_frequency = self.settings.stiffness / ROTOR_FREQUENCY_RAD_S**2
        most = max(self.links.most, velocity_gain / _FASTEST_PER_S)
        if by_frequency <= most:
            return by_frequency
        is_of_links = most == self.links.most
        scale = "its links have" if is_of_links else "its velocity gain needs"
        self.notes.append(
            f"rotor_inertia of {self.name} {most:.3g} kg·m², as much as {scale}, as"
            f" K/(100 rad/s)² would be {by_frequency:.3g}"
        )
        return most

    def _servo_to_spring(self, rotor: float) -> float:
        """k_p over K of an unknown servo, on a rotor whose inertia is assumed [1]."""
        K = self.settings.stiffness
        if rotor == K / ROTOR_FREQUENCY_RAD_S**2:
            return _SERVO_TO_SPRING
        ratio = rotor * _SERVO_RAD_S**2 / K
        return min(max(ratio, _LEAST_SERVO_TO_SPRING), _SERVO_TO_SPRING)

    def _damping(self, rotor: float) -> float:
        r"""D of an unknown transmission [N·m·s/rad].

        Rotor and lightest links swing with the damping ratio of the testbed's joint. All links that
        swing together come to rest, too: with :math:`m_j = \sum_i |M_{ji}|` every mode of the links
        on their springs has :math:`\varphi^T M \varphi \le \sum_j m_j \varphi_j^2`. So it decays at
        a rate of :math:`\sigma` with :math:`D_j \ge 2 \sigma m_j`. The damping of a soft spring is
        at most critical, and the rate of light links is at most what a physics step can follow.
        """
        K = self.settings.stiffness
        least = self.links.least
        together = self.links.together
        of_lightest = DAMPING_RATIO * np.sqrt(K * rotor * least / (rotor + least))
        of_slowest = min(DECAY_RATE_PER_S * together, np.sqrt(K * together))
        fastest = _FASTEST_PER_S / 2.0 * rotor * least / (rotor + least)
        return float(2.0 * max(of_lightest, min(of_slowest, fastest)))

    def _servo(self, known: ServoSettings, rotor: float, ratio: float, is_given: bool) -> Servo:
        """Complete a servo of which some values are known."""
        links = self.links
        kp = _first_known(known.position_gain, ratio * self.settings.stiffness)
        kv = known.velocity_gain
        motor = known.motor
        back_emf = 0.0 if motor is None else motor.damping
        if kv is None and motor is not None and is_given:
            kv = 0.0
        elif kv is None:
            is_soft = kp < _STIFF_SERVO_TO_SPRING * self.settings.stiffness
            carries_links = known.position_gain is not None and is_soft
            critical = 2.0 * float(np.sqrt(kp * (rotor + links.most * carries_links)))
            kv = max(critical - back_emf, 0.0)
            if known.position_gain is not None and not is_given:
                self.notes.append(
                    f"velocity_gain of {self.name} {kv:.3g} N·m·s/rad, critical"
                    " damping, as nothing in the model damps its servo"
                )
        enough = _TORQUE_RESERVE * links.torque + _RESERVE_RAD_S2 * (rotor + links.most)
        limit = known.torque_limit
        if limit is None:
            limit = force_limit(self.model, self.name)
        if limit is None and motor is not None:
            limit = motor.stall_torque
        # an integrator unwinds at the rate k_i/k_p, which Routh's criterion bounds by k_v/(B + M)
        rate = min(DECAY_RATE_PER_S, (kv + back_emf) / (4.0 * (rotor + links.most)))
        return Servo(
            position_gain=kp,
            velocity_gain=kv,
            integral_gain=_first_known(known.integral_gain, rate * kp),
            torque_limit=_first_known(limit, enough),
            speed_limit=_first_known(
                known.speed_limit,
                None if motor is None else motor.no_load_speed,
                _SPEED_LIMIT_RAD_S,
            ),
            motor=motor,
        )


def _first_known(*values: float | None) -> float:
    """First value that is not None."""
    return next(float(value) for value in values if value is not None)


def random_poses(model: MjModel, joints: list[str]) -> Array:
    """Draw poses within the joint ranges, at most a quarter turn from home, (200, n) [rad]."""
    lowest, highest = joint_ranges(model, joints)
    home = home_of_joints(model, joints)
    lowest = np.maximum(lowest, home - np.pi / 2)
    highest = np.minimum(highest, home + np.pi / 2)
    return np.random.default_rng(0).uniform(lowest, highest, (_POSES, len(joints)))


def home_of_joints(model: MjModel, joints: list[str]) -> Array:
    """First keyframe or the model's reference, inside the joint ranges, (n,) [rad].

    The distance to a limit is at least a tenth of the range, or 0.1 rad if there is only one limit.
    """
    lowest, highest = joint_ranges(model, joints)
    home = home_of(model)[[model.jnt_qposadr[model.joint(name).id] for name in joints]]
    with np.errstate(invalid="ignore"):
        margin = np.where(np.isfinite(highest - lowest), 0.1 * (highest - lowest), 0.1)
    return np.clip(home, lowest + margin, highest - margin)
