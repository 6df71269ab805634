"""The humanoid of the paper: THORMANG, 57 kg, twelve leg joints, built from `legs.csv`.

The table contains the links, parents before children, in the link frame and SI units. The column
`joint` is "fixed", "floating" or the name of a hinge.

All link frames are parallel to the pelvis at zero angles; the origin of the pelvis is the midpoint
between the hip axes. x points forward, y left, z up. The joint axes are +z (yaw), +x (roll) and +y
(pitch) on both legs. Sources (public GitHub repositories):

* lengths, masses and COMs of pelvis and legs, hip spacing 0.210 m, sole 0.26 × 0.16 m, ankle 0.100
  m above the sole: THORMANG "mk2", UPenn-RoboCup/UPennDev2, Robots/THOROP1/THOROPKinematics.h;
* inertias of thigh, shank, foot, hip and ankle: THORMANG3 CAD values scaled by mass, from
  thor-mang/ROBOTIS-THORMANG-Common; hip yaw: a box of 0.16 × 0.08 × 0.10 m, assumed;
* upper body: torso, waist, bent arms of the same header, head of psh117/thormang_mobile, and 4.7 kg
  of packs, assumed, to reach the paper's 57 kg;
* joint limits: THORMANG3, assumed for this robot.
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import MjModel, MjsBody, MjSpec

from elastic_env.core.config import Model, quantity
from elastic_env.core.files import read_rows
from elastic_env.core.signals import Array
from elastic_env.joint.dynamixel import H54_200_S500_R
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.make_elastic import Form, transform_hinges
from elastic_env.rigid.biped import Biped
from elastic_env.rigid.leg_kinematics import JOINTS, LegGeometry

SIDES = ("l", "r")
"""Prefixes of the left and the right leg."""
LEG_JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in JOINTS)
"""The twelve elastic joints, left leg first, from hip to foot."""
LEG = LegGeometry(thigh=0.3, shank=0.3)
ANKLE_HEIGHT_M = 0.1
"""Height of the ankle axes over the sole [m]."""
SOLE_HALF_SIZE_M = (0.13, 0.08)
"""Half length and half width of the sole; its center is under the ankle [m]."""

_SOLE_HALF_THICKNESS = 0.01
_LOAD_GYRATION_M = 0.1
_TORSO = "upper_body"
_DOUBLED = ("stiffness", "rotor_inertia", "damping", "coulomb_friction")
"""Parameters of a joint that two servos double."""


class Thormang(Model):
    """Options of the robot: published uncertainties, friction of the soles, and load."""

    hip_half_spacing: float = quantity("m", 0.105, gt=0)
    """Half the distance of the hips; 0.072 in mk1 [m]."""
    twin_knee: bool = False
    """True if two servos share each knee: twice its stiffness, damping, rotor inertia, friction
    and torque.
    """
    friction: float = quantity("1", 1.0, gt=0)
    """Friction of the soles on the floor [1]."""
    torso_load_kg: float = quantity("kg", 0.0, ge=0)
    """Mass carried on the shoulders [kg]."""

    @property
    def joints(self) -> dict[str, ElasticJoint]:
        """The elastic leg joints, all with the paper's servo."""
        joint = H54_200_S500_R
        knee = _twin_joint(joint) if self.twin_knee else joint
        return {name: knee if "knee" in name else joint for name in LEG_JOINTS}


@lru_cache(maxsize=8)
def biped(robot: Thormang) -> Biped:
    """Make the robot model for gait and controller."""
    half = robot.hip_half_spacing
    hips = np.array([[0.0, half, 0.0], [0.0, -half, 0.0]])
    rigid = rigid_spec(robot).compile()
    return Biped(rigid, LEG_JOINTS, LEG, hips, ANKLE_HEIGHT_M, SOLE_HALF_SIZE_M)


def _numbers(row: dict[str, str], *columns: str) -> Array:
    return np.array([float(row[column]) for column in columns])


def rigid_spec(robot: Thormang, floating: bool = True) -> MjSpec:
    """Make the robot with rigid joints, no actuator and explicit inertias, on a floor.

    Args:
        robot: Options.
        floating: True for a free pelvis; False fixes it in the air, for checks of the legs.
    """
    spec = MjSpec()
    spec.modelname = "thormang"
    spec.compiler.degree = False
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # with 1, soles creep by 0.2 mm/s down a slope of 1 degree
    spec.option.impratio = 10.0
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    bodies = {"world": spec.worldbody}
    for row in read_rows(Path(__file__).with_name("legs.csv")):
        joint = row["joint"]
        position = _numbers(row, "x_m", "y_m", "z_m")
        if joint.endswith("hip_yaw"):
            position[1] = np.sign(position[1]) * robot.hip_half_spacing
        body = bodies[row["parent"]].add_body(name=row["name"], pos=position)
        body.mass = float(row["mass_kg"])
        body.ipos = _numbers(row, "com_x", "com_y", "com_z")
        body.fullinertia = _numbers(row, "ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        body.explicitinertial = True
        bodies[row["name"]] = body
        if joint == "floating" and floating:
            body.add_freejoint(name="pelvis")
        elif row["lower_rad"]:
            hinge = body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_HINGE)
            hinge.axis = _numbers(row, "axis_x", "axis_y", "axis_z")
            hinge.range = _numbers(row, "lower_rad", "upper_rad")
            hinge.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    if robot.torso_load_kg > 0.0:
        # 0.16 m above the center of mass of the torso, which is itself 0.16 m above its frame
        load = add_load(spec, "load", robot.torso_load_kg, np.zeros(3))
        load.ipos = bodies[_TORSO].ipos
    for side in SIDES:
        _add_sole(bodies[f"{side}_foot"], side, robot.friction)
    bodies["pelvis"].add_site(name="imu")
    # a separate body, so that it can be tilted
    floor = spec.worldbody.add_body(name="floor")
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    floor.add_geom(name="floor", type=plane, size=[0.0, 0.0, 0.05])
    return spec


def elastic_spec(
    robot: Thormang,
    joints: Mapping[str, ElasticJoint],
    form: Form = "tendon",
    timestep_s: float = 1e-3,
) -> MjSpec:
    """Make the robot with elastic leg joints, servos, and force-torque sensors at the ankles.

    Args:
        robot: Options.
        joints: Parameters of the leg joints by name.
        form: "tendon", or "rigid" for an inelastic robot.
        timestep_s: Physics step [s].
    """
    spec = transform_hinges(rigid_spec(robot), joints, form, actuators="replace")
    spec.option.timestep = timestep_s
    for side in SIDES:
        for name in ("FORCE", "TORQUE"):
            sensor = spec.add_sensor(name=f"{side}_{name.lower()}")
            sensor.objname = f"{side}_ft"
            sensor.type = getattr(mujoco.mjtSensor, f"mjSENS_{name}")
            sensor.objtype = mujoco.mjtObj.mjOBJ_SITE
    return spec


DRAWN_LOAD = "drawn_load"
"""Name of the body of a load that a scenario draws."""


def add_load(spec: MjSpec, name: str, mass: float, place: Array) -> MjsBody:
    """Fix a load to the upper body, and return the body of the load.

    Args:
        spec: Specification of the robot.
        name: Name of the load's body.
        mass: Mass of the load [kg].
        place: Position from the center of mass of the upper body, (3,) [m].
    """
    torso = spec.body(_TORSO)
    load = torso.add_body(name=name, pos=torso.ipos + place, mass=mass)
    load.explicitinertial = True
    load.ipos = np.zeros(3)
    load.inertia = np.full(3, mass * _LOAD_GYRATION_M**2)
    return load


def place_load(model: MjModel, mass: float, place: Array) -> None:
    """Change mass and place of the `DRAWN_LOAD` in a compiled model, see `add_load`."""
    load = model.body(DRAWN_LOAD)
    load.mass[:] = mass
    load.inertia[:] = mass * _LOAD_GYRATION_M**2
    load.pos[:] = model.body(_TORSO).ipos + place
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _add_sole(foot: MjsBody, side: str, friction: float) -> None:
    """Add a box sole, and the site of the force-torque sensor at the ankle."""
    sole = foot.add_geom(name=f"{side}_sole", type=mujoco.mjtGeom.mjGEOM_BOX, mass=0.0)
    sole.size = [*SOLE_HALF_SIZE_M, _SOLE_HALF_THICKNESS]
    sole.pos = [0.0, 0.0, _SOLE_HALF_THICKNESS - ANKLE_HEIGHT_M]
    sole.friction = [friction, 0.005, 0.0001]
    sole.condim = 4
    sole.contype = 0
    sole.conaffinity = 1
    sole.priority = 1  # otherwise the larger friction of sole and floor would apply
    foot.add_site(name=f"{side}_ft")


def _twin_joint(joint: ElasticJoint) -> ElasticJoint:
    """Return the joint with two parallel servos instead of one."""
    servo = joint.servo
    doubled: dict[str, Any] = {name: 2.0 * getattr(joint, name) for name in _DOUBLED}
    if servo is not None:
        gains = ("position_gain", "velocity_gain", "integral_gain", "torque_limit")
        changes = {gain: 2.0 * getattr(servo, gain) for gain in gains}
        doubled["servo"] = servo.replace(**changes)
    return joint.replace(**doubled)
