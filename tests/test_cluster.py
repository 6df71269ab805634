"""Cells beside each other: kept by their content, moved when a worker is lost, the same wherever they are played."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from elastic_env.core.errors import ConfigurationError, SystemFailedError
from train.cells.key import cell_key
from train.cells.play import run_conditions
from train.cells.store import Store
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.evaluate import Evaluation, evaluate
from train.workers.calls import Watch, WorkerKilledError, run_calls
from train.workers.places import Place
from train.workers.versions import VersionsDifferError, require_same

SINE = {"kind": "sine", "duration_s": 0.5, "onset_s": 0.5, "amplitude": 0.1}
CONDITIONS = [
    Condition(policy=PolicySpec(name=name), reference=SINE, episodes=2) for name in ("uncompensated", "input")
]


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Place]:
    """A scheduler and two workers, real processes over TCP."""
    port, program = free_port(), str(Path(sys.executable).parent / "dask")
    address, quiet = f"tcp://127.0.0.1:{port}", {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    commands = [["scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]] + [
        ["worker", address, "--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path / str(n))]
        for n in range(2)
    ]
    known = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}  # the functions of this file
    started = [subprocess.Popen([program, *command], env=known, **quiet) for command in commands]  # type: ignore[call-overload]
    yield Place(f"dask://127.0.0.1:{port}")
    for process in reversed(started):
        process.terminate()
        process.wait()


def killed_once(mark: str, report: Callable[[int], None]) -> int:
    """Kills its process the first time."""
    if mark and not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def always_killed(kills: bool, report: Callable[[int], None]) -> str:
    if kills:
        os.kill(os.getpid(), signal.SIGKILL)
    return "fine"


def test_cells_are_the_same_on_dask_and_a_killed_worker_costs_its_own_call_alone(dask: Place, tmp_path: Path) -> None:
    """Catches results that depend on the place, and a call that is lost with its worker."""
    expected = [evaluate(condition, num_threads=1) for condition in CONDITIONS]
    found = run_conditions(CONDITIONS, Console(quiet=True), dask)
    assert [e.episodes for e in found] == [e.episodes for e in expected]
    with dask.opened(3, tmp_path) as pool:
        outcomes = run_calls(killed_once, [("",), (str(tmp_path / "mark"),), ("",)], pool, Watch())
    assert [outcome is not None and outcome.error is None for outcome in outcomes] == [True] * 3
    assert (tmp_path / "mark").exists()


def test_a_call_that_kills_its_process_each_time_fails_alone(tmp_path: Path) -> None:
    """Catches calls that are tried for ever, and others that go with it."""
    moved: list[int] = []
    with Place(jobs=2).opened(3, tmp_path) as pool:
        outcomes = run_calls(always_killed, [(False,), (True,), (False,)], pool, Watch(moved=moved.append))
    assert moved == [1, 1]
    assert [outcome.value for outcome in outcomes if outcome is not None] == ["fine", None, "fine"]
    assert isinstance(outcomes[1].error, WorkerKilledError)  # type: ignore[union-attr]


def test_a_kept_cell_is_what_was_played(tmp_path: Path) -> None:
    """Catches a digit, a type or an order that the file loses."""
    store, played = Store(tmp_path / "cells"), evaluate(CONDITIONS[0], num_threads=1)
    assert store.get(CONDITIONS[0]) is None
    store.keep(played)
    found = store.get(CONDITIONS[0])
    assert isinstance(found, Evaluation)
    assert repr(found.episodes) == repr(played.episodes)
    assert list(found.trace) == list(played.trace)
    for name, values in played.trace.items():
        np.testing.assert_array_equal(found.trace[name], values)


def test_a_damaged_cell_is_played_again(tmp_path: Path) -> None:
    """Catches a traceback for, or trust in, a file that lost its end."""
    store = Store(tmp_path)
    store.keep(evaluate(CONDITIONS[0], num_threads=1))
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-20])
    assert store.get(CONDITIONS[0]) is None


def test_only_what_is_missing_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a policy that is added and has all others played again."""
    store, played = Store(tmp_path), list[str]()

    def noted(condition: Condition, **options: Any) -> Evaluation:
        played.append(condition.policy.name)
        return evaluate(condition, **options)

    monkeypatch.setattr("train.cells.play.evaluate", noted)
    run_conditions(CONDITIONS[:1], Console(quiet=True), store=store)
    run_conditions(CONDITIONS, Console(quiet=True), store=store)
    assert played == ["uncompensated", "input"]


def test_a_key_changes_with_the_source_of_a_users_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a result of an older policy, and of an older module that it imports."""
    monkeypatch.chdir(tmp_path)
    Path("gains.py").write_text("GAIN = 1\n")
    Path("mine.py").write_text("from gains import GAIN\n")
    condition = Condition(policy=PolicySpec(name="mine.py:make"))
    keys = [cell_key(condition)]
    Path("gains.py").write_text("GAIN = 2\n")
    keys.append(cell_key(condition))
    Path("mine.py").write_text("from gains import GAIN as gain\n")
    keys.append(cell_key(condition))
    assert len(set(keys)) == 3
    assert cell_key(condition) == keys[-1]


def test_other_versions_are_refused_with_both() -> None:
    with pytest.raises(VersionsDifferError, match=r"on node7 .*numpy 2\.1 there, 2\.4 here"):
        require_same({"numpy": "2.4", "pin": "4"}, {"numpy": "2.1", "pin": "4"}, "node7")


@pytest.mark.parametrize("on", ["dask://nowhere", "ssh://host:1", "slurmy", ""])
def test_a_place_that_does_not_exist_says_which_do(on: str) -> None:
    with pytest.raises(ConfigurationError, match="on must be local, dask://HOST:PORT"):
        Place(on)


def test_a_scheduler_that_is_not_there_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("train.workers.dask_cluster._CONNECT_S", 0.5)
    port = free_port()
    with (
        pytest.raises(SystemFailedError, match=f"no dask scheduler answers at 127.0.0.1:{port}"),
        Place(f"dask://127.0.0.1:{port}").opened(1, tmp_path),
    ):
        pass
