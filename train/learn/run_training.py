"""`elastic train`: the training seeds of configurations, in turn or in parallel, resumable."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from math import ceil, isfinite, nan
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from train.evaluate.environments import environment
from train.evaluate.episodes import Progress
from train.evaluate.learning_curves import read_progress
from train.evaluate.rollout import single_world_envs
from train.learn.algorithm_options import CONSTANTS
from train.learn.train_config import TrainConfig
from train.learn.trainer import Trainer
from train.runs.console import make_table
from train.runs.folders import lock_part, lock_run, require_name, run_folder
from train.runs.progress import Show, show_progress
from train.runs.user_code import recorded_config
from train.workers.calls import Watch, run_calls
from train.workers.executors import Executors
from train.workers.pool import Outcome

ONE_BY_ONE = Executors(jobs=1)
"""Seeds in turn, in this process, with all cores for the physics of each."""
_LOCK_TIMEOUT_S = 60.0
"""Longest wait for another program that works on the same training seed [s]."""

_LEAST_SHARE = 0.5
"""Least share of an episode between two checkpoints.

On the testbed two thirds were enough, and a third made a residual worse than its base.
"""


@dataclass(frozen=True)
class Run:
    """A configuration and the folder of its training."""

    config: TrainConfig
    folder: Path

    @property
    def is_complete(self) -> bool:
        """True if all training seeds are complete."""
        seeds = self.config.seeds
        return all(_is_complete(self.folder / f"seed_{seed}") for seed in seeds)


def start(
    configs: Sequence[TrainConfig],
    console: Console,
    output: Path | None = None,
    executors: Executors = ONE_BY_ONE,
) -> list[Path]:
    """Train all seeds of some configurations, each in a new run.

    Args:
        configs: Configurations.
        console: Console for progress and results.
        output: Folder, new or empty; several configurations have folders in it by their names.
            Default runs/<name>, numbered if taken.
        executors: Place of the training of seeds, and number at a time; the weights do not depend
            on it.

    Returns:
        The runs' folders. No folder stays if nothing could begin.

    Raises:
        ConfigurationError: A name or an option does not exist.
        ResultsExistError: The output folder has results.
    """
    runs = list[Run]()
    with ExitStack() as locks:
        for config in configs:
            path = output
            if output is not None and len(configs) > 1:
                path = output / require_name(config.name)
            recorded = config.model_dump(mode="json")
            folder = run_folder(config.name, recorded, config.seeds[0], path)
            runs.append(Run(config, locks.enter_context(folder)))
            locks.enter_context(lock_run(runs[-1].folder))
        _train(runs, console, executors)
    return [run.folder for run in runs]


def resume(
    folders: Sequence[Path],
    console: Console,
    executors: Executors = ONE_BY_ONE,
    trust_code: bool = False,
) -> list[Path]:
    """Resume runs that were interrupted or killed; complete seeds do not change.

    Args:
        folders: Folders of the runs.
        console: Console for progress and results.
        executors: Place of the training of seeds, and number at a time.
        trust_code: True to import a user's algorithm, "module:Class", whose code may be in a
            folder.

    Raises:
        ConfigurationError: A folder is no training run, another program works on it, or its
            algorithm is not trusted.
    """
    configs = [recorded_config(folder, TrainConfig, trust_code) for folder in folders]
    runs = list(map(Run, configs, folders))
    with ExitStack() as locks:
        for run in runs:
            locks.enter_context(lock_run(run.folder))
        _train(runs, console, executors)
    return [run.folder for run in runs]


def _train(runs: Sequence[Run], console: Console, executors: Executors) -> None:
    for run in runs:
        text = f"training in {run.folder}; if it stops: elastic train --resume {run.folder}"
        if run.is_complete:
            cure = "to learn for longer, start a new run with --decisions"
            text = f"{run.folder} is complete; {cure}"
        console.print(text, soft_wrap=True)
        if not run.is_complete:
            _warn_of_cut_episodes(run.config)
    calls = [(run, seed) for run in runs for seed in run.config.seeds]
    names = [f"seed {seed}" for _, seed in calls]
    if len(runs) > 1:
        names = [f"{run.folder}, seed {seed}" for run, seed in calls]
    totals = dict(zip(names, (r.config.decisions for r, _ in calls), strict=True))
    with _name_resumption(runs), show_progress(console, totals, unit="decisions") as show:
        if executors == ONE_BY_ONE:
            for number, (run, seed) in enumerate(calls):
                _train_seed(run, seed, 0, partial(show, number))
        else:
            threads = executors.threads_per_call(len(calls))
            args = [(Run(r.config, r.folder.resolve()), seed, threads) for r, seed in calls]
            watch = _watch(names, console, show)
            with executors.open_pool(len(args), runs[0].folder) as pool:
                # Ctrl-C does not wait: a seed may take hours, and resumes from its checkpoint
                outcomes = run_calls(_train_seed, args, pool, watch, finishes=False)
            _raise_first_error(names, outcomes)
    for run in runs:
        console.print(_score_table(run.config, run.folder))


def _warn_of_cut_episodes(config: TrainConfig) -> None:
    """Warn if checkpoints end all episodes before their half, so that no world gets further."""
    if config.algorithm == CONSTANTS or config.checkpoint_every >= config.decisions:
        return
    ((_, env),) = single_world_envs([config.training_condition(config.scenarios[0])])
    length = ceil(env.unwrapped.task.fewest_control_steps / config.settings.decision_period)
    fewest = ceil(_LEAST_SHARE * length * config.worlds)
    if config.checkpoint_every < fewest:
        warnings.warn(
            f"checkpoint_every: {config.checkpoint_every} ends the episodes of {config.worlds}"
            f" worlds after about {config.checkpoint_every // config.worlds} of {length} decisions;"
            f" nothing is learned from the rest; set {fewest} or more",
            stacklevel=2,
        )


@contextmanager
def _name_resumption(runs: Sequence[Run]) -> Iterator[None]:
    """Name the command that continues the runs, at Ctrl-C within the context."""
    try:
        yield
    except KeyboardInterrupt as error:
        if kept := [str(run.folder) for run in runs if any(run.folder.glob("seed_*"))]:
            error.add_note(f"go on with: elastic train --resume {' '.join(kept)}")
        raise


def _watch(names: Sequence[str], console: Console, show: Show) -> Watch:
    """Make a watch that shows the progress of seeds in parallel."""
    done = [0] * len(names)

    def report(number: int, decisions: int) -> None:
        done[number] = max(done[number], decisions)
        show(number, done[number], watch.tally.summary("seeds"))

    def move(number: int) -> None:
        text = f"a worker was lost; {names[number]} goes on from its checkpoint"
        console.print(text, soft_wrap=True)

    watch = Watch(on_report=report, on_move=move)
    return watch


def _raise_first_error(names: Sequence[str], outcomes: Sequence[Outcome | None]) -> None:
    """Raise the first error of a seed, after the others have ended."""
    for name, outcome in zip(names, outcomes, strict=True):
        if outcome is not None and (error := outcome.error) is not None:
            error.add_note(f"in the training of {name}; the other seeds have ended")
            raise error


def _train_seed(run: Run, seed: int, threads: int, report: Progress) -> None:
    """Train a seed, or resume it.

    A worker that has lost its scheduler ends within some seconds. The worker that takes over its
    seed waits for that.
    """
    config = run.config
    folder = run.folder / f"seed_{seed}"
    report(0)
    with lock_part(folder, _LOCK_TIMEOUT_S):
        if not _is_complete(folder):
            trainer = _trainer_class(config)(config, seed, folder, threads)
            report(trainer.done)
            trainer.run(lambda done: report(min(done, config.decisions)))
    report(config.decisions)


def _is_complete(folder: Path) -> bool:
    """True if the training of a seed is complete."""
    return (folder / "last").is_dir()


def _trainer_class(config: TrainConfig) -> type[Trainer]:
    if config.algorithm == CONSTANTS:
        from train.learn.constant_search import ConstantSearch

        return ConstantSearch
    from train.learn.training import Training

    return Training


def _score_table(config: TrainConfig, folder: Path) -> Table:
    """Table of the last policies' scores against their base, on the episodes of the evaluations."""
    columns = environment(config.env).judged
    metrics = [column.metric for column in columns]
    head = ["seed", "scenario", *(column.label for column in columns), "failed"]
    table = []
    worse = []
    for seed in config.seeds:
        rows = read_progress(folder / f"seed_{seed}", metrics, ["failed"])
        rows = [row for row in rows if row["decisions"] == rows[-1]["decisions"]]
        scores = [(row[f"base_{metric}"], row[metric]) for row in rows for metric in metrics]
        ratios = [mine / base for base, mine in scores if base]
        if sum(ratios) > len(ratios):
            worse.append(str(seed))
        for row in rows:
            both = [(row[f"base_{c.metric}"], row[c.metric], c.scale) for c in columns]
            changes = [_change_text(*scores) for scores in both]
            table.append([str(seed), row["scenario"], *changes, f"{row['failed']:.0f}"])
    title = f"last policies on {config.base}, on episodes that training never sees"
    remark = f"on average worse than {config.base}: seed {', '.join(worse)}" if worse else ""
    return make_table(title, head, table, left=2, caption=escape(remark))


def _change_text(base: float, mine: float, scale: float) -> str:
    """Two scores and their relative change; - for a score if all its episodes failed."""
    scores = [scale * score for score in (base, mine)]
    both = " → ".join(f"{score:.2f}" if isfinite(score) else "-" for score in scores)
    change = mine / base - 1.0 if base else nan
    return f"{both} ({100.0 * change:+.0f} %)" if isfinite(change) else both
