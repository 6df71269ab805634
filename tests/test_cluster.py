"""Cells beside each other: kept by their content, moved when a worker is lost, the same wherever
they are played."""

import errno
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from elastic_env.core.errors import ConfigurationError, SystemFailedError
from elastic_env.core.files import flush
from tests.cluster_trials import SINE, dask_cluster, free_port
from tests.test_training import PPO, SMALL, weights
from train.cells.cell_key import cell_key
from train.cells.play import run_conditions
from train.cells.store import Store
from train.commands.cli import main
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import Evaluation, evaluate, evaluate_together
from train.learn.run_training import start
from train.learn.train_config import TrainConfig
from train.learn.training import Training
from train.workers.calls import Watch, run_calls
from train.workers.dask_cluster import warn_of_public
from train.workers.executors import Executors
from train.workers.pool import WorkerKilledError
from train.workers.versions import VersionsDifferError, require_same

CONDITIONS = [
    Condition(policy=PolicySpec(name=name), reference=SINE, episodes=2)
    for name in ("uncompensated", "input")
]


@pytest.fixture
def dask() -> Iterator[Executors]:
    """A scheduler and two workers."""
    with dask_cluster(2) as (executors, _):
        yield executors


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


@pytest.mark.slow
def test_cells_are_the_same_on_dask_and_a_killed_worker_costs_its_own_call_alone(
    dask: Executors, tmp_path: Path
) -> None:
    """Catches results that depend on the place, and a call that is lost with its worker."""
    expected = [evaluate(condition, num_threads=1) for condition in CONDITIONS]
    found = run_conditions(CONDITIONS, Console(quiet=True), dask)
    assert [e.episodes for e in found] == [e.episodes for e in expected]
    with dask.open_pool(3, tmp_path) as pool:
        outcomes = run_calls(killed_once, [("",), (str(tmp_path / "mark"),), ("",)], pool, Watch())
    assert [outcome is not None and outcome.error is None for outcome in outcomes] == [True] * 3
    assert (tmp_path / "mark").exists()


@pytest.mark.slow
def test_a_call_that_kills_its_process_each_time_fails_alone(tmp_path: Path) -> None:
    """Catches calls that are tried for ever, and others that go with it."""
    moved: list[int] = []
    with Executors(jobs=2).open_pool(3, tmp_path) as pool:
        outcomes = run_calls(
            always_killed, [(False,), (True,), (False,)], pool, Watch(on_move=moved.append)
        )
    assert moved == [1, 1]
    assert [outcome.value for outcome in outcomes if outcome is not None] == ["fine", None, "fine"]
    assert isinstance(outcomes[1].error, WorkerKilledError)  # type: ignore[union-attr]


class Unreadable:
    """What a worker can send and nobody can read."""

    def __reduce__(self) -> Any:
        return fails_to_load, ()


def fails_to_load() -> None:
    raise OSError("not here")


def unreadable(report: Callable[[int], None]) -> Unreadable:
    return Unreadable()


@pytest.mark.slow
def test_an_outcome_that_cannot_be_read_fails_alone_and_ends_its_process(tmp_path: Path) -> None:
    """Catches a call that waits for ever for the end of a process that lives."""
    before = processes_of(os.getpid())
    with Executors(jobs=2).open_pool(4, tmp_path) as pool:
        outcomes = run_calls(unreadable, [()] * 4, pool, Watch())
        assert len(processes_of(os.getpid()) - before) <= 2
    said = [str(outcome.error) for outcome in outcomes if outcome is not None]
    assert len(said) == 4
    assert all("cannot be read: not here" in text for text in said)


def processes_of(parent: int) -> set[int]:
    """Processes of Python that a process has started, without the tracker that Python starts for
    itself."""
    lists = Path(f"/proc/{parent}/task").glob("*/children")
    found = [child for file in lists for child in file.read_text().split()]
    return {
        int(child)
        for child in found
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    }


def helpers_killed(known: set[int], report: Callable[[int], None]) -> str:
    """Kills what the program has started beside its worker, then reports."""
    for other in processes_of(os.getppid()) - known - {os.getpid()}:
        os.kill(other, signal.SIGKILL)
    report(1)
    return "fine"


@pytest.mark.slow
def test_a_comparison_on_this_machine_needs_no_process_but_its_workers(tmp_path: Path) -> None:
    """Catches a call that fails, with an error of its connection, where a helper of the program
    is killed."""
    known = processes_of(os.getpid())
    reports = list[Any]()
    watch = Watch(on_report=lambda number, value: reports.append((number, value)))
    with Executors(jobs=1).open_pool(2, tmp_path) as pool:
        outcomes = run_calls(helpers_killed, [(known,)] * 2, pool, watch)
    assert [outcome.value for outcome in outcomes if outcome is not None] == ["fine"] * 2
    assert reports == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_a_kept_cell_is_what_was_played(tmp_path: Path) -> None:
    """Catches a digit, a type or an order that the file loses."""
    store = Store(tmp_path / "cells")
    played = evaluate(CONDITIONS[0], num_threads=1)
    assert store.get(CONDITIONS[0]) is None
    store.keep(played)
    found = store.get(CONDITIONS[0])
    assert isinstance(found, Evaluation)
    assert repr(found.episodes) == repr(played.episodes)
    assert list(found.trace) == list(played.trace)
    for name, values in played.trace.items():
        np.testing.assert_array_equal(found.trace[name], values)


def test_only_what_is_missing_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a policy that is added and has all others played again."""
    store = Store(tmp_path)
    played = list[str]()

    def noted(conditions: Sequence[Condition], *options: Any) -> list[Evaluation]:
        played.extend(condition.policy.name for condition in conditions)
        return evaluate_together(conditions, *options)

    monkeypatch.setattr("train.cells.play.evaluate_together", noted)
    run_conditions(CONDITIONS[:1], Console(quiet=True), store=store)
    run_conditions(CONDITIONS, Console(quiet=True), store=store)
    assert played == ["uncompensated", "input"]


def test_a_key_changes_with_the_source_of_a_users_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_cell_whose_policy_changed_while_it_was_played_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a result of the older policy under the key of the newer one, which --resume would
    take."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "import baselines\n\ndef make(env):\n    return baselines.make('input', env)\n"
    )
    condition = CONDITIONS[0].replace(policy=PolicySpec(name="mine.py:make"))
    store = Store(tmp_path / "cells")

    def edited(conditions: Sequence[Condition], *options: Any) -> list[Evaluation]:
        result = evaluate_together(conditions, *options)
        Path("mine.py").write_text(
            "import baselines\n\ndef make(env):\n    return baselines.make('zero', env)\n"
        )
        return result

    with monkeypatch.context() as context:
        context.setattr("train.cells.play.evaluate_together", edited)
        run_conditions([condition], Console(width=200), store=store)
    assert "is not kept: a file that it names changed" in capsys.readouterr().out
    assert store.get(condition) is None
    run_conditions([condition], Console(quiet=True), store=store)
    assert store.get(condition) is not None


def test_other_versions_are_refused_with_both() -> None:
    with pytest.raises(VersionsDifferError, match=r"on node7 .*numpy 2\.1 there, 2\.4 here"):
        require_same({"numpy": "2.4", "pin": "4"}, {"numpy": "2.1", "pin": "4"}, "node7")


@pytest.mark.parametrize("on", ["dask://nowhere", "ssh://host:1", "slurmy", ""])
def test_a_place_that_does_not_exist_says_which_do(on: str) -> None:
    with pytest.raises(
        ConfigurationError,
        match=f"unknown executors '{on}'; choose one of: local, dask://HOST:PORT",
    ):
        Executors(on=on)


@pytest.mark.parametrize(
    ("executors", "calls", "threads"),
    [
        (Executors(), 1, 8),
        (Executors(), 3, 2),
        (Executors(), 20, 1),
        (Executors(jobs=2), 20, 4),
        (Executors(jobs=12), 20, 1),
        (Executors(on="dask://host:1"), 1, 1),
    ],
)
def test_calls_share_the_cores_of_this_machine(
    executors: Executors, calls: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches cores that stand idle beside one training seed, and more threads than cores."""
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert executors.threads_per_call(calls) == threads


def test_a_scheduler_that_is_not_there_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("train.workers.dask_cluster._CONNECT_S", 0.5)
    port = free_port()
    with (
        pytest.raises(SystemFailedError, match=f"no dask scheduler answers at 127.0.0.1:{port}"),
        Executors(on=f"dask://127.0.0.1:{port}").open_pool(1, tmp_path),
    ):
        pass


OTHER_NUMPY = """
from importlib import metadata

real = metadata.version  # this file may be loaded twice
metadata.version = lambda name, real=real: "1.0.7" if name == "numpy" else real(name)
"""


def test_a_worker_of_another_version_is_refused(tmp_path: Path) -> None:
    """Catches versions of workers that nobody looks at."""
    (tmp_path / "other.py").write_text(OTHER_NUMPY)
    with (
        dask_cluster(1, "--no-nanny", "--preload", str(tmp_path / "other.py")) as (executors, _),
        pytest.raises(
            VersionsDifferError,
            match=r"on tcp://.*: numpy 1\.0\.7 there, .* here; install the same commit",
        ),
        executors.open_pool(1, tmp_path),
    ):
        pass


COMPARED = """
name: cells
env: testbed
references: [{kind: sine, duration_s: 0.5, onset_s: 0.5, amplitude: 0.1}]
policies: [uncompensated, input, dynamic]
"""


@pytest.mark.slow
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_takes_no_more_keeps_the_cells_before(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a cell that is half written and used, cells that go with the failure, and a
    traceback."""
    monkeypatch.chdir(tmp_path)
    Path("c.yaml").write_text(COMPARED)
    main(["compare", "c.yaml", "--output", "whole", "--jobs", "1"])
    flushed = flush
    kept = Path("run/cells")

    def full(path: Path) -> None:
        if path.parent == kept and len(list(kept.glob("*.npz"))) == 2:
            raise OSError(code, os.strerror(code))
        flushed(path)

    monkeypatch.setattr("elastic_env.core.files.flush", full)
    with pytest.raises(SystemExit) as caught:
        main(["compare", "c.yaml", "--output", "run", "--jobs", "1"])
    said = capsys.readouterr().err
    assert caught.value.code == 3
    assert f".npz: {os.strerror(code)}; " in said
    assert "finished cells are kept; go on with: elastic compare --resume run" in said
    assert "Traceback" not in said
    assert [file.suffix for file in kept.iterdir()] == [".npz"] * 2
    monkeypatch.setattr("elastic_env.core.files.flush", flushed)
    main(["compare", "--resume", "run"])
    assert "2 of 3 cells are kept" in capsys.readouterr().out
    for name in ("episodes.csv", "statistics.csv"):
        assert Path("run", name).read_bytes() == Path("whole", name).read_bytes()


UNGUARDED = """
from pathlib import Path
from rich.console import Console
from train.cells.play import run_conditions
from train.evaluate.conditions import Condition, PolicySpec
print("run", flush=True)
run_conditions([Condition(policy=PolicySpec(name=name)) for name in ("uncompensated", "input")], Console())
"""


@pytest.mark.slow
def test_a_script_whose_processes_import_it_is_told_so(tmp_path: Path) -> None:
    """Catches an EOFError of a process that says nothing, and tracebacks of the processes."""
    (tmp_path / "script.py").write_text(UNGUARDED)
    run = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 1
    assert (
        2 <= run.stdout.count("run\n") <= 3
    )  # the second worker may be ended before it comes that far
    assert run.stderr.count("Traceback") == 1
    assert 'must do so below if __name__ == "__main__":' in run.stderr.splitlines()[-1]


@pytest.mark.slow
def test_a_training_seed_whose_worker_is_killed_ends_with_the_same_weights(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a seed that begins anew, or goes on from another state, where another worker takes
    it over."""
    config = TrainConfig(**{**SMALL, **PPO, "seeds": [3], "decisions": 384})
    own = tmp_path / "run" / "seed_3"

    def kill() -> None:
        while not (own / "checkpoint").exists():
            time.sleep(0.01)
        os.kill(int((own / ".lock").read_text().split()[0]), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    start([config], Console(), tmp_path / "run", Executors(jobs=2))
    killer.join()
    assert "a worker was lost; seed 3 goes on from its checkpoint" in capsys.readouterr().out
    Training(config, 3, tmp_path / "alone").run()
    for name, tensor in weights(tmp_path / "alone" / "last").items():
        np.testing.assert_array_equal(tensor, weights(own / "last")[name], err_msg=name)


def test_a_scheduler_at_a_public_address_gets_a_warning() -> None:
    """Catches a scheduler on the Internet, which runs the code of whoever reaches it, without a
    word."""
    for address in ("8.8.8.8:8786", "[2001:4860:4860::8888]:8786"):
        with pytest.warns(
            UserWarning, match="public address, by plain TCP: whoever reaches it runs code"
        ):
            warn_of_public(address)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for address in (
            "127.0.0.1:8786",
            "10.1.2.3:8786",
            "192.168.0.7:8786",
            "[::1]:8786",
            "no.such.invalid:1",
        ):
            warn_of_public(address)
