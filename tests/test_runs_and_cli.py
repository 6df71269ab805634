"""Result folders, comparisons and the command `elastic`: what they write, and how they refuse
bad input."""

import csv
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from io import StringIO
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from PIL import Image, ImageSequence
from rich.console import Console

import train.commands.comparison
import train.commands.demo
import train.commands.speed
import train.evaluate.episodes
import train.report.summary
import train.speed.foreign_loops
from baselines.catalogue import ON_JOINTS, ON_THE_WALKER
from baselines.identification.identify import Identification
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError, ResultsExistError
from elastic_env.core.signals import Array
from elastic_env.world.link_signals import METRICS_OF_ONE as METRICS
from tests.test_identification import synthetic
from train.commands.cli import main
from train.commands.compare_config import CompareConfig
from train.commands.play import play
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import Evaluation, evaluate
from train.evaluate.rollout import PolicyFailedError
from train.figures.comparison_figures import figure_name
from train.runs.console import warn_once
from train.runs.folders import create_folder, run_folder
from train.runs.progress import show_progress
from train.speed.contenders import RawWorlds, ScalarLoop, VectorLoop

SINE = {"kind": "sine", "amplitude": 0.05, "duration_s": 0.3, "onset_s": 0.2}
MULTISINE = {
    "kind": "multisine",
    "amplitude": 0.05,
    "middle": 0.2,
    "duration_s": 0.2,
    "onset_s": 0.3,
}
HOLD = {
    "kind": "hold",
    "positions": 5,
    "lower": -0.3,
    "upper": 0.3,
    "rate": 0.8,
    "shortest_move_s": 0.3,
    "settle_s": 0.05,
    "measure_s": 0.05,
}
COMMAND_SINE = "{kind: sine, amplitude: 0.05, duration_s: 0.3, onset_s: 0.2}"


def condition(policy: str = "input", reference: Any = None, **values: Any) -> Condition:
    """A short cell of a comparison."""
    return Condition(policy=PolicySpec(name=policy), reference=reference or SINE, **values)


def files_of(folder: Path) -> dict[str, bytes]:
    """Contents of all files under a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test works in a folder of its own, on a wide terminal without colours."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


def run_here(conditions: Sequence[Condition], console: Console, *_: object) -> list[Evaluation]:
    return [evaluate(condition, num_threads=1) for condition in conditions]


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Conditions are evaluated in this process: starting others takes seconds."""

    monkeypatch.setattr(train.commands.comparison, "run_conditions", run_here)
    monkeypatch.setattr(train.commands.demo, "run_conditions", run_here)


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Error message of a command that must end with exit code 2."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    output = capsys.readouterr()
    assert caught.value.code == 2
    assert "Traceback" not in output.err
    return output.err


# The result of an evaluation.


def test_records_depend_neither_on_threads_nor_on_the_other_episodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches seeds that count differently in a batch, worlds that disturb each other, and episodes
    lost or repeated where there are more of them than worlds."""
    multi = {"reference": MULTISINE, "seed": 5, "scenario": "sensor"}
    together = evaluate(condition(**multi, episodes=3), num_threads=2)
    alone = evaluate(condition(**{**multi, "seed": 6}), num_threads=1).episodes[0]
    assert together.episodes[1] == alone
    assert [episode["seed"] for episode in together.episodes] == [5, 6, 7]
    assert len({episode["link_error_rms_rad"] for episode in together.episodes}) == 3
    monkeypatch.setattr(train.evaluate.episodes, "MOST_WORLDS", 2)
    parts = evaluate(condition(**multi, episodes=3), num_threads=1)
    assert parts.episodes == together.episodes
    np.testing.assert_array_equal(parts.trace["link_angle"], together.trace["link_angle"])


def test_record_names_its_cell_and_agrees_with_its_trace() -> None:
    """Catches metrics of another world or another window, and signals out of step with their
    time."""
    result = evaluate(condition("uncompensated", scenario="ideal"), num_threads=1)
    record = result.episodes[0]
    trace = result.trace
    named = {
        "policy": "uncompensated",
        "scenario": "ideal",
        "reference": "sine",
        "seed": 0,
        "termination": "",
    }
    assert {key: record[key] for key in named} == named
    scored = trace["time_s"] > 1.2 + 1e-9
    assert record["link_error_rms_rad"] == pytest.approx(
        np.sqrt(np.mean(trace["link_error"][scored] ** 2)), rel=1e-12
    )
    np.testing.assert_allclose(trace["time_s"], np.arange(376) * 0.004, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        trace["reference_angle"] - trace["link_angle"], trace["link_error"], atol=1e-15
    )


def test_error_of_the_estimate_is_that_of_the_policy() -> None:
    """Catches an estimate scored at another time than the truth: the error of the encoder is the
    deflection."""
    plain = evaluate(condition("uncompensated", scenario="ideal"), num_threads=1)
    seen = plain.trace["deflection"][plain.trace["time_s"] > 1.2 + 1e-9][
        :-1
    ]  # no policy sees the last state
    error = plain.episodes[0]["link_estimate_error_rms_rad"]
    assert error == pytest.approx(np.sqrt(np.mean(seen**2)), rel=1e-12)
    oracle = evaluate(condition("oracle", scenario="ideal"), num_threads=1).episodes[0]
    assert oracle["link_estimate_error_rms_rad"] == 0.0


def test_static_points_of_an_evaluation_are_those_of_the_first_world() -> None:
    """Catches points averaged over worlds or windows, and references in the order of another
    sweep."""
    cell = condition("uncompensated", HOLD, scenario="ideal", env_options={"stiffness": 3000.0})
    one = evaluate(cell, num_threads=1)
    two = evaluate(cell.replace(episodes=2), num_threads=1)
    assert one.points is not None
    assert two.points is not None
    np.testing.assert_array_equal(one.points.theta, two.points.theta)
    assert len(one.points) == len(one.rest_references) == 10
    np.testing.assert_allclose(
        one.points.theta, one.rest_references, rtol=0.0, atol=0.01
    )  # on the move


class Constant:
    """A policy that returns the same offset always and keeps no state."""

    def __init__(self, offset: float) -> None:
        self._offset = offset

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ):
        """The offset, for every world."""
        return np.full((*observation.shape[:-1], 1), self._offset), state


def constant(env: Any, offset: float = 0.1) -> Constant:
    """One's own policy, as "module:function"."""
    return Constant(offset)


def test_ones_own_policy_is_evaluated_like_a_baseline() -> None:
    """Catches a protocol that asks for more than `predict`: no estimate, no base class, options
    handed on."""
    spec = PolicySpec(name=f"{__name__}:constant", label="mine", options={"offset": 0.0})
    own = evaluate(Condition(policy=spec, reference=SINE), num_threads=1).episodes[0]
    zero = evaluate(condition("zero"), num_threads=1).episodes[0]
    assert own["policy"] == "mine"
    shared = own.keys() - {"policy"}
    assert {key: own[key] for key in shared} == {key: zero[key] for key in shared}
    assert "link_estimate_error_rms_rad" not in own


def test_the_command_finds_ones_own_policy_in_the_current_folder(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a console script that looks for modules beside itself, so that nobody's own policy
    is found."""
    Path("ones_own.py").write_text("def make(env):\n    return 'found'\n")
    script = Path(sys.executable).with_name("elastic")
    elsewhere = [entry for entry in sys.path if Path(entry or ".").resolve() != Path.cwd()]
    monkeypatch.setattr(sys, "path", [str(script.parent), *elsewhere])
    monkeypatch.setattr(sys, "argv", [str(script), "evaluate", "--policy", "ones_own:make"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "policy 'ones_own:make' has no method predict(), got str" in said


def condition_of(env: Any) -> str:
    """A function that makes no policy."""
    return str(env)


# Result folders.


def test_a_taken_name_gets_the_next_free_number() -> None:
    """Catches results that overwrite those of the run before."""
    folders = []
    for number in range(3):
        with run_folder("name", {"number": number}, seed=number) as folder:
            folders.append(folder)
    assert folders == [Path("runs/name"), Path("runs/name-2"), Path("runs/name-3")]
    assert [
        yaml.safe_load((folder / "config.yaml").read_text())["number"] for folder in folders
    ] == [0, 1, 2]


def test_metadata_says_seed_versions_and_commit() -> None:
    """Catches results that cannot be made again."""
    with run_folder("name", {}, seed=17) as folder:
        written = json.loads((folder / "metadata.json").read_text())
    assert written["seed"] == 17
    assert written["versions"]["mujoco"].count(".") >= 1
    assert {"elastic-env", "gymnasium", "numpy", "pin", "scipy"} <= written["versions"].keys()
    assert {"commit", "python", "platform", "created"} <= written.keys()


def test_named_output_folder_may_be_new_or_empty(tmp_path: Path) -> None:
    """Catches a folder that must exist, and one that must not."""
    (tmp_path / "empty").mkdir()
    assert create_folder("x", tmp_path / "empty") == tmp_path / "empty"
    assert create_folder("x", tmp_path / "deep" / "new") == tmp_path / "deep" / "new"


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_output_that_exists_is_refused(kind: str, tmp_path: Path) -> None:
    """Catches results written among others, or over a file."""
    output = tmp_path / "taken"
    inside = output / "precious.txt" if kind == "folder" else output
    inside.parent.mkdir(exist_ok=True)
    inside.write_text("years of work")
    with pytest.raises(ResultsExistError, match="taken"):
        create_folder("x", output)
    assert files_of(tmp_path) == {str(inside.relative_to(tmp_path)): b"years of work"}


# elastic compare, at night also with a real process, and elastic evaluate.


@dataclass(frozen=True)
class Compared:
    """Folder of `elastic compare`, its configuration, what it printed, and what it played in this
    process."""

    folder: Path
    config: CompareConfig
    printed: str
    evaluations: list[Evaluation]


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """Two policies, two episodes."""
    return compare_in(tmp_path_factory.mktemp("compare"), is_here=True)


def compare_in(root: Path, is_here: bool) -> Compared:
    """A small comparison, in this process or in one of its own."""
    content = {
        "name": "small",
        "references": [MULTISINE],
        "scenarios": ["soft"],
        "policies": [
            "uncompensated",
            {"name": "input", "label": "newton", "options": {"output": "newton"}},
        ],
        "episodes": 2,
        "seed": 3,
        "env_options": {"stiffness": 900},
    }
    (root / "small.yaml").write_text(yaml.safe_dump(content))
    evaluations: list[Evaluation] = []

    def noted(conditions: Sequence[Condition], console: Console, *_: object) -> list[Evaluation]:
        evaluations.extend(run_here(conditions, console))
        return evaluations

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        console = Console(
            width=200, record=True, quiet=False, file=(root / "printed.txt").open("w")
        )
        patch.setattr("train.commands.cli.CONSOLE", console)
        if is_here:
            patch.setattr(train.commands.comparison, "run_conditions", noted)
        main(["compare", "small.yaml", "--jobs", "1"])
        console.file.close()
    return Compared(
        root / "runs" / "small",
        load_yaml(root / "small.yaml", CompareConfig),
        (root / "printed.txt").read_text(),
        evaluations,
    )


def test_compare_writes_one_row_per_episode_with_every_metric(compared: Compared) -> None:
    """Catches rows or columns that are lost."""
    rows = rows_of(compared.folder / "episodes.csv")
    cells = [(row["policy"], row["scenario"], row["reference"], row["seed"]) for row in rows]
    assert cells == [
        (policy, "soft", "multisine", seed)
        for policy in ("uncompensated", "newton")
        for seed in ("3", "4")
    ]
    assert {metric.name for metric in METRICS} <= rows[0].keys()
    assert {"termination", "diverged", "link_estimate_error_rms_rad"} <= rows[0].keys()
    cells = [evaluation.condition for evaluation in compared.evaluations]
    assert cells == compared.config.conditions()
    expected = [episode for own in compared.evaluations for episode in own.episodes]
    assert rows == [{key: str(value) for key, value in episode.items()} for episode in expected]


@pytest.mark.slow
def test_compare_in_a_process_of_its_own_has_the_same_rows(
    compared: Compared, tmp_path: Path
) -> None:
    """Catches results that depend on running in a process of their own."""
    apart = compare_in(tmp_path, is_here=False)
    assert rows_of(apart.folder / "episodes.csv") == rows_of(compared.folder / "episodes.csv")


def test_compare_leaves_configuration_and_origin_beside_its_results(compared: Compared) -> None:
    """Catches a configuration that is not the resolved one: read again, it must be the same
    comparison."""
    assert load_yaml(compared.folder / "config.yaml", CompareConfig) == compared.config
    assert json.loads((compared.folder / "metadata.json").read_text())["seed"] == 3


def test_compare_summarises_every_cell(compared: Compared) -> None:
    """Catches a median over the wrong episodes: table, Markdown and CSV must say the same."""
    rows = rows_of(compared.folder / "episodes.csv")
    text = (compared.folder / "summary.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("| multisine")]
    assert len(lines) == 2
    for policy, line in zip(("uncompensated", "newton"), lines, strict=True):
        values = [float(row["link_error_rms_rad"]) for row in rows if row["policy"] == policy]
        median = f"{1e3 * np.median(values):.2f}"
        assert median not in [f"{1e3 * value:.2f}" for value in values]
        least, most = (f"{1e3 * value:.2f}" for value in (min(values), max(values)))
        assert line.startswith(
            f"| multisine | soft | {policy} | {median} [{least}, {most}] ({most}) |"
        )
        assert line.endswith("| 0/2 |")
        assert any(
            policy in printed and median in printed for printed in compared.printed.splitlines()
        )


def test_compare_draws_figures_that_open_and_names_its_files(compared: Compared) -> None:
    """Catches empty pictures, and files that the terminal does not tell of."""
    pictures = sorted(compared.folder.glob("*.png"))
    assert [path.name for path in pictures] == ["overview.png", "time_multisine_soft.png"]
    for path in pictures:
        with Image.open(path) as image:
            image.load()
            assert image.size[0] > 300
            assert len(np.unique(np.asarray(image.convert("L")))) > 20
    for name in ("episodes.csv", "summary.md", "overview.png", "time_multisine_soft.png"):
        assert f"runs/small/{name}" in compared.printed


def test_failed_episodes_are_counted_and_not_averaged_in() -> None:
    """Catches a fall that spoils, or improves, the median of the episodes that stayed up."""
    names = ("link_error_rms_rad", "link_error_peak_rad")
    episodes = [
        {"termination": reason, **dict.fromkeys(names, value)}
        for reason, value in (
            ("", 0.001),
            ("diverged", 9.0),
            ("", 0.003),
            ("diverged", float("nan")),
        )
    ]
    table = Console(width=160, record=True, file=StringIO())
    train.report.summary.print_summary([Evaluation(condition(), episodes)], table)
    row = next(line for line in table.export_text().splitlines() if "input" in line)
    assert "2.00 [1.00, 3.00]" in row
    assert "2/4" in row
    assert train.report.summary.failure_notes([Evaluation(condition(), episodes)]) == []
    failed = Evaluation(condition(), [episode for episode in episodes if episode["termination"]])
    assert train.report.summary.failure_notes([failed]) == [
        "input: diverged (2 of 2)"
    ]  # the testbed keeps no time of it


@pytest.mark.usefixtures("in_process")
def test_evaluate_again_makes_a_second_folder_and_leaves_the_first(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches results that are overwritten: `elastic evaluate` where a run of it lies."""
    Path("runs/evaluate").mkdir(parents=True)
    for name in ("episodes.csv", "config.yaml", "sine.svg"):
        Path("runs/evaluate", name).write_text("years of work")
    first = files_of(Path("runs/evaluate"))
    arguments = [
        "evaluate",
        "--policy",
        "input",
        "--reference",
        COMMAND_SINE,
        "--episodes",
        "2",
        "--seed",
        "6",
        "--figure-format",
        "svg",
    ]
    main(arguments)
    assert files_of(Path("runs/evaluate")) == first
    assert {path.name for path in Path("runs").iterdir()} == {"evaluate", "evaluate-2"}
    assert [row["seed"] for row in rows_of(Path("runs/evaluate-2/episodes.csv"))] == ["6", "7"]
    assert "runs/evaluate-2/episodes.csv" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_evaluate_hands_the_stiffness_to_the_policy() -> None:
    """Catches an option that is read and forgotten: a policy that believes in 2 K compensates
    half the deflection."""
    Path("identification.json").write_text('{"stiffness_nm_per_rad": 2002.0}')
    reference = "{kind: sine, middle: 0.5, amplitude: 0.005, duration_s: 0.1, onset_s: 0.2}"
    arguments = ["evaluate", "--reference", reference, "--scenario", "ideal"]
    for stiffness in ("identification.json", "2002", "[2002.0]"):
        main([*arguments, "--stiffness", stiffness])
    for more in ([], ["--policy", "uncompensated"]):
        main([*arguments, *more])
    folders = ["evaluate", "evaluate-2", "evaluate-3", "evaluate-4", "evaluate-5"]
    rms = [
        float(rows_of(Path("runs") / f / "episodes.csv")[0]["link_error_rms_rad"]) for f in folders
    ]
    assert rms[0] == rms[1] == rms[2]
    assert rms[0] == pytest.approx(0.5 * rms[4], rel=0.05)
    assert rms[3] < 0.05 * rms[4]


TWO_SINES: dict[str, Any] = {
    "name": "two",
    "references": [SINE, {**SINE, "frequency_hz": 0.5}],
    "policies": ["zero"],
}


def test_two_references_of_one_kind_have_names_of_their_own() -> None:
    """Catches the second sine's figure written over the first's, and rows of which nobody can
    say whose they are."""
    cells = CompareConfig(**TWO_SINES).conditions()
    assert len({cell.reference_name for cell in cells}) == 2
    assert len({figure_name("time", Evaluation(cell)) for cell in cells}) == 2


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_two_references_of_one_kind_stay_apart() -> None:
    """Catches files and rows that do not take the names of their references."""
    Path("two.yaml").write_text(yaml.safe_dump(TWO_SINES))
    main(["compare", "two.yaml", "--figure-format", "svg"])
    assert len(list(Path("runs/two").glob("time_*.svg"))) == 2
    assert len({row["reference"] for row in rows_of(Path("runs/two/episodes.csv"))}) == 2


@pytest.mark.parametrize("command", ["evaluate", "compare", "identify", "speed"])
def test_output_that_holds_results_is_refused_before_the_work(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches results that are overwritten, and minutes of work that end in a refusal."""
    Path("c.yaml").write_text(yaml.safe_dump({"name": "c", "references": [SINE]}))
    Path("taken").mkdir()
    Path("taken/notes.txt").write_text("keep me")
    for name in (
        "train.commands.comparison.run_conditions",
        "train.commands.identify.identify",
        "train.commands.speed.measure",
    ):
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("the work began"))
    arguments = {"evaluate": ["--reference", COMMAND_SINE], "compare": ["c.yaml"]}.get(command, [])
    message = refused([command, *arguments, "--output", "taken"], capsys)
    assert "taken already holds results (notes.txt" in message
    assert files_of(Path("taken")) == {"notes.txt": b"keep me"}
    assert not Path("runs").exists()


# Bad input: exit code 2, what is wrong, and what exists.

CONFIGURATIONS: dict[str, tuple[Any, list[str]]] = {
    "key": (
        {"name": "c", "polices": ["input"]},
        ["'polices'", "policies", "scenarios", "episodes"],
    ),
    "policy": ({"name": "c", "policies": ["inptu"]}, ["'inptu'", "input", "dynamic", "oracle"]),
    "policy key": (
        {"name": "c", "policies": [{"name": "input", "lable": "x"}]},
        ["'lable'", "label", "options"],
    ),
    "policy option": (
        {"name": "c", "policies": [{"name": "input", "options": {"stifness": 3}}]},
        ["'stifness'", "stiffness", "ramp_s"],
    ),
    "scenario": ({"name": "c", "scenarios": ["sof"]}, ["'sof'", "soft", "nominal", "backlash"]),
    "reference": ({"name": "c", "references": ["sin"]}, ["'sin'", "sine", "hold", "steps"]),
    "reference key": (
        {"name": "c", "references": [{"kind": "sine", "hz": 1}]},
        ["'hz'", "frequency_hz", "amplitude"],
    ),
    "environment": ({"name": "c", "env": "tesbed"}, ["'tesbed'", "testbed", "walker"]),
    "environment option": (
        {"name": "c", "env_options": {"stifness": 3}},
        ["'stifness'", "stiffness", "pendulum"],
    ),
    "no name": ({"policies": ["input"]}, ["name"]),
    "no policies": ({"name": "c", "policies": []}, ["policies"]),
    "twice": ({"name": "c", "policies": ["input", "input"]}, ["two policies", "'input'", "label"]),
    "no references": ({"name": "c", "references": []}, ["references"]),
    "no scenarios": ({"name": "c", "scenarios": []}, ["scenarios"]),
    "negative": ({"name": "c", "episodes": -1}, ["episodes", ">= 1", "-1"]),
    "policy's environment option": (
        {"name": "c", "policies": [{"name": "zero", "env_options": {"from": "rigid"}}]},
        ["'from'", "form", "stiffness"],
    ),
    "reserved option": (
        {"name": "c", "env_options": {"step_period": 3}},
        ["step_period cannot", "key", "of its own"],
    ),
    "reserved parameter": (
        {"name": "c", "env": "walker", "references": [{"step_period": 3, "scenario": "ideal"}]},
        ["references.0: scenario cannot be part of a reference; it has a key"],
    ),
    "unplaced parameter": (
        {"name": "c", "references": [{"kind": "sine", "num_envs": 3}]},
        ["num_envs cannot", "set it themselves"],
    ),
    "no reference": ({"name": "c", "references": [None]}, ["reference", "name", "mapping", "None"]),
    "policy of the figures": (
        {"name": "c", "figure_policies": ["inptu"]},
        ["'inptu'", "uncompensated", "input"],
    ),
    "scenario with episodes": (
        {"name": "c", "scenario_episodes": {"ideal": 1}},
        ["'ideal'", "nominal"],
    ),
    "no episodes": (
        {"name": "c", "scenario_episodes": {"nominal": 0}},
        ["scenario_episodes", "nominal", ">= 1", "0"],
    ),
    "sweep": ({"name": "c", "sweep": {"option": "stiffness_scale", "values": [1]}}, ["values"]),
    "sweep key": (
        {"name": "c", "sweep": {"options": "x", "values": [1, 2]}},
        ["'options'", "option"],
    ),
    "swept option": (
        {"name": "c", "sweep": {"option": "stiffnes", "values": [1, 2]}},
        ["'stiffnes'", "stiffness_scale"],
    ),
    "swept in vain": (
        {"name": "c", "sweep": {"option": "stiffness_scale", "values": [1, 2]}},
        [
            "'uncompensated' of the testbed does not use stiffness_scale",
            "it has no options",
            "level: true",
        ],
    ),
    "stiffness": (
        {"name": "c", "env_options": {"stiffness": -3}},
        ["stiffness", "> 0", "[N·m/rad]", "-3"],
    ),
    "no mapping": (["input"], ["mapping", "list"]),
}


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("case", CONFIGURATIONS)
def test_wrong_configuration_says_what_and_which_choices(
    case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a key or a name that is ignored, a traceback, and a result folder left behind."""
    content, words = CONFIGURATIONS[case]
    Path("c.yaml").write_text(yaml.safe_dump(content))
    message = refused(["compare", "c.yaml"], capsys)
    assert [word for word in words if word not in message] == []
    assert not Path("runs").exists()


COMMANDS: dict[str, tuple[list[str], list[str]]] = {
    "policy": (
        ["evaluate", "--policy", "inptu"],
        ["'inptu'", "uncompensated", "input", "dynamic", "oracle"],
    ),
    "module": (["evaluate", "--policy", "nowhere:f"], ["nowhere", "input", "module:function"]),
    "function": (["evaluate", "--policy", "math:nothing"], ["nothing", "input", "module:function"]),
    "no policy": (
        ["evaluate", "--policy", f"{__name__}:condition_of"],
        ["condition_of", "predict()"],
    ),
    "no function": (["evaluate", "--policy", "math:pi"], ["'math:pi'", "float", "module:function"]),
    "no module": (["evaluate", "--policy", ":x"], ["':x'", "module:function"]),
    "no attribute": (["evaluate", "--policy", "math:"], ["'math:'", "module:function"]),
    "relative module": (
        ["play", "--policy", ".x:f", "--video", "x.gif"],
        ["'.x:f'", "module:function"],
    ),
    "scenario": (
        ["evaluate", "--scenario", "sof"],
        ["'sof'", "ideal", "nominal", "soft", "payload", "sensor"],
    ),
    "ground": (["evaluate", "--scenario", "soft+ideal"], ["'ideal'", "first"]),
    "reference": (
        ["evaluate", "--reference", "sin"],
        ["'sin'", "hold", "sine", "multisine", "steps"],
    ),
    "reference key": (["evaluate", "--reference", "{kind: sine, hz: 3}"], ["'hz'", "frequency_hz"]),
    "reference text": (["evaluate", "--reference", "{kind: sine"], ["{kind: sine"]),
    "unit": (
        ["evaluate", "--reference", "{kind: sine, amplitude: -1}"],
        ["amplitude", "> 0", "[rad]", "-1"],
    ),
    "infeasible": (
        ["evaluate", "--reference", "{kind: sine, frequency_hz: 9}"],
        ["84 N·m", "amplitude"],
    ),
    "environment": (["evaluate", "--env", "wlaker"], ["'wlaker'", "testbed", "walker"]),
    "walk": (
        ["evaluate", "--env", "walker", "--reference", "5"],
        ["step_period", "24, 3, 1.6, 1.1", "5"],
    ),
    "walk mapping": (
        ["evaluate", "--env", "walker", "--reference", "{steps: 2}"],
        ["'step_period'", "num_steps"],
    ),
    "walk argument": (
        ["evaluate", "--env", "walker", "--reference", "{step_period: 3, steps: 2}"],
        ["'steps'", "num_steps", "gait"],
    ),
    "walk policy": (
        ["evaluate", "--env", "walker", "--policy", "inptu"],
        ["'inptu'", "input_output", "input_wrench"],
    ),
    "episodes": (["evaluate", "--episodes", "0"], ["error: --episodes must be", ">= 1"]),
    "seed": (["evaluate", "--seed", "-1"], ["error: --seed must be", ">= 0", "-1"]),
    "scenario of no name": (["evaluate", "--scenario", ""], ["unknown scenario ''", "nominal"]),
    "both": (
        ["evaluate", "--seed", "-1", "--episodes", "0"],
        ["--episodes must be", "\n--seed must be"],
    ),
    "reserved": (
        ["evaluate", "--env", "walker", "--reference", "{step_period: 3, scenario: ideal}"],
        [
            "error: --reference: scenario cannot be part of a reference; it has a key, or an"
            " option, of its own"
        ],
    ),
    "assumed": (["evaluate", "--stiffness", "-5"], ["stiffness", "> 0", "[N·m/rad]", "-5"]),
    "assumed list": (
        ["evaluate", "--stiffness", "[1001, 1001]"],
        ["stiffness", "one number or a list of 1", "[N·m/rad]", "[1001.0, 1001.0]"],
    ),
    "assumed text": (
        ["evaluate", "--stiffness", "[soft]"],
        ["stiffness must be numbers", "'soft'"],
    ),
    "assumed nan": (["evaluate", "--stiffness", "nan"], ["stiffness", "> 0", "nan"]),
    "assumed file": (["evaluate", "--stiffness", "none.json"], ["none.json"]),
    "missing file": (["compare", "none.yaml"], ["none.yaml"]),
    "brackets": (["compare", "[/bold].yaml"], ["[/bold].yaml"]),
    "jobs": (["compare", "good.yaml", "--jobs", "-1"], ["jobs", "-1"]),
    "identify scenario": (["identify", "--scenario", "sof"], ["'sof'", "soft"]),
    "identify seed": (["identify", "--seed", "-1"], ["--seed must be", "-1"]),
    "identify K": (["identify", "--stiffness", "-1"], ["stiffness", "> 0", "[N·m/rad]"]),
    "identify positions": (["identify", "--positions", "4"], ["positions", ">= 5", "4"]),
    "identify masses": (["identify", "--second-mass", "0"], ["mass", "> 0"]),
    "identify equal masses": (["identify", "--second-mass", "1"], ["mass"]),
    "play scenario": (["play", "--scenario", "sof", "--video", "x.gif"], ["'sof'", "soft"]),
    "play seed": (["play", "--seed", "-1", "--video", "x.gif"], ["error: --seed must be", "-1"]),
    "play environment": (
        ["play", "--env", "wlaker", "--video", "x.gif"],
        ["'wlaker'", "testbed", "walker"],
    ),
    "play format": (["play", "--video", "x.txt", "--max-s", "0.1"], [".mp4", ".gif", "x.txt"]),
    "play time": (["play", "--video", "x.gif", "--max-s", "-1"], ["max", "-1"]),
    "speed worlds": (["speed", "--num-envs", "0"], ["error: --num-envs must be", "0"]),
    "speed steps": (["speed", "--num-envs", "2", "--steps", "0"], ["steps", "0"]),
    "speed environment": (["speed", "--env", "wlaker"], ["'wlaker'", "testbed", "walker"]),
    "speed policy": (
        ["speed", "--num-envs", "2", "--policy", "inptu"],
        ["'inptu'", "input", "oracle"],
    ),
    "margins policy": (["margins", "--policies", "inptu"], ["'inptu'", "input_output", "foothold"]),
    "margins twice": (
        ["margins", "--policies", "zero", "zero"],
        ["error: --policies: 'zero' stands twice"],
    ),
    "margins ranges": (["margins", "--scenario", "drawn"], ["ranges", "push_n"]),
    "margins robots": (["margins", "--robots", "65"], ["--robots must be", "<= 64", "65"]),
    "speed rounds": (
        ["speed", "--num-envs", "2", "--steps", "1", "--rounds", "0"],
        ["rounds", "0"],
    ),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_wrong_argument_says_what_and_which_choices(
    case: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches tracebacks, units that vanish as markup, names that are not listed, and folders
    left behind."""
    arguments, words = COMMANDS[case]
    monkeypatch.setattr(
        "train.commands.identify.identify", lambda *_, **__: pytest.fail("the work began")
    )
    Path("good.yaml").write_text(yaml.safe_dump({"name": "c", "references": [SINE]}))
    message = refused(arguments, capsys)
    assert [word for word in words if word not in message] == []
    assert not Path("runs").exists()
    assert not list(Path().glob("x.*"))


def test_missing_file_names_those_beside_it(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a message that leaves the user to search."""
    Path("configs").mkdir()
    Path("configs/testbed.yaml").write_text("name: t")
    assert "configs/testbed.yaml" in refused(["compare", "configs/tesbed.yaml"], capsys)


def test_text_that_is_no_yaml_names_its_file(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a traceback of the YAML parser."""
    Path("c.yaml").write_text("name: [unclosed")
    assert "c.yaml is not valid YAML" in refused(["compare", "c.yaml"], capsys)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--help"], ["identify", "evaluate", "compare", "speed", "play"]),
        (
            ["evaluate", "--help"],
            ["--policy", "dynamic", "--scenario", "nominal", "--episodes", "Example"],
        ),
        (["evaluate", "--help"], ["walker", "input_wrench", "step_period", "num_steps", "push"]),
        (
            ["evaluate", "--help"],
            ["a list of one per joint", "twelve on the walker", "identification.json"],
        ),
        (["evaluate", "--help"], [*ON_JOINTS, *ON_THE_WALKER]),
        (["play", "--help"], ["walker", "--reference", ".mp4"]),
        (["speed", "--help"], ["walker", "--policy", "--num-envs"]),
        (
            ["compare", "--help"],
            ["--list", "episodes.csv", "report.html", "residual:PATH", "--jobs"],
        ),
        (["identify", "--help"], ["--second-mass", "N·m/rad", "identification.json"]),
    ],
)
def test_help_teaches(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a command or an option without explanation."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    printed = capsys.readouterr().out
    assert caught.value.code == 0
    assert [word for word in words if word not in printed] == []


NAMES = (
    "identify",
    "evaluate",
    "compare",
    "train",
    "iterate",
    "export",
    "bench",
    "speed",
    "margins",
    "play",
    "view",
    "robot",
    "demo",
)
PARTS = (
    *(("hardware", name) for name in ("scan", "check", "run", "emulate")),
    *(("export", name) for name in ("c", "onnx", "sb3")),
)


@pytest.mark.parametrize("command", [*((name,) for name in NAMES), *PARTS])
def test_every_command_has_help_and_refuses_what_it_does_not_know(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a command whose help fails, and an error that ends as bench's "worse"."""
    with pytest.raises(SystemExit) as caught:
        main([*command, "--help"])
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    assert f"elastic {' '.join(command)}" in printed
    assert "{None}" not in printed
    assert re.search(r"\(default:[\s│]*(None)?\)", printed) is None
    # an example has a line of its own, to be copied
    assert ": elastic " not in printed.removeprefix("usage: ")
    assert refused([*command, "--no-such-option"], capsys)


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert not caught.value.code
    assert capsys.readouterr().out == f"elastic-env {metadata.version('elastic-env')}\n"


@pytest.mark.slow
def test_output_that_nobody_reads_ends_as_by_sigpipe() -> None:
    """Catches a closed pipe that ends with 1, which is bench's "worse": rich ends the program so
    by itself."""
    elastic = str(Path(sys.executable).with_name("elastic"))
    short = "{kind: sine, duration_s: 0.5, onset_s: 0.5, amplitude: 0.1}"
    for command in (f"{elastic} --help", f"{elastic} evaluate --reference '{short}'"):
        script = f"{command} | true; echo ${{PIPESTATUS[0]}}"
        run = subprocess.run(
            ["bash", "-c", script], capture_output=True, text=True, timeout=120, check=True
        )
        assert run.stdout == "141\n", run.stderr
        assert "Traceback" not in run.stderr


# elastic identify, speed, play, demo.


def test_identify_writes_result_and_figure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a result that is printed and not written, and a second mass that is not used."""
    masses = []

    def record(env: Any, seed: int | None = None, progress: Any = None) -> list[Any]:
        progress(1.0)
        mass = env.unwrapped.task.config.pendulum.gravity_torque / 60.0
        masses.append(mass)
        return [synthetic(K=888.0, F=5.4, masses=(mass,))]

    monkeypatch.setattr("baselines.identification.identify.record_points", record)
    main(["identify", "--second-mass", "0.5", "--output", "result"])
    assert masses == [1.0, 0.5]
    result = Identification.load(Path("result/identification.json"))
    assert result.stiffness_nm_per_rad == pytest.approx(888.0, rel=1e-6)
    assert result.imu_sine_error_rad == pytest.approx(0.0, abs=1e-9)
    with Image.open("result/identification.png") as image:
        image.load()
    assert json.loads(Path("result/metadata.json").read_text())["seed"] == 0
    printed = capsys.readouterr().out
    assert [
        text
        for text in ("888.0", "5.40", "hysteresis", "result/identification.json")
        if text not in printed
    ] == []


SPEED = ["speed", "--steps", "3", "--rounds", "1", "--threads", "1"]


@pytest.mark.slow
def test_speed_measures_and_writes_every_contender(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a contender that is measured and not reported, and one that is compared with
    another's reference."""
    main(
        [
            *SPEED,
            "--env",
            "testbed",
            "--num-envs",
            "4",
            "2",
            "--processes",
            "1",
            "--no-ppo",
            "--profile",
        ]
    )
    results = json.loads(Path("runs/speed/speed.json").read_text())
    found = [(r["contender"], r["num_envs"], r["against"]) for r in results]
    loops = [
        "vector env",
        "raw mj_step",
        "vector env with input",
        "vector env with input and residual network",
    ]
    assert found[:8] == [(loop, n, f"raw mj_step, {n}") for n in (4, 2) for loop in loops]
    assert found[8:10] == [(name, 1, "raw mj_step, 1") for name in ("scalar env", "raw mj_step")]
    others = [
        "Gymnasium AsyncVectorEnv",
        "SB3 SubprocVecEnv",
        "Gymnasium SyncVectorEnv",
        "SB3 DummyVecEnv",
    ]
    assert found[10:] == [(name, 1, "vector env, 4") for name in others]
    for result in results:
        assert min(result["steps_per_s"], result["ratio"]) > 0.0
        assert result["contender"] != "raw mj_step" or result["ratio"] == 1.0
    kept = rows_of(Path("runs/speed/speed.csv"))
    assert [row["contender"] for row in kept] == [result["contender"] for result in results]
    assert "predict" in Path("runs/speed/profile.txt").read_text()
    printed = capsys.readouterr().out
    assert all(f"wrote runs/speed/speed.{end}" in printed for end in ("json", "csv"))


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["input", "mine.py:make"])
def test_speed_of_learning_end_to_end(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a PPO that collects in one place and is timed in another, and one that knows no
    policy of the user's."""
    own = "import baselines\n\n\ndef make(env):\n    return baselines.make('zero', env)\n"
    Path("mine.py").write_text(own)
    monkeypatch.setattr(train.speed.foreign_loops, "PPO_DECISIONS", 32)
    main([*SPEED, "--env", "testbed", "--num-envs", "2", "--no-others", "--policy", policy])
    ours, processes = json.loads(Path("runs/speed/speed.json").read_text())[-2:]
    assert (ours["contender"], ours["num_envs"]) == (f"PPO with {policy}, vector env", 64)
    assert processes["contender"] == f"PPO with {policy}, SubprocVecEnv(2)"
    assert processes["against"] == f"PPO with {policy}, vector env, 64"
    assert 0.0 < processes["ratio"] < 1.0


@pytest.mark.parametrize("kind", ["policy", "residual", "scalar"])
def test_raw_stepping_does_the_work_of_the_environment(kind: str) -> None:
    """Catches a benchmark that compares unequal work: the raw worlds must end where the
    environment's end, exactly."""
    loop = (
        ScalarLoop("walker")
        if kind == "scalar"
        else VectorLoop("testbed", 3, 1, "input", residual=kind == "residual")
    )
    inside = loop.env.unwrapped
    raw = RawWorlds(loop, threads=2)
    loop.run(100)
    raw.run(100)
    data = mujoco.MjData(inside.task.model)
    kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    for state, qpos, qvel in zip(
        raw.states, inside.simulation.qpos, inside.simulation.qvel, strict=True
    ):
        mujoco.mj_setState(inside.task.model, data, state, kind)
        np.testing.assert_array_equal(data.qpos, qpos)
        np.testing.assert_array_equal(data.qvel, qvel)


def test_play_films_the_episode_and_keeps_an_existing_film(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches a film of the wrong length or of nothing, and one that is overwritten."""
    main(["play", "--policy", "input", "--reference", "sine", "--video", "x.gif", "--max-s", "0.2"])
    with Image.open("x.gif") as film:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
        assert film.info["duration"] == 40  # 25 frames a second [ms]
    assert [frame.shape for frame in frames] == [(480, 640, 3)] * 5
    assert np.any(frames[0] != frames[-1])  # the clock at least
    before = Path("x.gif").read_bytes()
    assert "x.gif exists" in refused(["play", "--video", "x.gif", "--max-s", "0.1"], capsys)
    assert Path("x.gif").read_bytes() == before


@pytest.mark.slow
def test_play_writes_mp4_also_of_a_time_shorter_than_a_control_step() -> None:
    """Catches a writer that takes one format alone, and a film that is announced and not there."""
    play(condition(), Console(quiet=True), Path("deep/x.mp4"), max_s=0.001)
    assert Path("deep/x.mp4").read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(("max_s", "steps"), [(0.001, 1), (0.012, 3), (float("inf"), 375)])
def test_play_takes_one_step_at_least_and_the_episode_at_most(
    max_s: float, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a film without a picture, which is announced and not there, and a time without end
    that is none."""
    played = []

    @contextmanager
    def progress(_: Console, totals: dict[str, int], **__: Any) -> Iterator[Any]:
        played.extend(totals.values())
        yield lambda *_: None

    def film(env: Any, episode: Any, *_: Any) -> None:
        played.append(len(list(episode)))

    monkeypatch.setattr("train.commands.play.show_progress", progress)
    monkeypatch.setattr("train.commands.play._film", film)
    play(condition(), Console(quiet=True), Path("x.gif"), max_s=max_s)
    assert played == [steps, steps]


@pytest.mark.parametrize("video", ["x.mp4", pytest.param("x.gif", marks=pytest.mark.slow)])
def test_play_leaves_no_film_of_an_episode_that_failed(video: str) -> None:
    """Catches the first half of a film, which stands in the way of the next one."""
    own = "class Mine:\n    def __init__(self, env):\n        self.steps = 0\n\n"
    own += "    def predict(self, *_, **__):\n        self.steps += 1\n"
    own += "        return [0.0 / (self.steps < 12)], None\n"
    Path("mine.py").write_text(own)
    with pytest.raises(PolicyFailedError, match=r"at control step 11 .* ZeroDivisionError"):
        play(condition("mine.py:Mine"), Console(quiet=True), Path(video))
    assert not Path(video).exists()


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_demo_prints_its_table_and_the_paths_of_its_figures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a demonstration that breaks on the way; with short references, so that it takes
    seconds."""
    short_walk = {"step_period": [0.3, 0.5, 0.3], "num_steps": 1}
    settling_walk = {**short_walk, "num_steps": 2}
    references = [HOLD, SINE, short_walk, short_walk, settling_walk]
    parts = zip(train.commands.demo._PARTS, references, strict=True)
    short = [part.replace(references=[reference]) for part, reference in parts]
    monkeypatch.setattr(train.commands.demo, "_PARTS", short)
    main(["demo", "--figure-format", "svg"])
    printed = capsys.readouterr().out
    walks = {
        f"{name}_0.3+0.5+0.3_s_num_steps_{steps}_{scenario}.svg"
        for name in ("pelvis", "zmp")
        for steps, scenario in ((1, "nominal"), (2, "soft"))
    }
    names = {
        "fig5_identification.svg",
        "fig6_static_errors.svg",
        "sine.svg",
        "identification.json",
        *walks,
    }
    names |= {"episodes.csv", "summary.md", "report.html", "report.md"}
    assert {path.name for path in Path("runs/demo").iterdir()} == names | {
        "config.yaml",
        "metadata.json",
    }
    assert [name for name in names if f"runs/demo/{name}" not in printed] == []
    summary = Path("runs/demo/summary.md").read_text()
    assert [text for text in ("| sine |", "| input_output |") if text not in summary] == []
    report = Path("runs/demo/report.html").read_text()
    assert report.count("data:image/svg+xml;base64,") == 2
    assert report.count('class="chart" id=') == 3  # a motion and two walks
    of_the_paper = ("Pearson r", "0.9775", "-56.2 to +41.7", "about 40", "below 10")
    policies = (
        "uncompensated",
        "input",
        "dynamic",
        "oracle",
        "input_output",
        "input_wrench",
        "residual",
    )
    assert [text for text in (*of_the_paper, *policies) if text not in printed] == []


def test_work_that_fails_without_a_result_leaves_no_folder(tmp_path: Path) -> None:
    """Catches empty runs that look like results; what has been written before a failure stays."""
    with pytest.raises(RuntimeError), run_folder("x", {}, 0, tmp_path / "failed"):
        raise RuntimeError
    assert not (tmp_path / "failed").exists()
    with pytest.raises(ZeroDivisionError), run_folder("x", {}, 0, tmp_path / "partial") as folder:
        _write_and_fail(folder / "episodes.csv")
    assert (tmp_path / "partial" / "episodes.csv").exists()


def _write_and_fail(path: Path) -> None:
    path.write_text("seed")
    raise ZeroDivisionError


_SLOW_IMPORT = """
import sys, time

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "train.workers.local" and "--multiprocessing-fork" in sys.orig_argv:
            time.sleep({})

sys.meta_path.insert(0, Finder())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "import_s", "wait_s"),
    [(signal.SIGINT, 2.0, 1.0), pytest.param(signal.SIGKILL, 0.0, 2.0, marks=pytest.mark.slow)],
)
def test_a_comparison_that_ends_takes_its_workers_with_it(
    tmp_path: Path, how: signal.Signals, import_s: float, wait_s: float
) -> None:
    """Catches a second Ctrl-C that is ignored until all is done, that workers answer with
    tracebacks, and workers that
    go on.

    The workers import for `import_s` longer than they need. SIGINT reaches the whole process group,
    as from a terminal, the parent last; SIGKILL the parent alone.
    """
    (tmp_path / "sitecustomize.py").write_text(_SLOW_IMPORT.format(import_s))
    policies = [
        {"name": name, "label": f"{name} {n}"} for n in range(3) for name in ("zero", "input")
    ]
    (tmp_path / "long.yaml").write_text(yaml.safe_dump({"name": "long", "policies": policies}))
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from train.commands.cli import main; main()",
            "compare",
            "long.yaml",
        ],
        cwd=tmp_path,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    deadline = time.monotonic() + 60.0
    while (
        len(_members(process.pid)) < 4 and time.monotonic() < deadline
    ):  # parent, tracker, two workers
        time.sleep(0.05)
    time.sleep(wait_s)
    if how is signal.SIGINT:
        for _ in range(2):  # the first one lets what is running end
            for member in sorted(_members(process.pid), key=lambda member: member == process.pid):
                os.kill(member, how)
                time.sleep(0.1)
        output, _ = process.communicate(timeout=20)
        assert process.returncode == 130, output
        assert "Traceback" not in output
    else:
        process.kill()
    deadline = time.monotonic() + 10.0
    while (
        _members(process.pid) and time.monotonic() < deadline
    ):  # Python's own resource tracker leaves last
        time.sleep(0.1)
    assert _members(process.pid) == []
    assert how is signal.SIGKILL or not (tmp_path / "runs" / "long").exists()


def _members(group: int) -> list[int]:
    """Living processes of a process group."""
    listing = subprocess.run(
        ["ps", "-eo", "pid,pgid,stat"], capture_output=True, text=True, check=True
    ).stdout
    rows = [line.split() for line in listing.splitlines()[1:]]
    return [
        int(pid) for pid, pgid, state in rows if int(pgid) == group and not state.startswith("Z")
    ]


def test_name_of_a_run_cannot_leave_its_folder(tmp_path: Path) -> None:
    """Catches results written beside runs/, or anywhere."""
    for name in ("../escape", "/tmp/escape", ""):
        with pytest.raises(ConfigurationError, match="name"):
            CompareConfig(name=name)


def test_progress_names_what_its_percents_are_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches 50 %: 0 of 16, which counts control steps before the colon and cells behind it."""
    clock = [0.0]
    console = Console(file=StringIO())
    monkeypatch.setattr(time, "monotonic", lambda: clock[-1])
    with show_progress(console, {"all": 100}, unit="control steps") as show:
        for now, done in [(1.0, 10), (11.0, 50)]:
            clock.append(now)
            show(0, done, "0 of 16 cells done, 8 running, 0 failed")
    said = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert (
        said[-1]
        == "  50 % of the control steps, about 10 s to go; 0 of 16 cells done, 8 running, 0 failed"
    )


def test_a_warning_is_shown_once() -> None:
    """Catches a line of warning for every cell and every process of a comparison."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        with warn_once():
            for text in ("3 meshes are missing", "3 meshes are missing", "another"):
                warnings.warn(text, stacklevel=1)
            with warn_once():
                warnings.warn("another", stacklevel=1)
        warnings.warn("another", stacklevel=1)
    assert [str(warning.message) for warning in shown] == [
        "3 meshes are missing",
        "another",
        "another",
    ]


def test_where_there_is_no_terminal_progress_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a log in which long work says nothing until it ends, and one that short work
    fills."""
    clock = [0.0]
    console = Console(file=StringIO())
    monkeypatch.setattr(time, "monotonic", lambda: clock[-1])
    with show_progress(console, {"seed 0": 100, "seed 1": 100}) as show:
        for now, number, done in [
            (1.0, 0, 50),
            (11.0, 0, 60),
            (12.0, 1, 60),
            (22.0, 1, 61),
            (40.0, 1, 100),
        ]:
            clock.append(now)
            show(number, done)
    said = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert [line.strip() for line in said] == ["about 2 min to go", "30 %", "60 %", "80 %"]
