"""The notebook: of this version, without outputs, and its cells run one after the other."""

import ast
import json
import os
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

import elastic_env

FILE = Path(__file__).parents[1] / "examples" / "elastic_joints.ipynb"


def cells() -> list[dict[str, Any]]:
    """The cells of the notebook."""
    return json.loads(FILE.read_text(encoding="utf-8"))["cells"]


def sources() -> Iterator[str]:
    """Code of the cells, as IPython takes it."""
    return ("".join(cell["source"]) for cell in cells() if cell["cell_type"] == "code")


def run(source: str, namespace: dict[str, Any]) -> None:
    """Run a cell as IPython does."""
    if source.startswith("%%writefile "):
        first, _, content = source.partition("\n")
        Path(first.split()[1]).write_text(content + "\n", encoding="utf-8")
        return
    if source.startswith("%%bash\n"):
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        script = ["bash", "-e", "-c", source.partition("\n")[2]]
        subprocess.run(script, check=True, env={**os.environ, "PATH": path})
        return
    exec(compile(source, FILE.name, "exec"), namespace)


def test_the_notebook_installs_this_version_and_holds_no_outputs() -> None:
    """Catches a notebook of another version, outputs of somebody's machine, and a cell that
    Python does not read."""
    first, *others = sources()
    assert f'"elastic-env[report]=={elastic_env.__version__}"' in first
    for source in others:
        if not source.startswith("%%"):
            ast.parse(source)
    code = [cell for cell in cells() if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)


@pytest.mark.slow
def test_the_notebook_runs_and_shows_two_films(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a cell that fails, a film that is not there, and compensation that is none."""
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    shown: list[Any] = []
    notebook: Any = types.ModuleType("IPython")
    notebook.get_ipython = lambda: None  # Matplotlib asks for both
    notebook.version_info = (9, 0)
    notebook.display = types.SimpleNamespace(
        Video=lambda film, **_: Path(film).read_bytes(), display=shown.append
    )
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    namespace: dict[str, Any] = {}
    _, *others = sources()  # the first one installs
    for source in others:
        run(source, namespace)
    assert [film[4:8] for film in shown] == [b"ftyp"] * 2
    assert namespace["rms"]["input"] < namespace["rms"]["uncompensated"] / 2
    assert namespace["pelvis"] < 10.0
