"""The CI benchmark: what it measures, how it fails, what it writes."""

import json
import re
from collections.abc import Sequence
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from rich.console import Console

import train.commands.bench
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from train.commands.bench import BenchConfig, find_config
from train.commands.cli import main
from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation, evaluate
from train.runs.github_annotations import annotation
from train.workers.executors import Executors

ROOT = Path(__file__).parents[1]
QUICK = {"kind": "sine", "duration_s": 0.1, "onset_s": 0.1, "amplitude": 0.1}
LONGER = {**QUICK, "duration_s": 0.5, "onset_s": 0.5}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of a test go to its own folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GITHUB_STEP_SUMMARY", raising=False)
    monkeypatch.delenv("GITHUB_ACTIONS", raising=False)


def written(**case: Any) -> Path:
    """A configuration of one rollout."""
    path = Path("bench.yaml")
    content = {
        "env": "testbed",
        "policy": "input",
        "reference": QUICK,
        "figures": {"link_error_rms_rad": None},
        **case,
    }
    path.write_text(f"# mine\n{yaml.safe_dump({'cases': [content]})}  # the end\n")
    return path


def failed(arguments: list[str]) -> bool:
    """Whether the command ends with exit code 1."""
    code = 0
    try:
        main(["bench", *arguments])
    except SystemExit as end:
        code = end.code
    assert code in (0, 1)
    return code == 1


def test_what_was_accepted_is_kept_and_what_got_worse_falls_short(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a margin with the wrong sign, an update that accepts something else, and a failure
    without exit code."""
    path = written()
    assert failed([str(path)])
    assert "nothing was accepted yet; --update accepts it" in capsys.readouterr().out
    before = path.read_text()
    assert not failed([str(path), "--update"])
    accepted = yaml.safe_load(path.read_text())["cases"][0]["figures"]["link_error_rms_rad"]
    assert path.read_text() == before.replace("null", f"{accepted:.4g}")  # comments and order stay
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    assert not failed([str(path)])
    said = capsys.readouterr().out
    assert "accepts what is better" not in said
    assert "interval" not in said
    (figure,) = json.loads(Path("runs/bench-3/bench.json").read_text())
    assert figure["measured"] == pytest.approx(accepted, rel=1e-3)
    assert figure["bound"] == pytest.approx(1.05 * accepted)
    written(figures={"link_error_rms_rad": accepted / 1.1})
    capsys.readouterr()
    assert failed([str(path)])
    said = capsys.readouterr().out
    assert f"link_error_rms_rad is {accepted:.4g} (+10.0 %), at most" in " ".join(said.split())
    assert Path("summary.md").read_text().count("## elastic bench") == 2
    assert "falls short" in Path("summary.md").read_text()


class OfCases(NamedTuple):
    """What came of `elastic bench` with several cases, which a worker process plays."""

    said: list[str]
    folder: Path
    evaluations: list[Evaluation]


@pytest.fixture(scope="module")
def of_cases(tmp_path_factory: pytest.TempPathFactory) -> OfCases:
    """Play once for all tests of several cases: two of one motion, and one of another, whose worlds
    they cannot share, so that they are played in a worker."""
    folder = tmp_path_factory.mktemp("cases")
    kept = {"env": "testbed", "policy": "input", "reference": LONGER, "episodes": 2}
    kept["figures"] = {"link_error_rms_rad": 9.0, "link_error_peak_rad": 9.0}
    soft = {**kept, "options": {"stiffness_scale": 0.5}}
    soft["figures"] = {"link_error_rms_rad": 9.0, "link_error_peak_rad": 1e-4}
    short = {**kept, "reference": {**LONGER, "duration_s": 0.4}}
    short["figures"] = {"link_error_rms_rad": 9.0}
    (folder / "bench.yaml").write_text(yaml.safe_dump({"cases": [kept, soft, short]}))
    evaluations: list[Evaluation] = []
    play = train.commands.bench.run_conditions

    def noted(conditions: Sequence[Condition], console: Console) -> list[Evaluation]:
        evaluations.extend(play(conditions, console, Executors(jobs=1)))
        return evaluations

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        patch.chdir(folder)
        patch.delenv("GITHUB_STEP_SUMMARY", raising=False)
        patch.setenv("GITHUB_ACTIONS", "true")
        patch.setenv("GITHUB_WORKSPACE", str(folder.parent))
        patch.setattr(train.commands.bench, "run_conditions", noted)
        assert failed(["bench.yaml"])
    return OfCases(said.getvalue().splitlines(), folder, evaluations)


def test_what_falls_short_stands_first_and_is_an_annotation(of_cases: OfCases) -> None:
    """Catches a failure at the end of a long table, a change of the wrong sign, options that the
    policy does not get, and a file that is named as if the checkout were here."""
    folder = of_cases.folder
    begin = f"::error file={folder.name}/bench.yaml,title="
    (error,) = (line for line in of_cases.said if line.startswith(begin))
    assert "link_error_peak_rad is" in error
    figures = json.loads((folder / "runs/bench/bench.json").read_text())
    plain, scaled = (one["measured"] for one in figures if one["metric"] == "link_error_peak_rad")
    assert scaled != plain  # the same episode, so the options alone differ
    table = (folder / "runs/bench/bench.md").read_text().splitlines()
    rows = [line for line in table if "link_error" in line or "testbed" in line]
    assert "stiffness_scale" in rows[0]
    assert "falls short" in rows[1]
    assert f"| {scaled:.4g} |" in rows[1]
    assert re.search(r"\| [0-9.e-]+, [0-9.e-]+ \|$", rows[1])  # the interval over its episodes
    assert f"+{100 * (scaled / 1e-4 - 1):.1f} %" in rows[1]
    assert all("better" in line for line in rows[2:] if "link_error" in line)
    assert all("-99.9 %" in line for line in rows[2:] if "link_error" in line)


def test_figures_with_a_sign_are_judged_by_their_size(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a lowest error that grows tenfold and counts as better."""
    signed = partial(written, reference=LONGER)
    path = signed(figures={"link_error_min_rad": None, "clipped_share": None})
    played = [evaluate(Condition(policy={"name": "input"}, reference=LONGER))]
    monkeypatch.setattr(train.commands.bench, "run_conditions", lambda *_: played)
    assert not failed([str(path), "--update"])
    case = yaml.safe_load(path.read_text())["cases"][0]
    accepted = case["figures"]["link_error_min_rad"]
    assert accepted < 0.0
    assert case["figures"]["clipped_share"] == 0.0
    assert not failed([str(signed(figures={"link_error_min_rad": accepted}))])
    assert failed([str(signed(figures={"link_error_min_rad": 0.1 * accepted}))])
    assert "(+900." in capsys.readouterr().out
    assert not failed([str(signed(figures={"link_error_min_rad": 10.0 * accepted}))])
    assert "better" in capsys.readouterr().out


def test_an_update_fits_without_margin_and_changes_figures_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches digits that were rounded away and fail at once, line ends that change, and an update
    that does not say what it did."""
    path = written(margins={"link_error_rms_rad": 0.0})
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert not failed([str(path), "--update"])
    assert "accepted 1 of 1 figures" in capsys.readouterr().out
    assert path.read_bytes().count(b"\n") == path.read_bytes().count(b"\r\n") > 3
    assert not failed([str(path)])


@pytest.mark.parametrize(
    ("named", "case"),
    [
        (("- env", "- &a\n  env"), "{<<: *a, seed: 3}"),
        (("figures:", "figures: &a"), "{env: testbed, policy: zero, figures: *a}"),
        (("", ""), "{env: testbed, policy: zero, figures: {<<: {link_error_rms_rad: 1.0}}}"),
    ],
)
def test_an_update_refuses_figures_that_two_cases_share(
    named: tuple[str, str],
    case: str,
    of_cases: OfCases,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches figures of one case that take the place of another one's, which then falls short, and
    figures of another case that end in a traceback."""
    played = of_cases.evaluations[:2]
    monkeypatch.setattr(train.commands.bench, "run_conditions", lambda *_: played)
    path = written()
    path.write_text(path.read_text().replace(*named, 1) + f"- {case}\n")
    before = path.read_bytes()
    with pytest.raises(SystemExit) as end:
        main(["bench", str(path), "--update"])
    assert end.value.code == 2
    assert "figures of cases.1 stand elsewhere" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_wrong_inputs_are_annotations_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a workflow that fails and does not say why at the pull request."""
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    with pytest.raises(SystemExit) as end:
        main(["bench", "none.yaml"])
    assert end.value.code == 2
    assert "::error title=elastic::no configuration file at none.yaml" in capsys.readouterr().out


def test_an_annotation_is_one_command_whatever_it_says() -> None:
    """Catches a path or a message that ends the command early."""
    made = annotation("50 % of\na: b, c", Path("a,b:c.yaml"))
    place, message = "a%2Cb%3Ac.yaml", "50 %25 of%0Aa: b, c"
    assert made == f"::error file={place},title=elastic::{message}"


def test_a_fall_falls_short_and_an_unknown_figure_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches nan that counts as small, and a misspelt metric that guards nothing."""
    walk = {"step_period": [0.3, 0.4, 0.3], "num_steps": 2}
    path = written(
        env="walker",
        policy="zero",
        scenario="ideal+soft",
        reference=walk,
        figures={"pelvis_roll_rms_rad": 9.0},
    )
    assert failed([str(path)])
    assert "the episode ended as 'fell'" in capsys.readouterr().out
    path = written(figures={"link_eror_rms_rad": 9.0})
    with pytest.raises(SystemExit) as end:
        main(["bench", str(path)])
    assert end.value.code == 2
    assert "Did you mean 'link_error_rms_rad'?" in " ".join(capsys.readouterr().err.split())


def test_figures_have_margins_of_their_own_and_are_means_over_episodes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches one margin for all, an episode alone that counts, and a margin of no figure."""
    names = ("link_error_rms_rad", "link_error_peak_rad")
    path = written(figures=dict.fromkeys(names), episodes=3, seed=4)
    assert not failed([str(path), "--update"])
    accepted = yaml.safe_load(path.read_text())["cases"][0]["figures"]
    condition = Condition(policy={"name": "input"}, reference=QUICK, seed=4, episodes=3)
    alone = evaluate(condition).episodes
    for name in names:
        mean = sum(own[name] for own in alone) / 3.0
        assert accepted[name] == pytest.approx(mean, rel=1e-3)
        assert accepted[name] != pytest.approx(alone[0][name], rel=1e-5)
    better = {name: value / 1.2 for name, value in accepted.items()}
    path = written(figures=better, episodes=3, seed=4, margins={names[1]: 0.25})
    assert failed([str(path)])
    out = " ".join(capsys.readouterr().out.split())
    assert f"{names[0]} is {accepted[names[0]]:.4g} (+20.0 %)" in out
    assert f"{names[1]} is" not in out
    path = written(margins={"link_error_peak_rad": 0.1})
    with pytest.raises(SystemExit):
        main(["bench", str(path)])
    assert "figure with a margin of its own" in " ".join(capsys.readouterr().err.split())


def test_the_workflow_of_the_docs_runs_what_there_is() -> None:
    """Catches a workflow that no parser reads, or that installs other versions than the commit."""
    page = (ROOT / "docs" / "commands.md").read_text()
    (text,) = (block for block in page.split("```yaml") if "jobs:" in block.partition("```")[0])
    steps = yaml.safe_load(text.partition("```")[0])["jobs"]["bench"]["steps"]
    commands = [step["run"] for step in steps if "run" in step]
    assert commands[0].endswith("checkout COMMIT")
    assert commands[1].endswith("install -c elastic-env/constraints.txt ./elastic-env .")
    assert commands[-1].startswith("elastic bench ")


def test_the_shipped_configuration_is_accepted_in_full() -> None:
    """Catches a rollout that nobody has measured, and one without a walk."""
    config = BenchConfig.model_validate(
        yaml.safe_load((ROOT / "configs" / "bench.yaml").read_text())
    )
    assert all(value is not None for case in config.cases for value in case.figures.values())
    assert {case.env for case in config.cases} == {"testbed", "walker"}


def test_the_package_has_its_own_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a bench that works in a checkout alone, and one that would change the installed
    package."""
    shipped = find_config(Path("configs/bench.yaml"))
    assert load_yaml(shipped, BenchConfig).cases
    assert shipped.resolve() == (ROOT / "configs" / "bench.yaml").resolve()
    with pytest.raises(ConfigurationError, match=r"copy .* there first"):
        find_config(Path("configs/bench.yaml"), update=True)
    assert find_config(Path("mine.yaml")) == Path("mine.yaml")


@pytest.mark.parametrize("field", ["policy", "env"])
def test_a_configuration_that_nobody_named_runs_no_code(
    field: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches `elastic bench` in a folder from elsewhere, which imports what its
    configs/bench.yaml names."""
    Path("evil.py").write_text("open('imported', 'w')\nROBOT = None\n")
    Path("configs").mkdir()
    written(**{field: "evil.py:ROBOT"}).rename("configs/bench.yaml")
    with pytest.raises(SystemExit):
        main(["bench"])
    said = " ".join(capsys.readouterr().err.split())
    assert "configs/bench.yaml names 'evil.py:ROBOT', whose code would run" in said
    assert "then name it: elastic bench configs/bench.yaml" in said
    assert not Path("imported").exists()
    with pytest.raises(SystemExit):
        main(["bench", "configs/bench.yaml"])
    assert Path("imported").exists()


def test_a_configuration_that_nobody_named_is_played_where_it_names_no_code() -> None:
    """Catches a usual file that is no longer looked for."""
    Path("configs").mkdir()
    written(figures={"link_error_rms_rad": 9.0}).rename("configs/bench.yaml")
    assert not failed([])
    assert failed([str(written(figures={"link_error_rms_rad": 0.0}))])
