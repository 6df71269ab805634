"""Policies and wrappers in the user's own files, whatever these are called."""

import subprocess
import sys
from pathlib import Path

import pytest

from elastic_env.core.errors import ConfigurationError
from train.runs.user_code import named_object

TRAIN = """
import gymnasium
import elastic_env
from baselines import ResidualWrapper
env = ResidualWrapper(gymnasium.make("elastic_env/Testbed-v0", reference="sine"), "input")
env.reset(seed=0)
print(env.step(env.action_space.sample() * 0.0)[1] <= 0.0)
"""


def test_the_users_own_train_py_gets_the_wrappers(tmp_path: Path) -> None:
    """Catches a file of the user that imports itself in the place of our package, which is called train too."""
    (tmp_path / "train.py").write_text(TRAIN)
    run = subprocess.run([sys.executable, "train.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.stdout.split() == ["True"], run.stderr


def test_a_policy_is_found_by_the_path_of_its_file(tmp_path: Path) -> None:
    """Catches a file that is looked for among the modules, where another one, such as our train, has its name."""
    (tmp_path / "train.py").write_text("def answer(env):\n    return 42\n")
    assert named_object(f"{tmp_path / 'train.py'}:answer")(None) == 42
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "train.py").write_text("def answer(env):\n    return 43\n")
    assert named_object(f"{tmp_path / 'other' / 'train.py'}:answer")(None) == 43


def test_what_is_wrong_with_a_file_is_said(tmp_path: Path) -> None:
    """Catches a traceback for a missing file, a broken one, or a function that it does not have."""
    good, bad = tmp_path / "good.py", tmp_path / "bad.py"
    good.write_text("def answer(env):\n    return 42\n")
    bad.write_text("raise SystemExit(5)\n")
    for name, said in (
        (f"{tmp_path / 'none.py'}:f", "there is no file"),
        (f"{bad}:f", "SystemExit: 5"),
        (f"{good}:question", "has no 'question'; its functions are: answer"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            named_object(name)
