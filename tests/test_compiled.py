"""Compiled functions: the numbers that their Python code says, and nothing kept of code that has changed."""

import copy
import importlib.util
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments
from elastic_env import compiled as module
from elastic_env.compiled import compiled
from elastic_env.tasks import walk_step
from elastic_env.walking import ground_contact

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


def test_what_was_compiled_is_kept_until_any_module_of_the_package_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a cache that knows a function's own file alone, and keeps old constants and callees."""
    path = tmp_path / "module_of_twice.py"
    path.write_text(TWICE)
    hits = []
    for stamp in (("a", 1, 1), ("a", 1, 1), ("a", 2, 1), ("a", 2, 1)):
        monkeypatch.setattr(module, "_package_stamp", lambda stamp=stamp: (stamp,))
        twice = loaded(path)
        assert twice(np.ones(2)).tolist() == [2.0, 2.0]
        hits.append(sum(twice.stats.cache_hits.values()))
    assert hits == [0, 1, 0, 1]


def test_the_stamp_of_the_package_changes_with_a_module_that_is_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a stamp without the modules of sub-packages."""
    names = [name for name, _, _ in module._package_stamp()]
    for called in (ground_contact, walk_step):
        assert str(Path(called.__file__).relative_to(Path(module.__file__).parent)) in names


def test_an_interrupt_while_something_is_compiled_is_not_lost() -> None:
    """Catches a Ctrl-C that comes where C code has called Python, which drops its exception: a motion would go on."""
    times = 0

    def interrupt(frame: Any, event: str, _: Any) -> None:
        nonlocal times
        if event == "call" and frame.f_code.co_name == "_raw_object_cache_notify":
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
    ran: Callable[..., bool] = walk_step.control_step
    for _ in range(700):  # into the first swing
        worlds.step(np.zeros((2, 12), dtype=np.float32))
    steps = 0

    def both(*arguments: Any) -> bool:
        nonlocal steps
        given, outcome = list(arguments[:-4]), arguments[-4:]
        interpreted, plain = copy.deepcopy(given), copy.deepcopy(outcome)
        is_over = ran(*arguments)
        assert ran.py_func(*interpreted, *plain) == is_over  # type: ignore[attr-defined]
        for mine, expected in zip(outcome, plain, strict=True):
            np.testing.assert_allclose(mine, expected, rtol=1e-13, atol=1e-13)
        np.testing.assert_array_equal(given[5], interpreted[5])  # samples of noise that are used
        steps += 1
        return is_over

    monkeypatch.setattr(walk_step, "control_step", both)
    for k in range(20):
        worlds.step(np.full((2, 12), 0.01 * np.sin(k), dtype=np.float32))
    assert steps == 20
