"""Known robots on a fixed base, all of whose hinges are made elastic.

    spec = gallery_robot("panda")
    model = make_elastic(spec, gallery_joints("panda")).compile()

The arms are those of the package `example-robot-data` (extra `robots`); the pusher comes with
Gymnasium. Slides, such as fingers of grippers, are held where the model has them. Nobody publishes
stiffness, damping and rotor inertia of these joints in a form that we could check. They are
therefore assumed, by the rule of `assumed_joints`.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from mujoco import MjModel, MjSpec

from elastic_env.core.config import Model, read_mapping
from elastic_env.core.errors import missing_extra, require_known
from elastic_env.core.signals import Array
from elastic_env.joint.elasticity import ElasticJoint, Servo
from elastic_env.joint.model_file import read_model
from elastic_env.joint.model_joints import hinges_of, mass_matrix
from elastic_env.rigid.rigid_body import RigidBody

TIMESTEP_S = 1e-3
"""Physics step of all robots, with the integrator `implicitfast` [s]."""
SAG_RAD = 0.015
"""Deflection of a joint under the largest torque of its robot's weight, which the assumed
stiffness gives.
"""
_PACKAGE = "example-robot-data"
_SHARE = "cmeel.prefix/share/example-robot-data/robots"
_WEAKEST = 0.05
_SLOWEST = 2.0 * np.pi * 5.0
"""Least stiffness of a joint: over that which the largest torque asks for, and by its frequency
[rad/s].
"""
_ROTOR = 0.5
_LIGHTEST = 0.01
_DAMPING_RATIO = 0.1
_SERVO_RATE = 20.0
"""Rotor inertia over that of the joint's links, least one over the largest; damping ratio;
servo's rate [rad/s].
"""
_POSES = 50
_INNER = 0.8
_FARTHEST = np.pi
"""Number of random poses, the part of a joint's range that they use, and their largest angle
[rad].
"""


class GalleryRobot(Model):
    """A robot of the gallery."""

    title: str
    """Its name in full."""
    file: str
    """Where its model lies, in the package or among Gymnasium's."""
    end_effector: str
    """Body that is to be placed."""
    home: dict[str, float] = {}
    """Angles that differ from zero in the pose about which it moves, by joint [rad]."""
    licence: str = "BSD"
    """Licence of its model."""
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Which point of the end effector is to be placed, in its frame [m]."""


GALLERY: Mapping[str, GalleryRobot] = {
    name: GalleryRobot(**own)
    for name, own in read_mapping(Path(__file__).with_suffix(".yaml")).items()
}
"""The robots by name."""


def gallery_file(name: str, folder: Path | None = None) -> Path:
    """File of a robot's model.

    Args:
        name: As in `GALLERY`.
        folder: Folder of the robots in place of that of the package.

    Raises:
        ConfigurationError: No such robot, or the package is missing.
    """
    require_known("robot", [name], GALLERY)
    file = Path(GALLERY[name].file)
    if file.parts[0] == "gymnasium":
        assets = Path(gymnasium.__file__).with_name("envs") / "mujoco" / "assets"
        return assets / file.name
    robot = f"the robot {name!r}"
    try:
        path = (folder or Path(str(distribution(_PACKAGE).locate_file(_SHARE)))) / file
    except PackageNotFoundError:
        raise missing_extra(_PACKAGE, "robots", robot) from None
    if not path.is_file():
        where = f"which has no model at {path},"
        raise missing_extra(_PACKAGE, "robots", f"{robot}, {where}")
    return path


def gallery_robot(name: str, folder: Path | None = None, shapes: bool = False) -> MjSpec:
    """Rigid specification of a robot, whose slides are held.

    Args:
        name: As in `GALLERY`.
        folder: Folder of the robots in place of that of the package.
        shapes: Whether to load the meshes that MuJoCo reads, for pictures. They have no mass and
            touch nothing.

    Raises:
        ConfigurationError: No such robot, or the package is missing.
    """
    path = gallery_file(name, folder)
    spec = read_model(path, shapes=shapes).spec
    if path.suffix != ".urdf":
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0.0, 0.0, -9.81]
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    slides = [joint for joint in spec.joints if joint.type == slide]
    held = {joint.name for joint in slides}
    # a finger that copies the other
    ties = [tie for tie in spec.equalities if held & {tie.name1, tie.name2}]
    # the servos of the elastic joints take the place of actuators
    for element in (*ties, *slides, *spec.actuators):
        spec.delete(element)
    return spec


def home_pose(name: str, joints: Sequence[str]) -> Array:
    """Pose about which a robot of the gallery moves, (n,) [rad]."""
    return np.array([GALLERY[name].home.get(joint, 0.0) for joint in joints])


def random_poses(model: MjModel, generator: np.random.Generator, number: int = _POSES) -> Array:
    """Poses within the inner part of the joints' ranges, (number, n) [rad].

    The robot may cross itself in them.
    """
    ids = [int(model.joint(name).id) for name in hinges_of(model)]
    limited = model.jnt_limited[ids, None].astype(bool)
    ranges = np.where(limited, model.jnt_range[ids], [-_FARTHEST, _FARTHEST])
    ends = np.clip(ranges, -_FARTHEST, _FARTHEST)
    # of a range that lies beyond a half turn, such as Kinova's 47° to 313°, what is within it
    middle = ends.mean(axis=1)
    half = _INNER * np.ptp(ends, axis=1) / 2.0
    return generator.uniform(middle - half, middle + half, (number, len(ids)))


@cache
def gallery_joints(name: str, folder: Path | None = None) -> dict[str, ElasticJoint]:
    """Elastic joints of a robot's hinges, by the rule of `assumed_joints`."""
    return assumed_joints(gallery_robot(name, folder).compile())


def assumed_joints(model: MjModel) -> dict[str, ElasticJoint]:
    r"""Elastic joints by one rule for all robots, for want of measured ones.

    .. math::
        K_j = \max\left(\frac{\tau_j}{0.015}, \frac{\max_i \tau_i}{20 \cdot 0.015}, (10 \pi)^2 M_j\right), \quad
        B_j = \frac{M_j}{2} + \frac{\max_i M_i}{100}, \quad D_j = 0.2 \sqrt{K_j m_j}

    τ_j is the largest gravity torque over random poses, M_j the largest inertia about the joint.
    0.015 rad is a sag that users of arms report, 10π rad/s a frequency that keeps a vertical axis,
    which carries no weight, from swinging. m_j is the inertia against which the spring swings: that
    of the rotor and the least one of its links while the other joints are free. Two digits of K are
    kept.

    Args:
        model: Compiled rigid model, all of whose joints are hinges.

    Returns:
        Joints by name, with a servo that holds its angle.
    """  # noqa: E501
    names = hinges_of(model)
    poses = random_poses(model, np.random.default_rng(0))
    torque = np.abs(RigidBody(model, names).gravity_torque(poses)).max(axis=0)
    inertia = np.array([_inertia(model, pose) for pose in poses])
    links = np.diagonal(inertia, axis1=1, axis2=2).max(axis=0)
    free = (1.0 / np.diagonal(np.linalg.inv(inertia), axis1=1, axis2=2)).min(axis=0)
    carried = np.maximum(torque, _WEAKEST * torque.max())
    stiffness = np.maximum(carried / SAG_RAD, _SLOWEST**2 * links)
    digit = 10.0 ** (np.floor(np.log10(stiffness)) - 1.0)
    stiffness = np.round(stiffness / digit) * digit
    rotor = _ROTOR * links + _LIGHTEST * links.max()
    damping = 2.0 * _DAMPING_RATIO * np.sqrt(stiffness / (1.0 / rotor + 1.0 / free))
    joints: dict[str, ElasticJoint] = {}
    for j, name in enumerate(names):
        K = float(stiffness[j])
        total = float(rotor[j] + links[j])
        joints[name] = ElasticJoint(
            stiffness=K,
            damping=float(damping[j]),
            rotor_inertia=float(rotor[j]),
            servo=_servo(total, K, float(torque.max() + 25.0 * total)),
        )
    return joints


def _servo(inertia: float, stiffness: float, torque_limit: float) -> Servo:
    """A servo that holds its angle, no softer than the spring behind it.

    It gives a rigid load three equal poles.
    """
    carried = max(inertia, stiffness / (3.0 * _SERVO_RATE**2))
    return Servo(
        position_gain=3.0 * carried * _SERVO_RATE**2,
        velocity_gain=3.0 * carried * _SERVO_RATE,
        integral_gain=carried * _SERVO_RATE**3,
        torque_limit=torque_limit,
        speed_limit=5.0,
    )


def _inertia(model: MjModel, pose: Array) -> Array:
    """Mass matrix without armature, (n, n) [kg·m²]."""
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    return mass_matrix(model, data) - np.diag(model.dof_armature)
