"""Residuals as graphs of ONNX: equal to NumPy, with mirror, bounds and what one must know."""

import json
import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
import pytest

import baselines
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.residual_policy import save_residual
from baselines.residual.settings import ResidualDescription, ResidualSettings
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from train.commands.cli import main
from train.export.onnx_residual import onnx_model
from train.export.residual_layout import ResidualLayout

TOLERANCE = 1e-6
ON_WALKER: dict[str, Any] = {
    "acts_on": {"deflection": {"hip_roll": 0.6, "knee": 0.4}, "zmp": {"x": 0.006, "y": 0.012}},
    "decision_period": 25,
    "shared": True,
    "mirror": True,
    "observe": ("clock", "wrench", "encoder_angle"),
}
CASES: dict[str, dict[str, Any]] = {
    "testbed": {
        "robot": "testbed",
        "base": "input",
        "settings": {"acts_on": {"command": 0.04}, "history": 2},
        "activation": "tanh",
        "output": "clip",
    },
    "mirrored": {
        "robot": "walker",
        "base": "posture",
        "settings": ON_WALKER,
        "activation": "relu",
        "output": "tanh",
    },
    "cautious": {
        "robot": "walker",
        "base": "input_output",
        "settings": {**ON_WALKER, "acts_on": {"deflection": 0.5}, "cautious": True},
        "activation": "tanh",
        "output": "clip",
        "clip": 3.0,
    },
}
IDS = {"testbed": "elastic_env/Testbed-v0", "walker": "elastic_env/WalkInPlace-v0"}


def residual(case: str, folder: Path) -> str:
    """A residual with random weights and features of another size each; the name of its policy."""
    description = ResidualDescription(**CASES[case])
    env = gymnasium.make(IDS[description.robot])
    base = baselines.make(description.base, env)
    model = env.unwrapped.assumed_model  # type: ignore[attr-defined]
    corrected = Corrected(base, model, description.settings)
    generator = np.random.default_rng(0)
    width = Features(corrected).width
    widths = [width, 16, 8, corrected.num_residuals]
    tensors: dict[str, Any] = {
        "mean": generator.normal(0.0, 500.0, width),
        "std": generator.uniform(1e-3, 2.0, width),
    }
    for i in range(3):
        scale = 1.0 / np.sqrt(widths[i])
        shape = (widths[i + 1], widths[i])
        tensors[f"weight{i}"] = generator.normal(0.0, scale, shape).astype(np.float32)
        tensors[f"bias{i}"] = generator.normal(0.0, 0.3, widths[i + 1]).astype(np.float32)
    save_residual(folder, description, tensors)
    return f"residual:{folder}"


def inputs_of(session: Any, given: dict[str, Any]) -> dict[str, Any]:
    return {one.name: given[one.name] for one in session.get_inputs()}


@pytest.mark.parametrize("case", CASES)
def test_the_graph_computes_what_python_does(case: str, tmp_path: Path) -> None:
    """Catches a transposed weight, a wrong activation, a lost mean, mirror, bound or trust, and
    features in single precision."""
    layout = ResidualLayout.of(residual(case, tmp_path / "r"))
    session = onnxruntime.InferenceSession(onnx_model(layout))
    drawn = layout.draw(10_000, seed=5)
    found = session.run(None, inputs_of(session, drawn))
    expected = layout.decide(**drawn)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=TOLERANCE)
        assert (other.std(axis=0) > 1e-3).sum() >= len(layout.residual)
    names = [one.name for one in session.get_inputs()]
    assert ("on_right" in names) == (case != "testbed")
    assert ("trust" in names) == (case == "cautious")


def test_it_decides_on_a_walk_as_the_policy_does(tmp_path: Path) -> None:
    """Catches features in another order, and a mirror at the wrong steps or of one side alone."""
    name = residual("mirrored", tmp_path / "r")
    session = onnxruntime.InferenceSession(onnx_model(ResidualLayout.of(name)))
    env: Any = gymnasium.make(IDS["walker"], step_period=[0.3, 0.4, 0.3], num_steps=2)
    policy: Any = baselines.make(name, env)
    settings = policy.corrected.settings.model_dump() | {"mirror": False}
    base = baselines.make("posture", env)
    model = env.unwrapped.assumed_model
    features = Features(Corrected(base, model, ResidualSettings(**settings)))
    support = env.unwrapped.task.observation_table.columns("clock.support")
    observation, _ = env.reset(seed=0)
    state = None
    feet: list[float] = []
    for step in range(700):
        rows = observation[None]
        action, state = policy.predict(observation, state)
        if step % 25 == 0:
            seen, _ = features.at(rows, None, np.array([True]), None, None)
            on_right = rows[:, support] == 1.0
            decided, _ = session.run(None, {"features": seen, "on_right": on_right})
            np.testing.assert_allclose(decided, state.residual, rtol=0.0, atol=TOLERANCE)
            feet.append(float(rows[0, support][0]))
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    assert set(feet) == {0.0, 1.0}


def test_the_file_says_what_one_must_know(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches names, units or bounds of other columns, and a test vector of another graph."""
    monkeypatch.chdir(tmp_path)
    residual("testbed", Path("mine/r"))
    main(["export", "onnx", "residual:mine/r"])
    assert "wrote mine_r.npz" in capsys.readouterr().out
    session = onnxruntime.InferenceSession("mine_r.onnx")
    facts = session.get_modelmeta().custom_metadata_map
    features = json.loads(facts["features"])
    assert features[0] == {
        "name": "encoder_angle",
        "unit": "rad",
        "meaning": features[0]["meaning"],
    }
    assert features[-1]["name"].endswith("@-2")
    assert len(features) == session.get_inputs()[0].shape[1]
    (column,) = json.loads(facts["correction"])
    assert (column["name"], column["unit"], column["bound"]) == ("command.joint", "rad", 0.04)
    weights = Path("mine/r/weights.safetensors").read_bytes()
    assert facts["weights_sha256"] == sha256(weights).hexdigest()
    assert facts["decision_period"] == "25"
    vector: dict[str, Array] = dict(np.load("mine_r.npz"))
    outputs = [vector.pop("residual"), vector.pop("correction")]
    for one, other in zip(session.run(None, dict(vector)), outputs, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=TOLERANCE)
    for wrong, said in (
        (["residual:mine/r"], "mine_r.onnx exists; add --overwrite"),
        (["residual:mine/r", "-o", "a.bin"], "a graph of ONNX is a file .onnx"),
        (["residual:mine/r", "--env", "walker"], "is a residual for the testbed"),
        (["mine/r"], "residual:PATH"),
        (["residual:none"], "no residual at none"),
    ):
        with pytest.raises(SystemExit):
            main(["export", "onnx", *wrong])
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert said in error


def test_a_residual_that_no_robot_can_play_is_no_graph(tmp_path: Path) -> None:
    """Catches a teacher, and code that a folder names as its environment."""
    residual("mirrored", tmp_path / "r")
    file = tmp_path / "r" / "residual.json"
    given = json.loads(file.read_text())
    file.write_text(
        json.dumps({**given, "settings": {**given["settings"], "privileged": ["load"]}})
    )
    with pytest.raises(ConfigurationError, match="a teacher, which sees the true load"):
        ResidualLayout.of(f"residual:{tmp_path / 'r'}")
    file.write_text(json.dumps({**given, "robot": "antigravity:fly"}))
    with pytest.raises(ConfigurationError, match="name its environment by --env"):
        ResidualLayout.of(f"residual:{tmp_path / 'r'}")
    assert "antigravity" not in sys.modules


def test_the_layout_needs_no_torch() -> None:
    code = "import sys, train.export.residual_layout, train.export.c_arm; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
