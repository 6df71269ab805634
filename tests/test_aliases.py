"""`elastic_env.baselines` and `elastic_env.train`: the packages beside, or an error that helps."""

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import baselines
import elastic_env
import train


def test_the_packages_beside_are_reached_through_elastic_env() -> None:
    """Catches a second copy of a package, whose classes are not those of the first."""
    assert elastic_env.baselines is baselines
    assert elastic_env.train is train
    for name in baselines.__all__:
        assert getattr(elastic_env.baselines, name) is getattr(baselines, name)
    assert pickle.loads(pickle.dumps(elastic_env.baselines.Corrected)) is baselines.Corrected
    assert elastic_env.baselines.Corrected.__module__.startswith("baselines.")
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        elastic_env.trian  # noqa: B018  it is asked for


@pytest.mark.parametrize(
    "shadow", ["baselines.py", pytest.param("baselines/other.py", marks=pytest.mark.slow)]
)
def test_a_module_of_the_user_in_their_place_is_named(shadow: str, tmp_path: Path) -> None:
    """Catches a user's file that is taken for ours, or run before it is refused."""
    file = tmp_path / shadow
    file.parent.mkdir(exist_ok=True)
    file.write_text("print('imported')\n")
    (file.parent / "__init__.py").touch()
    run = subprocess.run(
        [sys.executable, "-c", "from elastic_env import baselines"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1
    assert not run.stdout
    last = run.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {tmp_path}/baselines")
    assert "stands in the place of the package baselines of elastic-env" in last
    assert "rename it" in last
