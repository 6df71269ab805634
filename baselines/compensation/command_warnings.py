"""Warnings of `PositionCompensator`, at the line of the program that uses it."""

import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from elastic_env.core.signals import Array

_FOLDER = str(Path(__file__).parent)
_SMALLEST_JUMP_RAD = 1e-3
"""Jump of a command from which on a warning follows [rad]."""
_CALM_RAD_S = 0.02
"""Rate of a command that moves the robot calmly [rad/s]."""


def warn_caller(message: str) -> None:
    """Warn at the line of the program that called this folder."""
    level = 2
    frame = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename.startswith(_FOLDER):
        frame = frame.f_back
        level += 1
    warnings.warn(message, stacklevel=level)


@dataclass(frozen=True)
class CommandWarnings:
    """Warnings about commands, each of them once.

    Attributes:
        joints: Names of the joints.
        lowest, highest: Joint ranges, (n,) each [rad].
        limit_rad: Largest offset between command and desired angle [rad].
        topics: Topics of earlier warnings.
    """

    joints: tuple[str, ...]
    lowest: Array
    highest: Array
    limit_rad: float
    topics: set[str] = field(default_factory=set)

    def warn_of_range(self, command: Array) -> None:
        """Warn of a command, (n,) [rad], that is beyond a joint range."""
        excess = np.maximum(self.lowest - command, command - self.highest)
        if excess.max() > 0.0:
            worst = int(excess.argmax())
            ends = f"{self.lowest[worst]:.4g} to {self.highest[worst]:.4g} rad"
            self._warn_once(
                "range",
                f"joint {self.joints[worst]!r} needs the command {command[worst]:.4g}"
                f" rad, beyond its range of {ends} in the model: its link stays"
                f" {excess[worst]:.2g} rad short; keep q_desired that far from the end",
            )

    def warn_of_limit(self, offsets: Array, when: str) -> None:
        """Warn of offsets, (n,) [rad], one of which is beyond `limit_rad`."""
        needed = float(offsets.max())
        joint = self.joints[offsets.argmax()]
        digit = 10.0 ** (np.floor(np.log10(needed)) - 1.0)
        enough = np.ceil(1.05 * needed / digit) * digit
        self._warn_once(
            "limit_rad",
            f"the load needs an offset of {needed:.3g} rad of joint {joint!r} {when},"
            f" and commands are cut at limit_rad = {self.limit_rad:g}: the link ends"
            f" short of where it should be; limit_rad={enough:.3g} is enough",
        )

    def warn_of_jump(self, jump: Array, has_ramp: bool) -> None:
        """Warn of a payload that moved the command at once, by `jump`, (n,) [rad]."""
        worst = int(np.abs(jump).argmax())
        size = float(np.abs(jump[worst]))
        if size <= _SMALLEST_JUMP_RAD:
            return
        ramp_s = max(np.ceil(size / _CALM_RAD_S * 10.0) / 10.0, 0.5)
        cure = f"ramp_s={ramp_s:.3g} takes it over in that time"
        if has_ramp:
            cure = "set the payload to 0 where it was, and let ramp_s pass before"
        self._warn_once(
            "jump",
            f"the payload moves the command of joint {self.joints[worst]!r} by"
            f" {1e3 * size:.3g} mrad at once; {cure}",
        )

    def _warn_once(self, topic: str, text: str) -> None:
        if topic not in self.topics:
            self.topics.add(topic)
            warn_caller(text)
