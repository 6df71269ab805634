"""Whether a program has been killed, before the system has closed what it had open.

A program that is killed closes its end of the channel late: it first needs a processor to end on, and gives its memory
back before its files. On a busy computer that takes as long as a hang does. Linux tells of it at once.
"""

import signal
from pathlib import Path

_PROC = Path("/proc")
_KILLED = 1 << (signal.SIGKILL - 1)
_EXITING, _DUMPING, _SIGNALED = 0x4, 0x200, 0x400  # PF_EXITING, PF_DUMPCORE, PF_SIGNALED of linux/sched.h
_FLAGS = 6  # of the fields behind the name, see proc(5)


def is_ending(process_id: int, proc: Path = _PROC) -> bool:
    """Whether a process has been killed, ends, writes its core, or is gone; False where the system does not tell.

    Args:
        process_id: Of the process.
        proc: Folder in which Linux tells of processes.
    """
    folder = proc / str(process_id)
    try:
        status = (folder / "status").read_text()
        stat = (folder / "stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return (proc / "self").exists()
    except OSError:
        return False
    fields = stat.rpartition(")")[2].split()
    return _is_killed(status) or fields[0] in "ZX" or bool(int(fields[_FLAGS]) & (_EXITING | _DUMPING | _SIGNALED))


def _is_killed(status: str) -> bool:
    """Whether SIGKILL waits for the process to run."""
    pending = [line.split()[1] for line in status.splitlines() if line.startswith(("SigPnd:", "ShdPnd:"))]
    return any(int(mask, 16) & _KILLED for mask in pending)
