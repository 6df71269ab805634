"""Static equilibrium of an elastic robot under zero offset, the start of an episode."""

import copy
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import llvmlite.binding as processor
import mujoco
import numpy as np
from mujoco import MjModel

from elastic_env.core.disk_cache import DiskCache, key_of
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import JointAddresses

_DAMPING = 75.0
"""D of all springs while the robot settles [N·m·s/rad]; with more, light links make the
integration unstable.
"""
_REST_RATE = 1e-4
"""Largest rate of a robot at rest [m/s], [rad/s]."""
_CHECK_PERIOD_S = 0.25
_LONGEST_S = 20.0
"""Time between checks, and largest time until the robot rests [s]."""
_LONGEST_STEP_S = 1e-3
"""Longest physics step while the robot settles [s]; with a longer one the dampers make it hop."""


@dataclass(frozen=True)
class Equilibrium:
    """State of a robot at rest: positions, servo integrators, and the solver's warm start."""

    qpos: Array
    act: Array
    warmstart: Array


_CACHE = DiskCache("standing")


def equilibrium(
    model: MjModel, joints: Sequence[str], pelvis: Array, q: Array, command: Array
) -> Equilibrium:
    """Settle a robot by `settle`, or read the result from the disk cache: the bits are the same."""
    content = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, content)
    start = np.concatenate([pelvis, q, command])
    key = key_of([*_platform(), content.tobytes(), repr([*joints]), start.tobytes()])
    sizes = (model.nq, model.na, model.nv)
    cached = _CACHE.read(key, sum(sizes))
    if cached is not None:
        return Equilibrium(*np.split(cached, np.cumsum(sizes)[:-1]))
    rest = settle(model, joints, pelvis, q, command)
    _CACHE.keep(key, np.concatenate([rest.qpos, rest.act, rest.warmstart]))
    return rest


@cache
def _platform() -> tuple[bytes | str, ...]:
    """Programs and processor, which the bits of a result depend on in addition to its input."""
    source = Path(__file__).read_bytes()
    cpu = processor.get_host_cpu_name(), processor.get_host_cpu_features().flatten()
    return source, mujoco.__version__, repr(platform.libc_ver()), *cpu


def settle(
    model: MjModel, joints: Sequence[str], pelvis: Array, q: Array, command: Array
) -> Equilibrium:
    """Simulate a robot from a posture until it rests.

    Stronger dampers and no friction shorten this motion. Its end is also an equilibrium with
    friction.

    Args:
        model: The plant; it is not changed.
        joints: Its elastic joints, in order.
        pelvis: Initial position of the level pelvis, (3,) [m].
        q: Initial joint angles, (n,) [rad].
        command: Servo inputs, (n,) [rad].

    Raises:
        ElasticError: The robot does not come to rest, or falls, or its joints are too stiff for the
            physics step.
    """
    damped = copy.copy(model)
    damped.opt.timestep = min(model.opt.timestep, _LONGEST_STEP_S)
    damped.tendon_damping[:] = np.maximum(damped.tendon_damping, _DAMPING)
    damped.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(damped)
    addresses = JointAddresses.of(damped, joints)
    data.qpos[:3] = pelvis
    data.qpos[addresses.q] = data.qpos[addresses.theta] = q
    data.ctrl[:] = command
    was_slow = False
    substeps = round(_CHECK_PERIOD_S / damped.opt.timestep)
    for _ in range(round(_LONGEST_S / _CHECK_PERIOD_S)):
        mujoco.mj_step(damped, data, substeps)
        rate = float(np.abs(data.qvel).max())
        if not np.isfinite(rate):
            raise _divergence_error(model, data)
        if data.qpos[2] < 0.5 * pelvis[2]:
            break
        is_slow = rate < _REST_RATE
        if is_slow and was_slow:  # once may be the turning point of a swing
            state = (data.qpos, data.act, data.qacc_warmstart)
            return Equilibrium(*(values.copy() for values in state))
        was_slow = is_slow
    raise ElasticError(
        f"the robot does not stand: pelvis at {data.qpos[2]:.3f} m (planned"
        f" {pelvis[2]:.3f} m) and moving with {np.abs(data.qvel).max():.2g} rad/s or"
        f" m/s after {data.time:.1f} s; is a joint too soft for the load?"
    )


def _divergence_error(model: MjModel, data: mujoco.MjData) -> ElasticError:
    """Error for a state that is not finite: joints that are too stiff for the physics step."""
    # all tendons are springs of elastic joints
    stiffest = model.tendon_stiffness.max(initial=0.0)
    return ElasticError(
        f"the simulation of the standing robot diverges within {data.time:.2f} s: with"
        f" a largest K of {stiffest:g} N·m/rad its joints are too stiff, or their links"
        f" or rotors too light, for timestep_s = {model.opt.timestep:g} s; lower the"
        " stiffness or take a shorter timestep_s"
    )
