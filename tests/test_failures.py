"""What goes wrong with the system or with a user's policy is one sentence, and an exit code that
says which."""

import ctypes
import errno
import io
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from elastic_env.core.errors import ConfigurationError, SystemFailedError
from train.commands.cli import COMMANDS, main
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.rollout import PolicyFailedError, policy_errors
from train.runs.failures import SignalError, explain
from train.runs.progress import duration, plain_progress
from train.workers.pool import WorkerKilledError

CONFIGS = Path(__file__).parents[1] / "configs"
POLICIES = """
import numpy as np
class Policy:
    def __init__(self, env, action):
        self.shape, self.action = env.action_space.shape, action
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        step = 0 if state is None else state
        return (np.zeros(self.shape, dtype=np.float32) if step < 3 else self.action(self.shape)), step + 1
def raises(env):
    return Policy(env, lambda shape: 1 / 0)
def nan(env):
    return Policy(env, lambda shape: np.full(shape, np.nan))
def shape(env):
    return Policy(env, lambda shape: np.zeros(7))
"""
KILLED = """
import multiprocessing, os, pathlib, signal, time
def killed(env):
    if multiprocessing.parent_process() is None:
        return Policy(env, np.zeros)
    while not any(pathlib.Path("runs/cells/cells").glob("*.npz")):
        time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGKILL)
"""
COMPARISON = """
name: cells
env: testbed
references: [{kind: sine, duration_s: 0.5, onset_s: 0.5, amplitude: 0.1}]
policies: [input, "mine.py:raises"]
"""


CELL = Condition(policy=PolicySpec(name="mine.py:policy"), reference={"kind": "sine"})


def elastic(*arguments: str, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from train.commands.entry import main; main()", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, **options
    )  # type: ignore[call-overload]


SEVERAL = """
import json, resource, sys
from train.commands.entry import main
for size, arguments in json.loads(sys.argv[1]):
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard if size is None else size, hard))
    sys.argv[1:] = arguments
    try:
        main()
        code = 0
    except SystemExit as end:
        code = end.code
    sys.stderr.write(f"ended with {code}\\n")
"""


def several(
    *commands: tuple[int | None, list[str]], first: str = "", **options: object
) -> list[str]:
    """What commands say on stderr that all end with the same code, one after the other in one
    process.

    Args:
        commands: Largest file that each may write [bytes], None for any, and its arguments.
        first: Program that goes before them.
        options: Of `subprocess.run`.

    Returns:
        Of each command what it said and "ended with CODE".
    """
    program = [sys.executable, "-c", first + SEVERAL, json.dumps(commands)]
    run = subprocess.run(
        program, capture_output=True, text=True, timeout=120, check=True, **options
    )  # type: ignore[call-overload]
    said = [line for line in re.split(r"(?<=ended with \d)\n", run.stderr) if line]
    assert len(said) == len(commands), run.stderr
    return said


@pytest.mark.parametrize(
    ("error", "said", "code"),
    [
        (ConfigurationError("no"), "no", 2),
        (SystemFailedError("gone"), "gone", 3),
        (
            OSError(errno.ENOSPC, "No space left on device", "runs/x"),
            "runs/x: No space left on device; free some",
            3,
        ),
        (WorkerKilledError(), "a worker process was killed", 3),
        (MemoryError(), "there is not enough memory", 3),
        (ModuleNotFoundError("", name="torch"), "constraints.txt '.[train]'", 2),
        (ModuleNotFoundError("", name="plotly.offline"), "constraints.txt '.[report]'", 2),
        (ModuleNotFoundError("", name="jinja2"), "constraints.txt '.[report]'", 2),
    ],
)
def test_a_failure_is_a_sentence_and_a_code(error: Exception, said: str, code: int) -> None:
    found = explain(error)
    assert found is not None
    assert said in found[0]
    assert found[1] == code


def test_a_full_disk_is_found_behind_the_error_of_a_library() -> None:
    """Catches a library that hides why it could not write."""
    error = RuntimeError("writer failed")
    cause = OSError(errno.ENOSPC, "No space left on device")
    error.__cause__ = cause
    assert explain(error) == explain(cause)
    assert explain(RuntimeError("a defect")) is None


@pytest.mark.parametrize("kind", ["raises", "nan", "shape"])
def test_a_policy_that_fails_is_named_with_scenario_and_step(
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches a traceback, or words that leave open whose policy it was."""
    (tmp_path / "mine.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    reference = "{kind: sine, duration_s: 0.5, onset_s: 0.5, amplitude: 0.1}"
    with pytest.raises(SystemExit) as caught:
        main(["evaluate", "--policy", f"mine.py:{kind}", "--reference", reference])
    assert caught.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert (
        f"the policy 'mine.py:{kind}' failed in scenario 'nominal', sine, at control step 3" in said
    )
    assert "Traceback" not in said


@pytest.mark.parametrize(
    "error",
    [
        FileNotFoundError(2, "No such file"),
        SystemExit(7),
        ConfigurationError("no"),
        RuntimeError("no"),
    ],
)
def test_whatever_a_policy_raises_is_the_policys(error: BaseException) -> None:
    """Catches a file that the policy misses taken for a disk that failed, and a policy that ends
    the program."""
    with (
        pytest.raises(
            PolicyFailedError,
            match=r"'mine.py:policy' failed in scenario 'nominal', sine, at control step 3",
        ),
        policy_errors(CELL, 3),
    ):
        raise error


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space"), MemoryError(), SystemFailedError("gone")]
)
def test_what_the_system_does_is_not_the_policys(error: Exception) -> None:
    """Catches a full disk that is put down to the policy that met it."""
    with pytest.raises(type(error)) as caught, policy_errors(CELL, 3):
        raise error
    assert caught.value is error


@pytest.mark.parametrize("command", ["play", "speed"])
def test_a_policy_that_fails_is_named_by_every_command(
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches a traceback in commands that play a policy without scoring it."""
    (tmp_path / "mine.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    given = {
        "play": ["--video", "x.gif", "--max-s", "0.1"],
        "speed": [
            "--env",
            "testbed",
            "--num-envs",
            "2",
            "--rounds",
            "1",
            "--no-others",
            "--no-ppo",
        ],
    }
    with pytest.raises(SystemExit) as caught:
        main([command, "--policy", "mine.py:raises", *given[command]])
    assert caught.value.code == 2
    assert "the policy 'mine.py:raises' failed in scenario 'nominal', " in capsys.readouterr().err


@pytest.mark.slow
def test_the_other_cells_of_a_comparison_are_kept(tmp_path: Path) -> None:
    """Catches a comparison that loses what has been played because one policy fails."""
    (tmp_path / "mine.py").write_text(POLICIES)
    (tmp_path / "cells.yaml").write_text(COMPARISON)
    run = elastic("compare", "cells.yaml", "--jobs", "1", cwd=tmp_path)
    assert run.returncode == 2, run.stderr
    assert "ZeroDivisionError" in run.stderr
    assert "finished cells: 1, in runs/cells/episodes.csv" in run.stdout
    assert ",input,"[1:] in (tmp_path / "runs" / "cells" / "episodes.csv").read_text()


@pytest.mark.slow
def test_what_had_been_played_before_a_worker_was_killed_is_kept(tmp_path: Path) -> None:
    """Catches a comparison whose folder goes with the process that the system killed."""
    (tmp_path / "mine.py").write_text(POLICIES + KILLED)
    (tmp_path / "cells.yaml").write_text(COMPARISON.replace("raises", "killed"))
    run = elastic("compare", "cells.yaml", "--jobs", "2", cwd=tmp_path)
    assert run.returncode == 3, run.stderr
    assert "a worker process was killed" in run.stderr
    assert "Traceback" not in run.stderr
    assert "finished cells: 1, in runs/cells/episodes.csv" in run.stdout


def test_output_that_nobody_reads_is_no_traceback(tmp_path: Path) -> None:
    """Catches BrokenPipeError, also where the interpreter flushes at its end."""
    code = f"{sys.executable} -c 'from train.commands.entry import main; main()' --help"
    run = subprocess.run(
        f"{code} | head -n 1", shell=True, capture_output=True, text=True, timeout=120, check=True
    )
    assert "Traceback" not in run.stderr
    assert "BrokenPipe" not in run.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "code", "said"),
    [
        ("> /dev/full", 3, "No space left on device"),
        pytest.param(">&-", 0, "", marks=pytest.mark.slow),
    ],
)
def test_output_that_cannot_be_written_is_one_sentence(where: str, code: int, said: str) -> None:
    """Catches a traceback and "worse" where a log's disk is full, and a program that needs a
    standard output."""
    program = (
        f"{sys.executable} -c 'from train.commands.entry import main; main()' evaluate --help"
        f" {where}"
    )
    run = subprocess.run(
        program, shell=True, capture_output=True, text=True, timeout=120, check=False
    )
    assert run.returncode == code, run.stderr
    assert said in run.stderr
    assert len(run.stderr.splitlines()) == bool(said)


def test_an_interrupt_while_modules_load_is_one_word() -> None:
    """Catches a traceback through the imports."""
    command = [
        sys.executable,
        "-c",
        "import sys; sys.argv[1:] = ['demo']; from train.commands.entry import main;"
        " print('begins', flush=True); main()",
    ]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "begins\n"
        time.sleep(0.2)  # it loads for a second and more
        program.send_signal(signal.SIGINT)
        _, said = program.communicate(timeout=60)
    assert said.splitlines()[-1].endswith("interrupted")
    assert program.returncode == 130
    assert "Traceback" not in said


@pytest.mark.parametrize("asked", [KeyboardInterrupt, SignalError])
def test_an_interrupt_that_c_code_quotes_is_an_interrupt(asked: type[KeyboardInterrupt]) -> None:
    """Catches "a defect" where Ctrl-C comes while `ctypes` converts an argument, as while Numba
    compiles."""

    class Interrupted:
        @classmethod
        def from_param(cls, _: object) -> object:
            raise asked(signal.SIGINT)

    function = ctypes.CDLL(None).abs
    function.argtypes = [Interrupted]
    with pytest.raises(ctypes.ArgumentError) as caught:
        function(1)
    assert explain(caught.value) == ("interrupted", 130)
    assert explain(ctypes.ArgumentError("argument 1: TypeError: wrong type")) is None


def limited(size: int) -> Callable[[], None]:
    """In a child: no file may become larger [bytes], as on a disk that is full."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


@pytest.mark.slow
def test_a_file_that_cannot_grow_is_one_sentence(tmp_path: Path) -> None:
    """Catches a traceback wherever a comparison writes, and a code that says "worse"."""
    (tmp_path / "cells.yaml").write_text(COMPARISON.replace(', "mine.py:raises"', ""))
    environment = {**os.environ, "MPLCONFIGDIR": str(tmp_path)}
    commands = [(size, ["compare", "cells.yaml"]) for size in (0, 100, 2_000, 20_000)]
    for said in several(*commands, cwd=tmp_path, env=environment):
        assert said.endswith("ended with 3"), said
        assert "File too large" in said
        assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("video", "said"),
    [
        pytest.param("x.gif", "File too large", marks=pytest.mark.slow),
        ("x.mp4", "x.mp4 is not whole, 0 of"),
    ],
)
def test_a_film_that_does_not_fit_is_one_sentence(video: str, said: str, tmp_path: Path) -> None:
    """Catches an encoder that says nothing, and a writer that prints what it raises a second
    time."""
    run = elastic(
        "play", "--video", video, "--max-s", "0.2", cwd=tmp_path, preexec_fn=limited(2_000)
    )
    assert run.returncode == 3, run.stderr
    assert said in run.stderr
    assert "Traceback" not in run.stderr
    assert not (tmp_path / video).exists()


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (34.0, "30 s"),
        (62.0, "60 s"),
        (89.0, "90 s"),
        (91.0, "2 min"),
        (5399.0, "90 min"),
        (7300.0, "2 h"),
    ],
)
def test_a_time_to_go_is_said_in_words(seconds: float, said: str) -> None:
    assert duration(seconds) == said


@pytest.mark.parametrize(("whole_s", "first"), [(100.0, "  about 2 min to go"), (20.0, "  50 %")])
def test_long_work_is_announced(
    whole_s: float, first: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a minute of silence, and words about what is over in a moment."""
    now = 0.0
    out = io.StringIO()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    say = plain_progress(Console(file=out), interval_s=10.0)
    for percent in range(1, 101):
        now = whole_s * percent / 100.0
        say(percent / 100.0)
    assert out.getvalue().splitlines()[0] == first


BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in (
            "torch", "stable_baselines3", "imageio", "matplotlib", "onnx", "dynamixel_sdk", "serial",
            "distributed", "huggingface_hub",
        ):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Blocked())
"""


EXTRAS = [
    (["train", str(CONFIGS / "train_testbed.yaml")], "train"),
    (["speed", "--env", "testbed"], "train"),
    (["export", "sb3", "x.zip", str(CONFIGS / "train_testbed.yaml")], "train"),
    (["export", "onnx", "residual:x"], "onnx"),
    (["play", "--video", "x.mp4"], "report"),
    (["hardware", "scan", "/dev/ttyX"], "hardware"),
    (["hub", "push", "residual:testbed/seed_0", "me/mine"], "hub"),
]
SOON = [(arguments, extra) for arguments, extra in EXTRAS if arguments[0] in ("speed", "hub")]
"""Those that import little before they look."""


@pytest.mark.parametrize(
    "cases", [SOON, pytest.param(EXTRAS, marks=pytest.mark.slow)], ids=["soon", "all"]
)
def test_an_extra_that_is_not_installed_is_one_sentence(
    cases: list[tuple[list[str], str]], tmp_path: Path
) -> None:
    """Catches a traceback, of this process or of one that it started before it looked."""
    found = several(*[(None, arguments) for arguments, _ in cases], first=BLOCKED, cwd=tmp_path)
    for said, (_, extra) in zip(found, cases, strict=True):
        assert said.endswith("ended with 2"), said
        assert f"pip install -c constraints.txt '.[{extra}]'" in said
        assert "Traceback" not in said


@pytest.mark.slow
def test_help_comes_without_any_extra(tmp_path: Path) -> None:
    """Catches a command whose options import what only its work needs."""
    asked = [(None, [command, "--help"]) for command in COMMANDS.split()]
    assert several(*asked, first=BLOCKED, cwd=tmp_path) == ["ended with 0"] * len(asked)
