"""Figure of a servo's identification: measured and replayed angles, and the goal."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from baselines.identification.servo_log import ServoLog
from elastic_env.core.signals import Array
from train.figures.plots import MRAD, label_text, new_figure, save

_COLUMNS = 3
_MEASURED = "#222222"
_REPLAYED = "#d1495b"
_GOAL = "#9aa5b1"
_MOST_SHOWN = 12


def draw_servo(
    logs: Sequence[ServoLog], played: Sequence[Array], path: Path, *, is_held_out: bool
) -> Path:
    """A panel per log, with the goal, the measured and the replayed angle.

    Args:
        logs: Logs; the first twelve are shown.
        played: Replayed angles of each, (N,) [rad].
        path: PNG file.
        is_held_out: True if the replay was not fitted to them; the title says so.
    """
    shown = list(zip(logs, played, strict=True))[:_MOST_SHOWN]
    columns = min(_COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    figure, axes = new_figure(rows, columns, (4.3 * columns, 2.7 * rows + 0.4))
    for axis, (log, q) in zip(axes, shown, strict=False):
        goal = np.where(log.enabled, log.goal, np.nan)
        axis.plot(log.time, goal, "--", color=_GOAL, lw=1.2, label="goal")
        axis.plot(log.time, log.position, color=_MEASURED, lw=1.6, label="measured")
        axis.plot(log.time, q, color=_REPLAYED, lw=1.2, label="replayed")
        rms = MRAD * float(np.sqrt(np.mean((q - log.position) ** 2)))
        gain = "" if log.gain == 1.0 else f", gain {log.gain:g}"
        axis.set_title(label_text(f"{log.name}{gain}: {rms:.1f} mrad rms"), fontsize=9)
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    axes[0].legend(fontsize=8)
    figure.supxlabel("time [s]", fontsize=10)
    figure.supylabel("angle [rad]", fontsize=10)
    if is_held_out:
        figure.suptitle("logs that were not fitted", fontsize=11)
    return save(figure, path)
