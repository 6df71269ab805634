"""Evaluating a walk: the error of the local frame against Eq. 1, records, tables, figures,
sweeps, and the commands."""

from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from gymnasium.vector import AutoresetMode
from PIL import Image
from rich.console import Console

import train.commands.comparison
from baselines.policies import RESIDUAL
from baselines.residual.residual_folder import load_residual
from baselines.residual_env import ResidualVectorWrapper
from baselines.walking.controller import LocalFrame, local_frame
from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.motion.gait import LEFT, RIGHT
from elastic_env.rigid.leg_kinematics import rotation_x, rotation_y
from elastic_env.world.robot_model import WalkerModel
from train.commands.cli import main
from train.commands.compare_config import CompareConfig
from train.commands.comparison import try_out
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import Evaluation, evaluate
from train.evaluate.local_frame_error import (
    SupportChanges,
    com_jump,
    frame_error,
    support_changes,
    tilt,
)
from train.evaluate.rollout import make_vector_env
from train.figures.chart import Chart
from train.figures.colours import policy_colours
from train.figures.comparison_figures import (
    draw_signals,
    figure_name,
    group_by_option,
    group_by_reference,
)
from train.figures.plots import draw_chart
from train.figures.score_charts import sweep_chart
from train.figures.time_chart import intervals
from train.learn.train_config import TrainConfig
from train.report.summary import failure_notes, print_summary, write_summary
from train.speed.contenders import RawWorlds, VectorLoop

SHORT = {"step_period": [0.3, 0.5, 0.3], "num_steps": 1}
FAST = {"step_period": [0.2, 0.3, 0.2], "num_steps": 1}
TWO_STEPS = {"step_period": [0.3, 0.5, 0.3], "num_steps": 2}
COMMAND_SHORT = "{step_period: [0.3, 0.5, 0.3], num_steps: 1}"
CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))
TRAININGS = [path for path in CONFIGS if path.stem.startswith("train_")]
COMPARISONS = [path for path in CONFIGS if path not in TRAININGS and path.stem != "bench"]
LARGE = ("map_", "footholds")
"""Beginnings of the names of configurations with very many conditions."""
SHIPPED = (TRAININGS, [path for path in COMPARISONS if not path.stem.startswith(LARGE)])
HIP_ROLL = 1
"""Place of the hip roll joint in a leg of six."""


def walk(policy: str = "zero", reference: Any = None, **values: Any) -> Condition:
    """A short cell of the walker."""
    spec = values.pop("spec", PolicySpec(name=policy))
    return Condition(env="walker", policy=spec, reference=reference or SHORT, **values)


def test_first_and_last_steps_have_a_table_where_they_are_not_the_whole_walk() -> None:
    """Catches a table of the same figures twice, and a long walk without its own."""
    gait = {"settling_steps": 2}
    references = (3, {"step_period": 3, "num_steps": 6}, {"step_period": 3, "gait": gait})
    cells = [walk(reference=reference) for reference in references]
    title = "First and last four steps, rms"
    shown = [title in c.environment.splits_of([c.arguments]) for c in cells]
    assert shown == [False, True, False]
    assert title in cells[0].environment.splits_of(c.arguments for c in cells)


def made_up(condition: Condition, *episodes: tuple[str, float]) -> Evaluation:
    """An evaluation whose metrics all have one value, with the termination of every episode."""
    names = [column.metric for column in condition.environment.columns]
    names += [
        column.metric for columns in condition.environment.splits.values() for column in columns
    ]
    return Evaluation(
        condition, [{"termination": end, **dict.fromkeys(names, value)} for end, value in episodes]
    )


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test works in a folder of its own, on a wide terminal without colours."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Conditions are evaluated in this process: starting others takes seconds."""

    def run(conditions: Sequence[Condition], console: Console, *_: object) -> list[Evaluation]:
        return [evaluate(condition, num_threads=1) for condition in conditions]

    monkeypatch.setattr(train.commands.comparison, "run_conditions", run)


@pytest.fixture(scope="module")
def model() -> WalkerModel:
    """The assumed walker with a plan of two steps."""
    return make_vector_env(walk(reference=TWO_STEPS), 1).unwrapped.assumed_model


@pytest.fixture(scope="module")
def fallen() -> Evaluation:
    """A walk without any control, which ends in a fall."""
    return evaluate(
        walk("zero", {"step_period": 3, "num_steps": 1}, scenario="ideal"), num_threads=1
    )


# The local frame at the support changes.


@pytest.mark.parametrize("foot", [LEFT, RIGHT])
@pytest.mark.parametrize("theta", [0.05, -0.02])
def test_frame_error_of_a_hip_roll_deflection_is_equation_1(
    model: WalkerModel, foot: int, theta: float
) -> None:
    """Catches a wrong sign, foot or axes: the pelvis rolls by θ over an upright leg, and no
    encoder shows it."""
    biped = model.biped
    seen = np.zeros((1, 12))
    true = np.zeros((1, 12))
    true[0, 6 * foot + HIP_ROLL] = -theta
    attitude = np.array([[theta, 0.0]])
    e = frame_error(local_frame(biped, seen, attitude), local_frame(biped, true, attitude), foot)
    L = biped.leg.reach + biped.ankle_height
    half = theta / 2.0
    expected = L * np.array([0.0, 2.0 * np.sin(half) * np.cos(half), 2.0 * np.sin(half) ** 2])
    np.testing.assert_allclose(e, [expected], rtol=0.0, atol=1e-12)
    assert np.linalg.norm(expected) == pytest.approx(2.0 * L * abs(np.sin(half)), rel=1e-12)


def test_com_jumps_by_what_the_distance_of_the_feet_is_wrong(model: WalkerModel) -> None:
    """Catches a jump of the true center of mass, and one that depends on where the pelvis is."""
    footholds = model.biped.footholds
    soles = np.pad(footholds, ((0, 0), (0, 1)), constant_values=-0.7)
    wrong = np.array([0.003, -0.002, 0.001])
    com = np.array([[0.01, 0.02, 0.1]])
    assert not com_jump(LocalFrame(com, soles[None]), footholds, LEFT, RIGHT).any()
    soles[RIGHT] += wrong
    frame = LocalFrame(com, soles[None])
    np.testing.assert_allclose(
        com_jump(frame, footholds, LEFT, RIGHT), [-wrong], rtol=0.0, atol=1e-15
    )
    np.testing.assert_allclose(
        com_jump(frame, footholds, RIGHT, LEFT), [wrong], rtol=0.0, atol=1e-15
    )


def test_support_changes_are_those_between_the_steps(model: WalkerModel) -> None:
    """Catches the beginning and the end of the walk taken for a change, and one that is a step
    late."""
    timing = model.plan.timing
    (change,) = support_changes(timing)
    assert timing.time[change - 1] == pytest.approx(1.0 + 1.1)  # standing, and the first step
    assert (timing.support[change - 1], timing.support[change]) == (LEFT, RIGHT)


def test_tilt_leaves_the_heading_out() -> None:
    """Catches an error of the frame that is the pelvis' heading, which no policy can know."""
    roll = 0.03
    pitch = -0.02
    yaw = 0.4
    heading = np.array(
        [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
    )
    R = heading @ rotation_y(np.array([pitch]))[0] @ rotation_x(np.array([roll]))[0]
    np.testing.assert_allclose(tilt(R[None]), [[roll, pitch]], atol=1e-15)


def test_figures_of_the_support_changes_are_taken_at_the_changes_alone(model: WalkerModel) -> None:
    """Catches samples of other steps, worlds mixed up, and a mean that is the largest."""
    theta = np.array([0.01, 0.03])
    change = int(support_changes(model.plan.timing)[0])
    observation = np.zeros((2, len(model.observation_table)))
    observation[:, model.observation_table.group("imu_attitude")] = np.stack(
        [theta, np.zeros(2)], axis=-1
    )
    true = np.zeros((2, 12))
    true[:, 6 * RIGHT + HIP_ROLL] = -theta
    truth = SimpleNamespace(q=true, pelvis_R=rotation_x(theta))
    changes = SupportChanges(model)
    assert changes.metrics(0) == {}
    for step, estimate in (
        (change - 1, true + 0.1),
        (change, np.zeros((2, 12))),
        (change + 1, true + 0.1),
    ):
        changes.record(step, estimate, observation, truth)
    L = model.biped.leg.reach + model.biped.ankle_height
    for world in (0, 1):
        metrics = changes.metrics(world)
        length = 2.0 * L * np.sin(theta[world] / 2.0)
        assert metrics["frame_error_mean_m"] == pytest.approx(length, rel=1e-9)
        assert metrics["frame_error_max_m"] == pytest.approx(length, rel=1e-9)
        assert metrics["frame_error_y_mean_m"] == pytest.approx(L * np.sin(theta[world]), rel=1e-9)


# Records.


@pytest.fixture(scope="module")
def elastic_walk() -> Evaluation:
    """Two walks of two fast steps, on an estimate that takes motors for links."""
    cell = walk("input", {**FAST, "num_steps": 2}, episodes=2, seed=3)
    return evaluate(cell, num_threads=1)


def test_a_rigid_robot_knows_its_frame_and_an_elastic_one_does_not(
    elastic_walk: Evaluation,
) -> None:
    """Catches an error that is there without elasticity, options of a policy that do not reach
    the environment."""
    rigid = PolicySpec(name="zero", label="rigid", env_options={"form": "rigid"})
    cell = walk(spec=rigid, reference={**FAST, "num_steps": 2}, scenario="ideal")
    stiff = evaluate(cell, num_threads=1).episodes[0]
    elastic = elastic_walk.episodes[0]
    assert stiff["policy"] == "rigid"
    assert max(stiff[f"frame_error_{part}_m"] for part in ("mean", "max", "y_mean")) < 1e-9
    assert stiff["link_estimate_error_rms_rad"] < 1e-12
    assert 1e-3 < elastic["frame_error_mean_m"] < 0.05
    assert elastic["frame_error_mean_m"] == elastic["frame_error_max_m"]  # one change
    assert elastic["link_estimate_error_rms_rad"] > 1e-3


def test_record_of_a_walk_names_its_cell_and_agrees_with_its_trace(
    elastic_walk: Evaluation,
) -> None:
    """Catches metrics of another world, a reference without its number, and signals out of step
    with their time."""
    record = elastic_walk.episodes[0]
    trace = elastic_walk.trace
    named = {
        "reference": "0.2+0.3+0.2 s num_steps=2",
        "step_period_s": 0.7,
        "scenario": "nominal",
        "seed": 3,
        "termination": "",
    }
    assert {key: record[key] for key in named} == named
    scored = (trace["time_s"] > 1.0 + 1e-9) & (trace["time_s"] < 2.4 + 1e-9)
    assert record["pelvis_roll_rms_rad"] == pytest.approx(
        np.sqrt(np.mean(trace["pelvis_roll"][scored] ** 2)), rel=1e-9
    )
    task = make_vector_env(elastic_walk.condition, 1).unwrapped.task
    assert {metric.name for metric in task.metrics} <= record.keys()
    assert record["link_estimate_error_rms_rad"] > 0.0
    # roll and pitch, with noise of 0.2 mrad each
    assert record["imu_error_rms_rad"] == pytest.approx(0.2e-3 * np.sqrt(2.0), rel=0.15)


class Blind:
    """A policy that commands nothing and estimates nothing."""

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ):
        """No offset."""
        return np.zeros((len(observation), 12)), state


def blind(env: Any) -> Blind:
    """One's own policy, as "module:function"."""
    return Blind()


@pytest.fixture(scope="module")
def blind_walk() -> dict[str, Any]:
    """Record of a walk of two fast steps without any command, in `ideal`."""
    cell = walk(f"{__name__}:blind", {**FAST, "num_steps": 2}, scenario="ideal")
    return evaluate(cell, num_threads=1).episodes[0]


def test_a_policy_without_estimate_has_no_error_of_it(blind_walk: dict[str, Any]) -> None:
    """Catches a protocol that asks for more than `predict`."""
    assert [
        name for name in blind_walk if name.startswith(("frame", "com_jump", "link_estimate"))
    ] == []
    assert blind_walk["pelvis_roll_rms_rad"] > 0.0


def test_the_error_of_the_imu_is_that_of_roll_and_pitch_in_the_walk(
    blind_walk: dict[str, Any],
) -> None:
    """Catches an error against another step's truth, one axis alone, and standing that counts."""
    off = evaluate(walk("zero", FAST, scenario="imu"), num_threads=1).episodes[0]
    assert blind_walk["imu_error_rms_rad"] < 1e-12
    assert 1e-3 < off["imu_error_rms_rad"] < 2e-2
    assert "link_estimate_error_rms_rad" in off
    assert "frame_error_mean_m" not in off  # one step, no change of the support foot


def test_a_fall_is_counted_and_not_scored(fallen: Evaluation) -> None:
    """Catches the scores of half a walk beside those of whole ones."""
    assert fallen.episodes[0]["termination"] == "fell"
    assert fallen.num_failed == 1
    assert len(fallen.values("pelvis_roll_rms_rad")) == 0
    assert fallen.trace["time_s"][-1] == pytest.approx(fallen.episodes[0]["duration_s"])
    assert fallen.trace["time_s"][-1] < 4.5
    table = Console(width=160, record=True, file=StringIO())
    print_summary([fallen], table)
    row = next(line for line in table.export_text().splitlines() if "zero" in line)
    assert row.split()[-1] == "1/1"
    assert not any(character.isdigit() for character in row.split("zero")[1].replace("1/1", ""))


# Tables.


def test_a_fall_of_all_says_when(fallen: Evaluation, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a policy of which nothing is known but that it fell, a mean of the times, and one
    of some that fell."""
    several, some = (
        made_up(walk(p, episodes=3), *[(end, 0.1) for end in ends]) for p, ends in FALLS.items()
    )
    for cell in (several, some):
        for episode, time in zip(cell.episodes, (3.42, 3.31, 9.0), strict=True):
            episode["duration_s"] = time
    time = fallen.trace["time_s"][-1]
    notes = ["zero: fell after 3.4 s (3 of 3)"]
    assert failure_notes([several, some]) == notes
    assert failure_notes([fallen]) == [f"zero: fell after {time:.1f} s (1 of 1)"]
    other = made_up(walk("zero", scenario="soft"), ("fell", 0.1))
    other.episodes[0]["duration_s"] = 2.0
    name = several.condition.reference_name
    assert failure_notes([several, other]) == [
        f"{name}, nominal, {notes[0]}",
        f"{name}, soft, zero: fell after 2.0 s (1 of 1)",
    ]
    print_summary([several, some], Console(width=100))
    assert notes[0] in capsys.readouterr().out.splitlines()
    assert (
        f"* {notes[0]}"
        in write_summary([several, some], Path("summary.md")).read_text().splitlines()
    )
    assert "failed:" not in write_summary([some], Path("summary.md")).read_text()


FALLS = {"zero": ("fell", "fell", "fell"), "input": ("fell", "", "fell")}


def test_tables_say_median_worst_and_falls() -> None:
    """Catches a fall averaged in, a worst episode that fell, and phases that are left out."""
    cell = made_up(walk("input", episodes=4), ("", 0.002), ("fell", 9.0), ("", 0.004), ("", 0.003))
    text = write_summary([cell], Path("summary.md")).read_text()
    first, second = (
        line
        for line in text.splitlines()
        if line.startswith("| 0.3+0.5+0.3 s num_steps=1 | nominal | input |")
    )
    assert first.count("3.00 [2.00, 4.00] (4.00)") == 6  # pelvis, roll, pitch and IMU
    assert second.count("(4.00)") == 9  # roll, pitch and ZMP in three phases
    for line in (first, second):
        assert line.endswith("| 1/4 |")
    assert "9000" not in text
    for word in (
        "pelvis",
        "double",
        "single",
        "transition",
        "e mean [mm]",
        "COM jump [mm]",
        "early [ms]",
    ):
        assert word.lower() in text.lower()


@pytest.mark.parametrize("width", [100, 72])
def test_the_table_fits_its_terminal(width: int) -> None:
    """Catches names cut short, numbers broken over lines, and a lack of room that hides what
    policies are judged by."""
    cells = [
        made_up(walk(policy, [0.8, 0.6, 0.8], scenario="ideal+soft"), ("", 0.0876))
        for policy in ("uncompensated", "input_output")
    ]
    console = Console(width=width, record=True, file=StringIO())
    print_summary(cells, console)
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    row = next(line for line in lines if "uncompensated" in line).split()
    assert row[:4] == ["0.8+0.6+0.8", "s", "ideal+soft", "uncompensated"]
    assert set(row[4:-1]) <= {"87.60", "87.6", "88"}
    assert any("ZMP" in line for line in lines if "no room" not in line)
    assert any("summary.md" in line for line in lines) == (width < 100)
    assert any("Eq. 1" in line for line in lines) == (
        width == 100
    )  # the legend is of what is shown


# Figures.


@pytest.mark.slow
def test_figures_of_walks_and_falls_are_drawn(fallen: Evaluation) -> None:
    """Catches empty pictures, and a fall that breaks the scale or the drawing."""
    upright = evaluate(
        walk("input_output", {"step_period": 3, "num_steps": 1}, scenario="ideal"), num_threads=1
    )
    files = draw_signals([fallen, upright], Path())
    assert [file.name.partition("_")[0] for file in files] == ["pelvis", "zmp"]
    for file in files:
        with Image.open(file) as image:
            pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
        for colour in (
            (0x9C, 0x66, 0x44),
            (0x14, 0xA0, 0x98),
            (0xE9, 0xEB, 0xEE),
        ):  # zero, input_output, single support
            assert (np.abs(pixels - colour).sum(axis=1) == 0).sum() > 20


def test_intervals_are_where_a_mask_is_true() -> None:
    """Catches a shade that is a sample short, or missing at the ends."""
    mask = np.array([1.0, 0.0, 1.0, 1.0, 0.0, 1.0])
    time = 0.1 * np.arange(6)
    assert intervals(mask, time) == [
        (0.0, 0.0),
        (pytest.approx(0.2), pytest.approx(0.3)),
        (0.5, 0.5),
    ]


@pytest.mark.parametrize(
    ("kind", "reference", "scenario", "name"),
    [
        ("pelvis", {"step_period": 24, "num_steps": 2}, "nominal", "fig7_pelvis_24_s_nominal"),
        ("pelvis", 3, "ideal", "fig8_pelvis_3_s_ideal"),
        ("zmp", 24, "nominal", "fig9_zmp_24_s_nominal"),
        ("zmp", 3.0, "nominal", "fig10_zmp_3_s_nominal"),
        ("zmp", 3, "soft", "zmp_3_s_soft"),
        ("pelvis", {"step_period": 3, "num_steps": 4}, "nominal", "fig8_pelvis_3_s_nominal"),
        ("pelvis", {"step_period": 3, "num_steps": 1}, "nominal", "pelvis_3_s_num_steps_1_nominal"),
        ("zmp", {"step_period": 24, "num_steps": 1}, "nominal", "zmp_24_s_num_steps_1_nominal"),
        ("pelvis", [0.8, 0.6, 0.8], "nominal", "pelvis_0.8+0.6+0.8_s_nominal"),
    ],
)
def test_figures_have_the_numbers_of_the_paper(
    kind: str, reference: Any, scenario: str, name: str
) -> None:
    """Catches a picture that claims to be the paper's and is not."""
    assert figure_name(kind, Evaluation(walk(reference=reference, scenario=scenario))) == name


def test_references_that_differ_stay_apart_and_say_each_parameter_once() -> None:
    """Catches a number of steps that is named twice, and two gaits of one name."""
    walks = [{"step_period": 3, "num_steps": 1, "form": form} for form in ("tendon", "rigid")]
    cells = CompareConfig(
        name="x", env="walker", references=[*walks, 3], policies=["zero"]
    ).conditions()  # type: ignore[list-item]
    names = ["3 s num_steps=1 form=tendon", "3 s num_steps=1 form=rigid", "3 s"]
    assert [cell.reference_name for cell in cells] == names


def swept() -> tuple[list[Condition], Chart]:
    """Cells of a sweep with falls, and its chart."""
    config = CompareConfig(
        name="s",
        env="walker",
        sweep={"option": "stiffness_scale", "values": [2.0, 0.5, 1.0]},
        policies=[{"name": "input"}, {"name": "oracle", "level": True}],
    )
    cells = config.conditions()
    ends = [[("", 0.03)], [("fell", 9.0)], [("", 0.01), ("fell", 9.0)], [("", 0.002)]]
    played = [made_up(cell, *end) for cell, end in zip(cells, ends, strict=True)]
    points = group_by_option(played)
    columns = [cells[0].environment.swept[0]]
    return cells, sweep_chart(points, columns, "", policy_colours(list(points)))


def test_sweeps_have_a_curve_per_policy_and_gaps_where_all_fell() -> None:
    """Catches values in the order of the configuration, a level that is a curve, and falls
    averaged in."""
    cells, chart = swept()
    assert [cell.policy_options for cell in cells] == [
        {"stiffness_scale": x} for x in (2.0, 0.5, 1.0)
    ] + [{}]
    failing_panel, panel = chart.panels
    input_curve, level = panel.curves
    np.testing.assert_array_equal(input_curve.x, [0.5, 1.0, 2.0])
    np.testing.assert_allclose(input_curve.y, [np.nan, 10.0, 30.0])
    np.testing.assert_allclose(level.y, [2.0, 2.0])
    assert (input_curve.dash, level.dash) == ("solid", "dot")
    (failing,) = failing_panel.curves
    assert (failing.x.tolist(), failing.crosses) == ([0.5, 1.0], [True, False])
    assert failing_panel.rows == ["input"]


@pytest.mark.slow
def test_a_sweep_with_gaps_is_drawn() -> None:
    """Catches an empty picture."""
    with Image.open(draw_chart(swept()[1], Path("s.png"))) as image:
        assert len(np.unique(np.asarray(image.convert("L")))) > 20


def test_references_are_swept_by_their_step_period() -> None:
    """Catches a list of durations that has no place on the axis."""
    references = [3, [0.8, 0.6, 0.8], {"step_period": 24, "num_steps": 2}]
    points = group_by_reference(
        [made_up(walk(reference=reference), ("", 0.01)) for reference in references]
    )
    chart = sweep_chart(points, [walk().environment.swept[0]], "", policy_colours(list(points)))
    (curve,) = chart.panels[0].curves
    np.testing.assert_allclose(curve.x, [2.2, 3.0, 24.0])


# Configurations and commands.


@pytest.mark.parametrize(
    ("trainings", "comparisons"),
    [
        pytest.param(*SHIPPED, id="one_of_each"),
        *(
            pytest.param(
                *([one] if one in part else [] for part in (TRAININGS, COMPARISONS)),
                id=one.stem,
                marks=pytest.mark.slow,
            )
            for one in (*TRAININGS, *COMPARISONS)
        ),
    ],
)
def test_configurations_that_come_with_it_are_valid(
    trainings: list[Path], comparisons: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a name, a duration, a scenario, a base or a setting that does not exist, a residual
    that is damaged, and a scenario that is to be held out.

    Each of them is made once for all configurations, at short walks; every night all of them for
    each configuration, which shows one that does not exist in its environment or at its motion
    alone, and walks as long as they are.
    """
    monkeypatch.chdir(Path(__file__).parents[1])  # where the paths of residuals begin
    of_one = len(trainings) + len(comparisons) == 1
    made: set[tuple[str, str]] = set()
    for path in trainings:
        config = load_yaml(path, TrainConfig)
        assert config.name == path.stem
        assert not {"stiff", "push", "slope"} & set(config.scenarios)
        assert len(config.seeds) >= 5
        for scenario in config.scenarios:
            condition = config.condition(scenario, config.base)
            if of_one or scenario == config.scenarios[0] or (config.env, scenario) not in made:
                made.add((config.env, scenario))
                few = {} if of_one or config.env != "walker" else {"num_steps": 6}
                env = make_vector_env(condition, 2, 1, AutoresetMode.SAME_STEP, **few)
                settings = config.settings.model_dump()
                assert ResidualVectorWrapper(env, config.base, **settings).num_envs == 2
    conditions: list[Condition] = []
    for path in comparisons:
        compared = load_yaml(path, CompareConfig)
        assert compared.name == path.stem
        conditions += compared.conditions()
    try_out(conditions if of_one else list(one_of_each(conditions)))
    for name in {c.policy.name for c in conditions if c.policy.name.startswith(RESIDUAL)}:
        load_residual(Path(name.removeprefix(RESIDUAL)))


def one_of_each(conditions: Sequence[Condition]) -> Iterator[Condition]:
    """Conditions with a motion, a scenario, or a policy that none before has, whatever its
    training seed. What is made for a motion counts at each motion. Walks have one step."""
    seen: set[str] = set()
    for condition in conditions:
        policy = condition.policy
        robot = (condition.env, condition.env_options, policy.env_options)
        name = policy.name.partition("/seed_")[0]
        motion = condition.reference
        if condition.env == "walker":
            motion = motion if isinstance(motion, dict) else {"step_period": motion}
            motion = {**motion, "num_steps": 1}
        made_at = motion if name.startswith((RESIDUAL, "phase_table")) else None
        keys = {
            repr((robot, motion)),
            repr((robot, condition.scenario_played)),
            repr((robot, name, policy.options, sorted(condition.policy_options), made_at)),
        }
        if not keys <= seen:
            seen |= keys
            yield condition.replace(reference=motion)


def test_a_cell_is_the_same_with_its_default_motion_named() -> None:
    """Catches a default of another type, whose cell is played and kept a second time."""
    named = Condition(env="walker", policy=PolicySpec(name="input"), reference=3)
    default = Condition(env="walker", policy=PolicySpec(name="input"))
    assert repr(default.reference) == repr(named.reference)
    with pytest.raises(ConfigurationError, match=r"Condition.env must be text, got 5"):
        Condition(env=5, policy=PolicySpec(name="input"))  # type: ignore[arg-type]
    twice = Condition(policy=PolicySpec(name="input"), env_options={"sensors": ["a", "a"]})
    assert twice.arguments["sensors"] == ["a", "a"]


def test_cells_of_a_scenario_have_their_own_number_of_episodes() -> None:
    """Catches five episodes of the same, where nothing is random."""
    config = CompareConfig(
        name="c",
        env="walker",
        scenarios=["ideal", "soft"],
        episodes=5,
        scenario_episodes={"ideal": 1},
    )
    assert {cell.scenario: cell.episodes for cell in config.conditions()} == {"ideal": 1, "soft": 5}
    assert {cell.reference for cell in config.conditions()} == {3}


def test_what_a_reference_says_goes_before_the_options_of_all() -> None:
    """Catches the number of steps of one motion that reaches all the others."""
    cell = walk(
        reference={"step_period": 24, "num_steps": 2},
        env_options={"num_steps": 4, "stiffness": 900},
    )
    assert cell.arguments == {
        "scenario": "nominal",
        "step_period": 24,
        "num_steps": 2,
        "stiffness": 900,
    }
    assert walk(reference=3, env_options={"num_steps": 4}).arguments["num_steps"] == 4


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_compare_of_walks_writes_tables_and_the_figures_of_the_chosen_policies(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches files that are lost or not named, and figures with policies that they should not
    show."""
    drawn: list[list[str]] = []
    draw = train.figures.comparison_figures.draw_picture

    def record(name: str, signals: Any, evaluations: Sequence[Evaluation], path: Path) -> Path:
        drawn.append([e.condition.policy.title for e in evaluations])
        return draw(name, signals, evaluations, path)

    monkeypatch.setattr(train.figures.comparison_figures, "draw_picture", record)
    content = {
        "name": "walks",
        "env": "walker",
        "references": [SHORT],
        "scenarios": ["ideal"],
        "policies": [
            "zero",
            "input",
            {"name": "zero", "label": "rigid", "env_options": {"form": "rigid"}},
        ],
        "figure_policies": ["input", "rigid"],
    }
    Path("walks.yaml").write_text(yaml.safe_dump(content))
    main(["compare", "walks.yaml", "--jobs", "1", "--figure-format", "pdf"])
    assert drawn == [["input", "rigid"]] * 2
    stem = "0.3+0.5+0.3_s_num_steps_1_ideal.pdf"
    reports = {"statistics.csv", "report.html", "report.md"}
    files = {
        "episodes.csv",
        "summary.md",
        "overview.pdf",
        f"pelvis_{stem}",
        f"zmp_{stem}",
    } | reports
    folder = Path("runs/walks")
    assert {path.name for path in folder.iterdir()} == files | {
        "config.yaml",
        "metadata.json",
        ".lock",
    }
    printed = capsys.readouterr().out
    assert [name for name in files if f"runs/walks/{name}" not in printed] == []
    assert load_yaml(folder / "config.yaml", CompareConfig) == load_yaml(
        "walks.yaml", CompareConfig
    )
    assert "0/1" in next(line for line in printed.splitlines() if "rigid" in line)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_evaluate_walks(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a command that knows the testbed alone."""
    main(["evaluate", "--env", "walker", "--reference", COMMAND_SHORT, "--policy", "input_wrench"])
    assert Path("runs/evaluate/pelvis_0.3+0.5+0.3_s_num_steps_1_nominal.png").exists()
    assert "input_wrench" in capsys.readouterr().out


@pytest.mark.slow
def test_play_of_a_fall_keeps_the_film(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a film of the testbed alone, and one that is lost where it becomes worth seeing."""
    arguments = ["--env", "walker", "--policy", f"{__name__}:leaning", "--reference", COMMAND_SHORT]
    main(["play", *arguments, "--video", "x.gif"])
    with Image.open("x.gif") as film:
        assert film.n_frames >= 2
        assert film.info["duration"] == 40
    printed = capsys.readouterr().out
    assert "fell" in printed
    assert "wrote x.gif" in printed


class Leaning(Blind):
    """A policy that falls at once."""

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ):
        """As far as the command goes, in every joint."""
        return np.full(12, 0.3), state


def leaning(env: Any) -> Leaning:
    """One's own policy, as "module:function"."""
    return Leaning()


@pytest.mark.parametrize("steps", [120, pytest.param(500, marks=pytest.mark.slow)])
def test_raw_stepping_walks_as_the_environment_does(steps: int) -> None:
    """Catches a benchmark that compares unequal work: the raw worlds must end where the
    environment's end, exactly."""
    loop = VectorLoop("walker", 3, 1, "input_wrench", residual=True)
    inside = loop.env.unwrapped
    raw = RawWorlds(loop, threads=2)
    loop.run(steps)
    raw.run(steps)
    data = mujoco.MjData(inside.task.model)
    kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    for state, qpos, qvel in zip(
        raw.states, inside.simulation.qpos, inside.simulation.qvel, strict=True
    ):
        mujoco.mj_setState(inside.task.model, data, state, kind)
        np.testing.assert_array_equal(data.qpos, qpos)
        np.testing.assert_array_equal(data.qvel, qvel)
