"""Residuals as graphs of ONNX and as headers in C: equal to NumPy, on a walk too."""

import json
import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import onnxruntime
import pytest

import baselines
from baselines.residual.correction import Corrected
from baselines.residual.features import Features
from baselines.residual.residual_folder import save_residual
from baselines.residual.settings import ResidualDescription, ResidualSettings
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from tests.test_c_export import COMPILERS, RELEASED, compiled, require_no_library
from train.commands.cli import main
from train.export.c_residual import c_residual
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
    "clipped": {
        "robot": "walker",
        "base": "input_output",
        "settings": {**ON_WALKER, "acts_on": {"deflection": 0.5}},
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
    """Catches a transposed weight, a wrong activation, a lost mean, mirror or bound, and
    features in single precision."""
    layout = ResidualLayout.load(residual(case, tmp_path / "r"))
    session = onnxruntime.InferenceSession(onnx_model(layout))
    drawn = layout.draw(10_000, seed=5)
    found = session.run(None, inputs_of(session, drawn))
    expected = layout.decide(**drawn)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=TOLERANCE)
        assert (other.std(axis=0) > 1e-3).sum() >= len(layout.residual)
    names = [one.name for one in session.get_inputs()]
    assert ("on_right" in names) == (case != "testbed")


class Walk(NamedTuple):
    """What a policy has decided on a walk, a row per control step.

    Attributes:
        layout: Of its residual.
        features: Before the mirror, as every moment has them.
        on_right: Whether the step is on the right foot, (T, 1).
        residual, values: As the policy remembers them.
    """

    layout: ResidualLayout
    features: Array
    on_right: Any
    residual: Array
    values: Array


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    """A short walk under the mirrored residual."""
    name = residual("mirrored", tmp_path_factory.mktemp("walk") / "r")
    env: Any = gymnasium.make(IDS["walker"], step_period=[0.3, 0.4, 0.3], num_steps=2)
    policy: Any = baselines.make(name, env)
    settings = policy.corrected.settings.model_dump() | {"mirror": False}
    model = env.unwrapped.assumed_model
    base = baselines.make("posture", env)
    features = Features(Corrected(base, model, ResidualSettings(**settings)))
    support = env.unwrapped.task.observation_table.columns("clock.support")
    observation, _ = env.reset(seed=0)
    rows: list[Any] = []
    state = None
    is_over = False
    while not is_over:
        before = observation[None]
        action, state = policy.predict(observation, state)
        seen, _ = features.at(before, None, np.array([True]), None, None)
        on_right = before[:, support] == 1.0
        rows.append((seen[0], on_right[0], state.residual[0], state.inner.values[0]))
        observation, _, terminated, truncated, _ = env.step(action)
        is_over = terminated or truncated
    return Walk(ResidualLayout.load(name), *map(np.array, zip(*rows, strict=True)))


def test_the_graph_decides_on_a_walk_as_the_policy_does(walk: Walk) -> None:
    """Catches features in another order, and a mirror at the wrong steps or of one side alone."""
    session = onnxruntime.InferenceSession(onnx_model(walk.layout))
    given = {"features": walk.features[::25], "on_right": walk.on_right[::25]}
    decided, _ = session.run(None, given)
    np.testing.assert_allclose(decided, walk.residual[::25], rtol=0.0, atol=TOLERANCE)
    assert set(walk.on_right[::25].ravel()) == {False, True}


DRIVER = r"""
#include "arm.h"
#include <stdio.h>

int main(int count, char **paths) {
    double in[ARM_FEATURES + 1], out[ARM_DECIDED + ARM_COLUMNS];
    FILE *from = fopen(paths[1], "rb"), *to = fopen(paths[2], "wb");
    arm_state state;
    arm_begin(&state);
    while (count == 3 && fread(in, sizeof in, 1, from) == 1) {
        const int on_right = in[ARM_FEATURES] > 0.0;
        int k;
        if (!arm_decide(in, on_right, out)) return 1;
        if (!arm_step(&state, arm_is_due(&state) ? in : 0, on_right)) return 1;
        for (k = 0; k < ARM_COLUMNS; k++) out[ARM_DECIDED + k] = state.values[k];
        fwrite(out, sizeof out, 1, to);
    }
    fclose(from);
    return fclose(to);
}
"""


def played_in_c(
    layout: ResidualLayout, compiler: str, folder: Path, features: Array, on_right: Any
) -> tuple[Array, Array]:
    """Decisions of every row, and values of the base's inputs where the rows are a motion."""
    program = compiled(folder, c_residual(layout, "arm"), compiler, DRIVER)
    np.hstack([features, on_right]).tofile(folder / "in")
    subprocess.run([program, "in", "out"], cwd=folder, check=True, timeout=300)
    found = np.fromfile(folder / "out").reshape(len(features), -1)
    decided, values = np.split(found, [len(layout.residual)], axis=1)
    return decided, values


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    "case",
    # the example of the last one checks itself on every commit
    ["testbed", "mirrored", pytest.param("clipped", marks=pytest.mark.slow)],
)
def test_the_header_computes_what_python_does(case: str, compiler: str, tmp_path: Path) -> None:
    """Catches what is wrong with a table, a layer, an activation or the mirror."""
    layout = ResidualLayout.load(residual(case, tmp_path / "r"))
    drawn = layout.draw(10_000, seed=2)
    found, _ = played_in_c(layout, compiler, tmp_path, **drawn)
    expected, _ = layout.decide(**drawn)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=TOLERANCE)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_header_corrects_on_a_walk_as_the_policy_does(
    walk: Walk, compiler: str, tmp_path: Path
) -> None:
    """Catches another period, a low-pass of another share, and a column at another's bound."""
    _, values = played_in_c(walk.layout, compiler, tmp_path, walk.features, walk.on_right)
    np.testing.assert_allclose(values, walk.values, rtol=0.0, atol=TOLERANCE)
    assert (np.abs(values).max(axis=0) > 0.0).sum() == np.count_nonzero(walk.layout.bounds)


def test_numbers_that_are_not_finite_change_nothing_in_c(tmp_path: Path) -> None:
    layout = ResidualLayout.load(residual("testbed", tmp_path / "r"))
    program = """#include "arm.h"
        int main(void) {
            double features[ARM_FEATURES] = {0.0};
            arm_state state;
            arm_begin(&state);
            features[0] = NAN;
            if (arm_step(&state, features, 0) || !arm_is_due(&state)) return 1;
            features[0] = 0.0;
            return !arm_step(&state, features, 0) || arm_is_due(&state);
        }"""
    subprocess.run([compiled(tmp_path, c_residual(layout, "arm"), "gcc", program)], check=True)


def test_the_header_needs_no_heap(tmp_path: Path) -> None:
    layout = ResidualLayout.load(residual("mirrored", tmp_path / "r"))
    function = """int all(arm_state *state, const double *features) {
        arm_begin(state);
        return arm_step(state, features, 1);
    }"""
    require_no_library(tmp_path, c_residual(layout, "arm"), function)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_example_in_c_checks_the_header(
    compiler: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches a test vector of another residual, and options of arms that have no effect."""
    monkeypatch.chdir(tmp_path)
    residual("clipped", Path("mine/r"))
    main(["export", "c", "residual:mine/r", "--prefix", "arm", "-o", "arm.h", "--example"])
    example = Path("arm_example/arm_main.c").read_text()
    folder = tmp_path / "arm_example"
    program = compiled(folder, Path("arm.h").read_text(), compiler, example, RELEASED)
    said = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert "us per decision" in said
    with pytest.raises(SystemExit):
        main(["export", "c", "residual:mine/r", "--joints", "300"])
    assert "--joints: without effect on residual:mine/r" in capsys.readouterr().err


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
        ResidualLayout.load(f"residual:{tmp_path / 'r'}")
    file.write_text(json.dumps({**given, "robot": "antigravity:fly"}))
    with pytest.raises(ConfigurationError, match="name its environment by --env"):
        ResidualLayout.load(f"residual:{tmp_path / 'r'}")
    assert "antigravity" not in sys.modules


@pytest.mark.slow
def test_the_layout_needs_no_torch() -> None:
    modules = "train.export.residual_layout, train.export.c_arm"
    code = f"import sys, {modules}; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
