"""Known robots on a fixed base, whose hinges all become elastic.

    spec = gallery_robot("panda")
    model = make_elastic(spec, gallery_joints("panda")).compile()

The arms come from the package `example-robot-data` (extra `robots`), the pusher from Gymnasium.
Slides, such as fingers of grippers, are fixed at their position in the model. No published
stiffness, damping or rotor inertia of these joints can be checked. They are therefore assumed, by
the rule of `elastic_env.robots.assumed_joints`.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from mujoco import MjSpec

from elastic_env.core.config import Model, read_mapping
from elastic_env.core.errors import missing_extra, require_known
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.model_file import read_model
from elastic_env.robots.assumed_joints import assumed_joints

TIMESTEP_S = 1e-3
"""Physics step of all robots, with the integrator `implicitfast` [s]."""
_PACKAGE = "example-robot-data"
_ROBOTS = "cmeel.prefix/share/example-robot-data/robots"


class GalleryRobot(Model):
    """A robot of the gallery."""

    title: str
    """Full name of the robot."""
    file: str
    """Path of the model, in the package or among Gymnasium's models."""
    end_effector: str
    """Body of the end effector."""
    home: dict[str, float] = {}
    """Nonzero angles of the pose about which it moves, by joint [rad]."""
    licence: str = "BSD"
    """Licence of the model."""
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point of the end effector that is positioned, in its frame [m]."""


GALLERY: Mapping[str, GalleryRobot] = {
    name: GalleryRobot(**fields)
    for name, fields in read_mapping(Path(__file__).with_suffix(".yaml")).items()
}
"""The robots by name."""


def gallery_file(name: str, folder: Path | None = None) -> Path:
    """File of a robot's model.

    Args:
        name: Name in `GALLERY`.
        folder: Folder of the robots; default the package's.

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
        path = (folder or Path(str(distribution(_PACKAGE).locate_file(_ROBOTS)))) / file
    except PackageNotFoundError:
        raise missing_extra(_PACKAGE, "robots", robot) from None
    if not path.is_file():
        robot = f"{robot}, which has no model at {path},"
        raise missing_extra(_PACKAGE, "robots", robot)
    return path


def gallery_robot(name: str, folder: Path | None = None, shapes: bool = False) -> MjSpec:
    """Rigid specification of a robot, whose slides are fixed.

    Args:
        name: Name in `GALLERY`.
        folder: Folder of the robots; default the package's.
        shapes: True to load meshes that MuJoCo can read, for pictures. They have no mass and no
            contacts.

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
    slide_names = {joint.name for joint in slides}
    # constraints of a finger that follows the other one
    ties = [tie for tie in spec.equalities if slide_names & {tie.name1, tie.name2}]
    # the servos of the elastic joints replace the actuators
    for element in (*ties, *slides, *spec.actuators):
        spec.delete(element)
    return spec


def home_pose(name: str, joints: Sequence[str]) -> Array:
    """Pose about which a robot of the gallery moves, (n,) [rad]."""
    return np.array([GALLERY[name].home.get(joint, 0.0) for joint in joints])


@cache
def gallery_joints(name: str, folder: Path | None = None) -> dict[str, ElasticJoint]:
    """Elastic joints of a robot's hinges, by the rule of `elastic_env.robots.assumed_joints`."""
    return assumed_joints(gallery_robot(name, folder).compile())
