"""Kept cells: what is read is what was written for this cell, whatever became of the file."""

import io
import json
import os
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from train.cells.cell_file import UnfitCellError, _digest
from train.cells.cell_key import cell_key
from train.cells.play import CellsFailedError, make_batches, run_conditions
from train.cells.store import Store
from train.evaluate.conditions import Condition, Member, PolicySpec
from train.evaluate.episodes import Evaluation, evaluate
from train.runs.console import warn_once
from train.workers.executors import Executors

SINE = {"kind": "sine", "duration_s": 0.5, "onset_s": 0.5, "amplitude": 0.1}
CONDITION, OTHER = (
    Condition(policy=PolicySpec(name=name), reference=SINE, episodes=2)
    for name in ("uncompensated", "input")
)


@pytest.fixture(scope="module")
def played() -> tuple[Evaluation, Evaluation]:
    """Two cells."""
    return evaluate(CONDITION, num_threads=1), evaluate(OTHER, num_threads=1)


@pytest.fixture
def file(tmp_path: Path, played: tuple[Evaluation, Evaluation]) -> Path:
    """The file of the first cell, beside that of the other one."""
    for evaluation in played:
        Store(tmp_path).keep(evaluation)
    return tmp_path / f"{cell_key(CONDITION)}.npz"


def other_than(file: Path) -> Path:
    """The file of the other cell."""
    (other,) = set(file.parent.glob("*.npz")) - {file}
    return other


def rewrite(file: Path, change: Callable[[dict[str, Any]], None], seals: bool = False) -> None:
    """Change the arrays of a file; `seals` makes the digest that of the changed ones."""
    with np.load(file) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    change(found)
    if seals:
        kept = {name: found[name] for name in found if name not in ("key", "sha256")}
        found["sha256"] = _digest(kept)
    with file.open("wb") as opened:
        np.savez_compressed(opened, **found)


def on_episodes(change: Callable[[list[Any]], Any]) -> Callable[[dict[str, Any]], None]:
    """A change of the arrays by one of the episodes."""

    def changed(arrays: dict[str, Any]) -> None:
        episodes = json.loads(arrays["episodes"].tobytes())
        text = json.dumps(change(episodes) or episodes)
        arrays["episodes"] = np.frombuffer(text.encode(), dtype=np.uint8)

    return changed


def scaled(episodes: list[Any]) -> None:
    for record in episodes:
        record["link_error_rms_rad"] *= 1e-3


def of_policy(name: str) -> Callable[[list[Any]], None]:
    def change(episodes: list[Any]) -> None:
        for record in episodes:
            record["policy"] = name

    return change


def set_first(name: str, value: Any) -> Callable[[list[Any]], None]:
    def change(episodes: list[Any]) -> None:
        episodes[0][name] = value

    return change


def set_array(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(arrays: dict[str, Any]) -> None:
        arrays[name] = value(arrays[name])

    return change


CHANGES: dict[str, Callable[[dict[str, Any]], None]] = {
    "figures": on_episodes(scaled),
    "one of two": on_episodes(lambda episodes: episodes[:1]),
    "nan": on_episodes(set_first("link_error_rms_rad", float("nan"))),
    "trace": set_array("trace/link_error", lambda values: 1e-3 * values),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_was_changed_is_not_taken(name: str, file: Path) -> None:
    """Catches figures that somebody, or a disk, changed."""
    rewrite(file, CHANGES[name])
    with pytest.raises(UnfitCellError, match="its content is not what was written"):
        Store(file.parent).get(CONDITION)


SEALED: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "one of two": (CHANGES["one of two"], "it has 1 episodes, the cell has 2"),
    "three": (on_episodes(lambda episodes: [*episodes, episodes[0]]), "it has 3 episodes"),
    "nan": (CHANGES["nan"], "link_error_rms_rad of episode 0 must be a finite number"),
    "text": (on_episodes(set_first("link_error_rms_rad", "0.1")), "must be a finite number"),
    "none": (on_episodes(set_first("deflection_rms_rad", None)), "is None"),
    "seed": (on_episodes(set_first("seed", 7)), "seed of episode 0 is 7, in the cell it is 0"),
    "policy": (on_episodes(of_policy("input")), "policy of episode 0 is 'input'"),
    "metric": (on_episodes(set_first("invented", 1.0)), "episode 1 lacks 'invented'"),
    "termination": (on_episodes(set_first("termination", 3)), "does not say how it ended"),
    "no list": (on_episodes(lambda _: {"a": 1}), "it has no episodes"),
    "no mappings": (on_episodes(lambda _: [1, 2]), "it has no episodes"),
    "no signal": (lambda arrays: arrays.pop("trace/link_error"), "it has the signals"),
    "short signal": (set_array("trace/link_error", lambda values: values[:-1]), "samples"),
    "table": (
        set_array("trace/link_error", lambda values: values[:, None]),
        "no series of numbers",
    ),
    "infinite": (set_array("trace/link_error", lambda values: values + np.inf), "not finite"),
    "time": (set_array("trace/time_s", lambda values: 0.0 * values), "its time does not go on"),
    "deep": (
        set_array("episodes", lambda _: np.frombuffer(b"[" * 30_000, dtype=np.uint8)),
        "RecursionError",
    ),
    "huge text": (
        set_array("episodes", lambda _: np.zeros(50_000, dtype=np.uint8)),
        "at most 40000 are read",
    ),
    "no episodes": (lambda arrays: arrays.pop("episodes"), "KeyError"),
}


@pytest.mark.parametrize("name", SEALED)
def test_what_does_not_fit_its_cell_is_not_taken(name: str, file: Path) -> None:
    """Catches content of another shape whose digest is right."""
    change, said = SEALED[name]
    rewrite(file, change, seals=True)
    with pytest.raises(UnfitCellError, match=said):
        Store(file.parent).get(CONDITION)


def test_an_episode_that_ended_early_may_lack_metrics(file: Path) -> None:
    """Catches cells with a fall before the first step that are played again in every resumption."""

    def fell(episodes: list[Any]) -> None:
        episodes[1]["termination"] = "fell"
        del episodes[1]["deflection_rms_rad"]

    rewrite(file, on_episodes(fell), seals=True)
    kept = Store(file.parent).get(CONDITION)
    assert kept is not None
    assert kept.episodes[1]["termination"] == "fell"


def unpacked(size: int) -> bytes:
    """A small archive of a large array."""
    content = io.BytesIO()
    with (
        zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("episodes.npy", "w") as part,
    ):
        for _ in range(size // 10_000_000):
            part.write(bytes(10_000_000))
    return content.getvalue()


FILES: dict[str, Callable[[Path], Any]] = {
    "empty": lambda file: file.write_bytes(b""),
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:-20]),
    "half": lambda file: file.write_bytes(file.read_bytes()[:2000]),
    "text": lambda file: file.write_text("[" * 100_000),
    "archive": lambda file: file.write_bytes(unpacked(10_000_000)),
    "bomb": lambda file: file.write_bytes(unpacked(410_000_000)),
    "huge": lambda file: os.truncate(file, 3_000_000_000),
    "pipe": lambda file: (file.unlink(), os.mkfifo(file)),
    "folder": lambda file: (file.unlink(), file.mkdir()),
    "link": lambda file: (file.unlink(), file.symlink_to("/dev/zero")),
    "swapped": lambda file: file.write_bytes(other_than(file).read_bytes()),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name == "bomb" else ()) for name in FILES],
)
def test_a_file_that_is_no_cell_is_not_taken(name: str, file: Path) -> None:
    """Catches a traceback for, a wait for, or trust in, whatever lies under the name of a cell."""
    FILES[name](file)
    with pytest.raises(UnfitCellError, match=file.name):
        Store(file.parent).get(CONDITION)


def test_a_file_that_does_not_fit_is_said_once_and_played_again(
    file: Path, played: tuple[Evaluation, Evaluation]
) -> None:
    """Catches a cell that is taken or played again without a word."""
    rewrite(file, CHANGES["figures"])
    out = io.StringIO()
    found = run_conditions(
        [CONDITION, OTHER], Console(file=out, width=400), store=Store(file.parent)
    )
    assert [e.episodes for e in found] == [e.episodes for e in played]
    said = out.getvalue()
    assert (
        said.count("kept cells that do not fit are played again: 'uncompensated' in 'nominal'") == 1
    )
    assert said.count(file.name) == 1
    assert "1 of 2 cells are kept" in said
    kept = Store(file.parent).get(CONDITION)
    assert kept is not None
    assert kept.episodes == played[0].episodes


@pytest.mark.slow
def test_a_robot_that_does_not_stand_ends_its_own_cell_alone() -> None:
    """Catches cells that fail since they share worlds with a robot of another cell."""
    conditions = [
        Condition(
            env="walker",
            policy=PolicySpec(name="uncompensated"),
            reference={"step_period": 1.1, "num_steps": 1},
            swept={"scenario.slope_rad": slope},
        )
        for slope in (0.0, 0.12, 0.01)
    ]
    assert make_batches(conditions * 2, cores=1) == [[0, 1, 2], [3, 4, 5]]
    place = Executors(jobs=1)
    with pytest.raises(CellsFailedError, match=r"slope_rad=0\.12: .*does not stand") as failure:
        run_conditions(conditions * 2, Console(quiet=True), place)
    finished = [evaluation.condition for evaluation in failure.value.finished]
    assert finished == [conditions[0], conditions[2]] * 2
    assert str(failure.value).count("does not stand") == 1


WARNING_POLICY = """
import warnings
import baselines

def make(env):
    warnings.warn("the policy is old", stacklevel=2)
    return baselines.make("input", env)
"""


@pytest.mark.slow
def test_a_warning_of_two_workers_is_shown_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Catches a line for each worker, and a warning that stays in the worker."""
    monkeypatch.chdir(tmp_path)
    Path("old.py").write_text(WARNING_POLICY)
    policy = PolicySpec(name="old.py:make")
    conditions = [Condition(policy=policy, reference=SINE, seed=seed) for seed in (0, 1)]
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        with warn_once():
            run_conditions(conditions, Console(quiet=True), Executors(jobs=2))
    assert [str(w.message) for w in shown].count("the policy is old") == 1
    assert "the policy is old" not in capfd.readouterr().err


@pytest.mark.parametrize("label", ["marked.inner:f", "marked.py:f", "broken.py:f", "broken:f"])
def test_a_label_is_no_code(label: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a label, a name or an option that is imported, or read as Python, while a key is
    made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for file in ("marked.py", "marked/__init__.py", "marked/inner.py"):
        Path(file).parent.mkdir(exist_ok=True)
        Path(file).write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    Path("broken.py").write_text("def f(:\n")
    member = Member(folder="nowhere", base=label)
    for condition in (
        Condition(policy=PolicySpec(name="input", label=label)),
        Condition(policy=PolicySpec(name="input"), label=label),
        Condition(policy=PolicySpec(name="input"), member=member),
        Condition(policy=PolicySpec(name=label)),
        Condition(policy=PolicySpec(name="input", options={"any": label})),
    ):
        assert len(cell_key(condition)) == 64
    assert not Path("ran").exists()
    assert not {"marked", "marked.inner", "broken"} & sys.modules.keys()


def test_a_key_changes_with_a_module_within_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a module that is not found without importing the packages around it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    module = tmp_path / "outer_of_key" / "inner" / "mine.py"
    module.parent.mkdir(parents=True)
    condition = Condition(policy=PolicySpec(name="outer_of_key.inner.mine:make"))
    keys = [cell_key(condition)]
    for text in ("GAIN = 1\n", "GAIN = 2\n"):
        module.write_text(text)
        keys.append(cell_key(condition))
    assert len(set(keys)) == 3
