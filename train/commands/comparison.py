"""Comparisons: cells are played under one protocol, then scored, compared and written."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from elastic_env.core.errors import ConfigurationError, SystemFailedError, quote
from train.cells.play import CellsFailedError, run_conditions
from train.cells.store import CELLS, Store
from train.commands.compare_config import CompareConfig
from train.evaluate.changes import changes
from train.evaluate.conditions import Condition
from train.evaluate.episodes import Evaluation, merge_seeds
from train.evaluate.leaderboard_rows import Standing, append_standings, standings
from train.evaluate.maps import heat_maps
from train.evaluate.robots import robot_scores
from train.evaluate.rollout import make_policy, single_world_envs
from train.figures import plots
from train.figures.comparison_figures import draw_figures, draw_maps
from train.report.change_tables import print_changes, write_maps, write_statistics
from train.report.leaderboard import print_leaderboard, write_leaderboard
from train.report.report_text import Results
from train.report.score_tables import print_robots, write_robots
from train.report.summary import print_summary, write_episodes, write_summary
from train.report.write import require_libraries, write_report
from train.runs import folders
from train.runs.console import warn_once
from train.speed.step_times import step_times
from train.workers.executors import LOCAL_EXECUTORS, Executors


@dataclass(frozen=True)
class Comparison:
    """A finished comparison."""

    folder: Path
    evaluations: list[Evaluation]
    files: list[Path]


@warn_once()
def compare(
    config: CompareConfig,
    console: Console,
    output: Path | None = None,
    executors: Executors = LOCAL_EXECUTORS,
    resumes: bool = False,
    fresh: bool = False,
    report: bool = True,
    figure_format: plots.FigureFormat = "png",
    published: Sequence[Standing] = (),
) -> Comparison:
    """Run a comparison, write its folder, and print its tables.

    Args:
        config: Configuration of the comparison.
        console: Console for progress and tables.
        output: Folder for the results; default runs/<name>, numbered if taken.
        executors: Executors that play the cells.
        resumes: Continue the run in the output folder.
        fresh: Play the stored cells of a continued run again.
        report: Compare policies with one another, and add bases of residuals for it; else policies
            are scored alone, and no cells are stored.
        figure_format: Format of the figures.
        published: Rows of a leaderboard to which the rows of this comparison are appended.

    Raises:
        ConfigurationError: A name or a parameter does not exist; found before the work begins.
        ResultsExistError: The output folder contains results.
        KeyboardInterrupt: Ctrl-C; finished cells are stored.
    """
    plots.require_matplotlib()
    if report:
        require_libraries()
    conditions = config.conditions(with_bases=report)
    _require_appendable(config, published)
    try_out(conditions)
    with _open_run(config, output, resumes) as folder:
        store = Store(folder / CELLS) if report else None
        with _save_finished(folder, console):
            evaluations = run_conditions(conditions, console, executors, store, fresh)
        files = [write_episodes(evaluations, folder / "episodes.csv")]
        board = []
        if config.leaderboard:
            console.print("measuring the time of every policy, in turn")
            board = standings(evaluations, config.groups, step_times(conditions), config.origin)
            board = append_standings(published, board) if published else board
        results = _results(config, evaluations, folder, board, report)
        files += _write_results(results, config.figure_policies, figure_format)
        if report:
            files += write_report(results)
        folders.record_results(folder, files)
    _print_results(results, console)
    return Comparison(folder, evaluations, files)


def _results(
    config: CompareConfig,
    cells: list[Evaluation],
    folder: Path,
    board: Sequence[Standing],
    report: bool,
) -> Results:
    """Return the results of finished cells; changes only for a report."""
    axis = config.sweep and config.sweep.title
    maps = [] if config.map is None else heat_maps(cells, config.map)
    rows = changes(cells, config.groups) if report else []
    # a leaderboard or a map finds the best policy of each column or cell itself
    if config.leaderboard or maps:
        rows = [row for row in rows if not row.is_rival]
    robots = robot_scores(cells)
    return Results(
        config.name, cells, rows, folder, swept=axis, maps=maps, standings=board, robots=robots
    )


def _write_results(
    results: Results, figure_policies: Sequence[str], figure_format: plots.FigureFormat
) -> list[Path]:
    """Write the tables and figures of a comparison; return their files."""
    folder = results.folder
    cells = merge_seeds(results.evaluations)
    files = []
    if results.robots:
        files.append(write_robots(results.robots, folder / "robots.csv"))
    files.append(write_summary(cells, folder / "summary.md"))
    if results.maps:
        files += draw_maps(results.maps, folder, figure_format)
        files.append(write_maps(results.maps, folder / "map.csv"))
    else:
        files += draw_figures(cells, folder, figure_policies, results.swept, figure_format)
    if results.standings:
        files += write_leaderboard(results.standings, folder)
    if results.changes:
        files.append(write_statistics(results.changes, folder / "statistics.csv"))
    return files


def _print_results(results: Results, console: Console) -> None:
    print_summary(merge_seeds(results.evaluations), console)
    print_robots(results.robots, console)
    print_changes(results.changes, console)
    if results.standings:
        print_leaderboard(results.standings, console)


def _require_appendable(config: CompareConfig, published: Sequence[Standing]) -> None:
    """Check, before anything is played, that new rows can be appended to published ones.

    Raises:
        ConfigurationError: No leaderboard is written, a policy of this name is published, or the
            protocol differs.
    """
    if not published:
        return
    if not config.leaderboard:
        raise ConfigurationError("published rows are for a configuration with leaderboard: true")
    names = {row.policy for row in published}
    for policy in config.policies:
        if policy.title in names:
            cure = "name your own by --policies, or give it a label in a configuration"
            raise ConfigurationError(f"{quote(policy.title)} is published already; {cure}")
    append_standings(published, [replace(published[0], origin=config.origin)])


@contextmanager
def _open_run(config: CompareConfig, output: Path | None, resumes: bool) -> Iterator[Path]:
    """Open the folder of a run, new or continued, and lock it."""
    recorded = (config.model_dump(mode="json"), config.seed)
    if not resumes or output is None:
        with folders.run_folder(config.name, *recorded, output) as new, folders.lock_run(new):
            yield new
        return
    folders.require_run(output)
    with folders.lock_run(output):
        folders.record_run(output, *recorded)
        yield output


@contextmanager
def _save_finished(folder: Path, console: Console) -> Iterator[None]:
    """Write finished cells if others fail within the context, and mention stored ones at Ctrl-C."""
    try:
        yield
    except CellsFailedError as error:
        if error.finished:
            write_summary(merge_seeds(error.finished), folder / "summary.md")
            file = write_episodes(error.finished, folder / "episodes.csv")
            console.print(f"finished cells: {len(error.finished)}, in {file} and summary.md")
        raise
    except (KeyboardInterrupt, SystemFailedError, OSError) as error:
        if any((folder / CELLS).glob("*.npz")):
            cure = f"go on with: elastic compare --resume {folder}"
            error.add_note(f"finished cells are kept; {cure}")
        raise


def try_out(conditions: Sequence[Condition]) -> None:
    """Make each environment and policy once, so that a wrong name fails before anything runs."""
    for condition, env in single_world_envs(_distinct_conditions(conditions)):
        try:
            policy = make_policy(condition.policy, env, condition.policy_options)
        except ConfigurationError as error:
            if not condition.swept:
                raise
            cure = "level: true leaves a policy out of the sweep"
            raise ConfigurationError(f"{error}; {cure}") from None
        if not hasattr(policy, "predict"):
            problem = f"no method predict(), got {type(policy).__name__}"
            raise ConfigurationError(f"policy {condition.policy.name!r} has {problem}")


def _distinct_conditions(conditions: Sequence[Condition]) -> Iterator[Condition]:
    """Yield conditions with an environment, or a policy at a motion, that no earlier one has.

    Their number is the sum of both numbers, not the product.
    """
    seen = set[str]()
    for condition in conditions:
        motion = (condition.env, condition.env_options, condition.reference)
        played = (motion, condition.policy, condition.swept)
        keys = {repr((motion, condition.scenario_played)), repr(played)}
        if not keys <= seen:
            seen |= keys
            yield condition
