"""The page of a report: what its sections hold, as data for the template `page.html.j2`."""

from typing import Any, Literal

from train.report.render import require_jinja2

Kind = Literal["heading", "bullets", "definitions", "table", "chart", "map", "text"]


class Page:
    """A page that grows section by section, with a table of contents. All texts are plain.

    Args:
        title: Its title.
        under: A line under it.
    """

    def __init__(self, title: str, under: str) -> None:
        self.title = title
        self.under = under
        self.sections: list[dict[str, Any]] = []

    def section(self, title: str, text: str = "") -> None:
        """Begin a section, with a paragraph under its title."""
        self.sections.append({"title": title, "text": text, "parts": []})

    def add(
        self, kind: Kind, content: Any, folded: str | None = None, is_open: bool = False
    ) -> None:
        """Add to the section.

        Args:
            kind: What it is.
            content: A text, texts, pairs of texts, a `Table`, a `Chart`, or the panels of a map.
            folded: Title under which it is folded away; None if it is not. A chart is drawn when it
                is unfolded.
            is_open: Whether it is unfolded at first.
        """
        self.sections[-1]["parts"].append(
            {"kind": kind, "content": content, "folded": folded, "is_open": is_open}
        )

    def html(self, plotly_js: str) -> str:
        """The whole page, with the source of plotly.js in it."""
        return require_jinja2().render(page=self, plotly_js=plotly_js)
