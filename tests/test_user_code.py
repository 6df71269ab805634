"""Policies and wrappers in the user's own files, whatever these are called."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

from elastic_env.core.errors import ConfigurationError
from train.evaluate.conditions import PolicySpec
from train.evaluate.rollout import control_steps, make_policy
from train.runs.import_path import append_to_path, remove_from_path
from train.runs.user_code import named_object

ROOT = Path(__file__).resolve().parents[1]
TRAIN = """
import gymnasium
import elastic_env
from baselines import ResidualWrapper
env = ResidualWrapper(gymnasium.make("elastic_env/Testbed-v0", reference="sine"), "input")
env.reset(seed=0)
print(env.step(env.action_space.sample() * 0.0)[1] <= 0.0)
"""


@pytest.mark.slow
def test_the_users_own_train_py_gets_the_wrappers(tmp_path: Path) -> None:
    """Catches a file of the user that imports itself in the place of our package, which is
    called train too."""
    (tmp_path / "train.py").write_text(TRAIN)
    run = subprocess.run(
        [sys.executable, "train.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert run.stdout.split() == ["True"], run.stderr


def test_a_policy_is_found_by_the_path_of_its_file(tmp_path: Path) -> None:
    """Catches a file that is looked for among the modules, where another one, such as our train,
    has its name."""
    (tmp_path / "train.py").write_text("def answer(env):\n    return 42\n")
    assert named_object(f"{tmp_path / 'train.py'}:answer")(None) == 42
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "train.py").write_text("def answer(env):\n    return 43\n")
    assert named_object(f"{tmp_path / 'other' / 'train.py'}:answer")(None) == 43


def test_what_is_wrong_with_a_file_is_said(tmp_path: Path) -> None:
    """Catches a traceback for a missing file, a broken one, or a function that it does not have."""
    good = tmp_path / "good.py"
    bad = tmp_path / "bad.py"
    good.write_text("def answer(env):\n    return 42\n")
    bad.write_text("raise SystemExit(5)\n")
    empty = tmp_path / "empty.py"
    empty.write_text("from pathlib import Path\nNAME = 'x'\n")
    for name, said in (
        (f"{tmp_path / 'none.py'}:f", "there is no file"),
        (f"{bad}:f", "SystemExit: 5"),
        (f"{good}:question", "unknown function or class in .*: 'question'; choose one of: answer"),
        (f"{empty}:f", "has no 'f', and no function or class of its own"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            named_object(name)


STANDARD = ("multiprocessing", "subprocess", "weakref", "random", "numpy")
"""Modules that every process imports, and that would be found in the working folder first."""
MINE = """
import baselines
import helper

def policy(env):
    return baselines.make(helper.NAME, env)
"""
CONFIG = """
name: mine
policies: [{name: "mine.py:policy", label: by file}, {name: "own:policy", label: by module}]
references: [{kind: sine, duration_s: 0.5, onset_s: 0.5, amplitude: 0.1}]
"""


def plant(folder: Path) -> Path:
    """Lay modules into a folder that leave their names in a file when they are imported; that
    file."""
    said = folder / "imported"
    for name in (*STANDARD, "train", "baselines", "elastic_env"):
        (folder / f"{name}.py").write_text(f"open({str(said)!r}, 'a').write('{name} ')\n")
    return said


def elastic(folder: Path, *arguments: str, **more: str) -> "subprocess.CompletedProcess[str]":
    """Run the console script in a folder, with further variables of the environment."""
    command = [str(Path(sys.executable).with_name("elastic")), *arguments]
    known = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        command, cwd=folder, env={**known, **more}, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_nothing_of_the_working_folder_stands_before_what_is_installed(tmp_path: Path) -> None:
    """Catches workers that import a user's multiprocessing.py, and a baselines.py that breaks
    every command."""
    said = plant(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "own.py").write_text(MINE)
    (tmp_path / "helper.py").write_text("NAME = 'input'\n")
    (tmp_path / "mine.yaml").write_text(CONFIG)
    run = elastic(tmp_path, "compare", "mine.yaml", "--jobs", "2", COLUMNS="200")
    assert run.returncode == 0, run.stderr
    assert not said.exists(), said.read_text()


PLUG_INS = ("pydantic", "gymnasium.envs", "torch.backends", "console_scripts")
"""Groups of entry points, which packages import when they are imported themselves."""


@pytest.mark.slow
def test_what_calls_itself_a_plug_in_in_the_working_folder_is_not_imported(tmp_path: Path) -> None:
    """Catches a folder that was unpacked beside the data, and whose "installed" package is
    imported by pydantic or gymnasium before any file is named."""
    said = tmp_path / "imported"
    (tmp_path / "evil.py").write_text(f"open({str(said)!r}, 'a').write('evil')\n")
    package = tmp_path / "evil-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    entries = "".join(f"[{group}]\nevil = evil:plug_in\n" for group in PLUG_INS)
    (package / "entry_points.txt").write_text(entries)
    run = elastic(tmp_path, "evaluate", "--help")
    assert run.returncode == 0, run.stderr
    assert not said.exists()


def test_the_working_folder_names_no_cache_of_compiled_code(tmp_path: Path) -> None:
    """Catches a cache in the working folder, which Numba would unpickle."""
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: here\n")
    code = "import train.commands.entry as e; e._leave_working_folder(); import numba; "
    run = subprocess.run(
        [sys.executable, "-c", code + "print([numba.config.CACHE_DIR])"],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout == "['']\n"


def test_a_file_that_stands_before_a_package_is_named(tmp_path: Path) -> None:
    """Catches "a defect of elastic-env" where a folder of PYTHONPATH has a baselines.py."""
    (tmp_path / "baselines.py").write_text("")
    (tmp_path / "work").mkdir()
    run = elastic(tmp_path / "work", "evaluate", "--help", PYTHONPATH=str(tmp_path))
    assert run.returncode == 2
    assert run.stderr.startswith(
        f"error: {tmp_path / 'baselines.py'} stands in the place of the package baselines"
    )
    assert len(run.stderr.splitlines()) == 1


def test_the_path_keeps_its_order_but_for_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a path that loses entries or has the folder twice, first, or before our packages."""
    monkeypatch.chdir(tmp_path)
    others = [entry for entry in sys.path if entry and Path(entry).resolve() != tmp_path]
    for first in ("", ".", str(tmp_path)):
        monkeypatch.setattr(sys, "path", [first, *others])
        remove_from_path(tmp_path)
        assert tmp_path not in map(Path, sys.path)
        append_to_path(tmp_path)
        append_to_path(tmp_path)
        assert sys.path[-1] == str(tmp_path)
        assert [entry for entry in sys.path if entry in others] == others
        assert sys.path.count(str(tmp_path)) == 1
        assert str(ROOT) in sys.path


def test_a_module_that_stands_before_the_users_file_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches "train has no 'make'" for a user whose train.py has one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "train.py").write_text("def make(env):\n    return 42\n")
    with pytest.raises(
        ConfigurationError,
        match=r"is imported instead of your train\.py; name the file itself: train\.py:make",
    ):
        named_object("train:make")


FAULTY = """import numpy as np
def make(env, gain=1.0):
    return np.linalg.inv(np.zeros((2, 2)))
class Alone:
    def predict(self, observation, **_):
        return np.zeros(1, np.float32)
"""


def test_an_error_names_the_line_of_the_user_and_none_of_a_library(tmp_path: Path) -> None:
    """Catches NumPy's line in the place of the user's, and a line of ours."""
    (tmp_path / "mine.py").write_text(FAULTY)
    spec = PolicySpec(name=f"{tmp_path}/mine.py:make", options={"gain": 2.0})
    with pytest.raises(ConfigurationError, match=r"raised \(mine\.py:3\) LinAlgError"):
        make_policy(spec, None)


def test_an_option_that_a_policy_does_not_take_is_answered_by_those_that_it_takes(
    tmp_path: Path,
) -> None:
    """Catches an answer that lists the baselines."""
    (tmp_path / "mine.py").write_text(FAULTY)
    spec = PolicySpec(name=f"{tmp_path}/mine.py:make", options={"gian": 2.0})
    with pytest.raises(ConfigurationError, match=r"one of: gain\. Did you mean 'gain'"):
        make_policy(spec, None)


def test_a_policy_that_returns_no_state_is_told_what_to_return(tmp_path: Path) -> None:
    """Catches the words of a failed unpacking."""
    (tmp_path / "mine.py").write_text(FAULTY)
    policy = named_object(f"{tmp_path}/mine.py:Alone")()
    env = gymnasium.make("elastic_env/Testbed-v0", reference="sine")
    with pytest.raises(ConfigurationError, match=r"must return \(action, state\), got ndarray"):
        next(control_steps(env, policy, 0))
