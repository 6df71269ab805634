"""Clock of buses, supervisors and control loops: that of the system, or of an emulated bus."""

from typing import Protocol


class Clock(Protocol):
    """A clock that only runs forwards, such as the module `time`."""

    def monotonic(self) -> float:
        """Present time [s]."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait for a time [s]."""
        ...
