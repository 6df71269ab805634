"""README and docs: short, in plain English, and true where they speak of the code."""

import contextlib
import io
import re
import subprocess
import tomllib
from ast import literal_eval
from functools import reduce
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.prose import sentences, words

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PLAIN = ["README.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md"))]
"""Pages that are held to plain English."""
MOST_WORDS = 900
LONGEST = 25
"""Words of the README, and words of a sentence."""


def test_the_readme_is_one_screen_and_shows_python_early() -> None:
    """Catches a README that grows again, and a console dump in it."""
    assert len(README.split()) <= MOST_WORDS  # as `wc -w` counts: code and tables included
    assert README[: README.index("```python")].count("\n") < 60
    assert all(
        block.count("\n") <= 20 for block in re.findall(r"```.*?```", README, flags=re.DOTALL)
    )


@pytest.mark.parametrize("policies", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_the_python_of_the_readme_prints_what_it_says(policies: int) -> None:
    """Catches a snippet that no longer runs, and figures beside it that are old."""
    code, printed = (
        re.findall(rf"```{kind}\n(.*?)```", README, flags=re.DOTALL)[0]
        for kind in ("python", "text")
    )
    named = re.findall(r"for name in (.*):", code)[0]
    code = code.replace(named, str(literal_eval(named)[:policies]))
    printed = "".join(printed.splitlines(keepends=True)[:policies])
    assert printed.count("\n") == policies
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(code, {})
    assert output.getvalue() == printed


@pytest.mark.parametrize("name", PLAIN)
def test_sentences_are_short(name: str) -> None:
    """Catches a sentence that a tired reader must read twice."""
    found = sentences((ROOT / name).read_text(encoding="utf-8"))
    assert [sentence for sentence in found if words(sentence) > LONGEST] == []
    assert np.percentile([0, *(words(sentence) for sentence in found)], 90) < LONGEST


def test_sentences_are_found() -> None:
    """Catches a measure that sees no sentence, or takes code and tables for prose."""
    prose = "One two three. Four `a b` six\nseven [eight](x.md).\n\n* Nine, in Eq. 9 of it."
    found = sentences(f"# Title\n\n{prose}\n\n| a | b |\n\n    code\n")
    assert [words(sentence) for sentence in found] == [3, 5, 6]


def test_every_equation_of_the_paper_has_a_function() -> None:
    """Catches a function that was renamed, and an equation that nobody implements."""
    text = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \|.*\| `([\w.]+)` \|$", text, flags=re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, 13))
    named = re.findall(r"`((?:elastic_env|baselines|train)(?:\.\w+)+)`", text)
    concepts = (ROOT / "docs" / "concepts.md").read_text(encoding="utf-8")
    named += re.findall(r"`((?:elastic_env|baselines|train)(?:\.\w+){2,})`", concepts)
    assert {function for _, function in rows} <= set(named)
    assert [name for name in named if not callable(_resolved(name))] == []


def _resolved(name: str) -> object:
    parts = name.split(".")
    for at in range(len(parts) - 1, 0, -1):
        with contextlib.suppress(ModuleNotFoundError):
            module = import_module(".".join(parts[:at]))
            return reduce(lambda owner, part: getattr(owner, part, None), parts[at:], module)
    return None


def published() -> list[Path]:
    """Files of the repository, as git lists them; all files where there is no git."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            check=True,
        ).stdout.decode()
    except (OSError, subprocess.CalledProcessError):
        return [path for path in ROOT.rglob("*") if ".venv" not in path.parts]
    return [ROOT / name for name in listed.split("\0") if name]


PUBLISHED = published()
MARKDOWN = [path for path in PUBLISHED if path.suffix == ".md" and path.is_file()]


@pytest.mark.parametrize("page", MARKDOWN, ids=[str(p.relative_to(ROOT)) for p in MARKDOWN])
def test_links_lead_somewhere_in_the_repository(page: Path) -> None:
    """Catches a page or a heading that was renamed, and a link to a file that only a build
    makes."""
    text = page.read_text(encoding="utf-8")
    shown = re.sub(r"^```.*?^```|`[^`\n]*`", "", text, flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"\]\((?!\w+:)([^)\s]+)\)", shown)
    links += re.findall(r"(?:src|href)=\"(?!\w+:)([^\"]+)\"", shown)
    for target in links:
        path, _, heading = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file in PUBLISHED or any(file in known.parents for known in PUBLISHED), target
        if heading:
            titles = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}
            assert heading in anchors, target


def test_files_that_only_a_build_makes_are_not_published() -> None:
    """Catches a list of files that takes the site's own pages for those of the repository."""
    assert ROOT / "docs" / "lookup" / "gains.md" in PUBLISHED
    assert not any("generated" in path.parts or "_build" in path.parts for path in PUBLISHED)


def test_the_citation_agrees_with_the_package() -> None:
    """Catches a version or a licence that was changed in one place alone."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (citation["title"], citation["version"]) == (project["name"], project["version"])
    assert citation["license"] == project["license"]
