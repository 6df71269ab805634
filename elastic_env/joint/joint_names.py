"""Names of the parts of an elastic joint, and addresses of its angles in a model."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from elastic_env.core.signals import IntArray


def motor_name(joint: str) -> str:
    """Name of the rotor's hinge of an elastic joint."""
    return f"{joint}_motor"


def spring_name(joint: str) -> str:
    """Name of the tendon of length θ − q."""
    return f"{joint}_spring"


def servo_name(joint: str) -> str:
    """Name of the servo's actuator."""
    return f"{joint}_servo"


def friction_name(joint: str) -> str:
    """Name of the parameters of a varying dry friction."""
    return f"{joint}_dry_friction"


def part_names(name: str) -> tuple[str, ...]:
    """Names of all these parts."""
    return motor_name(name), spring_name(name), servo_name(name), friction_name(name)


@dataclass(frozen=True)
class JointAddresses:
    """Indices of motor and link angles of the elastic joints in `qpos` and `qvel`, each (n,)."""

    theta: IntArray
    q: IntArray
    theta_dot: IntArray
    q_dot: IntArray

    @classmethod
    def of(cls, model: mujoco.MjModel, joints: Sequence[str]) -> "JointAddresses":
        """Look up joints by name, in a model of the tendon or the rigid form."""
        link = [model.joint(name) for name in joints]
        known = {model.joint(i).name for i in range(model.njnt)}
        rotors = [motor_name(n) if motor_name(n) in known else n for n in joints]
        motor = [model.joint(name) for name in rotors]
        return cls(
            theta=np.array([joint.qposadr[0] for joint in motor], dtype=np.int64),
            q=np.array([joint.qposadr[0] for joint in link], dtype=np.int64),
            theta_dot=np.array([joint.dofadr[0] for joint in motor], dtype=np.int64),
            q_dot=np.array([joint.dofadr[0] for joint in link], dtype=np.int64),
        )
