"""The page of a report: what its sections hold, as data for the template `page.html.j2`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from elastic_env.core.errors import missing_extra
from train.evaluate.changes import CEILING, Change, percent_interval
from train.report.changes_tables import falls
from train.report.parts import FONT, NIGHT, VERDICTS
from train.runs.escaping import script_json, template_value

if TYPE_CHECKING:
    from jinja2 import Template

Kind = Literal["heading", "bullets", "definitions", "table", "changes", "chart", "map", "board", "text"]


class Page:
    """A page that grows section by section, with a table of contents. All texts are plain.

    Args:
        title: Its title.
        under: A line under it.
    """

    def __init__(self, title: str, under: str) -> None:
        self.title, self.under = title, under
        self.sections: list[dict[str, Any]] = []

    def section(self, title: str, text: str = "") -> None:
        """Begin a section, with a paragraph under its title."""
        self.sections.append({"title": title, "text": text, "parts": []})

    def add(self, kind: Kind, content: Any, folded: str | None = None, is_open: bool = False) -> None:
        """Add to the section.

        Args:
            kind: What it is.
            content: A text, texts, pairs of texts, a `Chart`, or the arguments of the template's macro for a table.
            folded: Title under which it is folded away; None if it is not. A chart is drawn when it is unfolded.
            is_open: Whether it is unfolded at first.
        """
        self.sections[-1]["parts"].append({"kind": kind, "content": content, "folded": folded, "is_open": is_open})

    def html(self, plotly_js: str) -> str:
        """The whole page, with the source of plotly.js in it."""
        return require_jinja2().render(page=self, plotly_js=plotly_js)


def require_jinja2() -> "Template":
    """The template of a page, which escapes all that is put into it.

    Raises:
        MissingExtraError: Jinja2 is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError:
        raise missing_extra("jinja2", "report", "writing a report") from None
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        finalize=template_value,
    )  # fmt: skip
    environment.filters.update(falls=falls, means=_means, percent=percent_interval, script_json=script_json)
    environment.globals.update(ceiling=CEILING, font=FONT, night=NIGHT, verdicts=VERDICTS)
    return environment.get_template("page.html.j2")


def _means(row: Change) -> str:
    """Means of base and policy in the unit in which they are shown; - where there is nothing to compare."""
    if not np.isfinite(row.mine):
        return "-"
    before, after = (f"{row.column.scale * value:.{row.column.decimals}f}" for value in (row.theirs, row.mine))
    return f"{before} → {after} {row.column.unit}"
