"""What the docstrings of the tasks say in tables."""

import re


def documented_tables(text: str) -> tuple[list[list[str]], set[str]]:
    """Rows of the observation's table in a task's docstring, and the keys in its table of
    `info`."""
    tables = [
        [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("| ")][1:]
        for part in text.split("`info` of one world")
    ]
    return tables[0], {key for row in tables[1] for key in re.findall(r"`([^`]+)`", row[0])}
