"""The report of a comparison: texts, charts and tables, as one HTML file and as Markdown."""
