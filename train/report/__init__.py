"""The report of a comparison: words, charts and tables, as one HTML file and as Markdown."""
