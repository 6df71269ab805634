"""Compiled functions: the numbers that their Python code says, and nothing kept of code that has changed."""

import copy
import importlib.util
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numba.core import caching

import elastic_env  # noqa: F401  registers the environments
from elastic_env import compiled as module
from elastic_env import metrics, worlds
from elastic_env.compiled import compiled
from elastic_env.walking import kernels

TWICE = """
import numpy as np
from elastic_env.compiled import compiled

@compiled
def twice(values):
    return 2.0 * values
"""


def loaded(path: Path) -> Any:
    """The function of a module that is loaded anew, as by a new program."""
    spec = importlib.util.spec_from_file_location("module_of_twice", path)
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found.twice


def hits(twice: Any) -> int:
    """How much of what a function did was found compiled."""
    assert twice(np.ones(2)).tolist() == [2.0, 2.0]
    assert twice(1.0) == 2.0
    return sum(twice.stats.cache_hits.values())


def test_what_was_compiled_is_kept_until_any_module_of_the_package_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a cache that knows a function's own file alone, and keeps old constants and callees, or old files."""
    path = tmp_path / "module_of_twice.py"
    path.write_text(TWICE)
    found = []
    for stamp in ("a", "a", "b", "b"):
        monkeypatch.setattr(module, "_package_stamp", lambda stamp=stamp: stamp)
        found.append(hits(loaded(path)))
        assert len(list(tmp_path.rglob("*.nbc"))) == 2
    assert found == [0, 2, 0, 2]


def test_what_was_not_kept_whole_is_compiled_again(tmp_path: Path) -> None:
    """Catches a crash while writing that breaks every program from then on, and one type's code for another."""
    path = tmp_path / "module_of_twice.py"
    path.write_text(TWICE)
    assert hits(loaded(path)) == 0
    one, other = sorted(tmp_path.rglob("*.nbc"))
    whole = one.read_bytes()
    for damaged in (b"", whole[:100], other.read_bytes(), b"garbage\n\x00\xff", pickle.dumps(5)):
        one.write_bytes(damaged)
        assert hits(loaded(path)) == 1
        assert one.read_bytes() != damaged


@pytest.mark.parametrize("is_found_late", [False, True])
def test_where_nothing_can_be_kept_it_works_all_the_same(
    is_found_late: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an environment that cannot be imported from a read-only disk, or that fails when the disk is full."""

    def refuse(*_: Any) -> None:
        raise OSError("read-only file system")

    path = tmp_path / "module_of_twice.py"
    path.write_text(TWICE)
    twice = loaded(path) if is_found_late else None
    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", refuse)
    assert hits(twice or loaded(path)) == 0
    assert not list(tmp_path.rglob("*.nbc"))


def test_the_stamp_of_the_package_changes_with_every_module(tmp_path: Path) -> None:
    """Catches a stamp without the modules of sub-packages, or one that looks at their size or time alone."""
    called = tmp_path / "tasks" / "called.py"
    called.parent.mkdir()
    stamps = set()
    for text in ("A = 1", "A = 2", "A = 12"):
        called.write_text(text)
        os.utime(called, (0, 0))
        stamps.add(module._stamp_of(tmp_path))
    assert len(stamps) == 3
    called.write_text("A = 1")
    assert module._stamp_of(tmp_path) in stamps


def test_without_the_compiler_it_works_all_the_same() -> None:
    """Catches an import that fails when Numba is switched off, as for a debugger."""
    code = (
        "import gymnasium, elastic_env; env = gymnasium.make('elastic_env/WalkInPlace-v0'); env.reset(seed=0);"
        "print([float(x).hex() for x in env.step(env.action_space.sample() * 0)[0]])"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, check=True, capture_output=True
    )  # fmt: skip
    assert said.stdout.count(b"0x") == 95


USERS = """
import numba
from elastic_env.compiled import compiled

@compiled
def twice(value):
    return 2.0 * value

@numba.njit
def four_times(value):
    return twice(twice(value))

assert four_times(1.5) == 6.0
"""


def test_a_function_of_the_users_can_call_one_of_ours(tmp_path: Path) -> None:
    """Catches a thread that waits for the compiler's lock, which the function that is compiled holds."""
    path = tmp_path / "users.py"
    path.write_text(USERS)
    subprocess.run([sys.executable, str(path)], check=True, timeout=60)


def test_an_interrupt_while_something_is_compiled_is_not_lost() -> None:
    """Catches a Ctrl-C that comes where C code has called Python, which drops its exception: a motion would go on."""
    times = 0

    def interrupt(frame: Any, event: str, _: Any) -> None:
        nonlocal times
        called_by_c = ("_raw_object_cache_notify", "_raw_object_cache_getbuffer")  # compiling, loading
        if event == "call" and frame.f_code.co_name in called_by_c and times == 0:
            times += 1
            signal.raise_signal(signal.SIGINT)

    @compiled
    def twice(value: float) -> float:
        return 2.0 * value

    sys.setprofile(interrupt)
    threading.setprofile(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            twice(1.0)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    assert times == 1
    assert twice(1.0) == 2.0


def test_a_testbed_compiles_nothing_once_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a first step, or first steps that are scored, which let a servo wait for the compiler."""
    used: list[Any] = []
    for owner, name in ((worlds, "_clip"), (metrics, "_add_in_order")):
        used.append(compiled(getattr(owner, name).py_func))
        monkeypatch.setattr(owner, name, used[-1])
    env = gymnasium.make("elastic_env/Testbed-v0", disable_env_checker=True)
    assert [len(function.signatures) for function in used] == [1, 1]
    env.reset(seed=0)
    for k in range(300):
        env.step(np.zeros(1, dtype=(np.float32, np.float64)[k % 2]))
    assert [len(function.signatures) for function in used] == [1, 1]


def test_division_by_zero_is_as_in_numpy() -> None:
    """Catches an exception in the midst of a batch."""

    @compiled
    def inverse(value: float) -> float:
        return 1.0 / value

    assert inverse(0.0) == np.inf
    assert np.isnan(compiled(lambda value: value / 0.0)(0.0))


@pytest.mark.parametrize("scenario", ["nominal", "sensor", "spread"])
def test_a_compiled_control_step_does_what_its_python_code_says(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches code that is compiled to something else, and what was compiled before a change."""
    worlds = gymnasium.make_vec("elastic_env/WalkInPlace-v0", num_envs=2, scenario=scenario)
    worlds.reset(seed=4)
    ran: Callable[..., bool] = kernels.control_step
    for _ in range(700):  # into the first swing
        worlds.step(np.zeros((2, 12), dtype=np.float32))
    steps = 0

    def both(physics: Any, walker: Any, noise: Any, *arguments: Any) -> bool:
        nonlocal steps
        interpreted = copy.deepcopy((physics, walker, noise, *arguments))
        is_over = ran(physics, walker, noise, *arguments)
        with pytest.MonkeyPatch.context() as uncompiled:
            for name, function in vars(kernels).items():
                if hasattr(function, "py_func"):
                    uncompiled.setattr(kernels, name, function.py_func)
            assert ran.py_func(*interpreted) == is_over  # type: ignore[attr-defined]
        _, rows, outcome = arguments[-3:]
        _, plain_rows, plain = interpreted[-3:]
        for mine, expected in ((rows, plain_rows), (outcome.observed, plain.observed)):
            np.testing.assert_allclose(mine.view(np.float64), expected.view(np.float64), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(outcome.reward, plain.reward, rtol=1e-13)
        np.testing.assert_array_equal(outcome.ends, plain.ends)
        np.testing.assert_array_equal(noise.used, interpreted[2].used)
        steps += 1
        return is_over

    monkeypatch.setattr(kernels, "control_step", both)
    for k in range(20):
        worlds.step(np.full((2, 12), 0.01 * np.sin(k), dtype=np.float32))
    assert steps == 20
