"""Figure of recorded poses: held-out errors by prediction, and by the number of poses."""

from collections.abc import Sequence
from pathlib import Path

from docs.recorded.justin import GUESSED, VARIANTS, HandError
from train.figures.plots import require_matplotlib, save

_OWN = "#2a6f97"
_OTHER = "#9aa5b1"
_SHADES = ("#89c2d9", "#468faf", "#014f86")


def draw_hand_errors(rows: Sequence[HandError], path: Path) -> Path:
    """Mean error of a hand from most poses, and of what was identified from fewer."""
    plt = require_matplotlib()
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 3.6), width_ratios=(1.3, 1.0))
    own = [variant.name for variant in VARIANTS]
    most = max(row.poses for row in rows)
    full = [row for row in rows if row.poses == most and row.masses == GUESSED]
    for place, row in enumerate(full):
        left.barh(place, row.mean_mm, color=_OWN if row.prediction in own else _OTHER)
        left.text(row.mean_mm + 0.2, place, f"{row.mean_mm:.1f}", va="center", fontsize=9)
    left.set_yticks(range(len(full)), [row.prediction for row in full])
    left.set_xlim(0.0, 1.12 * max(row.mean_mm for row in full))
    left.set_xlabel("mean error of a hand [mm]")
    left.set_title(f"{most} poses fitted, {full[0].held_out} held out")
    left.invert_yaxis()
    for name, shade in zip(own, _SHADES, strict=True):
        points = [row for row in rows if row.prediction == name and row.masses == GUESSED]
        points = sorted(points, key=lambda row: row.poses)
        means = [row.mean_mm for row in points]
        right.plot([row.poses for row in points], means, "o-", color=shade, label=name)
    counts = sorted({row.poses for row in rows})
    right.set_xscale("log")
    right.set_xticks(counts, [f"{count}" for count in counts])
    right.minorticks_off()
    right.set_ylim(0.0, None)
    right.set_xlabel("poses that were fitted")
    right.set_ylabel("mean error of a hand [mm]")
    right.legend(fontsize=8)
    figure.tight_layout()
    return save(figure, path)
