"""A release: sdist and wheel of the tracked files, and the wheel tried in an empty environment.

    make release-check
    make release-check REPOSITORY=https://github.com/OWNER/elastic-env ARGS='--tag v0.1.0'

Both archives are built into dist/. Their README has absolute links, since an index has no pages
beside it: they lead to the tag of this version in the repository.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path
from typing import Annotated

import tyro

from elastic_env.core.errors import ConfigurationError, quote, shorten
from train.commands.cli import COMMANDS, CONSOLE, run_program

ROOT = Path(__file__).parents[1]
NOWHERE = "https://repository.invalid/elastic-env"
"""Address of the repository where none is named: archives for a trial, and not for an index."""
PLAIN = [*((name,) for name in COMMANDS.split()), ("hardware", "check")]
"""Commands whose help must come without any extra."""
_LINK = re.compile(r"(!?)(\[[^\]]*\]\()(?!https?:|#)([^)\s]+)\)")
_SHADOW = "raise SystemExit('the file of the user was imported')\n"


def main(
    tag: str | None = None,
    repository: str = os.environ.get("REPOSITORY") or NOWHERE,
    output: Path = ROOT / "dist",
    trial: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True,
) -> None:
    """Build a release and try its wheel.

    Args:
        tag: Tag that is released; it must be v and the version.
        repository: Address that the links of the README lead to; by default $REPOSITORY.
        output: Folder for sdist and wheel, whose older archives are removed.
        trial: Whether the wheel is installed into an empty environment and tried there.
    """
    version = version_of(tag)
    shutil.rmtree(output, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        wheel = build(copy_sources(Path(folder), repository, f"v{version}"), output)
        require_absolute_links(wheel)
    if trial:
        with tempfile.TemporaryDirectory() as folder:
            try_installed(make_environment(Path(folder), wheel), Path(folder), wheel)
    CONSOLE.print(f"{', '.join(file.name for file in sorted(output.iterdir()))} in {output}")


def version_of(tag: str | None) -> str:
    """Version of the package.

    Args:
        tag: Tag that is released, if one is.

    Raises:
        ConfigurationError: The tag is that of another version.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = project["version"]
    if tag not in (None, f"v{version}"):
        cure = "set the version in pyproject.toml, elastic_env/__init__.py and CITATION.cff"
        problem = f"a release of version {version} has the tag v{version}, got {quote(tag)}"
        raise ConfigurationError(f"{problem}; {cure}")
    return version


def absolute_links(text: str, repository: str, revision: str) -> str:
    """Markdown whose links lead into a repository, and whose pictures come from there.

    Args:
        text: With links relative to the root of the repository.
        repository: Its address.
        revision: Tag, branch or commit.
    """

    def absolute(found: re.Match[str]) -> str:
        mark, label, target = found.groups()
        view = "raw" if mark else "blob"
        return f"{mark}{label}{repository}/{view}/{revision}/{target})"

    return _LINK.sub(absolute, text)


def copy_sources(folder: Path, repository: str, revision: str) -> Path:
    """Copy the tracked files, without what earlier builds left beside them; the folder."""
    listed = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True)
    for name in listed.split("\0")[:-1]:
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, copy, follow_symlinks=False)
    readme = folder / "README.md"
    text = readme.read_text(encoding="utf-8")
    readme.write_text(absolute_links(text, repository, revision), encoding="utf-8")
    return folder


def build(sources: Path, output: Path) -> Path:
    """Build the sdist, and the wheel from it, with the pinned setuptools; the wheel."""
    options = ["--no-isolation", "--outdir", str(output), str(sources)]
    _run([sys.executable, "-m", "build", *options])
    (wheel,) = output.glob("*.whl")
    return wheel


def require_absolute_links(wheel: Path) -> None:
    """Refuse a wheel whose description an index would show with dead links.

    Raises:
        ConfigurationError: It holds relative links.
    """
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        description = message_from_bytes(archive.read(name)).get_payload()
    found = [target for _, _, target in _LINK.findall(str(description))]
    if found or not description:
        raise ConfigurationError(f"the description in {wheel.name} has relative links: {found}")


def make_environment(folder: Path, wheel: Path) -> Path:
    """An environment with the wheel and what it needs, in the pinned versions; its programs."""
    _run([sys.executable, "-m", "venv", str(folder / "venv")])
    programs = folder / "venv" / "bin"
    install(programs, str(wheel))
    return programs


def install(programs: Path, requirement: str) -> None:
    """Install a requirement into an environment, in pinned versions."""
    options = ["-q", "--disable-pip-version-check", "-c", str(ROOT / "constraints.txt")]
    _run([str(programs / "python"), "-m", "pip", "install", *options, requirement])


def try_installed(programs: Path, folder: Path, wheel: Path) -> None:
    """Use an installed wheel as a stranger would, first without extras.

    Args:
        programs: Of its environment.
        folder: Where it is used; it holds nothing of the checkout.
        wheel: For its extras `train` and `report`.
    """
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    code, printed = (
        re.findall(rf"```{kind}\n(.*?)```", readme, flags=re.DOTALL)[0]
        for kind in ("python", "text")
    )
    python = [str(programs / "python"), "-c"]
    _require("the ten lines of the README", _run([*python, code], folder), printed)
    residual = code.replace('"dynamic"', '"residual:testbed/seed_0"')
    said = _run([*python, residual], folder)
    errors = [float(line.split()[-2]) for line in said.splitlines()]
    if not errors[2] < errors[1]:
        raise ConfigurationError(f"the residual of the package must beat its base, got:\n{said}")

    elastic = str(programs / "elastic")
    own = folder / "own"
    own.mkdir()
    (own / "baselines.py").write_text(_SHADOW)
    for command in PLAIN:
        _run([elastic, *command, "--help"], own)
    if "leaderboard" not in _run([elastic, "compare", "--list"], own):
        raise ConfigurationError("elastic compare --list does not name leaderboard")
    _require_shadow_is_named([elastic, "--version"], own)
    _require_shadow_is_named([*python, "from elastic_env import baselines"], own)

    install(programs, f"{wheel}[train,report]")
    shutil.copy2(ROOT / "docs" / "identification" / "arm.xml", folder)
    for command in (
        ["compare", "paper_testbed", "--episodes", "1", "--output", "run"],
        ["robot", "arm.xml", "--stiffness", "1000", "--output", "arm"],
        ["demo", "--output", "demo"],
    ):
        _run([elastic, *command], folder)
    for report in ("run/report.html", "arm/comparison/report.html", "demo/report.html"):
        if not (folder / report).is_file():
            raise ConfigurationError(f"{report} was not written")
    for tutorial in sorted((ROOT / "examples").glob("[1-5]_*.py")):
        _run([python[0], str(shutil.copy2(tutorial, folder))], folder)
    found = _run([*python, _PUBLISHED], folder)
    if int(found) < 100:
        raise ConfigurationError(f"the published leaderboard has {found} rows")


_PUBLISHED = """\
from pathlib import Path
from train.report.leaderboard import find_published, read_leaderboard
print(len(read_leaderboard(find_published(Path("leaderboard")))))
"""


def _require_shadow_is_named(command: list[str], own: Path) -> None:
    """Require that a program names the baselines.py of a folder on its path, which hides ours."""
    env = {**os.environ, "PYTHONPATH": str(own)}
    run = subprocess.run(
        command, cwd=own.parent, env=env, capture_output=True, text=True, check=False
    )
    problem = f"{own / 'baselines.py'} stands in the place of the package baselines"
    if run.returncode == 0 or problem not in run.stderr:
        raise ConfigurationError(f"{' '.join(command)} must say: {problem}; got:\n{run.stderr}")


def _require(what: str, said: str, expected: str) -> None:
    if said != expected:
        raise ConfigurationError(f"{what} must print:\n{expected}\ngot:\n{said}")


def _run(command: list[str], folder: Path | None = None) -> str:
    """Run a program, of which nothing here is imported; what it prints.

    Raises:
        ConfigurationError: It fails.
    """
    CONSOLE.print(shorten(" ".join(command).replace("\n", " ")))
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    env["MPLBACKEND"] = "agg"  # a window would wait to be closed
    run = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    if run.returncode:
        raise ConfigurationError(f"it ended with {run.returncode}:\n{run.stdout}{run.stderr}")
    return run.stdout


if __name__ == "__main__":
    run_program(lambda: tyro.cli(main))
