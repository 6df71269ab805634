"""Known load of one joint in a log in time: a pendulum, or the weight of a robot's links."""

from dataclasses import dataclass

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.core.signals import Array
from elastic_env.joint.model_joints import hinges_of, home_of

GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s²]."""


@dataclass(frozen=True)
class Load:
    """Known load of the joint: weight that pulls by −m g l sin(q − rest), and its inertia.

    Any rigid load on one hinge has this form while the joints before it stand still.

    Attributes:
        torque: m g l, the largest torque of the weight [N·m]; zero without a weight.
        rest: Angle at which it hangs [rad].
        inertia: Inertia of link and load about the joint [kg·m²]; None if it is unknown.
    """

    torque: float = 0.0
    rest: float = 0.0
    inertia: float | None = None

    @staticmethod
    def pendulum(mass_kg: float, length_m: float, rod_kg: float = 0.0) -> "Load":
        """Load of a point mass at the end of a uniform rod that hangs at zero."""
        return Load(
            GRAVITY * (mass_kg + rod_kg / 2.0) * length_m,
            0.0,
            (mass_kg + rod_kg / 3.0) * length_m**2,
        )

    def pull(self, q: Array) -> Array:
        """Torque of the weight on the joint, (...,) [N·m]; positive turns it forward."""
        return -self.torque * np.sin(q - self.rest)

    @staticmethod
    def from_model(model: mujoco.MjModel, joint: str) -> "Load":
        """Load of the links beyond a hinge of a robot.

        The other joints are at the first keyframe, or at the reference.

        Raises:
            ConfigurationError: The model has no such hinge.
        """
        hinges = hinges_of(model)
        if joint not in hinges:
            raise unknown_name("joint", joint, hinges)
        if not np.any(model.opt.gravity):
            raise ConfigurationError("the model has no gravity, so that nothing loads the joint")
        data = mujoco.MjData(model)
        hinge = model.joint(joint)
        dof = int(hinge.dofadr[0])
        torques = []
        for angle in (0.0, 0.5 * np.pi):
            data.qpos[:] = home_of(model)
            data.qpos[hinge.qposadr[0]] = angle
            mujoco.mj_forward(model, data)
            torques.append(-float(data.qfrc_bias[dof]))
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        inertia = float(full[dof, dof] - model.dof_armature[dof])
        rest = float(np.arctan2(torques[0], -torques[1]))
        return Load(float(np.hypot(*torques)), rest, inertia)


NO_LOAD = Load()
"""Load of a joint that carries nothing, or whose torque is a column of the log."""
