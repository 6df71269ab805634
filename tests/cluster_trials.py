"""What the cells of a comparison cost beyond their own time, and what a kill costs: `python -m
tests.cluster_trials`.

    python -m tests.cluster_trials empty            # empty cells, on this machine and on dask with
    one worker python -m tests.cluster_trials long             # cells of 2 s on both, in turn
    python -m tests.cluster_trials workers          # kill -9 of a worker of dask, at a random
    moment of a comparison python -m tests.cluster_trials program          # kill -9 of the program
    itself, then --resume

The last two compare the tables with those of a comparison that nobody disturbed, and count how
often each cell began.
"""

import os
import random
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from train.cells.play import run_conditions
from train.cells.store import Store
from train.evaluate.changes import changes
from train.evaluate.conditions import Condition, PolicySpec
from train.report.change_tables import write_statistics
from train.report.summary import write_episodes
from train.workers.calls import Watch, run_calls
from train.workers.executors import Executors

ROOT = Path(__file__).parents[1]
PROGRAMS = Path(sys.executable).parent
SINE = {"kind": "sine", "duration_s": 0.5, "onset_s": 0.5, "amplitude": 0.1}
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
CELLS = 12
TABLES = ("episodes.csv", "statistics.csv")

COUNTED = '''
import time

import baselines


class Counted:
    """A share of what `input` commands, slowly; the first step of a cell is noted in a file."""

    def __init__(self, env, cell, folder):
        self._own, self._share, self._folder, self._noted = baselines.make("input", env), cell / 20.0, folder, cell

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if self._noted is not None:
            with open(f"{self._folder}/begun", "a") as file:
                file.write(f"{self._noted}\\n")
            self._noted = None
        time.sleep(0.002)
        action, state = self._own.predict(observation, state, episode_start, deterministic)
        return action * self._share, state
'''
"""A policy whose cells can be told apart, and last about half a second.

It is given a folder. A file that options name belongs to the key of a cell, and this one changes
with every cell.
"""


def empty(number: int, report: Callable[[int], None]) -> int:
    """A call that does nothing."""
    return number


def busy(seconds: float, report: Callable[[int], None]) -> float:
    """A call that calculates for a time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        sum(range(1000))
    return seconds


def free_port() -> int:
    """A port of this machine that nobody has."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def _wait_for_port(port: int) -> None:
    """Until a program listens there; on a busy machine it takes long to start."""
    last = time.monotonic() + 120.0
    while time.monotonic() < last:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return
        time.sleep(0.1)


@contextmanager
def dask_cluster(
    workers: int, *options: str
) -> Iterator[tuple[Executors, list[subprocess.Popen[bytes]]]]:
    """A scheduler and workers of dask, real processes over TCP; executors on it, and what keeps
    workers going."""
    port = free_port()
    known = {**os.environ, "PYTHONPATH": str(ROOT)}  # the functions of the tests
    at = f"127.0.0.1:{port}"
    dask = str(PROGRAMS / "dask")
    with tempfile.TemporaryDirectory() as own:
        scheduler = [
            dask,
            "scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            str(port),
            "--no-dashboard",
        ]
        worker = [
            dask,
            "worker",
            f"tcp://{at}",
            "--nthreads",
            "1",
            "--no-dashboard",
            "--local-directory",
            own,
            *options,
        ]
        commands = [scheduler, *[worker] * workers]
        started = [subprocess.Popen(command, env=known, **QUIET) for command in commands]  # type: ignore[call-overload]
        try:
            _wait_for_port(port)
            yield Executors(on=f"dask://{at}"), started[1:]
        finally:
            for process in reversed(started):
                process.terminate()
                process.wait()


def seconds_of(
    function: Callable[..., Any], given: list[tuple[Any, ...]], executors: Executors
) -> float:
    """How long calls take, once a first one has had the worker load what it needs."""
    with tempfile.TemporaryDirectory() as own, executors.open_pool(len(given), Path(own)) as pool:
        run_calls(empty, [(0,)], pool, Watch())
        begin = time.monotonic()
        outcomes = run_calls(function, given, pool, Watch())
        end = time.monotonic()
    assert [outcome.value for outcome in outcomes if outcome is not None] == [
        first for first, *_ in given
    ]
    return end - begin


def overhead(function: Callable[..., Any], given: list[tuple[Any, ...]], rounds: int) -> None:
    """Both places in turn, with one process each; seconds of every round and their medians."""
    with dask_cluster(1) as (executors, _):
        both = (Executors(jobs=1), executors)
        pairs = [[seconds_of(function, given, own) for own in both] for _ in range(rounds)]
    for local, dask in pairs:
        print(f"local {local:.2f} s, dask {dask:.2f} s, dask/local {dask / local:.3f}")
    local, dask = (statistics.median(pair[n] for pair in pairs) for n in (0, 1))
    ratio = statistics.median(dask / local for local, dask in pairs)
    each = [1e3 * whole / len(given) for whole in (local, dask)]
    print(
        f"{len(given)} calls: local {each[0]:.2f} ms, dask {each[1]:.2f} ms each; median of"
        f" dask/local {ratio:.3f}"
    )


@dataclass(frozen=True)
class Comparison:
    """A small comparison of cells that are counted when they begin.

    Attributes:
        folder: For its tables, its finished cells, and the list of those that began.
    """

    folder: Path

    def conditions(self) -> list[Condition]:
        """Its cells."""
        policies = [
            PolicySpec(
                name="counted.py:Counted",
                label=f"p{n}",
                options={"cell": n, "folder": str(self.folder)},
            )
            for n in range(CELLS)
        ]
        return [Condition(policy=policy, reference=SINE, episodes=2) for policy in policies]

    def play(self, executors: Executors) -> None:
        """As `elastic compare` does: what is not kept is played, then tables are written."""
        found = run_conditions(
            self.conditions(), Console(quiet=True), executors, Store(self.folder / "cells")
        )
        write_episodes(found, self.folder / TABLES[0])
        write_statistics(changes(found, {}), self.folder / TABLES[1])

    def begin(self, executors: Executors) -> int:
        """Play in a process of its own, a fork of this one; its number."""
        self.folder.mkdir(exist_ok=True)
        assert threading.active_count() == 1, "a fork has no other threads"
        process = os.fork()
        if process == 0:
            try:
                self.play(executors)
            except BaseException as error:
                print(f"{type(error).__name__}: {error}", file=sys.stderr)
                os._exit(1)
            os._exit(0)
        return process

    def begun(self) -> list[int]:
        """Cells in the order in which they began."""
        file = self.folder / "begun"
        return [int(line) for line in file.read_text().split()] if file.is_file() else []

    def finished(self) -> int:
        """How many cells are kept."""
        return len(list((self.folder / "cells").glob("*.npz")))

    def tables(self) -> list[bytes] | None:
        """The tables; None where they are missing."""
        files = [self.folder / name for name in TABLES]
        return (
            [file.read_bytes() for file in files] if all(file.is_file() for file in files) else None
        )


def _wait_for_begin(played: Comparison) -> None:
    while not played.begun():
        time.sleep(0.02)


def _ended(process: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def _kill_worker(nanny: subprocess.Popen[bytes]) -> bool:
    """Kill what a program of dask keeps going; it starts another one. Whether there was one."""
    # whichever thread of the program started it
    children = [path.read_text() for path in Path(f"/proc/{nanny.pid}/task").glob("*/children")]
    for child in " ".join(children).split():
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            os.kill(int(child), signal.SIGKILL)
            return True
    return False


def _undisturbed(executors: Executors) -> tuple[list[bytes], float]:
    """Tables of a comparison that nobody disturbs, and how long its cells take once the workers
    have loaded all."""
    _ended(Comparison(Path.cwd() / "first").begin(executors))
    whole = Comparison(Path.cwd() / "whole")
    process = whole.begin(executors)
    _wait_for_begin(whole)
    begin = time.monotonic()
    code = _ended(process)
    lasted = time.monotonic() - begin
    tables = whole.tables()
    assert code == 0, "the undisturbed comparison failed"
    assert tables is not None
    assert sorted(whole.begun()) == list(range(CELLS))
    print(f"undisturbed: {CELLS} cells in {lasted:.2f} s", flush=True)
    return tables, lasted


@contextmanager
def _own_folder() -> Iterator[None]:
    """Work in a folder of its own, which has the policy."""
    with tempfile.TemporaryDirectory() as own, chdir(own):
        Path("counted.py").write_text(COUNTED)
        yield


def workers(times: int, seed: int) -> None:
    """Kill a worker at a random moment of a comparison, and look at what comes of it."""
    chance = random.Random(seed)
    same = 0
    again = list[int]()
    with _own_folder(), dask_cluster(2) as (executors, nannies):
        tables, lasted = _undisturbed(executors)
        for number in range(times):
            played = Comparison(Path.cwd() / f"trial_{number}")
            process = played.begin(executors)
            _wait_for_begin(played)
            moment = chance.uniform(0.0, lasted)
            time.sleep(moment)
            finished = played.finished()
            killed = _kill_worker(chance.choice(nannies))
            code = _ended(process)
            again.append(len(played.begun()) - CELLS)
            is_same = code == 0 and played.tables() == tables
            same += is_same
            print(
                f"{number}: killed {killed} after {moment:.2f} s,"
                f" {_said(finished, code, is_same, again)}",
                flush=True,
            )
    print(f"kill -9 of a worker: {_sum(same, again)}; at most 1 is right")


def program(times: int, seed: int) -> None:
    """Kill the program itself at a random moment, resume it, and look at what comes of it."""
    chance = random.Random(seed)
    same = 0
    again = list[int]()
    wasted = 0
    with _own_folder(), dask_cluster(2) as (executors, _):
        tables, lasted = _undisturbed(executors)
        for number in range(times):
            played = Comparison(Path.cwd() / f"trial_{number}")
            process = played.begin(executors)
            _wait_for_begin(played)
            moment = chance.uniform(0.0, lasted)
            time.sleep(moment)
            os.kill(process, signal.SIGKILL)
            _ended(process)
            finished = played.finished()
            time.sleep(2.0)  # what runs on the workers ends, and begins no other
            before = len(played.begun())
            code = _ended(played.begin(executors))
            begun = len(played.begun())
            again.append(begun - CELLS)
            wasted += begun - before - (CELLS - finished)
            is_same = code == 0 and played.tables() == tables
            same += is_same
            print(
                f"{number}: killed after {moment:.2f} s, {_said(finished, code, is_same, again)}",
                flush=True,
            )
    print(
        f"kill -9 of the program: {_sum(same, again)}; finished cells that were played again:"
        f" {wasted}"
    )


def _said(finished: int, code: int, is_same: bool, again: list[int]) -> str:
    return (
        f"{finished} cells finished; code {code}, same tables {is_same}, {again[-1]} played again"
    )


def _sum(same: int, again: list[int]) -> str:
    counts = dict(sorted(Counter(again).items()))
    return (
        f"{same} of {len(again)} complete and identical; trials by the number of cells that began"
        f" again: {counts}"
    )


def main(
    what: tyro.conf.Positional[Literal["empty", "long", "workers", "program"]],
    calls: int = 0,
    times: int = 20,
    rounds: int = 5,
    seed: int = 0,
) -> None:
    """Measure.

    Args:
        what: empty, long, workers or program.
        calls: How many calls, 0 for 10 000 empty ones or 5 long ones.
        times: How many kills.
        rounds: How often both places are measured in turn.
        seed: Of the random moments.
    """
    if what == "empty":
        overhead(empty, [(number,) for number in range(calls or 10_000)], rounds)
    elif what == "long":
        overhead(busy, [(2.0,)] * (calls or 5), rounds)
    else:
        {"workers": workers, "program": program}[what](times, seed)


if __name__ == "__main__":
    tyro.cli(main)
