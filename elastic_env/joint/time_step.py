r"""Stability of MuJoCo's integrator with the springs, dampers and servos of a model.

Near rest a step of the physics is linear, :math:`x_{k+1} = A x_k`, and stable if no eigenvalue of A
lies outside the unit circle. For a spring without damper, of frequency ω, a semi-implicit step
(Euler, implicitfast) needs ωh < 2, and RK4 ωh < 2.83. A comes from differences of MuJoCo's
own step, with every integrator, every inertia and every servo. Contacts, limits, dry friction and
dead bands are left out, as they only hold a joint back.
"""

import copy

import mujoco
import numpy as np

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.compile_model import without_log_file

_ROOM = 1.1
"""Least ratio of the limit in the reference posture to a physics step: inertias change with the
posture.
"""
_LARGEST_RADIUS = 1.0 + 1e-3
"""Largest stable eigenvalue: those of a free body are 1, up to the error of the differences."""
_DIFFERENCE = 1e-6
_HALVINGS = 24
_LEFT_OUT = [
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    for flag in ("CONTACT", "LIMIT", "GRAVITY", "AUTORESET")
]
"""Flags of forces that hold a joint back, and of the reset that would hide a NaN."""


def spectral_radius(model: mujoco.MjModel, timestep_s: float) -> float:
    """Return the largest eigenvalue of a physics step about the reference, by magnitude [1].

    Args:
        model: It is not changed.
        timestep_s: Physics step [s].

    Returns:
        At most 1 for a stable step; infinite where a step gives NaN.
    """
    linear = _without_constraints(model)
    linear.opt.timestep = timestep_s
    with without_log_file(without_console=True):  # a step that explodes is a result
        A = _transition(linear)
    if not np.isfinite(A).all():
        return float("inf")
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def largest_stable_timestep(model: mujoco.MjModel) -> float:
    """Find the largest stable physics step to a thousandth, at most 1.1 times the model's own [s].

    Raises:
        ConfigurationError: No step down to a millionth of the model's own is stable.
    """
    high = _ROOM * model.opt.timestep
    low = 0.0
    if spectral_radius(model, high) <= _LARGEST_RADIUS:
        return high
    for _ in range(_HALVINGS):
        middle = (high + low) / 2.0
        if spectral_radius(model, middle) <= _LARGEST_RADIUS:
            low = middle
        else:
            high = middle
        if low > 0.0 and high - low < 1e-3 * low:
            return low
    raise ConfigurationError(
        f"no physics step from {model.opt.timestep:g} s down to {high:g} s follows the joints of"
        " this model: give them more rotor inertia, their links more inertia, or less stiffness"
    )


def is_stable(model: mujoco.MjModel) -> bool:
    """Return True if 1.1 times the model's physics step is stable."""
    return spectral_radius(model, _ROOM * model.opt.timestep) <= _LARGEST_RADIUS


def round_below(timestep_s: float) -> float:
    """Return the largest step of two digits that is a tenth below a limit of stability [s]."""
    digit = 10.0 ** (np.floor(np.log10(timestep_s / _ROOM)) - 1.0)
    return float(np.floor(timestep_s / _ROOM / digit) * digit)


def require_stable(model: mujoco.MjModel, control_period_s: float) -> None:
    """Refuse a model whose joints explode with its physics step.

    Args:
        model: Compiled model with its physics step.
        control_period_s: Control period, which the physics step has to divide [s].

    Raises:
        ConfigurationError: The step is not stable; the message names the largest stable one.
    """
    stable = stable_timestep(model, control_period_s)
    if stable < model.opt.timestep:
        raise ConfigurationError(
            "the joints are too stiff, or their links or rotors too light, for"
            f" timestep_s = {model.opt.timestep:g} s: the simulation would explode; the"
            f" largest stable one is timestep_s = {stable:.12g} s"
        )


def stable_timestep(model: mujoco.MjModel, control_period_s: float) -> float:
    """Return the model's physics step, or the largest stable one that divides a period [s].

    Raises:
        ConfigurationError: No step down to a millionth of the model's own is stable.
    """
    if is_stable(model):
        return float(model.opt.timestep)
    steps = control_period_s * _ROOM / largest_stable_timestep(model)
    return control_period_s / int(np.ceil(steps - 1e-9))


def _without_constraints(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy a model without the forces that hold a joint back."""
    linear = copy.copy(model)
    linear.opt.disableflags |= int(np.bitwise_or.reduce(_LEFT_OUT))
    linear.dof_frictionloss[:] = 0.0
    linear.tendon_frictionloss[:] = 0.0
    middle = linear.tendon_lengthspring.mean(axis=1, keepdims=True)
    linear.tendon_lengthspring[:] = middle
    return linear


def _transition(model: mujoco.MjModel) -> Array:
    """Compute A by central differences: MuJoCo's own do not support RK4."""
    size = 2 * model.nv + model.na
    data = mujoco.MjData(model)
    A = np.empty((size, size))
    reference = data.qpos.copy()

    def step(change: Array) -> Array:
        mujoco.mj_resetData(model, data)
        dq, data.qvel[:], data.act[:] = np.split(change, [model.nv, 2 * model.nv])
        mujoco.mj_integratePos(model, data.qpos, dq, 1.0)
        mujoco.mj_step(model, data)
        displacement = np.empty(model.nv)
        mujoco.mj_differentiatePos(model, displacement, 1.0, reference, data.qpos)
        return np.concatenate([displacement, data.qvel, data.act])

    for column, change in enumerate(_DIFFERENCE * np.eye(size)):
        A[:, column] = (step(change) - step(-change)) / (2.0 * _DIFFERENCE)
    return A
