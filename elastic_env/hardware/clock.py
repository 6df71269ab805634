"""The clock of buses, supervisors and control loops: the system's, or that of an emulated bus."""

from typing import Protocol


class Clock(Protocol):
    """What the module `time` offers of it."""

    def monotonic(self) -> float:
        """Now [s]."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Let time pass [s]."""
        ...
