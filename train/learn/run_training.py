"""`elastic train`: the training seeds of a configuration, in turn or side by side, resumable at any moment."""

from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from elastic_env.core.config import load_yaml
from elastic_env.core.errors import ConfigurationError
from train.evaluate.environments import environment
from train.evaluate.progress import read_progress
from train.learn.train_config import CONSTANTS, TrainConfig
from train.learn.trainer import Trainer
from train.runs.folders import locked, run_folder
from train.runs.workers import show_progress, side_by_side

_CONFIG = "config.yaml"


def start(config: TrainConfig, console: Console, output: Path | None = None, jobs: int = 1) -> Path:
    """Train all seeds of a configuration in a new run.

    Args:
        config: What is trained.
        console: Where progress and results go.
        output: Folder, new or empty; default runs/<name>, numbered if taken.
        jobs: Seeds at a time, 0 for one per core; the weights do not depend on it.

    Returns:
        The run's folder; there is none where nothing could begin.

    Raises:
        ConfigurationError: Names or options that do not exist.
        ResultsExistError: The output folder holds results.
    """
    with run_folder(config.name, config.model_dump(mode="json"), config.seeds[0], output) as folder, locked(folder):
        return _train(config, folder, console, jobs)


def resume(folder: Path, console: Console, jobs: int = 1, trust_code: bool = False) -> Path:
    """Go on with a run that was interrupted or killed; seeds that are complete stay as they are.

    Args:
        folder: Of the run.
        console: Where progress and results go.
        jobs: Seeds at a time, 0 for one per core.
        trust_code: Whether an algorithm of one's own, "module:Class", may be imported: its code may lie in the folder.

    Raises:
        ConfigurationError: The folder is no training run, another program works on it, or its algorithm is not trusted.
    """
    if not (folder / _CONFIG).is_file():
        raise ConfigurationError(
            f"{folder} is no training run: it has no {_CONFIG}; name the folder that train printed"
        )
    config = load_yaml(folder / _CONFIG, TrainConfig)
    for what, name in (("an algorithm", config.algorithm), ("a robot", config.env)):
        if ":" in name and not trust_code:
            raise ConfigurationError(
                f"{folder / _CONFIG} names {what} of its own, {name!r}, whose code would run; look at it, then say "
                "--trust-code"
            )
    with locked(folder):
        return _train(config, folder, console, jobs)


def _train(config: TrainConfig, folder: Path, console: Console, jobs: int) -> Path:
    if all(_is_complete(folder / f"seed_{seed}") for seed in config.seeds):
        console.print(f"{folder} is complete; to learn for longer, start a new run with --decisions", soft_wrap=True)
    else:
        console.print(f"training in {folder}; if it stops: elastic train --resume {folder}", soft_wrap=True)
    with show_progress(console, {f"seed {seed}": config.decisions for seed in config.seeds}) as show:

        def report(number: int, done: int) -> None:
            show(number, min(done, config.decisions))

        if jobs == 1:
            for number, seed in enumerate(config.seeds):
                _train_seed(config, seed, folder, 0, lambda done, number=number: report(number, done))
        else:  # one thread each: the seeds share the cores among them
            side_by_side(_train_seed, [(config, seed, folder, 1) for seed in config.seeds], jobs, report)
    console.print(_table(config, folder))
    return folder


def _train_seed(config: TrainConfig, seed: int, folder: Path, threads: int, report: Callable[[int], None]) -> None:
    own = folder / f"seed_{seed}"
    report(0)
    if not _is_complete(own):
        training = _trainer(config)(config, seed, own, threads)
        report(training.done)
        training.run(report)
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
