"""A label of a user stays text in every format of results: read back by parsers that are not ours."""

import csv
import html
import io
import json
import math
import re
from html.parser import HTMLParser

import pytest
from hypothesis import given
from hypothesis import strategies as st

from train.report.page import Page
from train.report.parts import Chart
from train.runs.escaping import chart_text, csv_row, markdown_table, script_json

NASTY = [
    "<!--<script>", "</script><b>", "a|b", "a\nb", "=cmd|' /C calc'!A0", "-1+2", "@x", "\tx", "&lt;", "\u2028", "ok",
]  # fmt: skip
"""Labels that mean something to a browser, a spreadsheet or Markdown."""


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
    """Catches a label that ends the script element, or begins a comment in which its end is lost."""
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
    """Catches a newline or a bar that makes another row or cell, and HTML that a viewer would take for such."""
    lines = markdown_table(["a", "b"], ["---", "---:"], [[first, second]]).split("\n")
    assert len(lines) == 3
    assert lines[2].replace("\\|", "").count("|") == 3
    assert "<" not in lines[2]


@given(st.lists(st.one_of(st.text(alphabet=st.characters(blacklist_categories=["Cs"])), st.floats(), st.integers())))
def test_no_cell_of_a_csv_file_is_a_formula(row: list[object]) -> None:
    """Catches text that a spreadsheet runs, and numbers that become text."""
    file = io.StringIO()
    csv.writer(file).writerow(csv_row(row))
    for value, cell in zip(row, csv_row(row), strict=True):
        if isinstance(value, str):
            is_number = re.fullmatch(r"[-+]?[\d.]+", cell) is not None
            assert is_number or not cell.startswith(("=", "+", "-", "@", "\t", "\r"))
            assert cell.removeprefix("'") == value.removeprefix("'")
        else:
            assert cell == value or math.isnan(value)  # type: ignore[arg-type]


@pytest.mark.parametrize("label", NASTY)
def test_a_chart_shows_a_label_as_it_is(label: str) -> None:
    """Catches a label whose tags a chart would draw."""
    assert "<" not in chart_text(label)
    assert html.unescape(chart_text(label)) == label


def page_of(text: str) -> str:
    """A page that has a text in every place where one can stand, in thirteen elements and a chart."""
    page = Page(text, text)
    page.section(text, text)
    page.add("heading", text, folded=text)
    page.add("bullets", [text])
    page.add("definitions", [(text, text)])
    page.add("table", {"head": [text], "rows": [[text]], "words": 1})
    page.add("chart", Chart({"name": text}, height=100))
    return page.html(plotly_js="0")


@pytest.mark.parametrize("label", NASTY)
def test_a_page_shows_a_label_as_it_is(label: str) -> None:
    """Catches a template that does not escape, and one that escapes what is escaped."""
    page, plain = Scripts(), Scripts()
    page.feed(page_of(label))
    plain.feed(page_of("plain"))
    assert page.tags == plain.tags
    assert html.unescape(page_of(label)).count(f">{label}<") == 13
    assert json.loads(page.scripts[1]) == {"name": label}
