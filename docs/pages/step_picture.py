"""Pelvis error and ZMP deviation over a step, without and with compensation, as an SVG for phones,
light and dark.

`python -m docs.pages` draws it from docs/results/step.csv. `python -m docs.pages.step` writes
that table.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

Rows = Sequence[Mapping[str, str]]

WITHOUT = "uncompensated"
WITH = "input_output"
"""The policies of the two curves."""
_TITLES = {WITHOUT: "without", WITH: "with compensation"}
_COLOURS = {WITHOUT: "#d05a3f", WITH: "#1a9a86"}
_WIDTH = 420
_LEFT = 44
_RIGHT = 408
_TOP = 34
_HEIGHT = 124
_GAP = 56
_HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" \
width="{width}" height="{height}"
role="img" aria-label="{label}">
<style>
  text {{ font: 14px sans-serif; fill: #737d88; }}
  .title {{ font-weight: bold; }} .right {{ text-anchor: end; }} .middle {{ text-anchor: middle; }}
  .curve {{ fill: none; stroke-width: 2.5; stroke-linejoin: round; }}
  .grid {{ stroke: #737d88; stroke-opacity: 0.3; }} \
.support {{ fill: #737d88; fill-opacity: 0.16; }}
</style>"""


@dataclass(frozen=True)
class Chart:
    """One of the two charts.

    Attributes:
        signal: Column of the table without the policy's name.
        title: Words and unit.
        ticks: Values of the grid, in its unit.
    """

    signal: str
    title: str
    ticks: Sequence[float]


CHARTS = (
    Chart("pelvis_error_rad", "pelvis error [mrad]", (0, 20, 40, 60, 80)),
    Chart("zmp_deviation_m", "ZMP deviation [mm]", (0, 25, 50, 75, 100)),
)


def step_svg(rows: Rows) -> str:
    """The picture.

    Args:
        rows: `time_s` from the beginning of a step, `single_support`, and per policy the signals of
            the charts.
    """
    height = _TOP + len(CHARTS) * (_HEIGHT + _GAP)
    label = "Pelvis error and ZMP deviation over a step of 3 s, without and with compensation"
    parts = [_HEAD.format(width=_WIDTH, height=height, label=label)]
    for at, chart in enumerate(CHARTS):
        parts += _draw(chart, rows, _TOP + at * (_HEIGHT + _GAP))
    parts.append(f'<text x="{_RIGHT}" y="{height - 6}" class="right">time in the step [s]</text>')
    return "\n".join([*parts, "</svg>", ""])


def _draw(chart: Chart, rows: Rows, top: float) -> list[str]:
    times = [float(row["time_s"]) for row in rows]
    bottom = top + _HEIGHT

    def x(time_s: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * (time_s - times[0]) / (times[-1] - times[0])

    def y(value: float) -> float:
        return bottom - _HEIGHT * value / chart.ticks[-1]

    alone = [time for time, row in zip(times, rows, strict=True) if row["single_support"] == "1"]
    begin = x(alone[0])
    end = x(alone[-1])
    parts = [
        (
            f'<rect class="support" x="{begin:.1f}" y="{top}" width="{end - begin:.1f}"'
            f' height="{_HEIGHT}"/>'
        ),
        f'<text x="{_LEFT}" y="{top - 10}" class="title">{chart.title}</text>',
        f'<text x="{(begin + end) / 2:.1f}" y="{bottom + 18}" class="middle">one foot</text>',
    ]
    for tick in chart.ticks:
        parts.append(
            f'<line class="grid" x1="{_LEFT}" x2="{_RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
        )
        parts.append(f'<text x="{_LEFT - 6}" y="{y(tick) + 5:.1f}" class="right">{tick:g}</text>')
    parts += [
        f'<text x="{x(t):.1f}" y="{bottom + 18}" class="middle">{t:g}</text>'
        for t in range(1, int(times[-1]))
    ]
    for policy, colour in _COLOURS.items():
        points = [
            (x(time), y(1e3 * float(row[f"{policy}_{chart.signal}"])))
            for time, row in zip(times, rows, strict=True)
        ]
        path = "L".join(f"{px:.1f} {py:.1f}" for px, py in points)
        parts.append(f'<path class="curve" stroke="{colour}" d="M{path}"/>')
    names = ((policy, _RIGHT - 138 if policy == WITHOUT else _RIGHT) for policy in _TITLES)
    parts += [
        f'<text x="{at}" y="{top - 10}" class="right" style="fill:'
        f' {_COLOURS[policy]}">{_TITLES[policy]}</text>'
        for policy, at in names
    ]
    return parts
