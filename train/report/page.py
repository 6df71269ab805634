"""A report as sections of texts, tables and charts, written as an HTML page and as Markdown."""

import base64
import tomllib
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from train.figures.map_plots import Panel, panel_rows
from train.report.markdown import bullets, to_markdown
from train.report.tables import Table
from train.report.templates import load_template
from train.runs.escaping import markdown_text

TEXTS = tomllib.loads(Path(__file__).with_name("texts.toml").read_text(encoding="utf-8"))
"""Paragraphs by section or table."""
_PICTURE_TYPES = {".png": "png", ".svg": "svg+xml"}
"""Types of pictures that a page shows, by the suffix of their files."""
Kind = Literal["bullets", "definitions", "table", "map", "text", "caption", "chart", "picture"]


@dataclass(frozen=True)
class Part:
    """A part of a section.

    Attributes:
        kind: Kind of the content; captions, charts and pictures are on the page only.
        content: A text, texts, pairs of texts, a `Table`, a chart's `Spec`, panels of a map, or the
            file of a picture.
        title: Title above the content; empty for none.
        is_folded: True if the part can be folded under its title. A chart is drawn when it is
            unfolded.
        is_open: True if the part is unfolded at first.
    """

    kind: Kind
    content: Any
    title: str = ""
    is_folded: bool = False
    is_open: bool = False

    @property
    def data(self) -> str:
        """A picture as a data URL; empty if a page cannot show its type."""
        kind = _PICTURE_TYPES.get(self.content.suffix)
        content = base64.b64encode(self.content.read_bytes()).decode()
        return f"data:image/{kind};base64,{content}" if kind else ""

    @property
    def as_markdown(self) -> list[str]:
        """Blocks of Markdown; none for a chart."""
        if self.kind in ("caption", "chart", "picture"):
            return []
        blocks = [f"### {markdown_text(self.title)}"] if self.title else []
        if self.kind == "table":
            return [*blocks, to_markdown(self.content)]
        if self.kind == "map":
            return [*blocks, *chain(*map(_panel, self.content))]
        if self.kind == "text":
            return [*blocks, markdown_text(self.content)]
        texts = self.content
        if self.kind == "definitions":
            texts = [f"{term}: {text}" for term, text in self.content]
        return [*blocks, bullets(texts)]


@dataclass
class Section:
    """A section of a page, with a paragraph under its title."""

    title: str
    text: str = ""
    parts: list[Part] = field(default_factory=list)

    @property
    def as_markdown(self) -> list[str]:
        """Blocks of Markdown; none for a section of charts."""
        blocks = [block for part in self.parts for block in part.as_markdown]
        text = [markdown_text(self.text)] if self.text else []
        return [f"## {markdown_text(self.title)}", *text, *blocks] if blocks else []


class Page:
    """A page that grows section by section, with a table of contents. All texts are plain.

    Args:
        title: Title of the page.
        under: Line under the title.
    """

    def __init__(self, title: str, under: str) -> None:
        self.title = title
        self.under = under
        self.sections: list[Section] = []

    def section(self, title: str, text: str = "") -> None:
        """Begin a section, with a paragraph under its title."""
        self.sections.append(Section(title, text))

    def add(self, kind: Kind, content: Any, title: str = "", **folding: bool) -> None:
        """Add a `Part` to the last section."""
        self.sections[-1].parts.append(Part(kind, content, title, **folding))

    def html(self, plotly_js: str) -> str:
        """Return the whole page, which contains the source of plotly.js."""
        return load_template().render(page=self, plotly_js=plotly_js)

    def as_markdown(self) -> str:
        """Return the texts and tables of the page."""
        blocks = [block for section in self.sections for block in section.as_markdown]
        return "\n\n".join([f"# {markdown_text(self.title)}", *blocks]) + "\n"


def _panel(panel: Panel) -> list[str]:
    """Return title and table of a panel of a map."""
    key = ", ".join(f"{letter} {title}" for letter, title, _ in panel.key)
    title = f"{panel.title} ({key}):" if key else f"{panel.title}:"
    return [markdown_text(title), to_markdown(Table.plain(*panel_rows(panel)))]
