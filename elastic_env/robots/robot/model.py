"""Rigid model of a robot from a file of MJCF or URDF, with shapes for pictures."""

import warnings
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from elastic_env.core.errors import quote
from elastic_env.joint.compile_model import compile_spec
from elastic_env.joint.held_joints import hold_other_joints
from elastic_env.joint.model_file import GivenModel, read_model
from elastic_env.rendering.simple_bodies import add_simple_bodies


def read_robot(model: GivenModel) -> mujoco.MjSpec:
    """Read the specification of a robot, see `read_model`.

    Collision shapes of a URDF are left out. Rods between the joints replace meshes that are missing
    or that MuJoCo cannot read. The end effector needs a named body. So bodies without a name get
    numbers if no body that a hinge moves has a name.

    Args:
        model: File, text or specification; it is not changed.

    Raises:
        ConfigurationError: It cannot be read or compiled, or the mass of a body comes from a
            missing mesh.

    Warns:
        UserWarning: Rods replace meshes.
    """
    content = read_model(model, shapes=True)
    if content.lost:
        warnings.warn(
            f"{len(content.lost)} meshes of {content.name} are missing or in a format"
            f" that MuJoCo cannot read, such as {quote(content.lost[0])[1:-1]}; rods"
            " between the joints are drawn in their place",
            stacklevel=4,
        )
        add_simple_bodies(content.spec)
    bodies = content.spec.bodies[1:]
    if not any(body.name for body in _moving_bodies(content.spec)):
        names = {body.name for body in bodies}
        for number, body in enumerate(bodies, 1):
            if not body.name and (name := f"body_{number}") not in names:
                body.name = name
    return content.spec


def _moving_bodies(spec: mujoco.MjSpec) -> Iterator[Any]:
    """Bodies that a hinge moves; some occur several times."""
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            yield joint.parent
            yield from joint.parent.find_all("body")


class RigidModel:
    """Factory of a specification in which only some hinges move, for `JointRobot`.

    It stores its arguments, so that it can be pickled. Contacts are off. Actuators, and armature,
    dry friction and linear damping of the hinges are removed: elastic joints replace them.

    Args:
        model: File, text or specification, see `read_robot`.
        joints: Hinges that move.
    """

    def __init__(self, model: GivenModel, joints: tuple[str, ...]) -> None:
        self._model = model
        self._joints = joints
        self._spec: Any = None

    def __call__(self) -> mujoco.MjSpec:
        """Return a copy that the caller may change."""
        if self._spec is None:
            # the first reading of the model has already shown the warnings
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                self._spec = hold_other_joints(read_robot(self._model), self._joints)
                _remove_joint_dynamics(self._spec, self._joints)
        return self._spec.copy()

    def __getstate__(self) -> dict[str, Any]:
        """Return files by name, specifications as text."""
        model: Any = self._model
        if isinstance(model, mujoco.MjSpec):
            model = model.copy()
            compile_spec(model, "the specification")
            model = model.to_xml()
        return {"_model": model, "_joints": self._joints, "_spec": None}


def _remove_joint_dynamics(spec: mujoco.MjSpec, joints: tuple[str, ...]) -> None:
    """Remove actuators, contacts, and properties of hinges that an `ElasticJoint` replaces."""
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in joints:
        hinge = spec.joint(name)
        hinge.armature = hinge.frictionloss = 0.0
        damping = np.array(hinge.damping)
        damping[0] = 0.0
        hinge.damping = damping
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
