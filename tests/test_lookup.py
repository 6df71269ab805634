"""The reference pages in docs/lookup: those that the code gives."""

import pytest

from docs.reference import FOLDER, PAGES, help_of
from train.commands.cli import COMMANDS

SLOW = {"environments.md", "help.md"}
"""Pages for which robots are made, or every command is asked."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in PAGES]
)
def test_a_reference_page_is_that_of_the_code(name: str) -> None:
    """Catches an option, a gain or a bound that has changed; `python -m docs.reference` writes
    the pages anew."""
    assert (FOLDER / name).read_text(encoding="utf-8") == PAGES[name]()


def test_every_command_is_on_the_page_of_help() -> None:
    """Catches a new command without its help, and the help of an old version of one."""
    text = (FOLDER / "help.md").read_text(encoding="utf-8")
    assert [name for name in COMMANDS.split() if f"\n## elastic {name}" not in text] == []
    assert help_of("hardware", "check") in text
