"""`elastic train`: the training seeds of a configuration, in turn or side by side, resumable at any moment."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from train.evaluate.environments import environment
from train.evaluate.progress import read_progress
from train.learn.train_config import CONSTANTS, TrainConfig
from train.learn.trainer import Trainer
from train.runs.folders import CONFIG, locked, run_folder
from train.runs.progress import Show, show_progress
from train.workers.calls import Outcome, Tally, Watch, run_calls
from train.workers.places import Place

ONE_BY_ONE = Place(jobs=1)
"""Seeds in turn, in this process, with all cores for the physics of each."""


def start(config: TrainConfig, console: Console, output: Path | None = None, place: Place = ONE_BY_ONE) -> Path:
    """Train all seeds of a configuration in a new run.

    Args:
        config: What is trained.
        console: Where progress and results go.
        output: Folder, new or empty; default runs/<name>, numbered if taken.
        place: Where seeds are trained, and how many at a time; the weights do not depend on it.

    Returns:
        The run's folder; there is none where nothing could begin.

    Raises:
        ConfigurationError: Names or options that do not exist.
        ResultsExistError: The output folder holds results.
    """
    with run_folder(config.name, config.model_dump(mode="json"), config.seeds[0], output) as folder, locked(folder):
        return _train(config, folder, console, place)


def resume(folder: Path, console: Console, place: Place = ONE_BY_ONE, trust_code: bool = False) -> Path:
    """Go on with a run that was interrupted or killed; seeds that are complete stay as they are.

    Args:
        folder: Of the run.
        console: Where progress and results go.
        place: Where seeds are trained, and how many at a time.
        trust_code: Whether an algorithm of one's own, "module:Class", may be imported: its code may lie in the folder.

    Raises:
        ConfigurationError: The folder is no training run, another program works on it, or its algorithm is not trusted.
    """
    if not (folder / CONFIG).is_file():
        raise ConfigurationError(f"{folder} is no training run: it has no {CONFIG}; name the folder that train printed")
    config = load_yaml(folder / CONFIG, TrainConfig)
    for what, name in (("an algorithm", config.algorithm), ("a robot", config.env)):
        if ":" in name and not trust_code:
            raise ConfigurationError(
                f"{folder / CONFIG} names {what} of its own, {name!r}, whose code would run; look at it, then say "
                "--trust-code"
            )
    with locked(folder):
        return _train(config, folder, console, place)


def _train(config: TrainConfig, folder: Path, console: Console, place: Place) -> Path:
    if all(_is_complete(folder / f"seed_{seed}") for seed in config.seeds):
        console.print(f"{folder} is complete; to learn for longer, start a new run with --decisions", soft_wrap=True)
    else:
        console.print(f"training in {folder}; if it stops: elastic train --resume {folder}", soft_wrap=True)
    with show_progress(console, {f"seed {seed}": config.decisions for seed in config.seeds}) as show:
        if place == ONE_BY_ONE:
            for number, seed in enumerate(config.seeds):
                _train_seed(config, seed, folder, 0, partial(show, number))
        else:
            _train_beside(config, folder, console, place, show)
    console.print(_table(config, folder))
    return folder


def _train_beside(config: TrainConfig, folder: Path, console: Console, place: Place, show: Show) -> None:
    """Train seeds beside each other, with one thread each: they share the cores among them.

    Ctrl-C ends at once, since a seed may take hours; each goes on from its checkpoint.
    """
    done, note = [0] * len(config.seeds), ""

    def report(number: int, decisions: int) -> None:
        done[number] = max(done[number], decisions)
        show(number, done[number], note)

    def tallied(tally: Tally) -> None:
        nonlocal note
        note = tally.in_words("seeds")

    def moved(number: int) -> None:
        console.print(f"a worker was lost; seed {config.seeds[number]} goes on from its checkpoint", soft_wrap=True)

    calls = [(config, seed, folder.resolve(), 1) for seed in config.seeds]
    watch = Watch(reported=report, tallied=tallied, moved=moved)
    with place.opened(len(calls), folder) as pool:
        outcomes = run_calls(_train_seed, calls, pool, watch, finishes=False)
    _raise_first(config, outcomes)


def _raise_first(config: TrainConfig, outcomes: Sequence[Outcome | None]) -> None:
    """The first error of a seed, when the others have ended."""
    for seed, outcome in zip(config.seeds, outcomes, strict=True):
        if outcome is not None and outcome.error is not None:
            outcome.error.add_note(f"in the training of seed {seed}; the other seeds have ended")
            raise outcome.error


def _train_seed(config: TrainConfig, seed: int, folder: Path, threads: int, report: Callable[[int], None]) -> None:
    own = folder / f"seed_{seed}"
    report(0)
    if not _is_complete(own):
        training = _trainer(config)(config, seed, own, threads)
        report(training.done)
        training.run(lambda done: report(min(done, config.decisions)))
    report(config.decisions)


def _is_complete(own: Path) -> bool:
    """Whether a seed's training has come to its end."""
    return (own / "last").is_dir()


def _trainer(config: TrainConfig) -> type[Trainer]:
    if config.algorithm == CONSTANTS:
        from train.learn.constant_search import ConstantSearch

        return ConstantSearch
    from train.learn.training import Training

    return Training


def _table(config: TrainConfig, folder: Path) -> Table:
    """Scores of the last policies against their base, on the episodes of the evaluation on the way."""
    columns = environment(config.env).judged
    table = Table(title=f"last policies on {config.base}, on episodes that training never sees")
    for name in ("seed", "scenario", *(column.label for column in columns), "failed"):
        table.add_column(name, justify="left" if name == "scenario" else "right")
    for seed in config.seeds:
        rows = read_progress(folder / f"seed_{seed}")
        for row in (row for row in rows if row["decisions"] == rows[-1]["decisions"]):
            scores = [_change(row[f"base_{column.metric}"], row[column.metric], column.scale) for column in columns]
            table.add_row(str(seed), row["scenario"], *scores, f"{row['failed']:.0f}")
    return table


def _change(base: float, mine: float, scale: float) -> str:
    return f"{scale * base:.2f} → {scale * mine:.2f} ({100.0 * (mine / base - 1.0):+.0f} %)"
