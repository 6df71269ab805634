"""The release: links of the README that an index can follow, and a tag that is the version's."""

import re
import zipfile
from pathlib import Path

import pytest
import yaml

import elastic_env
from elastic_env.core.errors import ConfigurationError
from tests.release import NOWHERE, absolute_links, require_absolute_links, version_of

ROOT = Path(__file__).parents[1]


def test_links_are_made_absolute_and_others_stay() -> None:
    """Catches a picture whose address is that of a page, and links that are changed twice."""
    text = "![a](b/c.png) [d](e.md#f) [g](https://h.i) [j](#k)"
    once = absolute_links(text, "https://r", "v1")
    picture, page = "https://r/raw/v1/b/c.png", "https://r/blob/v1/e.md#f"
    assert once == f"![a]({picture}) [d]({page}) [g](https://h.i) [j](#k)"
    assert absolute_links(once, "https://r", "v1") == once


def test_every_link_of_the_readme_leads_to_a_file_of_the_repository() -> None:
    """Catches a kind of link that stays relative, such as one of HTML, and one that leads
    nowhere."""
    text = absolute_links((ROOT / "README.md").read_text(encoding="utf-8"), NOWHERE, "v1")
    assert not re.findall(r"<(?:a|img)\b", text)
    assert not re.findall(r"^\[[^\]]+\]:", text, flags=re.MULTILINE)
    targets = re.findall(r"\]\(([^)]*)\)", text)
    assert len(targets) > 20
    for target in targets:
        place = re.fullmatch(rf"{NOWHERE}/(raw|blob)/v1/([^#]+)(#.*)?", target)
        assert place, target
        assert (ROOT / place[2]).exists(), target


@pytest.mark.parametrize(
    ("description", "is_right"),
    [("[a](https://b.c/d.md)", True), ("[a](d.md)", False), ("![a](d.png)", False), ("", False)],
)
def test_a_description_with_relative_links_is_refused(
    description: str, is_right: bool, tmp_path: Path
) -> None:
    """Catches a wheel whose page on an index has no pictures."""
    wheel = tmp_path / "a-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("a-1.dist-info/METADATA", f"Name: a\nVersion: 1\n\n{description}")
    if is_right:
        require_absolute_links(wheel)
    else:
        with pytest.raises(ConfigurationError, match="relative links"):
            require_absolute_links(wheel)


def test_the_tag_is_that_of_the_version() -> None:
    """Catches a release under the tag of another version."""
    version = version_of(None)
    assert version_of(f"v{version}") == version
    for tag in (version, "v0.0.0"):
        with pytest.raises(ConfigurationError, match=rf"has the tag v{version}, got '{tag}'"):
            version_of(tag)
    assert version == elastic_env.__version__


def test_hooks_check_with_the_pinned_ruff() -> None:
    """Catches hooks that format as another version does."""
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    revisions = {
        repository["repo"].rpartition("/")[2]: repository["rev"] for repository in hooks["repos"]
    }
    pinned = re.findall(r"^ruff==(.+)$", (ROOT / "constraints.txt").read_text(), flags=re.MULTILINE)
    assert [revisions["ruff-pre-commit"]] == [f"v{version}" for version in pinned]
