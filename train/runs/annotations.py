"""Problems as annotations of GitHub's workflows, which stand at the pull request."""

import os
from pathlib import Path


def in_workflow() -> bool:
    """True where a workflow of GitHub runs this program."""
    return os.environ.get("GITHUB_ACTIONS") == "true"


def annotation(problem: str, file: Path | None = None) -> str:
    """The command by which GitHub shows a problem at a pull request, or at a file of it.

    Its escapes are those of docs.github.com, "Workflow commands": a property may hold neither
    colons nor commas.
    """
    message = problem.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")
    place = ""
    if file is not None:
        found = os.path.relpath(file, os.environ.get("GITHUB_WORKSPACE"))
        escaped = found.replace("%", "%25").replace(":", "%3A").replace(",", "%2C")
        place = f"file={escaped},"
    return f"::error {place}title=elastic::{message}"
