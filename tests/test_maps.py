"""Maps over two axes: what an axis may vary, what a cell plays, who is best, and the pictures of
it."""

import csv
import math
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from baselines.catalogue import Track
from docs.pages.learned import learned_maps
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from elastic_env.world.scenario import make_scenario
from tests.cells import METRIC, cell, family
from train.commands.compare_config import CompareConfig
from train.evaluate.changes import changes
from train.evaluate.conditions import Condition, PolicySpec, scenario_fields, vary_scenario
from train.evaluate.episodes import Evaluation
from train.evaluate.maps import HeatMap, MapConfig, heat_maps
from train.evaluate.rollout import make_vector_env
from train.evaluate.scores import best_of
from train.evaluate.statistics import Estimate
from train.figures.comparison_figures import draw_maps
from train.figures.map_plots import Square, blend, panels
from train.report.change_tables import write_maps
from train.report.report_text import Results
from train.report.write import write_report
from train.runs.folders import run_folder

CONFIGS = Path(__file__).parents[1] / "configs"
K = "scenario.stiffness"
LOAD = "scenario.load_kg"
OFFSET = "scenario.mounting_rad.half_width"
NOISE = "scenario.pelvis_imu.noise_rad"
AXES: dict[str, Any] = {
    "x": {"what": K, "values": [0.7, 1]},
    "y": {"what": LOAD, "values": [0, 5, 10]},
}


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test works in a folder of its own."""
    monkeypatch.chdir(tmp_path)


def walker_map(axes: dict[str, Any], **more: Any) -> CompareConfig:
    """A comparison with a map."""
    return CompareConfig(
        **{"name": "m", "env": "walker", "policies": ["input"], "map": axes, **more}
    )


def at(evaluations: list[Evaluation], **fields: float) -> list[Evaluation]:
    """Cells at a place of a map."""
    return [Evaluation(e.condition.replace(swept=fields), e.episodes, e.trace) for e in evaluations]


# What is played.


def test_a_map_plays_every_pair_of_values_in_the_environment() -> None:
    """Catches a diagonal in the place of a grid, a value that stays in the name, and one that
    reaches the policy."""
    conditions = walker_map(AXES, scenarios=["sensor"]).conditions()
    assert [tuple(c.swept.values()) for c in conditions] == [
        (k, m) for k in (0.7, 1.0) for m in (0.0, 5.0, 10.0)
    ]
    played = conditions[1].arguments["scenario"]
    assert played == make_scenario("sensor").replace(stiffness=0.7, load_kg=5.0)
    assert conditions[1].policy_options == {}
    worlds = make_vector_env(conditions[1], 1).unwrapped
    np.testing.assert_allclose(worlds.truth().model.stiffness, 0.7 * worlds.assumed_model.stiffness)


def test_a_field_within_a_sensor_is_varied_and_the_others_stay() -> None:
    """Catches an axis that sets a sensor back to its defaults."""
    nominal = make_scenario("nominal")
    found = vary_scenario(nominal, {NOISE: 0.002})
    assert found == nominal.replace(pelvis_imu=nominal.pelvis_imu.replace(noise_rad=0.002))
    assert scenario_fields()[NOISE] == ("standard deviation of the white noise", "rad")
    assert (
        not {"scenario.name", "scenario.encoder_counts", "scenario.imu"} & scenario_fields().keys()
    )


def test_a_half_width_is_varied_to_both_sides() -> None:
    """Catches an error of the same sign in all robots, and one that fields without a sign have."""
    found = vary_scenario(make_scenario("nominal"), {OFFSET: 0.002})
    assert found == make_scenario("nominal").replace(mounting_rad=(-0.002, 0.002))
    description, unit = scenario_fields()[OFFSET]
    assert description.startswith("half-width: error of the IMU")
    assert unit == "rad"
    assert "scenario.load_kg.half_width" not in scenario_fields()


def test_an_axis_of_the_motion_gives_the_references() -> None:
    """Catches a gait axis beside references that contradict it, and a resolved configuration
    that cannot be read."""
    axes = {"x": AXES["x"], "y": {"what": "step_period", "values": [3, [0.8, 0.6, 0.8]]}}
    config = walker_map(axes)
    assert [(c.reference, c.swept[K]) for c in config.conditions()] == [
        (3, 0.7),
        (3, 1.0),
        ([0.8, 0.6, 0.8], 0.7),
        ([0.8, 0.6, 0.8], 1.0),
    ]
    assert config.map is not None
    assert config.map.y.ticks(config.conditions()[0].environment) == ["3", "2.2"]
    assert CompareConfig(**config.model_dump(mode="json")) == config
    with pytest.raises(
        ConfigurationError,
        match=r"varies the step_period, so its values are the references; leave out",
    ):
        walker_map(axes, references=[3])


@pytest.mark.parametrize(
    ("axis", "message"),
    [
        (
            {"what": "stiffness_scale", "values": [1, 2]},
            "unknown axis 'stiffness_scale' of map.y.*is varied by sweep",
        ),
        ({"what": "scenario.slope", "values": [0, 0.1]}, "Did you mean 'scenario.slope_rad'"),
        (
            {"what": "reference", "values": [0, 1]},
            "choose one of: step_period, scenario.stiffness",
        ),
        (
            {"what": "scenario.slope_rad", "values": [0, 0.6]},
            r"slope_rad must be a number or \[lowest, highest\] within 0 to 0.5 \[rad",
        ),
        ({"what": LOAD, "values": [0, "heavy"]}, "values of map.y must be numbers, got 'heavy'"),
        ({"what": LOAD, "values": [0, True]}, "values of map.y must be numbers, got True"),
        ({"what": LOAD, "values": [5, 5]}, "map.y.values: 5 stands twice"),
        ({"what": K, "values": [1, 2]}, f"must vary two things, both vary '{K}'"),
        ({"what": LOAD, "values": [5]}, "map.y.values must have at least 2 entries|at least 2"),
    ],
)
def test_axes_that_cannot_be_are_refused(axis: dict[str, Any], message: str) -> None:
    """Catches an hour of work for a misspelt axis, and an error that does not say what an axis
    can be."""
    with pytest.raises(ConfigurationError, match=message):
        walker_map({"x": AXES["x"], "y": axis})


def test_a_map_and_a_sweep_do_not_go_together() -> None:
    """Catches a sweep that a map silently replaces, and levels that no map has."""
    sweep = {"option": "stiffness_scale", "values": [1, 2]}
    with pytest.raises(ConfigurationError, match="a map has two axes of its own"):
        walker_map(AXES, sweep=sweep)
    with pytest.raises(ConfigurationError, match="leave out sweep, and level"):
        walker_map(AXES, policies=["input", {"name": "oracle", "level": True}])


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIGS.glob("map_*.yaml")))
def test_the_maps_that_come_with_the_project_can_be_played(name: str) -> None:
    """Catches a configuration that nobody has read since a field of the scenario was renamed."""
    config = load_yaml(CONFIGS / name, CompareConfig)
    assert config.map is not None
    assert [len(axis.values) for axis in config.map.axes] == [5, 5]
    conditions = config.conditions()
    assert all(
        sum(c.policy.title == title for c in conditions) == 25
        for title in ("input_output", "adaptive_posture")
    )
    assert sum(c.policy.title == "residual of 3 s" for c in conditions) == 25 * 5


# Who is best.


def grid(values: dict[tuple[float, float], dict[str, list[float | None]]]) -> HeatMap:
    """Map of the pelvis error with given episodes by place and policy; five training seeds have
    the same."""
    evaluations = []
    for (k, load), policies in values.items():
        for title, own in policies.items():
            found = (
                family([own] * 5, "nominal")
                if title == "learned"
                else [cell(title, {"all": own}, "nominal")]
            )
            evaluations += at(found, **{K: k, LOAD: load})
    axes: dict[str, Any] = {
        "x": {"what": K, "values": [0.7, 1]},
        "y": {"what": LOAD, "values": [0, 5]},
    }
    return heat_maps(evaluations, MapConfig(**axes))[0]


FOUR: dict[tuple[float, float], dict[str, list[float | None]]] = {
    (0.7, 0.0): {"base": [4.0, 4.0], "best": [2.0, 2.0], "learned": [1.0, 1.0]},
    (1.0, 0.0): {"base": [1.0, 1.0], "best": [2.0, 2.0], "learned": [3.0, 3.0]},
    (0.7, 5.0): {"base": [8.0, 8.0], "best": [0.1, None], "learned": [6.0, None]},
    (1.0, 5.0): {"base": [None, None], "best": [None, None], "learned": [None, None]},
}


@cache
def four() -> HeatMap:
    """The map of these episodes."""
    return grid(FOUR)


def test_a_cell_compares_learning_with_the_best_without_it_there() -> None:
    """Catches axes that are swapped, one rival for all cells, a wrong sign, and falls that make
    a policy the best."""
    found = four()
    assert [[c.best for c in row] for row in found.cells] == [["learned", "base"], ["base", None]]
    assert [[c.best_analytic for c in row] for row in found.cells] == [
        ["best", "base"],
        ["base", None],
    ]
    soft = found.cells[0][0]
    stiff = found.cells[0][1]
    loaded = found.cells[1][0]
    assert (soft.learned["learned"].relative.value, soft.learned["learned"].verdict) == (
        -0.5,
        "lower",
    )
    assert stiff.learned["learned"].relative.value == 2.0
    assert (loaded.learned["learned"].relative.value, loaded.learned["learned"].falls_more) == (
        -0.25,
        True,
    )
    assert loaded.failed == {"base": (0, 2), "best": (1, 2), "learned": (5, 10)}


def test_a_page_has_what_is_ahead_in_a_map_and_what_failed() -> None:
    """Catches a change with the wrong sign, and a cell in which every policy fell."""
    (found,) = learned_maps(write_maps([four()], Path("map.csv")))
    assert found.row == [
        "pelvis error",
        "learned",
        "2 of 4",
        "1",
        "−50 % to +200 %",
        "15",
        "base (2)",
    ]
    Path("none.csv").write_text("policy,verdict\ninput,\n")
    with pytest.raises(ConfigurationError, match=r"none\.csv compares no residual"):
        learned_maps(Path("none.csv"))


def test_the_truth_wins_no_cell_and_further_sensors_are_no_rival() -> None:
    """Catches learning compared with who reads what no robot has, or what this one has not."""
    spec = Condition(env="walker", policy=PolicySpec(name="oracle"))
    assert spec.track is Track.TRUTH
    assert (
        spec.replace(policy=PolicySpec(name="oracle", track=Track.LINK_ENCODERS)).track
        is Track.LINK_ENCODERS
    )
    cells = [cell("base", {"all": [4.0]}, "nominal"), cell("oracle", {"all": [1.0]}, "nominal")]
    sensors = cell("link_encoder", {"all": [2.0]}, "nominal")
    named = [
        *cells[:1],
        *(
            Evaluation(
                e.condition.replace(policy=PolicySpec(name=e.condition.policy.title)), e.episodes
            )
            for e in (cells[1], sensors)
        ),
        *family([[3.0]] * 5, "nominal"),
    ]
    everywhere = [e for k in (0.7, 1.0) for m in (0.0, 5.0) for e in at(named, **{K: k, LOAD: m})]
    axes: dict[str, Any] = {
        "x": {"what": K, "values": [0.7, 1]},
        "y": {"what": LOAD, "values": [0, 5]},
    }
    for found in heat_maps(everywhere, MapConfig(**axes))[0].flat:
        assert (found.best, found.best_analytic) == ("link_encoder", "base")


def test_failures_count_before_scores() -> None:
    """Catches a policy that wins because it falls in the hard episodes."""
    nan = float("nan")
    assert best_of({"a": (Estimate(1.0), (1, 8)), "b": (Estimate(2.0), (0, 8))}) == "b"
    assert best_of({"a": (Estimate(1.0), (2, 40)), "b": (Estimate(2.0), (1, 8))}) == "a"
    assert best_of({"a": (Estimate(nan), (8, 8)), "b": (Estimate(2.0), (8, 8))}) == "b"
    assert best_of({"a": (Estimate(nan), (8, 8))}) is None


def test_a_cell_is_held_out_unless_training_saw_the_same_scenario() -> None:
    """Catches a map on top of a trained scenario whose cells all pass for trained on."""
    rows = {}
    for k in (0.7, 0.6):
        found = [cell("base", {"all": [2.0]}, "nominal"), *family([[1.0]], "nominal")]
        ideal = [Evaluation(e.condition.replace(scenario="ideal"), e.episodes) for e in found]
        row = next(row for row in changes(at(ideal, **{K: k})) if row.policy == "learned")
        rows[k] = row.marks
    assert rows == {
        0.7: (),
        0.6: ("held out",),
    }  # the family of these tests was trained on ideal+soft


# How it is shown.


def test_panels_say_who_is_best_and_by_how_much_learning_is_ahead() -> None:
    """Catches letters that do not fit the key, green where learning is behind, and stars that
    are missing."""
    best, learned, *levels = panels(four())
    assert [entry[:2] for entry in best.key] == [("A", "base"), ("B", "best"), ("C", "learned")]
    assert [[s.text for s in row] for row in best.squares] == [["C", "A"], ["A", "-"]]
    assert [[s.text for s in row] for row in learned.squares] == [["−50", "+200"], ["−25", "-"]]
    assert learned.squares[0][0].colour == blend("#1a7f5a", 0.75 * 0.5)
    assert learned.squares[0][1].colour == blend("#b42318", 0.75)
    assert learned.squares[1][0].small == "to A ✕5/10"
    assert [panel.title.split(",")[0] for panel in levels] == ["base", "best", "learned"]
    few = grid(
        {place: {t: v for t, v in own.items() if t != "best"} for place, own in FOUR.items()}
    )
    assert panels(few)[1].squares[0][0].small == ""  # one rival alone needs no letter
    assert (Square("", "", "#1a7f5a").ink, Square("", "", "#ffffff").ink) == ("#ffffff", "#1f2328")


@pytest.mark.slow
def test_a_map_is_drawn() -> None:
    """Catches a picture that is missing, or without squares."""
    (picture,) = draw_maps([four()], Path())
    assert picture.name == "map_step_period_3_s_nominal_pelvis_error_rms_rad.png"
    with Image.open(picture) as image:
        assert len(np.unique(np.asarray(image.convert("L")))) > 20


def test_report_and_table_of_a_map_agree() -> None:
    """Catches a map that is upside down on the page, and a table with other figures."""
    found = four()
    evaluations = [
        e
        for (k, load), own in FOUR.items()
        for e in at(
            [
                cell("base", {"all": own["base"]}, "nominal"),
                *family([own["learned"]] * 5, "nominal"),
            ],
            **{K: k, LOAD: load},
        )
    ]
    with run_folder("x", {}, 0) as folder:
        write_report(Results("x", evaluations, changes(evaluations), folder, maps=[found]))
        table = write_maps([found], folder / "map.csv")
    page = (folder / "report.html").read_text()
    text = (folder / "report.md").read_text()
    headings = re.findall(r"<h2 id=\"s\d+\">([^<]*)</h2>", page)
    assert headings[:2] == ["What was compared", "Maps"]
    assert not {"Ladder of policies", "Curves over time", "Sweeps"} & set(headings)
    squares = re.findall(r'<td style="background:#\w+;color:#\w+">([^<]+)', page)
    assert [s.strip() for s in squares[:8]] == [
        "A",
        "-",
        "C",
        "A",
        "−25",
        "-",
        "−50",
        "+200",
    ]  # the greatest load first
    assert "| 0 | −50 to B | +200 to A |" in text
    assert "best of 4 cells: base in 2, learned in 1." in text
    assert "of 3 cells lower in 2, higher in 1; from −50 % to +200 %." in text
    with table.open(newline="") as file:
        rows = [
            row
            for row in csv.DictReader(file)
            if row["metric"] == METRIC and row["policy"] == "learned"
        ]
    assert [(row["x"], row["y"], row["is_best"]) for row in rows] == [
        ("0.7", "0", "True"),
        ("1", "0", "False"),
        ("0.7", "5", "False"),
        ("1", "5", "False"),
    ]
    assert [float(row["change"]) for row in rows[:3]] == [-0.5, 2.0, -0.25]
    assert math.isclose(float(rows[0]["mean"]), 1.0)
