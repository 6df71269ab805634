"""What others write: configurations and residual folders with mistakes are taken or refused, in
time and in bounds."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from baselines.residual.residual_folder import load_residual, read_description
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.json_text import parse_json
from elastic_env.world.physics import substeps
from tests.mutations import RESIDUALS
from train.commands.bench import BenchConfig
from train.commands.compare_config import CompareConfig
from train.evaluate.conditions import PolicySpec
from train.evaluate.environments import environment
from train.evaluate.residual_seeds import expand
from train.evaluate.rollout import make_policy
from train.learn.train_config import TrainConfig, training_worlds
from train.runs.user_code import KINDS

ROOT = Path(__file__).parents[1]
LONGEST_S = 300
MOST_BYTES = 2 * 10**9


@pytest.mark.parametrize(
    ("cases", "short_walks"), [(200, True), pytest.param(2000, False, marks=pytest.mark.slow)]
)
def test_mutated_configurations_and_folders_are_taken_or_refused(
    tmp_path: Path, cases: int, short_walks: bool
) -> None:
    """Catches a traceback, more than 2 GB, a case that does not end, and a file outside of the
    working folder."""
    limit = (
        f"import resource; resource.setrlimit(resource.RLIMIT_DATA, ({MOST_BYTES}, {MOST_BYTES}))"
    )
    call = f"main(0, {cases}, short_walks={short_walks})"
    code = f"{limit}; from tests.mutations import main; raise SystemExit({call} > 0)"
    (tmp_path / "tmp").mkdir()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path / "tmp")}
    played = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )
    assert played.returncode == 0, played.stdout[-3000:] + played.stderr[-3000:]
    assert [path.name for path in tmp_path.rglob("*")] == ["tmp"]


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a": 1, "a": 2}', "NaN", "1e999", "9" * 5000, '"\\u0000"', '"\\ud800"'],
)
def test_json_has_limits(text: str) -> None:
    """Catches a RecursionError, a key that hides another, and values that no file can hold."""
    with pytest.raises(ValueError, match=r"deep|twice|finite|characters"):
        parse_json(text)


def copied(tmp_path: Path) -> Path:
    """A shipped residual in a folder of its own."""
    return Path(shutil.copytree(RESIDUALS[0], tmp_path / "r"))


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        (
            "bias0",
            np.zeros((64, 1), dtype=np.float32),
            r"bias0 must have the shape \(n,\).*got \(64, 1\)",
        ),
        ("bias1", np.zeros((), dtype=np.float32), r"bias1 must have the shape \(n,\).*got \(\)"),
        (
            "weight1",
            np.zeros((64, 63), dtype=np.float32),
            r"weight1 must have the shape \(64, 64\), got \(64, 63\)",
        ),
        (
            "weight1",
            np.zeros((64, 64), dtype=np.int32),
            "weight1.*must be of type F32 or F64, got I32",
        ),
        ("weight0", np.full((64, 14), np.inf, dtype=np.float32), "weight0 must be finite"),
        ("weight0", np.full((64, 14), 1e30, dtype=np.float32), "weight0 must be finite.*within"),
        ("bias9", np.zeros(3, dtype=np.float32), "must be mean, std, weight0"),
    ],
)
def test_tensors_that_make_no_network_are_refused(
    name: str, tensor: Any, message: str, tmp_path: Path
) -> None:
    """Catches a tensor that passes when it is read and fails, or gives no number, in `predict`."""
    folder = copied(tmp_path)
    save_file(
        load_file(folder / "weights.safetensors") | {name: tensor}, folder / "weights.safetensors"
    )
    with pytest.raises(ConfigurationError, match=rf"weights\.safetensors.*{message}"):
        load_residual(folder)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("settings", "joints"), [], "settings.joints must have at least 1 entry"),
        (
            ("settings", "decision_period"),
            10**30,
            "settings.decision_period must be a whole number >= 1 and <= 100000",
        ),
        (("training", "config"), [], "config must be a mapping"),
        (("training", "config", "seeds"), 5, "config.seeds must be a list, got 5"),
        (("training", "config", "scenarios"), 7, "config.scenarios must be a list, got 7"),
        (("clip",), -1, "clip must be a finite number > 0"),
        (("extra",), 1, "unknown parameter 'extra'"),
    ],
)
def test_descriptions_that_nobody_can_use_are_refused(
    path: tuple[str, ...], value: Any, message: str, tmp_path: Path
) -> None:
    """Catches parts of `residual.json` that only a comparison reads, after it has simulated."""
    folder = copied(tmp_path)
    content = json.loads((folder / "residual.json").read_text())
    holder = content
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    (folder / "residual.json").write_text(json.dumps(content))
    with pytest.raises(
        ConfigurationError, match=rf"residual\.json describes no residual: .*{message}"
    ):
        read_description(folder)


def test_a_motion_of_training_that_no_report_can_name_is_refused_at_once(tmp_path: Path) -> None:
    """Catches an error at the end of a comparison, when all is simulated."""
    folder = Path(shutil.copytree(RESIDUALS[-1], tmp_path / "w"))
    content = json.loads((folder / "residual.json").read_text())
    content["training"]["config"]["reference"] = {"steps": 3}
    (folder / "residual.json").write_text(json.dumps(content))
    with pytest.raises(
        ConfigurationError, match=r"residual\.json: training\.config\.reference: .*'step_period'"
    ):
        expand([PolicySpec(name=f"residual:{folder}")])


def test_a_residual_far_down_in_folders_needs_no_label(tmp_path: Path) -> None:
    """Catches a bound of labels that a path exceeds, which is the label where none is given."""
    deep = tmp_path / ("x" * 150)
    shutil.copytree(RESIDUALS[0], deep)
    assert expand([PolicySpec(name=f"residual:{deep}")])[-1].policy.title == f"residual:{deep}"


@pytest.mark.parametrize(
    ("file", "model", "message"),
    [
        (
            "testbed.yaml",
            TrainConfig,
            "this is the configuration of a comparison: elastic compare FILE",
        ),
        (
            "train_testbed.yaml",
            CompareConfig,
            "this is the configuration of a training: elastic train FILE",
        ),
        ("bench.yaml", CompareConfig, "this is the configuration of a bench: elastic bench FILE"),
    ],
)
def test_a_configuration_of_another_command_is_recognised(
    file: str, model: Any, message: str
) -> None:
    """Catches twenty unknown parameters in the place of one sentence."""
    with pytest.raises(ConfigurationError, match=message):
        load_yaml(ROOT / "configs" / file, model)


def test_telling_keys_are_those_of_one_kind_alone() -> None:
    """Catches a key that was renamed, and one that tells nothing."""
    models = {"comparison": CompareConfig, "training": TrainConfig, "bench": BenchConfig}
    for kind, (_, keys) in KINDS.items():
        others = {
            name for other, model in models.items() if other != kind for name in model.model_fields
        }
        assert set(keys.split()) <= set(models[kind].model_fields) - others


def test_worlds_beyond_the_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a training that ends by the kernel's hand, without a word."""
    monkeypatch.setattr("os.sysconf", lambda name: 4096 if name == "SC_PAGE_SIZE" else 10**6)
    with pytest.raises(
        ConfigurationError, match=r"100000 worlds take about 10 GB.* has 4\.1 GB; .*at most 40960"
    ):
        training_worlds(TrainConfig(worlds=100_000), [("nominal", 100_000)], 1)


@pytest.mark.parametrize("name", ["elastic_env/Testbed-v0", "elastic_env/WalkInPlace-v0"])
def test_worlds_of_a_vector_environment_beyond_the_memory_are_refused(name: str) -> None:
    """Catches a computer that stands still, and a number that Python does not turn into text."""
    for worlds in (10**12, 10**5000):
        with pytest.raises(
            ConfigurationError, match=r"worlds take about .* GB of memory.*set num_envs to at most"
        ):
            gymnasium.make_vec(name, num_envs=worlds, vectorization_mode="vector_entry_point")


@pytest.mark.parametrize("timestep_s", [1e-310, 1e-300, 1e-9])
def test_a_physics_step_that_never_ends_a_control_period_is_refused(timestep_s: float) -> None:
    """Catches an OverflowError, and a loop of 10⁶ steps of physics in each of control."""
    with pytest.raises(ConfigurationError, match="timestep_s must be at least 4e-06 s"):
        substeps(0.004, timestep_s)


@pytest.mark.parametrize(
    "name", ["json:loads", "os:getpid", "no_such_module:f", "json:no_such", "os:sep", "a\\b:c"]
)
def test_a_function_that_makes_no_policy_is_explained(name: str) -> None:
    """Catches a traceback for a function that takes no environment."""
    with pytest.raises(
        ConfigurationError,
        match=r'"module:function", a function or class that takes the environment',
    ):
        make_policy(PolicySpec(name=name), object())


def test_what_an_error_shows_is_short() -> None:
    """Catches a terminal that is flooded, and an integer that Python does not turn into text."""
    for value in (10**5000, "x" * 10**6, [[1] * 1000] * 1000, {str(i): i for i in range(1000)}):
        assert len(quote(value)) < 300
    assert quote("nominal") == "'nominal'"
    with pytest.raises(ConfigurationError) as caught:
        environment("walker").arguments({str(i): i for i in range(2000)})
    assert len(str(caught.value)) < 500
