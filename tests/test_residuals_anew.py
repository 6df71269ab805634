"""Residuals of the package, trained anew and compared with those of the package."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from tests.residuals_anew import (
    CONFIGS,
    RESIDUALS,
    beside_the_shipped,
    main,
    reproduce,
    shipped_seeds,
)
from train.commands.compare_config import CompareConfig
from train.workers.executors import Executors

TRAINING = """\
name: train_testbed
env: testbed
reference: {kind: sine, duration_s: 2, onset_s: 0.5, amplitude: 0.1}
base: input
settings: {acts_on: {command: 0.1}, decision_period: 2}
env_options: {timestep_s: 0.001}
worlds: 2
decisions: 64
algorithm_options: {n_steps: 32, batch_size: 32, n_epochs: 1}
evaluate_every: 64
evaluation_episodes: 1
checkpoint_every: 64
"""
COMPARISON = """\
name: learned_testbed
references: [{kind: sine, duration_s: 2, onset_s: 0.5, amplitude: 0.1}]
env_options: {timestep_s: 0.001}
policies: [input, {name: "residual:testbed/seed_0", label: residual}]
"""


@pytest.mark.slow
def test_a_residual_stands_beside_the_one_of_the_package_and_a_second_call_goes_on(
    tmp_path: Path,
) -> None:
    """Catches policies of the package that are compared with themselves, and finished training
    that begins anew."""
    (tmp_path / "train_testbed.yaml").write_text(TRAINING)
    (tmp_path / "learned_testbed.yaml").write_text(COMPARISON)

    def played() -> dict[str, float]:
        made = reproduce(
            "testbed", tmp_path, Console(quiet=True), [3], Executors(jobs=1), configs=tmp_path
        )
        return {
            one.condition.policy.title: one.values("link_error_rms_rad")[0]
            for one in made.evaluations
        }

    first = played()
    weights = tmp_path / "testbed/training/seed_3/last/weights.safetensors"
    written = weights.stat().st_mtime_ns
    assert {"input", "of the package", "trained anew"} <= first.keys()
    assert first["of the package"] < first["input"]  # a policy of 64 decisions is another one
    assert first["trained anew"] not in (first["input"], first["of the package"])
    assert played() == first
    assert weights.stat().st_mtime_ns == written


def test_all_residuals_of_the_package_can_be_trained_anew() -> None:
    """Catches a residual without its configurations, and one that its comparison does not play."""
    assert {
        folder.name for folder in Path("baselines/trained").iterdir() if folder.is_dir()
    } == set(RESIDUALS)
    for name, compared in RESIDUALS.items():
        config = load_yaml(CONFIGS / f"{compared}.yaml", CompareConfig)
        both = beside_the_shipped(config, name, Path("run"))
        assert [policy.title for policy in both.policies][-2:] == ["of the package", "trained anew"]
        assert len(shipped_seeds(name)) >= 5
        assert (CONFIGS / f"train_{name}.yaml").is_file()


def test_a_comparison_without_the_residual_is_refused() -> None:
    """Catches two policies of one name, of which none is the package's."""
    config = CompareConfig(name="other", references=["sine"])
    with pytest.raises(ConfigurationError, match="does not compare residual:testbed"):
        beside_the_shipped(config, "testbed", Path("run"))


def test_an_unknown_residual_is_refused_before_hours_of_training() -> None:
    """Catches a name that is found out after the others were trained."""
    with pytest.raises(ConfigurationError, match="walker_3s"):
        main(("testbed", "walker_3"))


@pytest.mark.slow
def test_the_program_speaks_and_ends_as_elastic_does() -> None:
    """Catches escapes of a terminal in what it says, and a closed pipe that is no exit code."""
    command = [sys.executable, "-m", "tests.residuals_anew"]
    refused = subprocess.run([*command, "\x1b[31mred"], capture_output=True, check=False)
    assert refused.returncode == 2
    assert b"error: unknown residual of the package" in refused.stderr
    assert b"\x1b" not in refused.stdout + refused.stderr
    reading, writing = os.pipe()
    os.close(reading)
    unread = subprocess.run([*command, "--help"], stdout=writing, check=False)
    os.close(writing)
    assert unread.returncode == 141
