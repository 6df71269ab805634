"""Templates of Jinja2: the page of a report as HTML, and its sentences as plain text."""

from functools import cache
from pathlib import Path
from typing import Any

from elastic_env.core.errors import missing_extra
from train.figures.colours import NIGHT, VERDICTS
from train.report.plotly_charts import FONT
from train.runs.escaping import line_value, script_json, template_value


def load_template(name: str = "page.html.j2") -> Any:
    """Load a template, by default that of a page; HTML templates escape all values.

    Raises:
        MissingExtraError: Jinja2 is not installed.
    """
    try:
        import jinja2  # noqa: F401
    except ImportError:
        raise missing_extra("jinja2", "report", "writing a report") from None
    return _environment(name.endswith(".html.j2")).get_template(name)


@cache
def _environment(is_html: bool) -> Any:
    """Make Jinja's environment of HTML or of text, which keeps its compiled templates."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=is_html,
        undefined=StrictUndefined,
        trim_blocks=True,
        finalize=template_value if is_html else line_value,
    )
    environment.filters.update(script_json=script_json)
    environment.globals.update(font=FONT, night=NIGHT, verdicts=VERDICTS)
    return environment
