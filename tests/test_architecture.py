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
    if file != ROOT / "elastic_env" / "dynamics" / "floating_body.py":
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
    if file == ROOT / "train" / "learn" / "training.py":  # its checkpoints hold the generators that SB3 draws from
        allowed |= {"get_state", "set_state"}
    else:
        assert "random" not in top_level(file)
    assert [call for call in calls if call.split(".")[-1] not in allowed] == []


ROOMS = [
    "elastic_env.core", "elastic_env.rendering", "elastic_env.joint", "elastic_env.dynamics", "elastic_env.motion",
    "elastic_env.runtime", "elastic_env.registration", "elastic_env.robots.joint_robot", "elastic_env.robots.testbed",
    "elastic_env.robots.thormang", "elastic_env.robots.gallery", "elastic_env.robots.robot",
    "elastic_env.hardware", "elastic_env.hardware.servo_bus", "elastic_env.hardware.safety", "elastic_env.hardware.imu",
    "elastic_env.hardware.testbed", "elastic_env.hardware.emulator", "elastic_env",
    "baselines.compensation", "baselines.walking", "baselines.estimation", "baselines.adaptation",
    "baselines.options", "baselines.catalogue", "baselines.identification", "baselines.residual", "baselines.policies",
    "baselines.residual_env", "baselines",
    "train.runs", "train.workers", "train.evaluate", "train.cells",
    "train.figures", "train.report", "train.learn", "train.experiments", "train.speed",
    "train.hardware", "train.commands", "train",
]  # fmt: skip
"""Folders, and modules beside them, in the order in which they may import: each from those before it."""


def room_of(name: str) -> str:
    """The room of a module, or of a name in one."""
    return max((room for room in ROOMS if f"{name}.".startswith(f"{room}.")), key=len)


@pytest.mark.parametrize("file", FILES, ids=identify)
def test_rooms_import_only_from_those_before(file: Path) -> None:
    """Catches a formula that reaches into a task, a cycle of rooms, and a room that nobody has put into the order."""
    own = room_of(".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))
    used = {room_of(name) for name in imported(file) if name.split(".")[0] in PACKAGES}
    used -= {"elastic_env", "train"} if file.name != "__init__.py" else set()  # whose import registers, or is of names
    assert {room for room in used if ROOMS.index(room) > ROOMS.index(own)} == set()
    if own.startswith("baselines"):
        assert not {room for room in used if room.startswith("elastic_env.robots.")}, "a policy for one robot"
    if own not in ("elastic_env.robots.testbed", "elastic_env.robots.thormang"):
        return
    assert not {room for room in used if room.startswith("elastic_env.robots.")} - {own}, "robots know one another"


def test_importing_environment_and_baselines_loads_no_torch() -> None:
    """Catches an import that the source does not show, through a dependency or a registration."""
    code = (
        "import sys, gymnasium, elastic_env, baselines; gymnasium.make('elastic_env/Testbed-v0');"
        f"print([name for name in {sorted(HEAVY | {'matplotlib', 'plotly', 'imageio'})} if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.strip() == "[]"


def test_the_three_packages_and_all_their_parts_are_installed() -> None:
    """Catches a subpackage or a data file that pyproject.toml forgets, so that only editable installs work."""
    import tomllib

    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    listed = set(settings["tool"]["setuptools"]["packages"])
    existing = {".".join(file.parent.relative_to(ROOT).parts) for file in FILES if file.name == "__init__.py"}
    assert listed == existing
    patterns = settings["tool"]["setuptools"]["package-data"]
    packed = {file for name in PACKAGES for pattern in patterns[name] for file in (ROOT / name).glob(pattern)}
    data = {file for name in PACKAGES for file in (ROOT / name).rglob("*") if file.is_file() and file.suffix != ".py"}
    assert {file for file in data - packed if "__pycache__" not in file.parts} == set()
