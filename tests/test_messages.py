"""Messages: a user's text stays short in them, and what is missing is where they say."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import pytest

import baselines
from elastic_env.core import installed
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import (
    ElasticError,
    list_names,
    missing_extra,
    quote,
    shorten,
    unknown_name,
)
from elastic_env.robots.gallery import gallery_robot
from train.commands.bench import BenchConfig
from train.commands.cli import main
from train.commands.compare_config import CompareConfig
from train.evaluate.conditions import PolicySpec
from train.evaluate.environments import environment
from train.evaluate.rollout import make_policy
from train.learn.export import algorithm_class
from train.learn.train_config import TrainConfig

MOST = 200
LONGEST = 2500
LONG = ["x" * 10_000, "a b " * 2_500, "ä'" * 5_000, "d/" * 5_000 + "e.yaml", "m:" + "f" * 10_000]


def make(**options: Any) -> Any:
    """A testbed."""
    return gymnasium.make("elastic_env/Testbed-v0", disable_env_checker=True, **options)


@cache
def shared_testbed() -> Any:
    """One for all whose text is not its own."""
    return make()


ENTRIES: list[Callable[[str], Any]] = [
    lambda text: make(scenario=text),
    lambda text: make(reference=text),
    lambda text: make(reference={"kind": text}),
    lambda text: make(sensors=[text]),
    lambda text: make(form=text),
    lambda text: make(timestep_s=text),
    lambda text: gymnasium.make("elastic_env/WalkInPlace-v0", step_period=text),
    lambda text: baselines.make(text, SimpleNamespace(unwrapped=None)),
    lambda text: baselines.make(text, shared_testbed()),
    lambda text: baselines.make("input", shared_testbed(), **{text: 1}),
    lambda text: make_policy(PolicySpec(name=text), shared_testbed()),
    lambda text: gallery_robot(text),
    lambda text: environment(text),
    lambda text: algorithm_class(text),
    lambda text: TrainConfig(name=text),
    lambda text: TrainConfig(**{text: 1}),
    lambda text: TrainConfig(worlds=text),
    lambda text: TrainConfig(base=text),
    lambda text: TrainConfig(scenarios=[text, text]),
    lambda text: TrainConfig(weights={text: 1}),
    lambda text: TrainConfig(algorithm_options={text: 1}),
    lambda text: TrainConfig(algorithm_options={"policy_kwargs": {"activation_fn": text}}),
    lambda text: TrainConfig(settings={"observe": [text], "acts_on": {text: 1}}),
    lambda text: CompareConfig(name="c", policies=[text, text]),
    lambda text: CompareConfig(name="c", env=text),
    lambda text: CompareConfig(name="c", groups={text[:90]: [text]}),
    lambda text: CompareConfig(name="c", policies=[f"residual:{text}"]).conditions(),
    lambda text: BenchConfig(cases=text),
    lambda text: BenchConfig(cases=[{"env": text, "policy": text}]),
    lambda text: load_yaml(text, TrainConfig),
]


def quotes_too_much(message: str, text: str) -> bool:
    """Whether a message shows more than MOST characters of a text in one piece."""
    return any(text[i : i + MOST + 1] in message for i in range(len(text) - MOST))


@pytest.mark.parametrize("entry", ENTRIES, ids=range(len(ENTRIES)))
def test_a_users_text_stays_short_in_an_error(entry: Callable[[str], Any]) -> None:
    """Catches a message that prints all of a name, a path or a value."""
    for text in LONG:
        with pytest.raises(ElasticError) as caught:
            entry(text)
        message = str(caught.value)
        assert len(message) < LONGEST
        assert not quotes_too_much(message, text[:1000])
        assert not quotes_too_much(message, text[-1000:])


@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "@"],
        pytest.param(["train", "@"], marks=pytest.mark.slow),
        ["train", "--resume", "@"],
        pytest.param(["bench", "@"], marks=pytest.mark.slow),
        ["robot", "@"],
        pytest.param(["@"], marks=pytest.mark.slow),
        ["evaluate", "--scenario", "@"],
        ["play", "--video", "@"],
        pytest.param(["evaluate", "--jobs", "@"], marks=pytest.mark.slow),
        pytest.param(["evaluate", "--output", "@"], marks=pytest.mark.slow),
    ],
)
def test_the_command_line_stays_short(
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Catches a terminal that is flooded by what was typed."""
    monkeypatch.chdir(tmp_path)
    for text in LONG:
        with pytest.raises(SystemExit) as ended:
            main([text if argument == "@" else argument for argument in arguments])
        assert ended.value.code in (2, 3)
        said = capfd.readouterr()
        assert len(said.err) < LONGEST
        assert not quotes_too_much(said.err, text[:1000])


def test_what_is_shown_has_its_begin_and_end() -> None:
    """Catches a text that is cut where it tells most, and one that is cut though it is short."""
    for value in (
        "x" * 10**4,
        ["y" * 50] * 100,
        10**5000,
        "\x00" * 190,
        {str(i): i for i in range(1000)},
    ):
        assert len(quote(value)) <= MOST
    path = "/" + "a" * 300 + "/run.yaml"
    assert len(shorten(path)) == MOST
    assert shorten(path).startswith("/aaa")
    assert shorten(path).endswith("/run.yaml")
    assert shorten("x" * MOST) == "x" * MOST


def test_our_own_words_are_not_cut() -> None:
    """Catches a long message of ours that loses its middle, such as between two quoted names."""
    said = f"unknown 'x.'; {'choose one of these, ' * 40} or 'y'"
    assert str(ElasticError(said)) == said
    names = [f"joint_{i}" for i in range(1000)]
    assert list_names(["a", "b"]) == "a, b"
    assert list_names(names).endswith(f" and {1000 - list_names(names).count('joint_')} more")
    assert "Did you mean 'joint_7'?" in str(unknown_name("joint", "jiont_7", names))


def test_an_extra_is_installed_as_this_project_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an index that does not have the package, and a checkout that is not there."""
    root = Path(__file__).parents[1]
    assert (
        str(missing_extra("torch", "train", "training"))
        == "training needs the package torch; install it with: pip install -c constraints.txt"
        f" '.[train]' in {root}"
    )
    needs = [
        "numpy>=2.0",
        'torch>=2.13; extra == "train"',
        "cmaes>=0.13 ; extra == 'train'",
        'dask>=1; extra == "x"',
    ]
    monkeypatch.setattr(installed, "checkout", lambda: None)
    monkeypatch.setattr(installed, "requires", lambda _: needs)
    said = str(missing_extra("torch", "train", "training"))
    assert (
        said == "training needs the package torch; install it with: pip install 'torch>=2.13'"
        " 'cmaes>=0.13'"
    )
