"""Folders of results: each for one program alone, and none elsewhere than where it should be."""

import errno
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from elastic_env.core.errors import ConfigurationError, SystemFailedError
from train.learn.run_training import resume
from train.runs.folders import free_folder, locked, new_run


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_programs_that_begin_at_the_same_moment_get_a_folder_each() -> None:
    """Catches a free name that is looked up first and taken later."""
    barrier, found = threading.Barrier(30), list[Path]()

    def begin() -> None:
        barrier.wait()
        found.append(free_folder("x"))

    threads = [threading.Thread(target=begin) for _ in range(30)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 30
    assert all(folder.is_dir() for folder in found)


@pytest.mark.parametrize("name", ["../../elsewhere", "/tmp/elsewhere", "..", ".", "", "a/b", "a\\b", "a\0b"])
def test_a_name_leads_nowhere_else(name: str, tmp_path: Path) -> None:
    """Catches a configuration that writes outside of runs."""
    with pytest.raises(ConfigurationError, match="name must be the name of a folder in runs"):
        new_run(name, {}, 0)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("obstacle", ["file", "dangling link"])
def test_what_is_in_the_way_is_said(obstacle: str, tmp_path: Path) -> None:
    """Catches a traceback where runs is a file or a link to nowhere."""
    runs = tmp_path / "runs"
    if obstacle == "file":
        runs.write_text("")
    else:
        runs.symlink_to(tmp_path / "nowhere")
    with pytest.raises(SystemFailedError, match="no folder for results can be made at runs"):
        free_folder("x")


def test_a_run_that_cannot_be_described_leaves_no_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Catches a folder with a configuration alone, where the disk got full behind it."""
    monkeypatch.setattr(Path, "write_text", full_at("metadata.json"))
    with pytest.raises(OSError, match="No space"):
        new_run("x", {"a": 1}, 0)
    assert list((tmp_path / "runs").iterdir()) == []


def full_at(name: str) -> Callable[..., int]:
    """`Path.write_text` on a disk that gets full at a file."""
    write = Path.write_text

    def write_text(path: Path, text: str, **options: Any) -> int:
        if path.name == name:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, text, **options)

    return write_text


HOLD = """
import sys
from pathlib import Path
from train.runs.folders import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_run_is_worked_on_by_one_program_and_a_kill_frees_it(tmp_path: Path) -> None:
    """Catches two --resume of one run at once, a lock that outlives its program, and one that nobody waits for."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        cwd=Path(__file__).parents[1],
    ) as other:  # fmt: skip
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with (
            pytest.raises(ConfigurationError, match=f"another program, process {other.pid} of .*, works on"),
            locked(tmp_path),
        ):
            pass
        seed = tmp_path / "seed_3"
        seed.mkdir()
        with (
            pytest.raises(ConfigurationError, match=r"process \d+ of .*, works on .*seed_3"),
            locked(seed),
            locked(seed),
        ):
            pass
        threading.Timer(0.3, other.kill).start()
        with locked(tmp_path, patience_s=60.0):
            pass
        other.wait()
        with locked(tmp_path):
            assert (tmp_path / ".lock").read_text() == f"{os.getpid()} of {platform.node()}\n"


def test_a_run_that_is_resumed_runs_no_code_of_its_folder(tmp_path: Path) -> None:
    """Catches a folder from elsewhere whose algorithm lies beside its configuration."""
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass Algorithm: pass\n")
    text = (Path(__file__).parents[1] / "configs" / "train_testbed.yaml").read_text()
    (tmp_path / "config.yaml").write_text(f"algorithm: evil:Algorithm\n{text}")
    with pytest.raises(ConfigurationError, match=r"whose code would run.*--trust-code"):
        resume([tmp_path], Console(quiet=True))
    assert not (tmp_path / "ran").exists()
