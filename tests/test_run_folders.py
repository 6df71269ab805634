"""Folders of results: each for one program alone, and none elsewhere than where it should be."""

import errno
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from elastic_env.core.errors import ConfigurationError, SystemFailedError
from elastic_env.core.files import read_bounded, write_whole
from train.commands.compare_config import CompareConfig
from train.learn.run_training import resume
from train.runs.folders import (
    create_folder,
    lock_run,
    record_results,
    record_run,
    require_run,
    run_folder,
)
from train.runs.user_code import recorded_config


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_programs_that_begin_at_the_same_moment_get_a_folder_each() -> None:
    """Catches a free name that is looked up first and taken later."""
    barrier = threading.Barrier(30)
    found = list[Path]()

    def begin() -> None:
        barrier.wait()
        found.append(create_folder("x"))

    threads = [threading.Thread(target=begin) for _ in range(30)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 30
    assert all(folder.is_dir() for folder in found)


@pytest.mark.parametrize(
    "name", ["../../elsewhere", "/tmp/elsewhere", "..", ".", "", "a/b", "a\\b", "a\0b"]
)
def test_a_name_leads_nowhere_else(name: str, tmp_path: Path) -> None:
    """Catches a configuration that writes outside of runs."""
    with pytest.raises(ConfigurationError, match="name must be the name of a folder in runs"):
        create_folder(name)
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
        create_folder("x")


def test_a_run_that_cannot_be_described_leaves_no_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a folder with a configuration alone, where the disk got full behind it."""
    monkeypatch.setattr("train.runs.folders.write_whole", full_at("metadata.json"))
    with pytest.raises(OSError, match="No space"):
        run_folder("x", {"a": 1}, 0).__enter__()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_ctrl_c_removes_is_named() -> None:
    """Catches a run that disappears without a word, and a missing folder without a config.yaml."""
    with pytest.raises(KeyboardInterrupt) as caught, run_folder("mine", {}, 0):
        raise KeyboardInterrupt
    assert caught.value.__notes__ == ["nothing was finished, and runs/mine is removed"]
    with pytest.raises(ConfigurationError, match="there is no folder runs/mine; name a run"):
        require_run(Path("runs/mine"))


def full_at(name: str) -> Callable[..., None]:
    """`write_whole` on a disk that gets full at a file."""

    def write(path: Path, text: str) -> None:
        if path.name == name:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_whole(path, text)

    return write


HOLD = """
import sys
from pathlib import Path
from train.runs.folders import lock_run
with lock_run(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.slow
def test_a_run_is_worked_on_by_one_program_and_a_kill_frees_it(tmp_path: Path) -> None:
    """Catches two --resume of one run at once, a lock that outlives its program, and one that
    nobody waits for."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[1],
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with (
            pytest.raises(
                ConfigurationError, match=f"another program, process {other.pid} of .*, works on"
            ),
            lock_run(tmp_path),
        ):
            pass
        seed = tmp_path / "seed_3"
        seed.mkdir()
        with (
            pytest.raises(ConfigurationError, match=r"process \d+ of .*, works on .*seed_3"),
            lock_run(seed),
            lock_run(seed),
        ):
            pass
        threading.Timer(0.3, other.kill).start()
        with lock_run(tmp_path, patience_s=60.0):
            pass
        other.wait()
        with lock_run(tmp_path):
            assert (tmp_path / ".lock").read_text() == f"{os.getpid()} of {platform.node()}\n"


def mark_when_imported(folder: Path) -> Path:
    """A module and a package, `evil` and `evil_room.inner`, whose import leaves a mark: the file
    of it."""
    mark = folder / "ran"
    for name in ("evil.py", "residual:evil.py", "evil_room/__init__.py", "evil_room/inner.py"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(
            f"open({str(mark)!r}, 'w')\nROBOT = make = Algorithm = lambda env: None\n"
        )
    return mark


CODE = ["evil.py:make", "evil:make", "evil_room.inner:make", "./evil.py:make"]


@pytest.mark.parametrize("code", [*CODE, "residual:evil.py:make"])
@pytest.mark.parametrize("field", ["algorithm", "env", "base"])
def test_a_training_that_is_resumed_runs_no_code_of_its_folder(
    field: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a folder from elsewhere whose algorithm, robot or base lies beside its
    configuration."""
    monkeypatch.syspath_prepend(str(tmp_path))
    mark = mark_when_imported(tmp_path)
    (tmp_path / "config.yaml").write_text(f"{field}: '{code}'\n")
    with pytest.raises(
        ConfigurationError, match=r"whose code would run.*--trust-code|must be no residual"
    ):
        resume([tmp_path], Console(quiet=True))
    assert not mark.exists()


FIELDS = {
    "env": "env: '{}'",
    "policy": "policies: ['{}']",
    "policy's name": "policies: [{{name: '{}', label: mine}}]",
    "env without sense": "env: '{}'\nmap: {{x: 3}}",
}


@pytest.mark.parametrize("code", CODE)
@pytest.mark.parametrize("field", FIELDS)
def test_a_comparison_that_is_resumed_runs_no_code_of_its_folder(
    field: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an import while the configuration is read, before anybody asked whether the folder
    is trusted."""
    monkeypatch.syspath_prepend(str(tmp_path))
    mark = mark_when_imported(tmp_path)
    (tmp_path / "config.yaml").write_text(f"name: x\n{FIELDS[field].format(code)}\n")
    with pytest.raises(ConfigurationError, match=r"whose code would run.*--trust-code"):
        recorded_config(tmp_path, CompareConfig)
    assert not mark.exists()


def test_a_robot_that_is_called_like_a_residual_is_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an exception for policies in folders that holds for other fields too."""
    mark = mark_when_imported(tmp_path)
    (tmp_path / "config.yaml").write_text("name: x\nenv: 'residual:evil.py:ROBOT'\n")
    with pytest.raises(ConfigurationError, match="whose code would run"):
        recorded_config(tmp_path, CompareConfig)
    assert not mark.exists()


def test_a_comparison_that_is_trusted_runs_its_code(tmp_path: Path) -> None:
    """Catches a folder of one's own that cannot be gone on with."""
    mark_when_imported(tmp_path)
    (tmp_path / "config.yaml").write_text("name: x\npolicies: ['evil.py:make', 'residual:evil']\n")
    assert (
        recorded_config(tmp_path, CompareConfig, trust_code=True).policies[0].name == "evil.py:make"
    )


@pytest.mark.parametrize(
    "place", ["summary.md", "cells", "cells/x.npz", ".lock", "config.yaml", "seed_0/best.new"]
)
def test_a_run_with_a_link_out_of_it_is_not_gone_on_with(place: str, tmp_path: Path) -> None:
    """Catches files of the user's that are overwritten, locked or read through a run from
    elsewhere."""
    run = tmp_path / "run"
    (run / place).parent.mkdir(parents=True)
    mine = tmp_path / "mine"
    mine.write_text("name: x\n")
    if place != "config.yaml":
        (run / "config.yaml").write_text("name: x\n")
    (run / place).symlink_to("../" * place.count("/") + "../mine")
    for go_on in (
        lambda folder: recorded_config(folder, CompareConfig),
        lambda folder: resume([folder], Console(quiet=True)),
    ):
        with pytest.raises(ConfigurationError, match=f"{place} is a link that leads out of .*run"):
            go_on(run)
    assert mine.read_text() == "name: x\n"


def test_a_run_with_a_pipe_is_not_gone_on_with(tmp_path: Path) -> None:
    """Catches a checkpoint, a table or a cell that is waited for."""
    (tmp_path / "seed_0").mkdir()
    os.mkfifo(tmp_path / "seed_0" / "progress.csv")
    (tmp_path / "config.yaml").write_text("name: x\n")
    with pytest.raises(ConfigurationError, match=r"progress\.csv is neither a file nor a folder"):
        resume([tmp_path], Console(quiet=True))


@pytest.mark.parametrize("text", ["", "decisions,scenario\n", "\0", "decisions\nx\n", "[" * 9000])
def test_a_broken_table_of_a_training_is_one_sentence(text: str, tmp_path: Path) -> None:
    """Catches a traceback where the seeds of a run are complete and their table is not."""
    (tmp_path / "seed_0" / "last").mkdir(parents=True)
    (tmp_path / "seed_0" / "progress.csv").write_text(text)
    (tmp_path / "config.yaml").write_text("name: x\n")
    with pytest.raises(
        ConfigurationError,
        match=r"progress\.csv (must be the table of a training|has no evaluations)",
    ):
        resume([tmp_path], Console(quiet=True))


def test_results_of_another_configuration_do_not_stay(tmp_path: Path) -> None:
    """Catches a report of policies that the configuration beside it no longer has, and a list of
    files that removes others'."""
    folder = tmp_path / "run"
    folder.mkdir()
    (tmp_path / "mine.txt").write_text("mine")
    (folder / "notes.md").write_text("mine")
    record_run(folder, {"policy": "input"}, 0)
    (folder / "report.md").write_text("input")
    record_results(folder, [folder / "report.md"])
    record_run(folder, {"policy": "input"}, 0)
    assert (folder / "report.md").is_file()
    record_run(folder, {"policy": "dynamic"}, 0)
    assert not (folder / "report.md").exists()
    for results in (["../mine.txt", "metadata.json", "config.yaml", "..", ".", 3, ["x"]], 7, "n"):
        content = json.loads((folder / "metadata.json").read_text())
        (folder / "metadata.json").write_text(json.dumps({**content, "results": results}))
        record_run(folder, {"policy": "zero"}, 0)
        assert sorted(file.name for file in folder.iterdir()) == [
            "config.yaml",
            "metadata.json",
            "notes.md",
        ]
    assert (tmp_path / "mine.txt").is_file()


def test_a_run_may_be_a_link_and_have_links_to_itself(tmp_path: Path) -> None:
    """Catches a refusal of runs/latest, and of a best policy that is a link to one of the run's
    own."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("name: x\n")
    (tmp_path / "run" / "best").symlink_to("last")
    (tmp_path / "latest").symlink_to("run")
    assert require_run(tmp_path / "latest").name == "config.yaml"


@pytest.mark.parametrize("kind", ["link", "second name", "pipe", "folder"])
def test_a_lock_is_a_file_of_its_own(kind: str, tmp_path: Path) -> None:
    """Catches a lock through which another file is emptied, or that is waited for."""
    mine = tmp_path / "mine"
    mine.write_text("mine")
    lock = tmp_path / ".lock"
    {
        "link": lambda: lock.symlink_to(mine),
        "second name": lambda: lock.hardlink_to(mine),
        "pipe": lambda: os.mkfifo(lock),
        "folder": lock.mkdir,
    }[kind]()
    with (
        pytest.raises(ConfigurationError, match="must be a plain file with one name"),
        lock_run(tmp_path),
    ):
        pass
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("link", ["symbolic", "hard"])
def test_a_file_is_written_in_the_place_of_a_link(link: str, tmp_path: Path) -> None:
    """Catches a writer that follows a link, at the file or beside it, and one that keeps the
    group from reading."""
    mine = tmp_path / "mine"
    summary = tmp_path / "summary.md"
    mine.write_text("mine")
    for path in (summary, tmp_path / f".summary.md.{os.getpid()}.new"):
        (path.symlink_to if link == "symbolic" else path.hardlink_to)(mine)
    write_whole(summary, "äöü")
    assert mine.read_text() == "mine"
    assert summary.read_bytes() == "äöü".encode()
    assert not summary.is_symlink()
    plain = tmp_path / "plain"
    plain.touch()
    assert summary.stat().st_mode == plain.stat().st_mode
    assert {path.name for path in tmp_path.iterdir()} == {"mine", "summary.md", "plain"}


def test_a_file_is_read_within_its_bounds(tmp_path: Path) -> None:
    """Catches a pipe that is waited for, a device without an end, and a large file that is read
    to be refused."""
    file = tmp_path / "file"
    pipe = tmp_path / "pipe"
    link = tmp_path / "link"
    file.write_bytes(b"12345")
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    assert read_bounded(file, 5, within=tmp_path) == b"12345"
    with pytest.raises(ConfigurationError, match="at most 4 bytes, it has 5"):
        read_bounded(file, 4)
    with pytest.raises(ConfigurationError, match="must be a plain file"):
        read_bounded(pipe, 5)
    with pytest.raises(ConfigurationError, match="must be a plain file"):
        read_bounded(link, 5)
    with pytest.raises(ConfigurationError, match="is a link out of its folder"):
        read_bounded(link, 5, within=tmp_path)
    with pytest.raises(ConfigurationError, match="at most 5 bytes"):
        read_bounded(Path("/proc/self/environ"), 5)
    with pytest.raises(IsADirectoryError):
        read_bounded(tmp_path, 5)
