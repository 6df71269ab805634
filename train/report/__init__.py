"""The report of a comparison: words, charts and tables, as one HTML file and as Markdown."""

from train.report.render import require_jinja2
from train.report.report_text import Results
from train.report.write import require_plotly, write_report

__all__ = ["Results", "require_jinja2", "require_plotly", "write_report"]
