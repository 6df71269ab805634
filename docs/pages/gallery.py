"""The gallery of robots: how far they sag, with and without input compensation, and how that looks.

    python -m docs.pages.gallery [CHECKOUT]     # docs/results/gallery.csv and docs/images/gallery

Everything is at rest. A servo holds its angle; the joint behind it gives way under the weight of
the robot.
"""

import csv
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from elastic_env.rendering.headless import prefer_egl

prefer_egl()

import mujoco  # noqa: E402
import numpy as np  # noqa: E402

from baselines import PositionCompensator  # noqa: E402
from elastic_env.core.signals import Array  # noqa: E402
from elastic_env.joint.model_joints import hinges_of  # noqa: E402
from elastic_env.joint.static_equilibrium import static_link_angle  # noqa: E402
from elastic_env.rendering.picture import Image  # noqa: E402
from elastic_env.rendering.sag import SagViews  # noqa: E402
from elastic_env.rendering.simple_bodies import add_simple_bodies  # noqa: E402
from elastic_env.rigid.rigid_body import RigidBody  # noqa: E402
from elastic_env.robots.assumed_joints import random_poses  # noqa: E402
from elastic_env.robots.gallery import (  # noqa: E402
    GALLERY,
    gallery_joints,
    gallery_robot,
    home_pose,
)

_SOFT = 0.7
"""True stiffness over the assumed one in the scenario `soft`."""
_SEED = 7
_PIXELS = 340
_COLOURS = 64


@dataclass(frozen=True)
class Sag:
    """A row of the table: deviations of the end effector over random poses at rest.

    Attributes:
        robot: Name in the gallery.
        title: Name in full.
        joints: Number of elastic joints.
        stiffness_least_Nm_per_rad: K of the softest joint.
        stiffness_most_Nm_per_rad: K of the stiffest joint.
        stiffness_source: Where K comes from.
        deflection_peak_rad: Largest deflection of a joint, uncompensated.
        uncompensated_rms_m: Deviation without compensation.
        uncompensated_peak_m: Its largest.
        input_rms_m: With `input`, whose K is right.
        soft_uncompensated_rms_m: Without, where the joints are 30 % softer than assumed.
        soft_input_rms_m: With `input`, likewise.
    """

    robot: str
    title: str
    joints: int
    stiffness_least_Nm_per_rad: float
    stiffness_most_Nm_per_rad: float
    stiffness_source: str
    deflection_peak_rad: float
    uncompensated_rms_m: float
    uncompensated_peak_m: float
    input_rms_m: float
    soft_uncompensated_rms_m: float
    soft_input_rms_m: float


class AtRest:
    """A robot of the gallery whose servos hold their angles.

    Args:
        name: As in `GALLERY`.
        folder: Folder of the robots in place of that of the package.
    """

    def __init__(self, name: str, folder: Path | None = None) -> None:
        self.name = name
        self.model = gallery_robot(name, folder).compile()
        self.joints = gallery_joints(name, folder)
        self.hinges = hinges_of(self.model)
        self.stiffness = np.array([self.joints[hinge].stiffness for hinge in self.hinges])
        self._torque = RigidBody(self.model, self.hinges)
        self._compensator = PositionCompensator(self.model, self.stiffness.tolist())

    def commands(self, q_ref: Array) -> Array:
        """Commands of the input compensator, (..., n) [rad]."""
        return np.apply_along_axis(self._compensator.command, -1, q_ref)

    def links(self, theta: Array, softer: float = 1.0) -> Array:
        """Angles of the links for angles of the servos, (..., n) [rad]; `softer` is true over
        assumed stiffness.
        """
        return static_link_angle(
            theta,
            softer * self.stiffness,
            self._torque.gravity_torque,
            self._torque.gravity_gradient,
        )

    def end_effector(self, q: Array) -> Array:
        """Place of the end effector, from (m, n) [rad] to (m, 3) [m]."""
        data = mujoco.MjData(self.model)
        robot = GALLERY[self.name]
        body = data.body(robot.end_effector)
        places = []
        for pose in q:
            data.qpos[:] = pose
            mujoco.mj_kinematics(self.model, data)
            places.append(body.xpos + body.xmat.reshape(3, 3) @ robot.tip)
        return np.array(places)


def measure(name: str, folder: Path | None = None) -> Sag:
    """How far a robot sags; arguments as of `AtRest`."""
    robot = AtRest(name, folder)
    q_ref = random_poses(robot.model, np.random.default_rng(_SEED))
    commands = robot.commands(q_ref)
    wanted = robot.end_effector(q_ref)

    def deviation(theta: Array, softer: float) -> Array:
        return np.linalg.norm(robot.end_effector(robot.links(theta, softer)) - wanted, axis=-1)

    without = deviation(q_ref, 1.0)
    return Sag(
        robot=name,
        title=GALLERY[name].title,
        joints=len(robot.hinges),
        stiffness_least_Nm_per_rad=float(robot.stiffness.min()),
        stiffness_most_Nm_per_rad=float(robot.stiffness.max()),
        stiffness_source="assumed",
        deflection_peak_rad=float(np.abs(robot.links(q_ref) - q_ref).max()),
        uncompensated_rms_m=_rms(without),
        uncompensated_peak_m=float(without.max()),
        input_rms_m=_rms(deviation(commands, 1.0)),
        soft_uncompensated_rms_m=_rms(deviation(q_ref, _SOFT)),
        soft_input_rms_m=_rms(deviation(commands, _SOFT)),
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def picture(name: str) -> Image:
    """Home pose without and with compensation, side by side; deviations from the translucent
    reference are enlarged.
    """
    robot = AtRest(name)
    home = home_pose(name, robot.hinges)
    links = np.array([robot.links(theta) for theta in (home, robot.commands(home))])
    return SagViews(_display(name), robot.hinges, _PIXELS).draw(np.array([home, home]), links)


def _display(name: str) -> mujoco.MjSpec:
    """A robot to look at."""
    spec = gallery_robot(name, shapes=True)
    for geom in [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]:
        spec.delete(geom)
    if not any(geom.type == mujoco.mjtGeom.mjGEOM_MESH for geom in spec.geoms) and name != "pusher":
        add_simple_bodies(spec)
    return spec


def write(checkout: Path) -> None:
    """The table and all pictures, under docs of a checkout."""
    import PIL.Image

    docs = checkout / "docs"
    rows = [asdict(measure(name)) for name in GALLERY]
    with (docs / "results" / "gallery.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(
            {
                column: f"{cell:.6g}" if isinstance(cell, float) else cell
                for column, cell in row.items()
            }
            for row in rows
        )
    (docs / "images" / "gallery").mkdir(exist_ok=True)
    for name in GALLERY:
        image = PIL.Image.fromarray(picture(name)).quantize(_COLOURS)
        image.save(docs / "images" / "gallery" / f"{name}.png", optimize=True)


if __name__ == "__main__":
    write(Path(*sys.argv[1:2]))
