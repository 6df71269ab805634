"""An environment is registered in one place, and everything else asks there."""

from importlib import import_module

import gymnasium
import pytest

from elastic_env import IDS
from train.evaluate import environments


@pytest.mark.parametrize("name", IDS)
def test_id_entry_points_and_commands_know_an_environment(name: str) -> None:
    """Catches an environment that `gymnasium.make` knows and `--env` does not, or an entry point that leads nowhere."""
    spec = gymnasium.registry[IDS[name]]
    for entry_point in (spec.entry_point, spec.vector_entry_point):
        module, _, function = str(entry_point).partition(":")
        assert callable(getattr(import_module(module), function))
    assert environments.environment(name).id == IDS[name]


@pytest.mark.parametrize("name", [name for name in IDS if name != "hardware"])
def test_a_task_has_the_name_of_its_registration(name: str) -> None:
    """Catches a residual that its own environment refuses, since it is kept under the task's name."""
    assert gymnasium.make(IDS[name], disable_env_checker=True).unwrapped.task.name == name  # type: ignore[attr-defined]
