"""`elastic train`: the training seeds of a configuration, one after the other, resumable at any moment."""

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from elastic_env.config import load_yaml
from elastic_env.errors import ConfigurationError
from train.environments import environment
from train.learn import TrainConfig, Training, read_progress
from train.runs import new_run

_CONFIG = "config.yaml"


def start(config: TrainConfig, console: Console, output: Path | None = None) -> Path:
    """Train all seeds of a configuration in a new run.

    Args:
        config: What is trained.
        console: Where progress and results go.
        output: Folder, new or empty; default runs/<name>, numbered if taken.

    Returns:
        The run's folder.

    Raises:
        ConfigurationError: Names or options that do not exist.
        ResultsExistError: The output folder holds results.
    """
    folder = new_run(config.name, config.model_dump(mode="json"), config.seeds[0], output)
    return _train(config, folder, console)


def resume(folder: Path, console: Console) -> Path:
    """Go on with a run that was interrupted or killed; seeds that are complete stay as they are.

    Raises:
        ConfigurationError: The folder is no training run.
    """
    if not (folder / _CONFIG).is_file():
        raise ConfigurationError(
            f"{folder} is no training run: it has no {_CONFIG}; name the folder that train printed"
        )
    return _train(load_yaml(folder / _CONFIG, TrainConfig), folder, console)


def _train(config: TrainConfig, folder: Path, console: Console) -> Path:
    console.print(f"training in {folder}; if it stops: elastic train --resume {folder}", soft_wrap=True)
    with _bar(console) as bar:
        for seed in config.seeds:
            own = folder / f"seed_{seed}"
            task = bar.add_task(f"seed {seed}", total=config.decisions)
            if not (own / "last").is_dir():
                training = Training(config, seed, own)
                bar.update(task, completed=training.done)
                training.run(lambda done, task=task: bar.update(task, completed=done))
            bar.update(task, completed=config.decisions)
    console.print(_table(config, folder))
    return folder


def _table(config: TrainConfig, folder: Path) -> Table:
    """Scores of the last policies against their base, on the episodes of the evaluation on the way."""
    column = environment(config.env).overview
    table = Table(title=f"{column.label} of the last policy, on episodes that training never sees; base: {config.base}")
    for name in ("seed", "scenario", "base", "with residual", "change", "failed"):
        table.add_column(name, justify="left" if name == "scenario" else "right")
    for seed in config.seeds:
        rows = read_progress(folder / f"seed_{seed}")
        for row in (row for row in rows if row["decisions"] == rows[-1]["decisions"]):
            mine, base = row[column.metric], row[f"base_{column.metric}"]
            scores = (
                f"{column.scale * base:.2f}",
                f"{column.scale * mine:.2f}",
                f"{100.0 * (mine / base - 1.0):+.0f} %",
            )
            table.add_row(str(seed), row["scenario"], *scores, f"{row['failed']:.0f}")
    return table


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        console=console,
    )  # fmt: skip
