"""Pages of the documentation, written from the results beside them: `python -m docs.pages`."""
