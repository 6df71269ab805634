"""The page of the report: style, script, tables and charts as HTML that needs nothing from outside."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from train.evaluate.changes import CEILING, Change, by_line, percent_interval
from train.report.changes_tables import falls
from train.report.parts import FONT, VERDICTS, Chart
from train.runs.escaping import script_json

_STYLE = """
:root { --ink: #1f2328; --soft: #59636e; --line: #d0d7de; --faint: #f6f8fa; --link: #0b5cad; }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
body { margin: 0; background: white; color: var(--ink); font: 16px/1.55 FONT; }
main { max-width: 1320px; margin: 0 auto; padding: 36px 28px 80px; }
h1 { font-size: 30px; line-height: 1.25; margin: 0 0 4px; letter-spacing: -0.01em; }
h2 { font-size: 22px; margin: 52px 0 8px; padding-top: 14px; border-top: 1px solid var(--line); }
nav + h2 { border-top: 0; margin-top: 18px; }
h3 { font-size: 17px; margin: 26px 0 4px; }
p { max-width: 86ch; margin: 8px 0; }
a { color: var(--link); text-decoration: none; } a:hover { text-decoration: underline; }
.under { color: var(--soft); margin: 0 0 18px; }
nav { display: flex; flex-wrap: wrap; gap: 4px 22px; padding: 12px 0; border-top: 1px solid var(--line);
      border-bottom: 1px solid var(--line); font-size: 15px; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 5px 22px; margin: 18px 0; font-size: 15px; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
ul { padding-left: 22px; max-width: 92ch; } li { margin: 4px 0; }
figure { margin: 10px 0 26px; }
.wide { overflow-x: auto; margin: 12px 0 22px; }
table { border-collapse: collapse; font-size: 14px; width: 100%; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: var(--soft); border-bottom: 1.5px solid var(--ink); padding: 6px 8px;
     vertical-align: bottom; }
td { border-bottom: 1px solid #e8eaed; padding: 5px 8px; vertical-align: top; }
td.n, th.n { text-align: right; } td.n { white-space: nowrap; }
td.name { white-space: nowrap; }
td.words { min-width: 170px; }
tr.group td { background: var(--faint); } tr.group td:nth-child(-n+2) { font-weight: 600; }
tr.head td { font-weight: 700; padding-top: 20px; border-bottom: 1px solid var(--line); font-size: 15px; }
tr.first td { border-top: 1px solid #b7bec6; }
.badge { display: inline-block; font-size: 12px; line-height: 1.45; font-weight: 500; padding: 0 7px; margin-left: 4px;
         border: 1px solid #b08800; border-radius: 9px; color: #7a5c00; background: #fff9e5; white-space: nowrap; }
.badge.ceiling { border-color: #8250df; color: #6639ba; background: #f8f3ff; }
.badge.pooled { border-color: #8c959f; color: #424a53; background: #f6f8fa; }
.dot { display: inline-block; width: 11px; height: 11px; border-radius: 50%; margin-right: 8px; }
.falls { color: #b42318; font-weight: 600; }
details > summary { cursor: pointer; font-weight: 600; padding: 7px 0; }
details { border-bottom: 1px solid #e8eaed; } details[open] { padding-bottom: 8px; }
@media print { nav { display: none; } }
""".replace("FONT", FONT)

_SCRIPT = """
const drawn = new Set();
function draw(box) {
  if (drawn.has(box.id)) return;
  drawn.add(box.id);
  const spec = JSON.parse(document.getElementById(box.id + "-spec").textContent);
  Plotly.newPlot(box, spec.data, spec.layout, {displaylogo: false, responsive: true, displayModeBar: false});
}
for (const box of document.querySelectorAll(".chart")) {
  const folded = box.closest("details:not([open])");
  if (!folded) draw(box);
}
for (const part of document.querySelectorAll("details")) {
  part.addEventListener("toggle", () => { if (part.open) part.querySelectorAll(".chart").forEach(draw); });
}
"""


class Page:
    """A page that grows section by section, with a table of contents.

    Args:
        title: Its title, plain text.
        under: A line under it, plain text.
    """

    def __init__(self, title: str, under: str) -> None:
        self._title, self._under = title, under
        self._sections: list[tuple[str, str]] = []
        self._parts: list[str] = []
        self._charts = 0

    def section(self, title: str) -> None:
        """Begin a section."""
        anchor = f"s{len(self._sections) + 1}"
        self._sections.append((anchor, title))
        self._parts.append(f'<h2 id="{anchor}">{escape(title)}</h2>')

    def add(self, html: str) -> None:
        """HTML as it is."""
        self._parts.append(html)

    def text(self, text: str) -> None:
        """A paragraph of plain text."""
        self._parts.append(f"<p>{escape(text)}</p>")

    def heading(self, text: str) -> None:
        """A heading within a section, plain text."""
        self._parts.append(f"<h3>{escape(text)}</h3>")

    def bullets(self, lines: Sequence[str]) -> None:
        """A list of plain texts."""
        self._parts.append("<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>")

    def chart(self, chart: Chart, folded: str | None = None, is_open: bool = True) -> None:
        """A chart; one that is folded away under a title is drawn when it is opened."""
        self._charts += 1
        name = f"c{self._charts}"
        spec = script_json(chart.spec)
        figure = (
            f'<figure><div class="chart" id="{name}" style="height:{chart.height}px"></div></figure>'
            f'<script type="application/json" id="{name}-spec">{spec}</script>'
        )
        self._parts.append(figure if folded is None else fold(folded, figure, is_open))

    def html(self, plotly_js: str) -> str:
        """The whole page, with the source of plotly.js in it."""
        links = "".join(f'<a href="#{anchor}">{escape(title)}</a>' for anchor, title in self._sections)
        return "\n".join(
            [
                '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">',
                '<meta name="viewport" content="width=device-width, initial-scale=1">',
                f"<title>{escape(self._title)}</title><style>{_STYLE}</style>",
                f"<script>{plotly_js}</script></head><body><main>",
                f'<h1>{escape(self._title)}</h1><p class="under">{escape(self._under)}</p><nav>{links}</nav>',
                *self._parts,
                f"</main><script>{_SCRIPT}</script></body></html>",
            ]
        )


def fold(title: str, html: str, is_open: bool = False) -> str:
    """HTML under a title that opens and closes it."""
    return f"<details{' open' if is_open else ''}><summary>{escape(title)}</summary>{html}</details>"


def definitions(pairs: Sequence[tuple[str, str]]) -> str:
    """Terms and what they are, plain texts."""
    return "<dl>" + "".join(f"<dt>{escape(t)}</dt><dd>{escape(d)}</dd>" for t, d in pairs) + "</dl>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int) -> str:
    """A table of plain texts: so many columns of words, then numbers, which are aligned at the right.

    Words that are those of the row before are left out.
    """
    cells = "".join(f"<th{_number(i, words)}>{escape(name)}</th>" for i, name in enumerate(head))
    lines, previous = [], [""] * words
    for row in rows:
        same = 0
        while same < words - 1 and row[same] == previous[same]:
            same += 1
        shown = ["" if i < same else text for i, text in enumerate(row)]
        kind = ' class="first"' if same == 0 else ""
        body = "".join(f"<td{_number(i, words)}>{escape(text)}</td>" for i, text in enumerate(shown))
        lines.append(f"<tr{kind}>{body}</tr>")
        previous = list(row[:words])
    return f'<div class="wide"><table><thead><tr>{cells}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def changes_html(
    rows: Sequence[Change], colour: Mapping[str, str], swept: Sequence[str], with_sentences: bool = True
) -> str:
    """Table of paired changes, a heading per policy and base, a row per cell and metric.

    Args:
        rows: The changes.
        colour: Colours of the policies.
        swept: Names of options that a sweep varies.
        with_sentences: Whether each row says what it shows.
    """
    figures = ["base → policy", "change", "better than base", f"{rows[0].failure} (base)"]
    head = "<th>reference</th><th>scenario</th>"
    head += "".join(f'<th class="n">{escape(name.replace("_", " "))}</th>' for name in swept) + "<th>metric</th>"
    head += "".join(f'<th class="n">{escape(name)}</th>' for name in figures)
    head += "<th>what it shows</th>" if with_sentences else ""
    width = 3 + len(swept) + len(figures) + with_sentences
    lines, before = [], ("", "")
    for line in by_line(rows):
        first = line[0]
        if (first.policy, first.base) != before:
            before = first.policy, first.base
            seeds = f", {first.num_seeds} training seed{'s' * (first.num_seeds != 1)}" if first.is_family else ""
            lines.append(
                f'<tr class="head"><td colspan="{width}"><span class="dot" style="background:{colour[first.policy]}">'
                f"</span>{escape(first.policy)} against {escape(first.base)}{seeds}</td></tr>"
            )
        lines += [_change_row(row, swept, number == 0, with_sentences) for number, row in enumerate(line)]
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _change_row(row: Change, swept: Sequence[str], is_first: bool, with_sentence: bool) -> str:
    badges = "".join(
        f' <span class="badge{" ceiling" if mark == CEILING else ""}">{escape(mark)}</span>' for mark in row.marks
    )
    if row.is_group:
        badges = ' <span class="badge pooled">pooled</span>' + badges
    where = [escape(row.reference), escape(row.scope) + badges] if is_first else ["", ""]
    values = [f"{row.swept[name]:g}" if name in row.swept else "-" for name in swept] if is_first else [""] * len(swept)
    before, after = (f"{row.column.scale * value:.{row.column.decimals}f}" for value in (row.theirs, row.mine))
    figures = [
        f"{before} → {after} {row.column.unit}" if np.isfinite(row.mine) else "-",
        f'<b style="color:{VERDICTS[row.verdict]}">{percent_interval(row.relative)}</b>',
        percent_interval(row.improvement, signed=False),
        _falls(row) if is_first else "",
    ]
    kinds = " ".join(kind for kind, holds in (("group", row.is_group), ("first", is_first)) if holds)
    body = f'<td class="name">{where[0]}</td><td>{where[1]}</td>'
    body += "".join(f'<td class="n">{text}</td>' for text in values)
    body += f'<td class="name">{escape(row.column.title)}</td>'
    body += "".join(f'<td class="n">{text}</td>' for text in figures)
    body += f'<td class="words">{escape(row.sentence)}</td>' if with_sentence else ""
    return f'<tr class="{kinds}">{body}</tr>'


def _falls(row: Change) -> str:
    return f'<span class="falls">{falls(row)}</span>' if row.falls_more else falls(row)


def _number(column: int, words: int) -> str:
    return ' class="n"' if column >= words else ""
