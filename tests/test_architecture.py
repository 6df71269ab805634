"""Who may import whom: the layers stay layers, and a benchmark needs neither torch nor Stable-Baselines3."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("elastic_env", "baselines", "train")
FILES = sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
HEAVY = {"torch", "stable_baselines3", "tensorboard"}


def imported(file: Path) -> set[str]:
    """Full names of all modules that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def top_level(file: Path) -> set[str]:
    """Packages that a file imports from."""
    return {name.split(".")[0] for name in imported(file)}


def package_of(file: Path) -> str:
    """Which of our packages a file belongs to."""
    return file.relative_to(ROOT).parts[0]


def identify(file: Path) -> str:
    """A test's name for a file."""
    return str(file.relative_to(ROOT))


@pytest.mark.parametrize("file", FILES, ids=identify)
def test_imports_point_upwards(file: Path) -> None:
    """Catches an environment that needs a policy, a policy that needs the trainer, and torch where CI has none."""
    allowed = PACKAGES[: PACKAGES.index(package_of(file)) + 1]
    assert top_level(file) & set(PACKAGES) <= set(allowed)
    if package_of(file) != "train":
        assert not top_level(file) & HEAVY
    if file != ROOT / "elastic_env" / "rigid_body.py":
        assert "pinocchio" not in top_level(file)


@pytest.mark.parametrize("file", FILES, ids=identify)
def test_nobody_draws_from_global_randomness(file: Path) -> None:
    """Catches np.random.uniform and random.random: every draw comes from a Generator that is passed down."""
    calls = [
        ast.unparse(node.func)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("np.random.", "numpy.random."))
    ]
    allowed = {"default_rng", "Generator", "SeedSequence"}
    if file == ROOT / "train" / "learn.py":  # its checkpoints hold the generators that SB3 draws from
        allowed |= {"get_state", "set_state"}
    else:
        assert "random" not in top_level(file)
    assert [call for call in calls if call.split(".")[-1] not in allowed] == []


LAYERS = [
    ("errors", "yaml_text", "json_text", "config_problems", "config", "signals", "headless", "step_info", "compiled"),
    ("rows",),
    ("elasticity", "sensors", "metrics", "plan"),
    ("rigid_body",),
    ("walking",),
    ("robots",),
    ("scenario", "simulation"),
    ("references",),
    ("tasks", "worlds", "rendering"),
    ("envs", "entry_points"),
    ("hardware",),
]


@pytest.mark.parametrize("file", [f for f in FILES if package_of(f) == "elastic_env"], ids=identify)
def test_layers_of_the_environment_import_only_from_above(file: Path) -> None:
    """Catches a formula that reaches into a task: the groups of the design, section 7, in its order."""
    rank = {name: i for i, layer in enumerate(LAYERS) for name in layer}
    part = file.relative_to(ROOT / "elastic_env").with_suffix("").parts[0]
    if part == "__init__":
        return
    assert part in rank, f"give {part} its place among the layers"
    modules = {name.split(".")[1] for name in imported(file) if name.startswith("elastic_env.")}
    below = {name for name in modules if rank[name] > rank[part]}
    assert below == set(), f"{part} must not import {below}"


def test_importing_environment_and_baselines_loads_no_torch() -> None:
    """Catches an import that the source does not show, through a dependency or a registration."""
    code = (
        "import sys, gymnasium, elastic_env, baselines; gymnasium.make('elastic_env/Testbed-v0');"
        f"print([name for name in {sorted(HEAVY | {'matplotlib', 'plotly', 'imageio'})} if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.strip() == "[]"


def test_the_three_packages_and_all_their_parts_are_installed() -> None:
    """Catches a new subpackage that the list in pyproject.toml forgets, so that only editable installs work."""
    import tomllib

    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    listed = set(settings["tool"]["setuptools"]["packages"])
    existing = {".".join(file.parent.relative_to(ROOT).parts) for file in FILES if file.name == "__init__.py"}
    assert listed == existing
