"""Child processes: their start, their messages, and the detection of their end.

`python -m` puts the working directory first on the import path. A `serial.py` there would run in
the process that must switch torque off. Here a child

* has no working directory on its path: by `-P`, and by a PYTHONPATH without any spelling of it.
  The rest of PYTHONPATH and the user's own packages stay, since the driver's packages may be
  installed there (`-I` would drop them);
* loads our packages from the folders of this program, one of which may be the working directory,
  without a search.

A child runs this file first: it imports only the standard library.
"""

import importlib
import importlib.util
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

Process: TypeAlias = "subprocess.Popen[str]"

_PACKAGE = "elastic_env"
_PATH = "PYTHONPATH"
_LONGEST_MESSAGE = 65536

_PROC = Path("/proc")
_KILLED = 1 << (signal.SIGKILL - 1)
_ENDING = 0x4 | 0x200 | 0x400  # PF_EXITING, PF_DUMPCORE, PF_SIGNALED of linux/sched.h
_FLAGS = 6  # of the fields behind the name, see proc(5)


def child_command(module: str, *arguments: str) -> list[str]:
    """Command that runs a module of ours in a child process.

    Args:
        module: Name of the module, such as elastic_env.hardware.safety.supervisor.
        *arguments: Its arguments in `sys.argv`.
    """
    names = dict.fromkeys((_PACKAGE, module.partition(".")[0]))
    folders = os.pathsep.join(str(_folder(name)) for name in names)
    this_file = str(Path(__file__).resolve())
    return [sys.executable, "-P", this_file, folders, module, *arguments]


def start_child(module: str, *arguments: str, **options: Any) -> Process:
    """Run a module of ours in a child process with its own session.

    Args:
        module: As in `child_command`.
        *arguments: As in `child_command`.
        **options: Further arguments of `subprocess.Popen`: its pipes and descriptors.
    """
    command = child_command(module, *arguments)
    return subprocess.Popen(
        command, env=child_environment(), text=True, start_new_session=True, **options
    )


def end_child(process: Process, within_s: float) -> None:
    """End a child that stops when its input is closed; kill it if it does not within a time [s]."""
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
    try:
        process.wait(timeout=within_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def child_environment(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Environment variables of a child, without the working directory in PYTHONPATH.

    Args:
        environment: Variables by name, default those of this program.
    """
    here = os.path.realpath(".")  # an empty entry means the same
    folders = environment.get(_PATH, "").split(os.pathsep)
    entries = [path for path in folders if path and os.path.realpath(path) != here]
    others = {name: value for name, value in environment.items() if name != _PATH}
    return {**others, _PATH: os.pathsep.join(entries)} if entries else others


def _folder(package: str) -> Path:
    """Folder from which this program has loaded a package."""
    file = importlib.import_module(package).__file__
    assert file is not None
    return Path(file).resolve().parent


def _load(folder: Path) -> None:
    """Import a package from its folder."""
    spec = importlib.util.spec_from_file_location(
        folder.name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules[folder.name] = package
    spec.loader.exec_module(package)


def _run(folders: str, module: str, arguments: Sequence[str]) -> None:
    """Run a module as `python -m` would."""
    for folder in folders.split(os.pathsep):
        _load(Path(folder))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


class Channel:
    """One end of a pair of sockets for messages, one JSON object each.

    Args:
        end: Socket that keeps messages separate (SOCK_SEQPACKET).
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    @staticmethod
    def pair() -> tuple[socket.socket, socket.socket]:
        """Create both ends."""
        return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def send(self, message: dict[str, Any]) -> None:
        """Send a message.

        Raises:
            OSError: The other end is gone.
        """
        self._end.send(json.dumps(message).encode())

    def is_waiting(self, timeout_s: float | None) -> bool:
        """Wait for a time; return True once a message comes, or the other end closes."""
        return bool(select.select([self._end], [], [], timeout_s)[0])

    def receive(self) -> dict[str, Any] | None:
        """Receive the next message; None if the other end is gone."""
        try:
            data = self._end.recv(_LONGEST_MESSAGE)
        except ConnectionError:
            return None
        return json.loads(data) if data else None

    def close(self) -> None:
        """Close this end."""
        self._end.close()


def is_ending(process_id: int, proc: Path = _PROC) -> bool:
    """Return True if a process has been killed, is ending, writes its core, or is gone.

    Return False if the system does not report it.

    A killed program closes its end of a channel late. It first needs a processor to end on, and
    releases its memory before its files. On a busy computer that takes as long as a hang does.
    Linux reports the kill at once.

    Args:
        process_id: Id of the process.
        proc: Folder in which Linux describes processes.
    """
    folder = proc / str(process_id)
    try:
        status = (folder / "status").read_text()
        stat = (folder / "stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return (proc / "self").exists()
    except OSError:
        return False
    lines = [line.split() for line in status.splitlines() if line.strip()]
    pending = [line[1] for line in lines if line[0] in ("SigPnd:", "ShdPnd:")]
    is_killed = any(int(mask, 16) & _KILLED for mask in pending)
    fields = stat.rpartition(")")[2].split()
    return is_killed or fields[0] in "ZX" or bool(int(fields[_FLAGS]) & _ENDING)


if __name__ == "__main__":
    _run(sys.argv[1], sys.argv[2], sys.argv[3:])
