"""The rigid model of a robot from a file of MJCF or URDF, with bodies that can be drawn."""

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
    """The specification of a robot, which compiles, see `read_model`.

    Collision shapes of a URDF are left out. What has a mesh that is missing, or that MuJoCo cannot
    read, is drawn by rods between the joints. Bodies without a name get numbers where no body that
    a hinge moves has a name, since the end effector is one by name.

    Args:
        model: File, text or specification; it is not changed.

    Raises:
        ConfigurationError: It cannot be read or compiled, or a body has its mass from a mesh that
            is missing.

    Warns:
        UserWarning: Meshes are replaced.
    """
    read = read_model(model, shapes=True)
    if read.lost:
        warnings.warn(
            f"{len(read.lost)} meshes of {read.name} are missing or in a format that MuJoCo cannot"
            f" read, such as {quote(read.lost[0])[1:-1]}; rods between the joints are drawn in"
            " their place",
            stacklevel=4,
        )
        add_simple_bodies(read.spec)
    bodies = read.spec.bodies[1:]
    if not any(body.name for body in _moved(read.spec)):
        taken = {body.name for body in bodies}
        for number, body in enumerate(bodies, 1):
            if not body.name and (name := f"body_{number}") not in taken:
                body.name = name
    return read.spec


def _moved(spec: mujoco.MjSpec) -> Iterator[Any]:
    """Bodies that a hinge moves; some of them several times."""
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            yield joint.parent
            yield from joint.parent.find_all("body")


class RigidModel:
    """Makes the specification of a robot in which only some hinges move, as `JointRobot` takes it.

    It holds what it was given, so that it can be pickled. Contacts are off. Taken out are
    actuators, and what elastic joints have in their place: armature, dry friction and linear
    damping of the hinges.

    Args:
        model: As of `read_robot`.
        joints: Hinges that move.
    """

    def __init__(self, model: GivenModel, joints: tuple[str, ...]) -> None:
        self._model = model
        self._joints = joints
        self._spec: Any = None

    def __call__(self) -> mujoco.MjSpec:
        """A copy that the caller may change."""
        if self._spec is None:
            # they were said when it was read for the first time
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                moving = hold_other_joints(read_robot(self._model), self._joints)
                self._spec = _bare(moving, self._joints)
        return self._spec.copy()

    def __getstate__(self) -> dict[str, Any]:
        """Files by name, specifications as text."""
        given: Any = self._model
        if isinstance(given, mujoco.MjSpec):
            given = given.copy()
            compile_spec(given, "the specification")
            given = given.to_xml()
        return {"_model": given, "_joints": self._joints, "_spec": None}


def _bare(spec: mujoco.MjSpec, joints: tuple[str, ...]) -> mujoco.MjSpec:
    """A model without actuators, contacts, and what an `ElasticJoint` has of its hinges."""
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in joints:
        hinge = spec.joint(name)
        hinge.armature = hinge.frictionloss = 0.0
        damping = np.array(hinge.damping)
        damping[0] = 0.0
        hinge.damping = damping
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return spec
