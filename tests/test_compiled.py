"""Compiled functions: the numbers that their Python code says, and nothing kept of code that has
changed."""

import ast
import contextlib
import copy
import importlib
import importlib.util
import io
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from rich.console import Console

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core import compiled as module
from elastic_env.core.compiled import compile_now, compiled
from elastic_env.world import attitude_kernels, joint_kernels, walk_kernels, walk_reward
from train.runs.progress import announce_compilation

ROOT = Path(__file__).parents[1]
KERNELS = (
    "elastic_env.world.joint_kernels",
    "elastic_env.world.attitude_kernels",
    "elastic_env.world.walk_kernels",
    "elastic_env.world.walk_reward",
    "elastic_env.joint.elasticity",
    "elastic_env.joint.friction",
    "elastic_env.joint.mujoco_friction",
    "elastic_env.world.metrics",
    "elastic_env.rigid.tree.kernels",
    "baselines.compensation.filters",
    "baselines.compensation.dynamic_compensator",
    "baselines.compensation.contact_torque",
    "baselines.walking.controller",
    "baselines.walking.dcm_observer",
    "baselines.walking.flat_feet",
    "baselines.walking.standing_estimate",
    "baselines.walking.zmp_offset",
    "baselines.walking.foot_tare",
    "baselines.walking.foothold",
    "baselines.walking.posture",
    "baselines.walking.zmp_shift",
    "baselines.estimation.model_error",
    "baselines.residual.network",
    "baselines.identification.servo_replay",
)
DECORATORS = ("compiled", "compiled_part", "within_compiled")


def decorated(tree: ast.Module, *decorators: str) -> list[ast.FunctionDef]:
    """Functions with one of these decorators, by default all that Numba compiles."""
    return [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and node.decorator_list
        and ast.unparse(node.decorator_list[0]) in (decorators or DECORATORS)
    ]


@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_uses_only_kernels_and_types_of_other_files(name: str) -> None:
    """Catches code that Numba keeps although a constant in another file has changed."""
    module = importlib.import_module(name)
    tree = ast.parse(Path(str(module.__file__)).read_text())
    imported = {
        alias.asname or alias.name: str(node.module)
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        and str(node.module).startswith(("elastic_env", "baselines", "train"))
        for alias in node.names
    }
    compiled_ones = decorated(tree)
    assert compiled_ones
    for function in compiled_ones:
        nodes = [node for part in function.body for node in ast.walk(part)]
        used = {node.id for node in nodes if isinstance(node, ast.Name)}
        for other in used & imported.keys():
            assert imported[other] in KERNELS, (function.name, other)
            assert callable(getattr(module, other)), (function.name, other)


CHAIN = {
    "chain_first": "@{kind}\ndef first(value):\n    return {factor} * value\n",
    "chain_second": "from chain_first import first\n\n@{kind}\ndef second(value):\n"
    "    return first(value) + 1.0\n",
    "chain_third": "from chain_second import second\n\n@compiled\ndef third(value):\n"
    "    return second(value)\n",
}


@pytest.mark.parametrize("kind", ["compiled", "compiled_part", "within_compiled"])
def test_a_kernel_compiles_anew_where_a_file_that_it_calls_has_changed(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches code that Numba keeps although what it calls has changed in another file."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # files of one second look the same
    for factor in ("2.0", "3.0", "2.0"):
        for name, text in CHAIN.items():
            sys.modules.pop(name, None)
            decorators = f"from elastic_env.core.compiled import compiled, {kind} as {kind}\n"
            text = decorators + text.format(kind=kind, factor=factor)
            (tmp_path / f"{name}.py").write_text(text)
        importlib.invalidate_caches()
        third = importlib.import_module("chain_third").third
        assert third(5.0) == float(factor) * 5.0 + 1.0
    for name in CHAIN:
        sys.modules.pop(name)


def test_every_compiled_function_is_looked_at() -> None:
    """Catches a kernel in a file that the test above does not know."""
    files = [
        file
        for package in ("elastic_env", "baselines", "train")
        for file in (ROOT / package).rglob("*.py")
    ]
    signs = "\n@compiled", "\n@within_compiled", "numba.njit", "register_jitable("
    found = {file for file in files if any(sign in file.read_text() for sign in signs)}
    known = {ROOT / f"{name.replace('.', '/')}.py" for name in KERNELS}
    assert found - {ROOT / "elastic_env" / "core" / "compiled.py"} == known


def test_the_package_calls_no_part_of_a_kernel_from_python() -> None:
    """Catches a call that compiles an entry in every process."""
    parts: set[str] = set()
    for name in KERNELS:
        tree = ast.parse((ROOT / f"{name.replace('.', '/')}.py").read_text())
        here = {function.name for function in decorated(tree, "compiled_part")}
        in_python = [node for node in tree.body if node not in decorated(tree)]
        used = [n for part in in_python for n in ast.walk(part) if isinstance(n, ast.Name)]
        assert not {node.id for node in used} & here, name
        parts |= here
    for package in ("elastic_env", "baselines", "train"):
        for file in (ROOT / package).rglob("*.py"):
            text = file.read_text()
            assert not set(re.findall(r"kernels\.(\w+)\(", text)) & parts, file
            tree = ast.parse(text)
            imported = {
                alias.name
                for node in tree.body
                if isinstance(node, ast.ImportFrom) and node.module in KERNELS
                for alias in node.names
            }
            in_python = [node for node in tree.body if node not in decorated(tree)]
            used = [n for part in in_python for n in ast.walk(part) if isinstance(n, ast.Name)]
            assert not {node.id for node in used} & imported & parts, file


def test_where_nothing_can_be_kept_it_works_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an environment that cannot be imported from a read-only disk."""
    njit = module.numba.njit

    def refusing(**options: Any) -> Any:
        def decorate(function: Callable[..., Any]) -> Any:
            if options.pop("cache", False):
                raise RuntimeError("cannot cache function: no locator available")
            return njit(**options)(function)

        return decorate

    monkeypatch.setattr(module, "numba", SimpleNamespace(njit=refusing))
    assert compiled(lambda value: 2.0 * value)(1.5) == 3.0


def test_without_source_files_kernels_compile_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an installation of compiled Python alone that cannot be imported."""

    def missing(_: object) -> str:
        raise OSError("could not get source code")

    monkeypatch.setattr(module.inspect, "getsource", missing)
    rms_of_rows = compiled(walk_kernels.rms_of_rows.py_func)  # its file imports kernels
    assert rms_of_rows(np.full((1, 3), -2.0)) == [2.0]


def test_a_full_disk_costs_time_and_nothing_else() -> None:
    """Catches an environment that fails because what was compiled cannot be kept."""
    calls = []

    def keep() -> None:
        calls.append(1)
        if len(calls) == 1:
            raise OSError("no space left on device")

    compile_now(keep)
    assert len(calls) == 2


USERS = """
import numba
from elastic_env.core.compiled import compiled

@compiled
def twice(value):
    return 2.0 * value

@numba.njit
def four_times(value):
    return twice(twice(value))

assert four_times(1.5) == 6.0
assert twice(1.5) == 3.0
"""


def test_a_function_of_the_users_can_call_one_of_ours(tmp_path: Path) -> None:
    """Catches a thread that waits for the compiler's lock, which the function that is compiled
    holds, and output of a library in programs of others."""
    path = tmp_path / "users.py"
    path.write_text(USERS)
    ran = subprocess.run([sys.executable, str(path)], check=True, timeout=60, capture_output=True)
    assert (ran.stdout, ran.stderr) == (b"", b"")


KEPT = """
from elastic_env.core.compiled import compiled, within_compiled

@within_compiled
def twice(value):
    return 2.0 * value

@compiled
def four_times(value):
    return twice(twice(value))

@compiled
def eight_times(value):
    return four_times(value) * 2.0
"""


def test_a_command_says_once_that_functions_of_ours_are_compiled(tmp_path: Path) -> None:
    """Catches a wait that nobody explains, a line for every function, and one where the code is
    loaded."""
    path = tmp_path / "kept.py"
    said = []
    path.write_text(KEPT)
    for _ in range(2):
        spec = importlib.util.spec_from_file_location("kept", path)
        assert spec is not None
        assert spec.loader is not None
        kept = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(kept)
        console = Console(file=io.StringIO())
        with announce_compilation(console):
            assert numba.njit(lambda value: value + 1.0)(1.5) == 2.5  # of the user's
            said.append(console.file.getvalue())  # type: ignore[attr-defined]
            assert kept.eight_times(1.5) == 12.0
            assert kept.four_times(1.5) == 6.0
        kept.four_times(np.float32(1.5))  # compiled, and out of the command
        said.append(console.file.getvalue())  # type: ignore[attr-defined]
    line = (
        "compiling, once after an installation or an update: the first use takes some seconds"
        " longer\n"
    )
    assert said == ["", line, "", ""]


def test_an_interrupt_while_something_is_compiled_is_not_lost() -> None:
    """Catches a Ctrl-C that comes where C code has called Python, which drops its exception: a
    motion would go on."""
    times = 0

    def interrupt(frame: Any, event: str, _: Any) -> None:
        nonlocal times
        called_by_c = (
            "_raw_object_cache_notify",
            "_raw_object_cache_getbuffer",
        )  # compiling, loading
        if event == "call" and frame.f_code.co_name in called_by_c and times == 0:
            times += 1
            signal.raise_signal(signal.SIGINT)

    @numba.njit
    def twice(value: float) -> float:
        return 2.0 * value

    sys.setprofile(interrupt)
    threading.setprofile(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            compile_now(twice, 1.0)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    assert times == 1
    assert twice(1.0) == 2.0


def test_a_testbed_compiles_nothing_once_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a first step, or first steps that are scored, which let a servo wait for the
    compiler."""
    used: list[Any] = []
    names = ("write_commands", "begin_links", "sense_links", "observe_all_joints")
    for name in names:
        used.append(compiled(getattr(joint_kernels, name).py_func))
        monkeypatch.setattr(joint_kernels, name, used[-1])
    env = gymnasium.make("elastic_env/Testbed-v0", disable_env_checker=True)
    assert [len(function.signatures) for function in used] == [1] * len(used)
    env.reset(seed=0)
    for k in range(300):
        env.step(np.zeros(1, dtype=(np.float32, np.float64)[k % 2]))
    assert [len(function.signatures) for function in used] == [1] * len(used)


def test_division_by_zero_is_as_in_numpy() -> None:
    """Catches an exception in the midst of a batch."""

    @compiled
    def inverse(value: float) -> float:
        return 1.0 / value

    assert inverse(0.0) == np.inf
    assert np.isnan(compiled(lambda value: value / 0.0)(0.0))


@pytest.mark.parametrize(
    "scenario",
    [
        "imu",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("nominal", "sensor", "spread")),
    ],
)
def test_a_compiled_control_step_does_what_its_python_code_says(
    scenario: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches code that is compiled to something else, and what was compiled before a change."""
    short = {"step_period": [0.3, 0.4, 0.3], "num_steps": 1}
    worlds = gymnasium.make_vec(
        "elastic_env/WalkInPlace-v0", num_envs=2, scenario=scenario, **short
    )
    worlds.reset(seed=4)
    for _ in range(360):  # into the first swing
        worlds.step(np.zeros((2, 12), dtype=np.float32))
    steps = 0

    def compared(ran: Any) -> Callable[..., Any]:
        def both(*arguments: Any) -> Any:
            nonlocal steps
            interpreted = copy.deepcopy(arguments)
            found = ran(*arguments)
            with pytest.MonkeyPatch.context() as uncompiled:
                for file, name, function in compiled_ones:
                    uncompiled.setattr(file, name, function.py_func)
                assert ran.py_func(*interpreted) == found
            for mine, expected in zip(_arrays(arguments), _arrays(interpreted), strict=True):
                np.testing.assert_allclose(mine, expected, rtol=1e-13, atol=1e-13)
            steps += 1
            return found

        return both

    compiled_ones = [
        (file, name, function)
        for file in (attitude_kernels, joint_kernels, walk_kernels, walk_reward)
        for name, function in vars(file).items()
        if hasattr(function, "py_func")
    ]
    for file, name in ((joint_kernels, "write_commands"), (walk_kernels, "sense_walk")):
        monkeypatch.setattr(file, name, compared(getattr(file, name)))
    for k in range(20):
        worlds.step(np.full((2, 12), 0.01 * np.sin(k), dtype=np.float32))
    assert steps == 40


def _arrays(value: Any) -> Iterator[Any]:
    """All numbers of arguments of kernels."""
    if isinstance(value, tuple):
        for part in value:
            yield from _arrays(part)
    elif isinstance(value, np.ndarray) and value.dtype.names:
        for name in value.dtype.names:
            yield from _arrays(value[name])
    elif value is not None:
        yield np.asarray(value)


PLAYED = """
import gymnasium, numpy as np, baselines, elastic_env
short = {"step_period": [0.1, 0.2, 0.1], "num_steps": 1, "gait": {"lift_m": 0.005}}
env = gymnasium.make("elastic_env/WalkInPlace-v0", scenario="nominal", **short)
walk = [baselines.make("adaptive_posture", env, base=base) for base in ("input_output", "dynamic")]
(row, _), start = env.reset(seed=3), True
states = [None, None]
for step in range(3):
    steps = [policy.predict(row, state, start) for policy, state in zip(walk, states)]
    states, start = [state for _, state in steps], False
    row = env.step(steps[0][0])[0]
    memories = [x for state in states for x in state.own[0].tolist()]
    print(*[float(x) for action, _ in steps for x in action], *np.hstack(memories).tolist())
assert np.isfinite(row).all() and len(row) == 95
"""


@pytest.mark.slow
def test_compiled_policies_do_what_their_python_code_says() -> None:
    """Catches a policy's code that is compiled to something else, and what was compiled before a
    change.

    Also an import or an environment that fails when Numba is switched off, as for a debugger.
    """
    here = io.StringIO()
    with contextlib.redirect_stdout(here):
        exec(PLAYED, {})
    there = subprocess.run(
        [sys.executable, "-c", PLAYED],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )
    said = here.getvalue(), there.stdout
    compiled_ones, plain = (
        np.array([line.split() for line in text.splitlines()], dtype=np.float64) for text in said
    )
    assert compiled_ones.shape == (3, 42)
    np.testing.assert_allclose(compiled_ones, plain, rtol=1e-7, atol=1e-12)
