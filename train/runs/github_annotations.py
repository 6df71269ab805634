"""Annotations of GitHub's workflows, which show problems at the pull request."""

import os
from pathlib import Path


def runs_in_workflow() -> bool:
    """Return true if a workflow of GitHub runs this program."""
    return os.environ.get("GITHUB_ACTIONS") == "true"


def annotation(problem: str, file: Path | None = None) -> str:
    """Return the command that lets GitHub show a problem at a pull request, or at a file of it.

    docs.github.com, "Workflow commands", lists the escapes. A property may contain neither colons
    nor commas.
    """
    message = problem.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")
    location = ""
    if file is not None:
        path = os.path.relpath(file, os.environ.get("GITHUB_WORKSPACE"))
        escaped = path.replace("%", "%25").replace(":", "%3A").replace(",", "%2C")
        location = f"file={escaped},"
    return f"::error {location}title=elastic::{message}"
