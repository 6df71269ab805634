"""Static equilibrium of an elastic robot under zero offset: where an episode begins."""

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
_CHECK_EVERY_S = 0.25
_LONGEST_S = 20.0
_LONGEST_STEP_S = 1e-3
"""Longest physics step while the robot settles [s]; the strengthened dampers make it hop else."""


@dataclass(frozen=True)
class Equilibrium:
    """State of a robot at rest: positions, servo integrators, and the solver's warm start."""

    qpos: Array
    act: Array
    warmstart: Array


_KEPT = DiskCache("standing")


def equilibrium(
    model: MjModel, joints: Sequence[str], pelvis: Array, q: Array, command: Array
) -> Equilibrium:
    """`settle`, or what an earlier process kept of it, which is the same to the last bit."""
    content = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, content)
    start = np.concatenate([pelvis, q, command])
    key = key_of([*_calculation(), content.tobytes(), repr([*joints]), start.tobytes()])
    sizes = (model.nq, model.na, model.nv)
    kept = _KEPT.read(key, sum(sizes))
    if kept is not None:
        return Equilibrium(*np.split(kept, np.cumsum(sizes)[:-1]))
    rest = settle(model, joints, pelvis, q, command)
    _KEPT.keep(key, np.concatenate([rest.qpos, rest.act, rest.warmstart]))
    return rest


@cache
def _calculation() -> tuple[bytes | str, ...]:
    """What the bits of a calculation depend on beside its input: programs, and the processor."""
    source = Path(__file__).read_bytes()
    cpu = processor.get_host_cpu_name(), processor.get_host_cpu_features().flatten()
    return source, mujoco.__version__, repr(platform.libc_ver()), *cpu


def settle(
    model: MjModel, joints: Sequence[str], pelvis: Array, q: Array, command: Array
) -> Equilibrium:
    """Let a robot come to rest from a posture.

    On the way its dampers are strengthened and its friction is switched off, which shortens the
    way; where it stands in the end is an equilibrium with friction too.

    Args:
        model: The plant; it is not changed.
        joints: Its elastic joints, in order.
        pelvis: Position of the level pelvis to begin with, (3,) [m].
        q: Joint angles to begin with, (n,) [rad].
        command: Servo inputs, (n,) [rad].

    Raises:
        ElasticError: It does not come to rest, or falls, or its joints are too stiff for the
            physics step.
    """
    calm = copy.copy(model)
    calm.opt.timestep = min(model.opt.timestep, _LONGEST_STEP_S)
    calm.tendon_damping[:] = np.maximum(calm.tendon_damping, _DAMPING)
    calm.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(calm)
    at = JointAddresses.of(calm, joints)
    data.qpos[:3] = pelvis
    data.qpos[at.q] = data.qpos[at.theta] = q
    data.ctrl[:] = command
    was_calm = False
    substeps = round(_CHECK_EVERY_S / calm.opt.timestep)
    for _ in range(round(_LONGEST_S / _CHECK_EVERY_S)):
        mujoco.mj_step(calm, data, substeps)
        rate = float(np.abs(data.qvel).max())
        if not np.isfinite(rate):
            raise _diverged(model, data)
        if data.qpos[2] < 0.5 * pelvis[2]:
            break
        is_calm = was_calm and rate < _REST_RATE
        was_calm = rate < _REST_RATE
        if is_calm:  # twice in a row: once may be the turning point of a swing
            state = (data.qpos, data.act, data.qacc_warmstart)
            return Equilibrium(*(values.copy() for values in state))
    raise ElasticError(
        f"the robot does not stand: pelvis at {data.qpos[2]:.3f} m (planned {pelvis[2]:.3f} m) and"
        f" moving with {np.abs(data.qvel).max():.2g} rad/s or m/s after {data.time:.1f} s; is a"
        " joint too soft for the load?"
    )


def _diverged(model: MjModel, data: mujoco.MjData) -> ElasticError:
    """The error for a state that is not finite: joints that the physics step cannot resolve."""
    # the elastic joints' springs are all tendons that there are
    stiffest = model.tendon_stiffness.max(initial=0.0)
    return ElasticError(
        f"the simulation of the standing robot diverges within {data.time:.2f} s: with a largest K"
        f" of {stiffest:g} N·m/rad its joints are too stiff, or their links or rotors too light,"
        f" for timestep_s = {model.opt.timestep:g} s; lower the stiffness or take a shorter"
        " timestep_s"
    )
