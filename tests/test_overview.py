"""The overview of a comparison: bars of every policy, a panel per reference."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation, evaluate
from train.figures import plots
from train.report.summary import bound_notes

PLAYED = {1.0: ["nominal", "payload"], 0.9: ["payload"], 0.8: ["soft"]}


@pytest.mark.slow
def test_panels_name_the_scenarios_that_their_bars_are_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a reference with fewer scenarios than another, whose bars stand over their names."""
    kept: list[Any] = []
    monkeypatch.setattr(plots, "save", lambda figure, path: kept.append(figure) or path)
    evaluations = [
        evaluate(
            Condition(
                env="walker",
                scenario=scenario,
                reference={"step_period": [0.2, 0.6, step - 0.8], "num_steps": 1},
                policy={"name": "zero"},
            )
        )
        for step, scenarios in ((s + 0.2, own) for s, own in PLAYED.items())
        for scenario in scenarios
    ]
    columns = evaluations[0].condition.environment.judged
    plots.draw_overview(evaluations, columns, tmp_path / "overview.png")
    shown = [[label.get_text() for label in axis.get_xticklabels()] for axis in kept[0].axes]
    assert shown == 2 * list(PLAYED.values())
    labels = [axis.get_ylabel() for axis in kept[0].axes]
    figures = ["pelvis error rms [mrad]", "ZMP deviation rms [mm]"]
    assert labels == [label for label in figures for _ in PLAYED]  # one below the other
    plt.close(kept[0])


def test_actions_that_were_cut_at_their_bounds_are_said() -> None:
    """Catches a policy that is judged by commands which it did not get."""
    quick = {"kind": "sine", "duration_s": 0.5, "onset_s": 0.5, "amplitude": 0.1}
    cells = [Condition(policy={"name": name}, reference=quick) for name in ("input", "zero")]
    kept = evaluate(cells[0])
    cut = Evaluation(cells[1], [{**kept.episodes[0], "policy": "zero"}])
    assert bound_notes([kept, cut]) == []
    cut.episodes[0]["clipped_share"] = 0.25
    assert bound_notes([kept, cut]) == [
        "Actions were cut at their bounds in 1 of 2 cells: in up to 25 % of the control steps of"
        " zero in nominal, sine."
    ]


def test_intervals_stand_beside_the_episodes_of_bars(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an interval of another statistic than the bar's, one in other units, and a legend of
    what is not drawn."""
    kept: list[Any] = []
    monkeypatch.setattr(plots, "save", lambda figure, path: kept.append(figure) or path)
    quick = {"kind": "multisine", "duration_s": 0.5}
    several = evaluate(Condition(policy={"name": "input"}, reference=quick, episodes=4))
    columns = several.condition.environment.judged[:1]
    metric = columns[0].metric
    values = np.sort([own[metric] for own in several.episodes])
    for own, is_drawn in (
        (several, True),
        (replace(several, episodes=several.episodes[:1]), False),
    ):
        plots.draw_overview([own], columns, tmp_path / "overview.png")
        figure = kept.pop()
        axis = figure.axes[0]
        lines = [part for part in axis.collections if isinstance(part, LineCollection)]
        assert len(lines) == is_drawn
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert ("95 % interval of the median" in labels) is is_drawn
        if is_drawn:
            assert axis.patches[0].get_height() == pytest.approx(1e3 * np.median(values))
            low, high = lines[0].get_segments()[0][:, 1]
            assert 1e3 * values[0] <= low < 1e3 * np.median(values) < high <= 1e3 * values[-1]
        plt.close(figure)
