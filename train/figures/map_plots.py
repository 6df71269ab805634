"""Heat maps as panels of coloured squares with text, for the page and for pictures."""

import math
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np

from train.evaluate.change_text import BEST_ANALYTIC, SIGNS, percent
from train.evaluate.environments import Column
from train.evaluate.maps import HeatMap, MapCell
from train.figures.colours import INK, policy_colours
from train.figures.plots import new_figure, save

_AHEAD = "#1a7f5a"
_BEHIND = "#b42318"
_SCORE = "#2a6f97"
_EMPTY = "#f1f3f5"
_STRONGEST = 0.75
_STRONGEST_CHANGE = 1.0
"""Share of a colour in the strongest square, and the smallest change that has this share."""
_BEST_SHARE = 0.32
"""Share of a policy's colour in a square that it wins."""


@dataclass(frozen=True)
class Square:
    """A cell of a panel.

    Attributes:
        text: Its text.
        small: A second line; empty for none.
        colour: Colour of its background.
    """

    text: str
    small: str
    colour: str

    @property
    def ink(self) -> str:
        """Colour of its text: light on a dark background."""
        red, green, blue = _rgb(self.colour)
        return "#ffffff" if 0.299 * red + 0.587 * green + 0.114 * blue < 128.0 else INK


@dataclass(frozen=True)
class Panel:
    """One heat map: the best policy, the change of a residual, or the score of a policy.

    Attributes:
        title: Its title.
        x_label, y_label: Titles of the axes.
        x_ticks, y_ticks: Texts of their values.
        squares: (len(y_ticks), len(x_ticks)), the smallest y first.
        is_main: True if pictures show it too.
        key: Letters, policies and colours that its squares refer to.
    """

    title: str
    x_label: str
    y_label: str
    x_ticks: list[str]
    y_ticks: list[str]
    squares: list[list[Square]]
    is_main: bool = True
    key: tuple[tuple[str, str, str], ...] = ()


def panels(heat_map: HeatMap) -> list[Panel]:
    """The best policy, changes of residuals against the best without learning, and scores."""
    column = heat_map.column
    policies = heat_map.table.policies
    x_ticks, y_ticks = heat_map.ticks
    shades = policy_colours(policies)
    # a map with more policies than letters would not be readable
    letters = dict(zip(policies, ascii_uppercase, strict=False))
    key = tuple((letters.get(title, "?"), title, shades[title]) for title in policies)
    rivals = {cell.best_analytic for cell in heat_map.flat} - {None}
    rival_letters = letters if len(rivals) > 1 else {}
    levels = [level.value for cell in heat_map.flat for level in cell.levels.values()]
    positive = [level for level in levels if np.isfinite(level) and level > 0.0]
    ends = (min(positive, default=1.0), max(positive, default=1.0))

    def panel(title: str, square: Callable[[MapCell], Square], **more: Any) -> Panel:
        return Panel(
            title=title,
            x_label=heat_map.axes.x.title,
            y_label=heat_map.axes.y.title,
            x_ticks=x_ticks,
            y_ticks=y_ticks,
            squares=[list(map(square, row)) for row in heat_map.cells],
            **more,
        )

    best = partial(_best_square, column=column, letters=letters, shades=shades)
    result = [panel(f"Best policy, and its {column.label}", best, key=key)]
    for title in heat_map.table.members:
        change = partial(_change_square, title=title, letters=rival_letters)
        text = f"{title} against the {BEST_ANALYTIC}, change of {column.title} [%]"
        result.append(panel(text, change))
    for title in policies:
        score = partial(_score_square, title=title, column=column, ends=ends)
        result.append(panel(f"{title}, {column.label}", score, is_main=False))
    return result


def draw_map(heat_map: HeatMap, path: Path) -> Path:
    """Draw the main panels of a map, one below the other, narrow enough for a telephone."""
    main_panels = [panel for panel in panels(heat_map) if panel.is_main]
    columns, rows = map(len, heat_map.ticks)
    size = max(0.72 * columns + 0.9, 4.4), (0.5 * rows + 1.25) * len(main_panels) + 0.35
    figure, axes = new_figure(len(main_panels), 1, size)
    for axis, panel in zip(axes, main_panels, strict=True):
        _draw_panel(axis, panel)
    figure.suptitle(heat_map.title, fontsize=9, color="#59636e")
    return save(figure, path)


def _best_square(
    cell: MapCell, column: Column, letters: Mapping[str, str], shades: Mapping[str, str]
) -> Square:
    if cell.best is None:
        return Square("-", "", _EMPTY)
    score = _score_text(cell.levels[cell.best].value, column)
    small = f"{score}{_failures_text(cell.failed[cell.best])}"
    colour = blend(shades[cell.best], _BEST_SHARE)
    return Square(letters.get(cell.best, "?"), small, colour)


def _change_square(cell: MapCell, title: str, letters: Mapping[str, str]) -> Square:
    """Square of a change, with the sign of its verdict; green below zero, red above."""
    change = cell.learned.get(title)
    if change is None or not np.isfinite(change.relative.value):
        return Square("-", "", _EMPTY)
    value = change.relative.value
    share = _STRONGEST * min(abs(value) / _STRONGEST_CHANGE, 1.0)
    small = f"to {letters[change.base]}" if change.base in letters else ""
    falls = f" ✕{change.falls}/{change.episodes}" if change.falls_more else ""
    text = percent(value).removesuffix(" %") + SIGNS.get(change.verdict, "")
    colour = blend(_AHEAD if value < 0.0 else _BEHIND, share)
    return Square(text, f"{small}{falls}".strip(), colour)


def _score_square(cell: MapCell, title: str, column: Column, ends: tuple[float, float]) -> Square:
    failures = _failures_text(cell.failed.get(title, (0, 0))).strip()
    if title not in cell.levels or not cell.levels[title].is_known:
        return Square("-", failures, _EMPTY)
    value = cell.levels[title].value
    low, high = map(math.log, ends)
    share = (math.log(max(value, ends[0])) - low) / (high - low) if high > low else 0.0
    colour = blend(_SCORE, 0.06 + (_STRONGEST - 0.06) * share)
    return Square(_score_text(value, column), failures, colour)


def _failures_text(failed: tuple[int, int]) -> str:
    return f" ✕{failed[0]}/{failed[1]}" if failed[0] else ""


def _score_text(value: float, column: Column) -> str:
    """A score with at most one decimal, since a square has little room."""
    return f"{column.scale * value:.{min(column.decimals, 1)}f}"


def blend(colour: str, share: float) -> str:
    """Mix a share of a colour with white."""
    return "#" + "".join(
        f"{round(share * part + (1.0 - share) * 255):02x}" for part in _rgb(colour)
    )


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _draw_panel(axis: Any, panel: Panel) -> None:
    pixels = [[_rgb(square.colour) for square in row] for row in panel.squares]
    axis.imshow(np.array(pixels, dtype=np.uint8), origin="lower", aspect="auto")
    for y, row in enumerate(panel.squares):
        for x, square in enumerate(row):
            style = {"ha": "center", "va": "center", "color": square.ink}
            lift = 0.16 if square.small else 0.0
            axis.text(x, y + lift, square.text, fontsize=10, **style)
            axis.text(x, y - 0.24, square.small, fontsize=7.5, **style)
    axis.set_xticks(range(len(panel.x_ticks)), panel.x_ticks)
    axis.set_yticks(range(len(panel.y_ticks)), panel.y_ticks)
    axis.set_xlabel(_wrap(panel.x_label))
    axis.set_ylabel(_wrap(panel.y_label, 24))
    axis.set_title(_wrap(panel.title), fontsize=9.5)
    axis.grid(visible=False)
    axis.tick_params(length=0)
    for edge in np.arange(1, len(panel.x_ticks)) - 0.5:
        axis.axvline(edge, color="white", lw=2.0)
    for edge in np.arange(1, len(panel.y_ticks)) - 0.5:
        axis.axhline(edge, color="white", lw=2.0)
    for side in ("left", "bottom"):
        axis.spines[side].set_visible(False)
    if panel.key:
        entries = (f"{letter} {title}" for letter, title, _ in panel.key)
        text = "   ".join(entry.replace(" ", "\N{NO-BREAK SPACE}") for entry in entries)
        place = {"xycoords": "axes fraction", "textcoords": "offset points"}
        below = _wrap(text, 60)
        axis.annotate(below, (0.0, 0.0), (0, -34), fontsize=8, va="top", **place)


def _wrap(text: str, width: int = 52) -> str:
    return "\n".join(textwrap.wrap(text, width))


def panel_rows(panel: Panel) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a panel as a table, the largest y first."""
    head = [f"{panel.y_label} \\ {panel.x_label}", *panel.x_ticks]
    rows = [
        [tick, *(f"{square.text} {square.small}".strip() for square in row)]
        for tick, row in zip(panel.y_ticks, panel.squares, strict=True)
    ]
    return head, rows[::-1]
