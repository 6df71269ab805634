"""Presets: found by name wherever the package is, and never in the place of a user's file."""

from pathlib import Path
from typing import Any

import pytest

from elastic_env.core.config import load_yaml
from train.commands.bench import BenchConfig
from train.commands.cli import main
from train.commands.compare_config import CompareConfig
from train.commands.comparison import Comparison
from train.learn.train_config import TrainConfig
from train.runs.presets import find_configuration, first_sentence, presets
from train.runs.user_code import KINDS, kind_of

ROOT = Path(__file__).parents[1]
MODELS: dict[str, Any] = {
    "comparison": CompareConfig,
    "training": TrainConfig,
    "bench": BenchConfig,
}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working folder without configurations."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


def listed(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What `elastic COMMAND --list` prints, in one line."""
    main([command, "--list"])
    return " ".join(capsys.readouterr().out.split())


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The error that a command ends with."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    return capsys.readouterr().err.strip()


def test_all_configurations_of_the_checkout_are_presets() -> None:
    """Catches a folder that is not in the package, and names that are not those of the files."""
    files = {file.stem: file.read_text() for file in (ROOT / "configs").glob("*.yaml")}
    assert {name: file.read_text() for name, file in presets().items()} == files


def test_both_lists_hold_each_preset_once_and_say_what_it_is(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches a preset that no command lists, that the wrong one lists, or that cannot be
    played."""
    lists = {kind: listed(KINDS[kind][0].split()[1], capsys) for kind in MODELS if kind != "bench"}
    for name, file in presets().items():
        owners = [kind for kind, text in lists.items() if f"│ {name} │" in text]
        config = load_yaml(file, MODELS[owners[0] if owners else "bench"])
        assert config.name == name
        assert len(owners) == (name != "bench")
        assert first_sentence(file)


@pytest.mark.parametrize(
    ("comment", "said"),
    [
        ("# Fig. 6 of the paper,\n#  in motion. And more.\n", "Fig. 6 of the paper, in motion."),
        ("# Who stays up? `zero` does not.\n", "Who stays up?"),
        ("# Without an end\n", "Without an end"),
        ("", ""),
    ],
)
def test_the_first_sentence_ends_where_it_ends(comment: str, said: str) -> None:
    """Catches a list that is cut after `Fig.`, or holds whole comments."""
    file = Path("own.yaml")
    file.write_text(f"{comment}name: own  # not this\n# nor this\n")
    assert first_sentence(file) == said


def test_a_name_is_a_preset_and_a_path_stands_before_it() -> None:
    """Catches a user's file that a preset hides, and a folder of results that hides a preset."""
    name = Path("leaderboard")
    own = presets()["leaderboard"]
    assert find_configuration(name, "comparison") == own
    name.mkdir()
    assert find_configuration(name, "comparison") == own
    name.rmdir()
    name.write_text("name: mine")
    assert find_configuration(name, "comparison") == name
    for path in (Path("sub/mine.yaml"), Path("mine.yaml"), Path()):
        assert find_configuration(path, "comparison") == path


def test_what_there_is_not_names_what_is_near(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a missing file of a checkout whose preset is not named, a list of thirty names for
    a typing error, and comparisons that are offered to `elastic train`."""
    said = refused(["compare", "leaderbord"], capsys)
    assert said == (
        "error: no file and no preset is called 'leaderbord'; similar presets are leaderboard;"
        " elastic compare --list shows all of them"
    )
    said = refused(["compare", "zzz"], capsys)
    assert said.endswith("called 'zzz'; elastic compare --list shows all of them")
    assert "similar presets are train_testbed;" in refused(["train", "testbd"], capsys)
    said = refused(["compare", "configs/paper.yaml"], capsys)
    assert said.endswith("the preset of this name needs no path: elastic compare paper")
    said = refused(["compare", "train_testbed"], capsys)
    assert said.endswith("this is the configuration of a training: elastic train FILE")


def test_export_takes_presets_too(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a command that alone still needs a path."""
    assert "none.zip" in refused(["export", "none.zip", "train_testbed"], capsys)


def test_kinds_are_told_by_the_keys_that_most_of_them_have() -> None:
    """Catches a configuration without telling keys that nothing takes."""
    assert kind_of({"cases": []}) == "bench"
    assert kind_of({"decisions": 3, "seeds": [0], "episodes": 1}) == "training"
    assert kind_of({"name": "x"}) == "comparison"


def test_fewer_episodes_are_played_than_a_configuration_says(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches `--episodes` that leaves scenarios their own number, and one below the bound."""
    own = "name: own\nscenarios: [ideal, drawn]\nepisodes: 2\nscenario_episodes: {drawn: 32}\n"
    Path("own.yaml").write_text(own)
    played: list[CompareConfig] = []
    monkeypatch.setattr(
        "train.commands.compare.compare",
        lambda config, *_, **__: played.append(config) or Comparison(Path(), [], []),
    )
    main(["compare", "own.yaml", "--episodes", "1"])
    assert {condition.episodes for condition in played[0].conditions()} == {1}
    capsys.readouterr()
    assert "--episodes must be" in refused(["compare", "own.yaml", "--episodes", "0"], capsys)
