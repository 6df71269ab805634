"""Processes of our own import nothing from the working directory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from elastic_env.hardware import child

PLANTED = ("serial", "socket", "numpy", "yaml", "pydantic", "mscl", "json", "runpy", "elastic_env")
MODULES = ("elastic_env.hardware.supervisor", "elastic_env.hardware.attitude_reader",
           "elastic_env.hardware.emulator.process")  # fmt: skip


@pytest.mark.parametrize("module", MODULES)
def test_no_module_of_the_working_directory_runs_in_a_child(module: str, tmp_path: Path) -> None:
    """Catches a serial.py or numpy.py that lies where the user works and runs in the process that keeps the limits."""
    for name in PLANTED:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\nraise SystemExit\n"
        )
    environment = {**os.environ, "PYTHONPATH": f"{os.pathsep}.{os.pathsep}{tmp_path}"}
    code = f"import runpy; runpy.run_module({module!r}, run_name='__planted__')"  # imports, without serving
    made = child.command(module)
    imports = [*made[:-1], made[-1].replace("'__main__'", "'__planted__'")]
    subprocess.run(imports, cwd=tmp_path, env=environment, check=True, timeout=60)
    assert not (tmp_path / "ran").exists()
    plain = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=False, timeout=60)
    assert plain.returncode == 0
    assert (tmp_path / "ran").read_text()  # what was planted does run where nobody is isolated


def test_all_children_are_started_so() -> None:
    """Catches another child that is started by python -m."""
    folder = Path(child.__file__).parent
    for file in folder.rglob("*.py"):
        if file.name != "child.py":
            assert "sys.executable" not in file.read_text(), file
