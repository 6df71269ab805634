"""A label of a user stays text in every format of results: read back by parsers that are not
ours."""

import csv
import html
import io
import json
import math
import re
import warnings
from collections.abc import Callable
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from train.figures import plots
from train.figures.chart import Chart, Curve, Panel
from train.report.markdown import to_markdown
from train.report.page import Page
from train.report.tables import Table as ReportTable
from train.runs.console import PlainConsole, traceback_text, warn_once
from train.runs.escaping import (
    chart_text,
    csv_cell,
    markdown_text,
    script_json,
    visible,
    write_records,
)
from train.runs.progress import show_progress

NASTY = [
    "<!--<script>",
    "</script><b>",
    "a|b",
    "a\nb",
    "=cmd|' /C calc'!A0",
    "-1+2",
    "@x",
    "\tx",
    "&lt;",
    "\u2028",
    "ok",
]
"""Labels that mean something to a browser, a spreadsheet or Markdown."""

COMMANDS = [
    *map(chr, [*range(9), *range(0x0B, 0x20), *range(0x7F, 0xA0)]),
    "\u061c",
    "\u200e",
    "\u200f",
    "\u202a",
    "\u202d",
    "\u202e",
    "\u2066",
    "\u2069",
    "\udc9b",
]
"""What a terminal obeys, what turns the order of letters around, and half a character."""
HOSTILE = "a" + "".join(COMMANDS) + "]8;;http://x[31mb"


def test_a_text_keeps_its_letters_and_loses_its_commands() -> None:
    """Catches U+009B, a carriage return, and letters of other scripts that are taken for
    commands."""
    assert visible(HOSTILE) == "a" + "�" * len(COMMANDS) + "]8;;http://x[31mb"
    assert visible("τ_J 関節 שלום 🤖 a\tb\n") == "τ_J 関節 שלום 🤖 a\tb\n"


def shown_by(console: PlainConsole, print_it: Callable[[PlainConsole], None]) -> str:
    """What a console writes to its terminal, without the colours of Rich."""
    print_it(console)
    written: str = console.file.getvalue()  # type: ignore[attr-defined]
    return re.sub(r"\x1b\[[\d;]*m", "", written)


def table_of(text: str) -> Table:
    table = Table(title=escape(text), caption=escape(text))
    table.add_column(escape(text))
    table.add_row(escape(text))
    table.add_row(Text(text))
    return table


PRINTED: dict[str, Callable[[PlainConsole], None]] = {
    "text": lambda console: console.print(f"wrote {HOSTILE}", soft_wrap=True),
    "object": lambda console: console.print(Text(HOSTILE)),
    "table": lambda console: console.print(table_of(HOSTILE)),
    "rule": lambda console: console.rule(HOSTILE),
    "error": lambda console: console.print(
        Text.assemble(("error:", "bold red"), HOSTILE), soft_wrap=True
    ),
}


@pytest.mark.parametrize("is_terminal", [True, False])
@pytest.mark.parametrize("name", PRINTED)
def test_a_console_obeys_no_text(name: str, is_terminal: bool) -> None:
    """Catches a label that moves the cursor, sets the title of the window, or turns a line
    around."""
    console = PlainConsole(file=io.StringIO(), width=400, force_terminal=is_terminal)
    written = shown_by(console, PRINTED[name])
    assert "�]8;;http://x[31mb" in written
    assert not set(COMMANDS) & set(written)


@pytest.mark.parametrize(
    "text", ["[/bold] x", "[link=file:///x]y[/link]", "\\[mm] [bold]x", "a:smile:b"]
)
def test_a_printed_text_is_no_markup(text: str) -> None:
    """Catches a path or a label that ends a command with an error of Rich's, or becomes a link."""
    console = PlainConsole(file=io.StringIO(), width=100, force_terminal=True)
    assert shown_by(console, lambda console: console.print(text)) == f"{text}\n"


class Screen(io.StringIO):
    """What a terminal shows."""

    def isatty(self) -> bool:
        """Lines can be drawn again."""
        return True


def test_a_file_that_asks_for_colours_gets_no_bar_that_is_drawn_again() -> None:
    """Catches a notebook, whose FORCE_COLOR makes Rich take it for a terminal, with a line for
    every drawing of a bar."""
    for file, is_bar in ((Screen(), True), (io.StringIO(), False)):
        console = PlainConsole(file=file, width=100, force_terminal=True)
        with show_progress(console, {"filming": 10}) as show:
            for done in range(11):
                show(0, done)
        assert ("\x1b[2K" in file.getvalue()) is is_bar


def test_progress_and_warnings_obey_no_text() -> None:
    """Catches the name of a folder in a bar, and that of a joint in a warning."""
    console = PlainConsole(file=Screen(), width=100, force_terminal=True)
    with show_progress(console, {f"[/x] {HOSTILE}": 2}) as show:
        show(0, 1, f"[/x] {HOSTILE}")
    written = re.sub(r"\x1b\[[\d;]*[A-Za-ln-z]", "", console.file.getvalue())  # type: ignore[attr-defined]
    assert "\x9b" not in written
    assert "\u202e" not in written
    with warn_once():
        said = warnings.formatwarning(f"the joint {HOSTILE}", UserWarning, "file.py", 3)
        foreign = warnings.formatwarning("1 / 0", RuntimeWarning, "file.py", 3)
    assert said.startswith("warning: the joint a�")
    assert foreign == "warning: RuntimeWarning: 1 / 0 (file.py:3)\n"
    assert not set(COMMANDS) & set(said)
    assert not set(COMMANDS) & set(traceback_text(ValueError(HOSTILE)))


def test_files_obey_no_text(tmp_path: Path) -> None:
    """Catches a file that runs commands where somebody looks at it with cat."""
    path = write_records([{f"x{HOSTILE}": HOSTILE, "y": f"\x1b={HOSTILE}"}], tmp_path / "x.csv")
    text = to_markdown(ReportTable.plain([HOSTILE], [[HOSTILE]]))
    page = page_of(HOSTILE)
    data = script_json({"name": [HOSTILE]})
    for written in (path.read_text(encoding="utf-8"), text, page, data, chart_text(HOSTILE)):
        assert not (set(COMMANDS) - {"\r"}) & set(written)
        assert "�" in written
    assert "\\u001b" not in data


LINKS = [
    r"a \ b",
    r"a\\",
    r"\*",
    "[a](http://x)",
    "![a](http://x/y.png)",
    "![a][b]",
    "[a][b]",
    "[a]: http://x",
    "http://x.y",
    "HTTPS://x.y",
    "www.x.org",
    "ftp://x.y",
    "\\[a](x)",
    "[a\\](x)",
    "[a](<x>)",
    "<http://x>",
    "![](x)",
    "[![a](b)](c)",
]


@pytest.mark.parametrize("label", LINKS)
def test_a_label_is_no_link_of_markdown(label: str) -> None:
    """Catches a report that loads a picture from elsewhere, or leads there, read by a parser
    that is not ours."""
    parser = MarkdownIt("commonmark")
    assert re.search("(http|https|ftp)://|www[.]", markdown_text(label), re.IGNORECASE) is None, (
        "links of GitHub's"
    )
    for text in (markdown_text(label), f"* {markdown_text(label)}", f"# {markdown_text(label)}"):
        tokens = [part for token in parser.parse(text) for part in (token, *(token.children or ()))]
        assert not {"link_open", "image", "html_inline", "html_block"} & {
            token.type for token in tokens
        }
        (shown,) = [
            "".join(part.content for part in t.children or ()) for t in tokens if t.type == "inline"
        ]
        assert shown == label


def test_intervals_stay_as_they_are_in_markdown() -> None:
    """Catches brackets that are escaped for nothing in every table."""
    assert (
        markdown_text("12.3 [11.0, 13.5] residual:seed_[0-4] a_b")
        == "12.3 [11.0, 13.5] residual:seed_[0-4] a_b"
    )


TO_MATPLOTLIB = {"$\\foo{", "_mine", "\x1b[31mred", "a\nb"}
"""Labels that mean something to Matplotlib."""


class Scripts(HTMLParser):
    """Contents of script elements, and the tags that come after."""

    def __init__(self) -> None:
        super().__init__()
        self.scripts: list[str] = []
        self.tags: list[str] = []
        self._is_script = False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.append(tag)
        self._is_script = tag == "script"

    def handle_endtag(self, tag: str) -> None:
        self._is_script = False

    def handle_data(self, data: str) -> None:
        if self._is_script:
            self.scripts.append(data)


@pytest.mark.parametrize("label", NASTY)
def test_nothing_after_a_chart_is_swallowed(label: str) -> None:
    """Catches a label that ends the script element, or begins a comment in which its end is
    lost."""
    page = Scripts()
    text = script_json({"name": label})
    page.feed(f'<script type="application/json">{text}</script><h2>next</h2>')
    page.close()
    assert page.tags == ["script", "h2"]
    assert json.loads("".join(page.scripts)) == {"name": label}
    assert "<!--" not in text
    assert "</" not in text


@given(st.text(), st.text())
def test_a_markdown_table_keeps_its_cells(first: str, second: str) -> None:
    """Catches a newline or a bar that makes another row or cell, and HTML that a viewer would
    take for such."""
    lines = to_markdown(ReportTable.plain(["a", "b"], [[first, second]])).split("\n")
    assert len(lines) == 3
    assert lines[2].replace("\\|", "").count("|") == 3
    assert "<" not in lines[2]


@given(
    st.lists(
        st.one_of(
            st.text(alphabet=st.characters(blacklist_categories=["Cs"])), st.floats(), st.integers()
        )
    )
)
def test_no_cell_of_a_csv_file_is_a_formula(row: list[object]) -> None:
    """Catches text that a spreadsheet runs, and numbers that become text."""
    file = io.StringIO()
    csv.writer(file).writerow(map(csv_cell, row))
    for value, cell in zip(row, map(csv_cell, row), strict=True):
        if isinstance(value, str):
            is_number = re.fullmatch(r"[-+]?[\d.]+", cell) is not None
            assert is_number or not cell.startswith(("=", "+", "-", "@", "\t", "\r"))
            assert cell.removeprefix("'") == visible(value).removeprefix("'")
        else:
            assert cell == value or math.isnan(value)  # type: ignore[arg-type]


@pytest.mark.parametrize("label", NASTY)
def test_a_chart_shows_a_label_as_it_is(label: str) -> None:
    """Catches a label whose tags a chart would draw."""
    assert "<" not in chart_text(label)
    assert html.unescape(chart_text(label)) == label


@pytest.mark.parametrize(
    ("label", "fails"),
    [
        pytest.param(label, fails, marks=[pytest.mark.slow] * (fails or label not in TO_MATPLOTLIB))
        for label in ("$\\foo{", "a $x^", "_mine", "__", "\x1b[31mred", *NASTY)
        for fails in (False, True)
    ],
)
def test_a_picture_shows_a_label_as_it_is(label: str, fails: bool, tmp_path: Path) -> None:
    """Catches a label that Matplotlib takes for a formula, which ends the command with a
    traceback, and one that it leaves out of the legend."""
    x = np.linspace(0.0, 1.0, 3)
    curves = [Curve(label, "#123456", x, x, fails=fails), Curve("", "#123456", x, -x)]
    crosses = [Curve("", "#123456", x, 0.0 * x, crosses=[True] * len(x))]
    failing = [Panel(label, crosses, rows=[label])] if fails else []
    chart = Chart(label, label, [*failing, Panel(label, curves)])
    plt = plots.require_matplotlib()
    figure, axis = plt.subplots()
    axis.plot(x, x, label=plots.label_text(label))
    (shown,) = axis.legend().get_texts()
    assert shown.get_text().strip() == visible(label).strip()
    plt.close(figure)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "Glyph .* missing")
        assert plots.draw_chart(chart, tmp_path / "chart.png").stat().st_size > 1000


@cache
def page_of(text: str) -> str:
    """A page that has a text in every place where one can stand, in fourteen elements and a
    chart."""
    page = Page(text, text)
    page.section(text, text)
    page.add("text", text, text, is_folded=True)
    page.add("bullets", [text], text)
    page.add("definitions", [(text, text)])
    page.add("table", ReportTable.plain([text], [[text]], subjects=(text,)))
    page.add("chart", {"name": text, "layout": {"height": 100}})
    return page.html(plotly_js="0")


@pytest.mark.parametrize("label", NASTY)
def test_a_page_shows_a_label_as_it_is(label: str) -> None:
    """Catches a template that does not escape, and one that escapes what is escaped."""
    page = Scripts()
    plain = Scripts()
    text = page_of(label)
    page.feed(text)
    plain.feed(page_of("plain"))
    assert page.tags == plain.tags
    assert html.unescape(text).count(f">{label}<") == 14
    assert json.loads(page.scripts[1])["name"] == label


def test_a_table_is_escaped_in_every_format(tmp_path: Path) -> None:
    """Catches a format in which the text of a label is a command, a tag or a formula."""
    table = ReportTable.plain(["a|<b>\x1b"], [["=1+a|<b>\x1b"]])
    page = Page("x", "")
    page.section("x")
    page.add("table", table)
    path = write_records([{"a|<b>\x1b": "=1+a|<b>\x1b"}], tmp_path / "table.csv")
    assert to_markdown(table) == "| a\\|&lt;b&gt;� |\n| --- |\n| =1+a\\|&lt;b&gt;� |"
    assert to_markdown(table) in page.as_markdown()
    assert '<td class="words">=1+a|&lt;b&gt;�</td>' in page.html(plotly_js="")
    assert path.read_bytes().decode() == "a|<b>�\r\n'=1+a|<b>�\r\n"
