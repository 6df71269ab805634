"""Turn rigid hinges of any MuJoCo specification into elastic joints.

Two forms of the same joint:

* `tendon` (default): the rotor is a hinge `<joint>_motor` of its own with armature B, and a fixed
  tendon `<joint>_spring` of length θ − q couples it to the link's hinge: K, D, and backlash as the
  spring's dead band. The link's hinge keeps its name, axis, limits and everything that refers to
  it.
* `rigid`: no spring; the rotor's inertia is the hinge's armature.

Friction acts on the link side of the spring. The servo and all actuators of the hinge act on the
rotor.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

import mujoco
import numpy as np
from mujoco import MjsBody, MjsJoint, MjSpec

from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.core.signals import Array
from elastic_env.joint.compile_model import compile_spec
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.joint_drive import BLANK, ActuatorRule, drive_joint
from elastic_env.joint.joint_names import motor_name, part_names, spring_name
from elastic_env.joint.keyframes import carry_keyframes
from elastic_env.joint.model_file import read_model
from elastic_env.joint.mujoco_friction import add_terms, varies
from elastic_env.joint.supported_models import require_few, require_flags, require_hinge
from elastic_env.joint.time_step import is_stable, largest_stable_timestep, round_below

Form = Literal["tendon", "rigid"]

_HINGE = mujoco.mjtJoint.mjJNT_HINGE
_IMPLICITFAST = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
# MuJoCo needs mass on every moving body; the rotor's inertia is its joint's armature
_ROTOR_MASS = 1e-12
# with MuJoCo's default constraint, friction creeps: at rest 5 N·m are nearly lost within 10 s
_FRICTION_SOLREF = (0.001, 1.0)
_FRICTION_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)


def make_elastic(
    spec: str | Path | MjSpec,
    joints: Mapping[str, ElasticJoint],
    form: Form = "tendon",
    actuators: ActuatorRule = "keep",
) -> MjSpec:
    """Return a copy of a specification in which the named hinges are elastic.

    Limits, springs, damping and friction of a hinge stay on the link. The joint's friction is
    added. Sensors and equalities stay on the link angle, actuators move to the rotor. The rotor
    inertia replaces the armature of the hinge. Keyframes get the rotors at their link angles,
    without deflection.

    The elastic model follows its springs at the physics step of the model. The integrator becomes
    `implicitfast` where the model's own does not follow them. MuJoCo's automatic reset is off, so
    that a divergence shows as NaN in the state and as a warning in `data.warning`. A model that
    starts again would look healthy. With dampers, `implicitfast` moves a joint as if
    rotor and link each had the inertia D times the physics step more: choose a step for which that
    is small.

    MuJoCo simulates everything that acts on the joints. So this function takes models that
    `Robot-v0` and `PositionCompensator` refuse, since these must know every torque in advance:
    floating bases and ball joints; loops and other equality constraints; tendons that pull; drives
    by a tendon, a site or a slider-crank; springs that are not linear; deformable bodies, plugins
    and wind; and a flag that turns gravity off. `elastic_env.joint.supported_models` has the
    checks of both. All three refuse models that contradict themselves, that have no hinge, or whose
    flags turn springs, dampers, the servo or the friction of the joints off.

    Args:
        spec: Any specification with hinges, a file of MJCF or URDF, or the text of one, see
            `read_model`. It is not changed. Set its physics step before.
        joints: Parameters by hinge name.
        form: "tendon" or "rigid", see the module.
        actuators: "keep" moves the actuators of a hinge to its rotor and adds the servo only where
            there is none; "replace" deletes them and adds the servo.

    Returns:
        The elastic specification, ready to compile.

    Raises:
        ConfigurationError: The model cannot be read or compiled; unknown form or hinge, a joint
            that is no hinge, or a name that is already taken; no hinge at all, or a flag that turns
            off what a joint has. Or `implicitfast` does not follow the joints either at the physics
            step of the model; the message names the largest step at which it does.

    Warns:
        UserWarning: The integrator was changed, a servo is left out because the hinge keeps its
            actuators, or friction changes with load or speed, which needs a call before every step.
    """
    are_joints = isinstance(joints, Mapping)
    if not are_joints or not all(isinstance(j, ElasticJoint) for j in joints.values()):
        needed = "a mapping from names of hinges to ElasticJoint"
        raise ConfigurationError(f"joints must be {needed}, got {quote(joints)}")
    require_few(joints)
    rigid = read_model(spec)
    require_hinge(rigid.model)
    elastic = transform_hinges(rigid.spec, joints, form, actuators)
    elastic.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    _choose_integrator(elastic)
    changing = [name for name, joint in joints.items() if varies(joint)]
    if changing:
        warnings.warn(
            f"the dry friction of {', '.join(changing)} changes with load or speed, which MuJoCo"
            " does not simulate by itself: make friction = elastic_env.VaryingFriction(model), and"
            " call friction.update(model, data) before every mj_step",
            stacklevel=2,
        )
    return elastic


def transform_hinges(
    spec: MjSpec,
    joints: Mapping[str, ElasticJoint],
    form: Form = "tendon",
    actuators: ActuatorRule = "keep",
) -> MjSpec:
    """Make hinges elastic without a check of stability: the caller sets the physics step later.

    Integrator and automatic reset stay as in the given specification.
    """
    require_known("form", [form], get_args(Form))
    require_known("actuator rule", [actuators], get_args(ActuatorRule))
    _require_flags(spec, joints)
    elastic = spec.copy()
    with carry_keyframes(elastic, list(joints)):
        _resolve_springdampers(elastic, list(joints))
        for name, joint in joints.items():
            _transform(elastic, _hinge(elastic, name), joint, form, actuators)
    return elastic


def _require_flags(spec: MjSpec, joints: Mapping[str, ElasticJoint]) -> None:
    """Refuse flags that turn off a part of the joints."""
    needed = ["spring", "damper"]
    if any(joint.servo is not None for joint in joints.values()):
        needed.append("actuation")
    if any(joint.coulomb_friction > 0.0 or varies(joint) for joint in joints.values()):
        needed += ["frictionloss", "constraint"]
    require_flags(int(spec.option.disableflags), needed)


def _choose_integrator(spec: MjSpec) -> None:
    """Set `implicitfast` where the model's own integrator does not follow the joints.

    Refuse the model if neither follows them.
    """
    model = compile_spec(spec, "the elastic model")
    if is_stable(model):
        return
    integrator = mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_")
    names = " and ".join(dict.fromkeys((integrator, "IMPLICITFAST")))
    step = f"at a physics step of {model.opt.timestep:g} s"
    model.opt.integrator = _IMPLICITFAST
    if not is_stable(model):
        raise ConfigurationError(
            f"the elastic joints explode {step} with {names}; set spec.option.timestep"
            f" to at most {round_below(largest_stable_timestep(model)):g} s before they"
            " are made elastic, or give them more damping"
        )
    spec.option.integrator = _IMPLICITFAST
    warnings.warn(
        f"the elastic joints explode with {integrator} {step}; the elastic model has"
        " the integrator IMPLICITFAST, which follows them",
        stacklevel=3,
    )


def _resolve_springdampers(spec: MjSpec, joints: list[str]) -> None:
    """Write out springs that are given as time constants, which depend on the inertias."""
    hinges = [j for j in spec.joints if j.name in joints and np.any(j.springdamper)]
    if hinges:
        model = compile_spec(spec, "the specification")
        for hinge in hinges:
            compiled = model.joint(hinge.name)
            hinge.stiffness = np.array([compiled.stiffness[0], 0.0, 0.0])
            hinge.damping = np.array([compiled.damping[0], 0.0, 0.0])
            hinge.springdamper = np.zeros(2)


def _hinge(spec: MjSpec, name: str) -> MjsJoint:
    hinges = [joint for joint in spec.joints if joint.type == _HINGE and joint.name]
    require_known("hinge", [name], [hinge.name for hinge in hinges])
    used = {part.name for part in [*spec.joints, *spec.tendons, *spec.actuators]}
    used |= {motor_name(name)} & {body.name for body in spec.bodies}
    used |= {number.name for number in spec.numerics}
    for derived in part_names(name):
        if derived in used:
            raise ConfigurationError(
                f"{derived!r} already exists in the model; is the hinge {name!r} elastic already?"
            )
    return spec.joint(name)


def _transform(
    spec: MjSpec, hinge: MjsJoint, joint: ElasticJoint, form: Form, rule: ActuatorRule
) -> None:
    name = hinge.name
    driven = name
    hinge.armature = joint.rotor_inertia
    if form == "tendon":
        driven = motor_name(name)
        hinge.armature = 0.0
        _add_rotor(spec, hinge, joint)
        _add_spring(spec, name, joint)
    _add_friction(spec, hinge, joint)
    drive_joint(spec, name, driven, joint.servo, rule)


def _rotor_body(spec: MjSpec, hinge: MjsJoint) -> MjsBody:
    """Add a body for the rotor beside the link's body.

    Its place does not matter: it has no mass, only the armature.
    """
    body = hinge.parent
    parent = body.parent if isinstance(body.parent, MjsBody) else spec.worldbody
    # attached from a new specification: the model's defaults, units and bounds of mass do not apply
    blank = MjSpec()
    blank.compiler.degree = hinge.compiler.degree
    rotor = blank.worldbody.add_body(
        name=motor_name(""),
        mass=_ROTOR_MASS,
        ipos=[0.0] * 3,
        inertia=[_ROTOR_MASS] * 3,
        explicitinertial=True,
    )
    if spec.option.density > 0.0 or spec.option.viscosity > 0.0:
        # without a geom, drag acts on the box of equal inertia: 2 m large for a massless rotor
        rotor.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-9, 0.0, 0.0],
            mass=0.0,
            group=6,
            contype=0,
            conaffinity=0,
            fluid_ellipsoid=1,
            fluid_coefs=[0.0] * 5,
        )
    return parent.add_frame().attach_body(rotor, hinge.name, "")


def _add_rotor(spec: MjSpec, hinge: MjsJoint, joint: ElasticJoint) -> None:
    """Add the rotor's hinge."""
    # not enforced, so not converted: only actuators that inherit their range use it
    limits = _to_radians(hinge, hinge.range)
    rotor = _rotor_body(spec, hinge).add_joint(
        BLANK.default,
        name=motor_name(hinge.name),
        type=_HINGE,
        pos=hinge.pos,
        axis=hinge.axis,
        ref=hinge.ref,
        springref=hinge.ref,
        armature=joint.rotor_inertia,
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        range=limits,
        actfrclimited=hinge.actfrclimited,
        actfrcrange=hinge.actfrcrange,
        group=hinge.group,
    )
    # an attached model may have another unit than the rotor
    ref = float(_to_radians(hinge, hinge.ref))
    rotor.ref = rotor.springref = np.rad2deg(ref) if rotor.compiler.degree else ref
    hinge.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    hinge.actfrcrange = np.zeros(2)


def _to_radians(hinge: MjsJoint, angle: Array) -> Array:
    """Convert an angle of the specification, which may be in degrees, to radians."""
    return np.deg2rad(angle) if hinge.compiler.degree else np.array(angle)


def _add_spring(spec: MjSpec, name: str, joint: ElasticJoint) -> None:
    """Add the spring as a tendon of length θ − q."""
    spring = spec.add_tendon(BLANK.default, name=spring_name(name))
    spring.wrap_joint(motor_name(name), 1.0)
    spring.wrap_joint(name, -1.0)
    spring.stiffness = np.array([joint.stiffness, 0.0, 0.0])
    spring.damping = np.array([joint.damping, 0.0, 0.0])
    spring.springlength = np.array([-joint.backlash / 2, joint.backlash / 2])


def _add_friction(spec: MjSpec, hinge: MjsJoint, joint: ElasticJoint) -> None:
    """Add the joint's friction to that of the hinge."""
    hinge.damping = hinge.damping + np.array([joint.viscous_friction, 0.0, 0.0])
    hinge.frictionloss += joint.coulomb_friction
    if varies(joint):
        add_terms(spec, hinge, joint)
    if joint.coulomb_friction > 0.0 or varies(joint):
        hinge.solref_friction[:] = _FRICTION_SOLREF
        hinge.solimp_friction[:] = _FRICTION_SOLIMP
