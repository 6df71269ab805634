r"""The paper's single-joint testbed (Fig. 4): a servo, a linkage with a pendulum, an IMU.

The pendulum hangs at q = 0 and swings in the vertical plane, q positive towards +x. The torque that
holds it is τ_g = m g d sin q, 60 N·m at the horizontal. The paper gives neither mass nor length.
The range of its static deflection (−56 to +42 mrad at 1001 N·m/rad) spans −52.5 to +34.6 N·m, less
than 60 N·m. We chose a steel bob of 10 kg, 0.61 m from the axis, with a radius of gyration
of 0.1 m.
"""

import mujoco
import numpy as np
from mujoco import MjSpec

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.make_elastic import Form, transform_hinges

JOINT = "joint"
GRAVITY_M_S2 = 9.81
_LEAST = 1e-3
"""Least value of a pendulum's parameters, in their units: rounding would lose a smaller inertia."""


class Pendulum(Model):
    """The load of the testbed."""

    gravity_torque: float = quantity("N·m", 60.0, ge=_LEAST, le=1e4)
    """Torque that holds it at the horizontal [N·m]."""
    mass: float = quantity("kg", 10.0, ge=_LEAST, le=1e4)
    """Mass of bob and linkage [kg]."""
    gyration_radius: float = quantity("m", 0.1, ge=_LEAST, le=10)
    """Radius of gyration about its center of mass [m]."""

    @property
    def com_distance(self) -> float:
        """Distance of the center of mass from the joint axis [m]."""
        return self.gravity_torque / (self.mass * GRAVITY_M_S2)

    @property
    def inertia(self) -> float:
        """Moment of inertia I about the joint axis [kg·m²]."""
        return self.mass * (self.com_distance**2 + self.gyration_radius**2)

    def torque(self, q: Array) -> Array:
        """Gravity torque τ_g = m g d sin q that holds the pendulum, elementwise [N·m]."""
        return self.gravity_torque * np.sin(q)

    def torque_gradient(self, q: Array) -> Array:
        """∂τ_g/∂q, from (..., 1) to (..., 1, 1) [N·m/rad]."""
        return (self.gravity_torque * np.cos(q))[..., None]

    def with_mass_scaled(self, scale: float) -> "Pendulum":
        """Return the pendulum with its mass scaled at the same place."""
        torque = self.gravity_torque * scale
        return self.replace(mass=self.mass * scale, gravity_torque=torque)


def imu_arm(pendulum: Pendulum) -> float:
    """Distance of the IMU from the joint axis [m]: half the distance of the center of mass."""
    return 0.5 * pendulum.com_distance


def rigid_spec(pendulum: Pendulum, gravity: float = GRAVITY_M_S2) -> MjSpec:
    """Make the testbed with a rigid joint and no actuator, with explicit inertia and no contacts.

    Args:
        pendulum: The load.
        gravity: Acceleration of gravity [m/s²]; 0 turns the testbed on its side.
    """
    spec = MjSpec()
    spec.modelname = "testbed"
    spec.compiler.degree = False
    spec.option.gravity = np.array([0.0, 0.0, -gravity])
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    # a NaN must end the episode; MuJoCo must not restart the world by itself
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    link = spec.worldbody.add_body(name="link", mass=pendulum.mass)
    link.explicitinertial = True
    link.ipos = [0.0, 0.0, -pendulum.com_distance]
    link.inertia = [pendulum.mass * pendulum.gyration_radius**2] * 3
    # the axis points to −y, so that positive q moves the pendulum towards +x
    link.add_joint(name=JOINT, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, -1.0, 0.0])
    link.add_site(name="imu", pos=[0.0, 0.0, -imu_arm(pendulum)])
    return spec


def elastic_spec(
    pendulum: Pendulum,
    joint: ElasticJoint,
    form: Form = "tendon",
    timestep_s: float = 5e-4,
    gravity: float = GRAVITY_M_S2,
) -> MjSpec:
    """Make the testbed with its elastic joint and servo, integrated by RK4."""
    spec = transform_hinges(rigid_spec(pendulum, gravity), {JOINT: joint}, form)
    spec.option.timestep = timestep_s
    return spec
