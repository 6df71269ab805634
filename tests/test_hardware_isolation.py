"""What runs in the processes of the hardware: ours and the installed packages, nothing of the
working directory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from elastic_env.hardware.emulator.launch import RunningEmulator
from elastic_env.hardware.imu import AttitudeStream
from elastic_env.hardware.safety.processes import child_command, child_environment
from elastic_env.hardware.safety.supervised_bus import SupervisedBus
from tests.busy import once_more

PLANTED = (
    "serial",
    "socket",
    "numpy",
    "yaml",
    "pydantic",
    "mscl",
    "dynamixel_sdk",
    "mujoco",
    "json",
    "select",
    "pty",
    "elastic_env",
    "train",
    "sitecustomize",
    "usercustomize",
)
"""Modules of the standard library, of installed packages, and our own, that would be found
first."""

pytestmark = once_more


def plant(folder: Path) -> Path:
    """Lay modules into a folder that leave their names in a file, and end whoever imports them;
    that file."""
    said = folder / "imported"
    for name in PLANTED:
        text = f"import os\nopen({str(said)!r}, 'a').write('{name} ')\nos._exit(9)\n"
        (folder / f"{name}.py").write_text(text)
    return said


@pytest.mark.slow
@pytest.mark.parametrize("path", [None, f".{os.pathsep}"])
def test_nothing_of_the_working_directory_runs_in_a_child(
    path: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a file that happens to be called serial.py and runs in the process which switches
    torque off."""
    said = plant(tmp_path)
    monkeypatch.chdir(tmp_path)
    if path is None:
        monkeypatch.delenv("PYTHONPATH", raising=False)
    else:
        monkeypatch.setenv("PYTHONPATH", path)
    with RunningEmulator() as emulator:
        with SupervisedBus({emulator.port: [1]}) as bus:
            assert bus.models == [[54024]]
        with AttitudeStream(emulator.imu_port, oldest_s=0.5) as stream:
            stream.latest()
        done = subprocess.run(
            child_command("tests.hardware_trials.wave", "/dev/ttyNOTHING", "1"),
            env=child_environment(),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert "/dev/ttyNOTHING: there is no such device" in done.stdout
    assert not said.exists(), said.read_text()


def test_the_command_of_a_child_finds_nothing_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a child's command, or its environment, by which planted modules are imported."""
    said = plant(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f".{os.pathsep}")
    done = subprocess.run(
        child_command("elastic_env.hardware.buses.port"),
        env=child_environment(),
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0
    assert not said.exists(), said.read_text()


def test_planted_modules_are_found_by_python_m(tmp_path: Path) -> None:
    """Catches planted modules that nothing would ever import, with which the test above could
    not fail."""
    said = plant(tmp_path)
    command = [sys.executable, "-m", "elastic_env.hardware.safety.supervisor", "0", "0"]
    assert (
        subprocess.run(
            command, cwd=tmp_path, capture_output=True, timeout=60, check=False
        ).returncode
        == 9
    )
    assert said.exists()


def test_packages_of_the_users_path_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches isolation that goes too far: a driver's package installed by PYTHONPATH, also a
    relative one."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "serial.py").write_text("raise SystemExit('from the path')\n")
    monkeypatch.chdir(tmp_path)
    for given in (tmp_path / "packages", "packages"):
        monkeypatch.setenv("PYTHONPATH", f"{given}{os.pathsep}.")
        done = subprocess.run(
            child_command("elastic_env.hardware.buses.port"),
            env=child_environment(),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert "from the path" in done.stderr


def test_a_child_has_the_rest_of_the_environment() -> None:
    """Catches an empty PYTHONPATH that is left, and other variables that are lost."""
    assert child_environment({"A": "1", "PYTHONPATH": "/x::/y:."}) == {
        "A": "1",
        "PYTHONPATH": "/x:/y",
    }
    for here in ("", os.pathsep, ".", "./.", str(Path.cwd()), f"{Path.cwd()}/../{Path.cwd().name}"):
        assert child_environment({"A": "1", "PYTHONPATH": here}) == {"A": "1"}
