"""The paper's two testbed experiments in under a minute: identification (Fig. 5), compensation (Fig. 6), and motion."""

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

import baselines.identification as identification
from baselines.gravity_torque import make_gravity
from train import plots
from train.compare import CompareConfig, run_conditions, summary_table
from train.evaluate import Evaluation, PolicySpec, make_vector_env
from train.runs import run_folder

_STATIC = CompareConfig(
    name="demo",
    policies=[PolicySpec(name="uncompensated"), PolicySpec(name="input")],
)
_MOTION = CompareConfig(
    name="demo",
    references=["sine"],
    policies=[PolicySpec(name=name) for name in ("uncompensated", "input", "dynamic", "oracle")],
)


def demo(console: Console, output: Path | None = None) -> None:
    """Run, print the table beside the paper's figures, and say where the pictures are."""
    plots.require_matplotlib()
    conditions = [*_STATIC.conditions(), *_MOTION.conditions()]
    with run_folder("demo", {"conditions": [c.model_dump(mode="json") for c in conditions]}, 0, output) as folder:
        console.print("Testbed of the paper, simulated: servo, elastic gear, pendulum of 60 N·m (scenario nominal)")
        evaluations = run_conditions(conditions, console)
        static, motion = evaluations[:2], evaluations[2:]
        model = make_vector_env(static[0].condition, 1).unwrapped.assumed_model
        points = static[0].points
        assert points is not None
        result = identification.identify_points(points, [make_gravity(model)])
        result.save(folder / "identification.json")
        figures = [
            plots.draw_identification(result, points, [model], folder / "fig5_identification.png"),
            plots.draw_static_errors(static, model, folder / "fig6_static_errors.png"),
            plots.draw_time_series(motion, folder / "sine.png"),
        ]
    console.print(_paper_table(result, static))
    console.print(summary_table(motion))
    console.print("Figures and data:")
    for path in [*figures, folder / "identification.json"]:
        console.print(f"  {path}", soft_wrap=True)


def _paper_table(result: identification.Identification, static: list[Evaluation]) -> Table:
    table = Table(title="the paper's testbed experiments, Figs. 5 and 6")
    table.add_column("quantity")
    table.add_column("here", justify="right")
    table.add_column("paper", justify="right")
    table.add_row("true stiffness of the plant [N·m/rad]", "1001", "-")
    low, high = result.stiffness_low_nm_per_rad, result.stiffness_high_nm_per_rad
    table.add_row("identified stiffness [N·m/rad]", f"{result.stiffness_nm_per_rad:.1f}", "1001")
    table.add_row("  95 % interval", f"{low:.1f} to {high:.1f}", "-")
    table.add_row("  plain line", f"{result.line_stiffness_nm_per_rad:.1f}", "1001")
    table.add_row("friction [N·m]", f"{result.friction_nm:.2f}", "-")
    table.add_row("Pearson r", f"{result.pearson_r:.4f}", "0.9775")
    for evaluation, paper in zip(static, ("-56.2 to +41.7", "-3.7 to +7.1"), strict=True):
        error = 1e3 * plots.static_errors(evaluation)
        name = evaluation.condition.policy.title
        table.add_row(escape(f"link error at rest, {name} [mrad]"), f"{error.min():+.1f} to {error.max():+.1f}", paper)
    return table
