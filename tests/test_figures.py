"""Pictures: their formats, what a panel holds, and which times they mark."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from train.evaluate.conditions import Condition
from train.evaluate.environments import TracedSignal
from train.evaluate.episodes import Evaluation, evaluate
from train.figures.chart import Chart, Curve, Panel
from train.figures.comparison_figures import figure_name
from train.figures.plots import draw_chart
from train.figures.time_chart import time_chart

TIME = np.linspace(0.0, 5.0, 101)
ANGLE = TracedSignal("angle", "angle", "rad", reference="wanted")
ERROR = TracedSignal("error", "error", "mrad")
SIZES = {"a": 1.0, "b": 9.0, "c": 2.0, "d": 8.0, "e": 3.0}


def played(policy: str, size: float, **condition: object) -> Evaluation:
    """An episode whose error has a size [mrad]."""
    error = 1e-3 * size * np.sin(TIME)
    wanted = 0.3 * np.sin(2.0 * TIME)
    trace = {"time_s": TIME, "scored": 1.0 * (TIME > 2.0), "error": error}
    trace |= {"wanted": wanted, "angle": wanted - error}
    made = Condition(env="testbed", policy={"name": "zero", "label": policy}, **condition)
    return Evaluation(made, [{"termination": ""}], trace)


def test_a_panel_holds_few_lines_of_like_errors() -> None:
    """Catches a fifth line, a policy that is lost, and one that hides in the scale of another."""
    policies = {name: [played(name, size)] for name, size in SIZES.items()}
    colours = dict.fromkeys(SIZES, "#000000")
    chart = time_chart(policies, [ANGLE, ERROR], colours, most_lines=4)
    lines = [[curve.name for curve in panel.curves] for panel in chart.panels]
    assert lines == [
        ["b", "d", "e", "reference"],
        ["c", "a", "reference"],
        ["b", "d", "e"],
        ["c", "a"],
    ]
    assert [panel.own_legend for panel in chart.panels] == 2 * [["b", "d", "e"], ["c", "a"]]
    low, high = chart.panels[3].limits or (0.0, 0.0)
    assert high - low == pytest.approx(4.0, rel=0.2)  # [mrad], of "c" and not of "b"
    (panel, _) = time_chart(policies, [ANGLE, ERROR], colours).panels
    assert [curve.name for curve in panel.curves] == [*SIZES, "reference"]


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_a_picture_is_what_its_ending_says_with_its_fonts(ending: str, tmp_path: Path) -> None:
    """Catches a PNG that is called PDF, fonts that a publisher refuses (Type 3), and few dots."""
    curve = Curve("µ", "#2a6f97", TIME, np.sin(TIME))
    file = draw_chart(
        Chart("θ − q", "time [s]", [Panel("δ [mrad]", [curve])]), tmp_path / f"a.{ending}"
    )
    content = file.read_bytes()
    if ending == "pdf":
        assert content.startswith(b"%PDF")
        assert b"/FontFile2" in content  # a TrueType font within
        assert b"/Type3" not in content
    elif ending == "svg":
        assert b"<svg" in content
        assert b"<text" not in content  # letters are outlines
    else:
        with Image.open(file) as image:
            assert image.info["dpi"] == pytest.approx((300, 300), abs=0.1)


def test_names_of_files_have_no_signs_that_tools_trip_over() -> None:
    """Catches `=`, which LaTeX and shells take for something else."""
    walk = {"step_period": 3, "num_steps": 20}
    cell = Evaluation(Condition(env="walker", policy={"name": "zero"}, reference=walk))
    assert figure_name("zmp", cell) == "zmp_3_s_num_steps_20_nominal"


@pytest.mark.parametrize(
    ("env", "reference", "spans"),
    [
        ("testbed", {"kind": "sine", "duration_s": 0.5, "onset_s": 0.7}, (1.7, 2.2)),
        (
            "walker",
            {"step_period": [0.1, 0.4, 0.2], "num_steps": 2, "gait": {"settling_steps": 1}},
            (1.7, 2.4),
        ),
    ],
)
def test_the_strip_marks_what_the_metrics_count(
    env: str, reference: dict[str, object], spans: tuple[float, float]
) -> None:
    """Catches standing, onset, settling steps or the end that look as if they were scored."""
    condition = Condition(env=env, policy={"name": "input"}, reference=reference)
    found = evaluate(condition, num_threads=1)
    chart = time_chart({"input": [found]}, condition.environment.curves[:1], {"input": "#000000"})
    ramp, scored = chart.marks
    period_s = found.trace["time_s"][1] - found.trace["time_s"][0]
    assert ramp.spans == [(0.0, pytest.approx(1.0))]
    (own,) = scored.spans
    assert own == pytest.approx(spans, abs=1.5 * period_s)
