"""An environment is registered in one place, and everything else asks there."""

from importlib import import_module
from pathlib import Path

import gymnasium
import pytest

from elastic_env import IDS
from elastic_env.world.scenario import scenario_names
from train.evaluate import environments

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", IDS)
def test_id_entry_points_and_commands_know_an_environment(name: str) -> None:
    """Catches an environment that `gymnasium.make` knows and `--env` does not, or an entry point
    that leads nowhere."""
    spec = gymnasium.registry[IDS[name]]
    for entry_point in (spec.entry_point, spec.vector_entry_point):
        module, _, function = str(entry_point).partition(":")
        assert callable(getattr(import_module(module), function))
    assert environments.environment(name).id == IDS[name]


@pytest.mark.parametrize("name", [name for name in IDS if name != "hardware"])
def test_a_task_has_the_name_of_its_registration(name: str) -> None:
    """Catches a residual that its own environment refuses, since it is kept under the task's
    name."""
    assert gymnasium.make(IDS[name], disable_env_checker=True).unwrapped.task.name == name  # type: ignore[attr-defined]


def test_documents_name_every_environment_and_scenario() -> None:
    """Catches an environment or a scenario that no document tells of."""
    readme, robots = (
        (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/robots.md")
    )
    options = (ROOT / "docs" / "options.md").read_text(encoding="utf-8")
    assert [known for known in IDS.values() if known not in readme + robots + options] == []
    assert [name for name in IDS if f"`{name}`" not in options] == []
    assert [name for name in scenario_names() if f"`{name}`" not in options] == []
    assert [name for name in scenario_names(walks=False) if f"`{name}`" not in robots] == []
