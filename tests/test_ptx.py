"""A control step compiled for a GPU, which no test runs."""

import importlib
import math
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from numba.cuda import libdevicefuncs

import elastic_env  # noqa: F401  registers the environments
from elastic_env.world import attitude_kernels, joint_kernels, walk_kernels, walk_reward
from tests.ptx import TARGET, ptx_of

WALKER = "elastic_env/WalkInPlace-v0"
TESTBED = "elastic_env/Testbed-v0"
cuda: Any = importlib.import_module("numba.cuda")


def write_commands(step: Any, action: Any, bound: Any, is_clipped: Any, inputs: Any) -> None:
    worlds = (cuda.grid(1), cuda.gridsize(1))
    joint_kernels.write_commands(step, action, bound, is_clipped, inputs, *worlds)


def sense_walk(physics: Any, step: Any, walker: Any, control: Any) -> None:
    walk_kernels.sense_walk(physics, step, walker, control, cuda.grid(1), cuda.gridsize(1))


def sense_links(qpos: Any, qvel: Any, step: Any, links: Any, control: Any) -> None:
    joint_kernels.sense_links(qpos, qvel, step, links, control, cuda.grid(1), cuda.gridsize(1))


@pytest.mark.parametrize(
    ("env", "scenario", "kernels_of_gpu"),
    [
        pytest.param(WALKER, "imu", (write_commands, sense_walk), marks=pytest.mark.slow),
        (TESTBED, "nominal", (write_commands, sense_links)),
    ],
)
def test_a_control_step_compiles_to_ptx(
    env: str,
    scenario: str,
    kernels_of_gpu: tuple[Callable[..., None], ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches what a GPU does not have: memory on demand, most of NumPy, numbers not aligned."""
    worlds = gymnasium.make_vec(env, num_envs=2, scenario=scenario)
    worlds.reset(seed=0)
    arguments: dict[str, Any] = {}
    for kernel in kernels_of_gpu:
        file = walk_kernels if kernel is sense_walk else joint_kernels
        on_cpu = getattr(file, kernel.__name__)

        def call(*given: Any, name: str = kernel.__name__, on_cpu: Any = on_cpu) -> Any:
            arguments[name] = given
            return on_cpu(*given)

        monkeypatch.setattr(file, kernel.__name__, call)
    worlds.step(0.0 * worlds.action_space.sample())
    monkeypatch.undo()
    for kernel in kernels_of_gpu:
        given = arguments[kernel.__name__]
        records = [value.dtype for value in _arrays(given) if value.dtype.names]
        assert records
        assert all(kind.isalignedstruct for kind in records)
        kinds = tuple(map(numba.typeof, given[:-2]))
        ptx = ptx_of(kernel, kinds, attitude_kernels, joint_kernels, walk_kernels, walk_reward)
        assert f".target {TARGET}" in ptx
        assert len(re.findall(r"^\.visible \.entry", ptx, re.MULTILINE)) == 1
        missing = set(re.findall(r"^\.extern \.func .*?(\w+)$", ptx, re.MULTILINE))
        assert missing <= set(libdevicefuncs.functions)


def _arrays(value: Any) -> Iterator[Any]:
    """The arrays among arguments of kernels."""
    if isinstance(value, tuple):
        for part in value:
            yield from _arrays(part)
    elif isinstance(value, np.ndarray):
        yield value


def _zeros(values: Any) -> None:
    values[0] = np.zeros(3)[0]


def _as_many(values: Any) -> None:
    values[0] = np.empty(len(values))[0]


def _rounded(values: Any) -> None:
    values[0] = np.round(values[0])


def _listed(values: Any) -> None:
    values[0] = [values[1]][0]


def _called(values: Any) -> None:
    values[0] = math.sin(values[0])


@pytest.mark.parametrize(
    ("kernel", "says"),
    [
        (_zeros, "no attribute 'zeros'"),
        (_as_many, "not constant"),
        (_rounded, "no attribute 'round'"),
        (_listed, "build_list"),
    ],
)
def test_what_a_gpu_does_not_have_does_not_compile(kernel: Callable[..., None], says: str) -> None:
    """Catches a compilation that lets pass whatever a control step is given."""
    here = sys.modules[__name__]
    kind = numba.typeof(np.zeros(2))
    assert "__nv_sin" in ptx_of(_called, (kind,), here)
    with pytest.raises(Exception, match=says):
        ptx_of(kernel, (kind,), here)
