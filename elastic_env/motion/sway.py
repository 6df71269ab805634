r"""Natural frequencies of a robot that stands on both feet, on its springs, with fixed motors.

With both soles fixed, the pelvis pose x (position and small rotation, 6) determines the joint
angles q(x). About the equilibrium, with the motors at θ = q + K⁻¹τ,

.. math:: M(x)\,\ddot x = -\partial V / \partial x, \quad V = \tfrac12 \sum K (\theta - q(x))^2 + m g z_{com}(x)
"""  # noqa: E501

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rigid import leg_kinematics as legs
from elastic_env.rigid.biped import Biped
from elastic_env.rigid.floating_body import FloatingBody

_DOF = 6
_STEP = 1e-4  # of the finite differences [m], [rad]


def sway_frequencies(
    biped: Biped, pelvis: Array, stiffness: Array, ankles: Array | None = None
) -> Array:
    """Return the natural frequencies of a robot at rest: level pelvis, weight shared equally.

    Args:
        biped: The robot.
        pelvis: Position of the pelvis over the middle between the soles, (3,) [m].
        stiffness: K of the twelve joints, (12,) [N·m/rad].
        ankles: Ankles of both feet, (2, 3) [m]; None for feet under the hips.

    Returns:
        The six angular frequencies, ascending, (6,) [rad/s]; nan for one that gravity makes
        unstable.
    """
    from scipy import linalg  # late, see `elastic_env.motion.preview_control`

    feet = biped.ankles if ankles is None else ankles

    def angles_at(x: Array) -> Array:
        """Angles with both soles on the ground, from pelvis motions (n, 6) to (n, 12)."""
        R = _rotations(x)
        relative = (feet - (pelvis + x[:, :3])[:, None]) @ R - biped.hips
        feet_R = np.broadcast_to(R.swapaxes(-1, -2)[:, None], (len(x), 2, 3, 3))
        return legs.leg_angles(biped.leg, relative, feet_R).reshape(len(x), -1)

    q = angles_at(np.zeros((1, _DOF)))[0]
    gravity = np.array([0.0, 0.0, -biped.gravity])
    loads = biped.chains.loads(1, gravity, mass=-biped.chains.mass / 2.0)
    theta = q + biped.chains.torque(loads, q[None])[0] / stiffness

    def potential(x: Array) -> Array:
        angles = angles_at(x)
        com = biped.chains.center_of_mass(angles)
        height = pelvis[2] + x[:, 2] + (_rotations(x) @ com[..., None])[:, 2, 0]
        spring_energy = 0.5 * (stiffness * (theta - angles) ** 2).sum(axis=1)
        return spring_energy + biped.weight * height

    unit = _STEP * np.eye(_DOF)
    pairs = unit[:, None] + unit[None]
    mixed = unit[:, None] - unit[None]
    ends = np.concatenate([pairs, mixed, -mixed, -pairs]).reshape(-1, _DOF)
    V = potential(ends).reshape(4, _DOF, _DOF)
    hessian = (V[0] - V[1] - V[2] + V[3]) / (4.0 * _STEP**2)
    change = angles_at(unit) - angles_at(-unit)
    motion = np.vstack([np.eye(_DOF), change.T / (2.0 * _STEP)])
    body = FloatingBody(biped.rigid, biped.joint_names)
    mass = motion.T @ body.mass_matrix(q) @ motion
    eigenvalues = linalg.eigh(hessian, mass, eigvals_only=True)
    return np.sqrt(np.where(eigenvalues > 0.0, eigenvalues, np.nan))


def _rotations(x: Array) -> Array:
    tilted = legs.rotation_z(x[:, 5]) @ legs.rotation_y(x[:, 4])
    return tilted @ legs.rotation_x(x[:, 3])
