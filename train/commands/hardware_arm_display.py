"""Output of an arm's motion on the console: a live table now and then, a table at the end."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from elastic_env.hardware.live.arm_state import ArmState
from train.runs.console import can_redraw, make_table

_REDRAW_S = 0.5
"""Time between two live tables at a terminal [s]."""
_REPRINT_S = 5.0
"""Time between two live tables where lines go into a file [s]."""


def rest_table(rests: Sequence[ArmState], joints: Sequence[str]) -> Table:
    """Table of the distances between estimated links and poses, at the end of each pose."""
    errors = 1e3 * np.array([state.link - state.target for state in rests])
    rms = np.sqrt(np.mean(errors**2, axis=0))
    columns = zip(joints, rms, np.abs(errors).max(axis=0), strict=True)
    rows = [[name, f"{error:.1f}", f"{most:.1f}"] for name, error, most in columns]
    poses = "1 pose" if len(errors) == 1 else f"{len(errors)} poses"
    title = f"estimated link from its target at {poses} [mrad]"
    return make_table(title, ["joint", "rms", "largest"], rows)


@contextlib.contextmanager
def throttled_display(console: Console) -> Iterator[Callable[[Callable[[], str]], None]]:
    """Give a function that shows a text now and then: in place at a terminal, else below.

    Below, the first text comes after the first period: an arm begins uncompensated.
    """
    is_redrawn = can_redraw(console)
    period_s = _REDRAW_S if is_redrawn else _REPRINT_S
    next_s = time.monotonic() + (0.0 if is_redrawn else period_s)
    live = Live(console=console, auto_refresh=False) if is_redrawn else None

    def show(text: Callable[[], str]) -> None:
        nonlocal next_s
        if time.monotonic() < next_s:
            return
        next_s = time.monotonic() + period_s
        if live is None:
            console.print(text())
        else:
            live.update(Text(text()), refresh=True)

    with live or contextlib.nullcontext():
        yield show
