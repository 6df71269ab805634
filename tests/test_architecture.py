"""An import of environments and policies loads no torch, and the wheel holds every part."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from setuptools import find_packages

from tests.broken_formulas import BROKEN

ROOT = Path(__file__).parents[1]
PACKAGES = ("elastic_env", "baselines", "train")
HEAVY = {"torch", "stable_baselines3", "tensorboard"}


def test_importing_environment_and_baselines_loads_no_torch() -> None:
    """Catches an import that the source does not show, through a dependency or a registration, an
    environment that loads policies, a testbed that waits for the dynamics of walkers, and a cycle
    of imports."""
    code = (
        "import sys, elastic_env;"
        " early = [name for name in ('baselines', 'train') if name in sys.modules];"
        " import gymnasium; gymnasium.make('elastic_env/Testbed-v0');"
        " early += ['pinocchio'] if 'pinocchio' in sys.modules else [];"
        " from elastic_env import baselines, train; print(early + [name for name in"
        f" {sorted(HEAVY | {'matplotlib', 'plotly', 'imageio', 'warp'})} if name in sys.modules]);"
        " print(baselines.make.__module__, train.__name__)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert result.stdout.splitlines() == ["[]", "baselines.policies train"]


def test_the_three_packages_and_all_their_parts_are_installed() -> None:
    """Catches a subpackage or a data file that pyproject.toml forgets, so that only editable
    installs work."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found = set(
        find_packages(
            str(ROOT), include=settings["tool"]["setuptools"]["packages"]["find"]["include"]
        )
    )
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    assert found == {".".join(file.parent.relative_to(ROOT).parts) for file in files}
    patterns = settings["tool"]["setuptools"]["package-data"]
    packed = {
        file
        for name in PACKAGES
        for pattern in patterns[name]
        for file in (ROOT / name).glob(pattern)
    }
    data = {
        file
        for name in PACKAGES
        for file in (ROOT / name).rglob("*")
        if file.is_file() and file.suffix != ".py"
    }
    assert {file for file in data - packed if "__pycache__" not in file.parts} == set()


def test_formulas_that_are_broken_on_purpose_stand_once() -> None:
    """Catches a formula that was rewritten, so that nobody breaks it any more."""
    counts = {one.right: (ROOT / one.file).read_text().count(one.right) for one in BROKEN}
    assert {text: count for text, count in counts.items() if count != 1} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_begin_with_a_verb_or_the_thing(package: str) -> None:
    """Catches a docstring that begins in the middle of a sentence, or only points elsewhere."""
    halves = re.compile(r"(What|Whether|Where|Which|Who|How|When|Of|That|Those|It|See|Such)\b")
    anywhere = re.compile(rf"[\"']\s*{halves.pattern}")  # parsing takes far longer than this
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    sources = {
        file: file.read_text(encoding="utf-8") for file in sorted((ROOT / package).rglob("*.py"))
    }
    bad = [
        f"{file.relative_to(ROOT)}: {text}"
        for file, source in sources.items()
        if anywhere.search(source)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, kinds) and halves.match(text := ast.get_docstring(node) or "")
    ]
    assert bad == []
