"""Cells of a comparison, played at the same time; if one fails, the others continue."""

import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, compress
from pathlib import Path

from rich.console import Console

from elastic_env.core.errors import ElasticError, SystemFailedError
from train.cells.cell_file import UnfitCellError
from train.cells.cell_key import cell_key
from train.cells.store import Store
from train.evaluate import rollout
from train.evaluate.conditions import Condition
from train.evaluate.episodes import MOST_WORLDS, Evaluation, evaluate, evaluate_together
from train.runs.console import warning_text
from train.runs.failures import DEFECT, explain
from train.runs.progress import Show, plain_progress, show_progress
from train.workers.calls import Tally, Watch, run_calls
from train.workers.executors import LOCAL_EXECUTORS, Executors
from train.workers.pool import Outcome

_MAX_NAMES = 5
"""Cells that one message names."""


class CellsFailedError(ElasticError):
    """Some conditions have no result, since a policy failed or a process was killed.

    Args:
        failures: Exit codes of the failures, by message.
        finished: Evaluations of the other conditions.
    """

    def __init__(self, failures: dict[str, int], finished: list[Evaluation]) -> None:
        super().__init__("\n".join(failures))
        self.finished = finished
        self.exit_code = max(failures.values())  # type: ignore[misc]


def run_conditions(
    conditions: Sequence[Condition],
    console: Console,
    place: Executors = LOCAL_EXECUTORS,
    store: Store | None = None,
    fresh: bool = False,
) -> list[Evaluation]:
    """Evaluate conditions, the long ones first, and return their results in the given order.

    The results do not depend on the executors. On hardware the conditions are played one after the
    other, in this process, since somebody must agree to them at its terminal. They are not stored.

    Args:
        conditions: Cells to play.
        console: Console for progress.
        place: Executors that play them.
        store: Store of finished cells; cells that it has are not played again.
        fresh: Play those cells again.

    Raises:
        CellsFailedError: Some conditions have no result; the error has the results of the others.
        KeyboardInterrupt: Ctrl-C; running cells were finished and stored.
    """
    if any(condition.environment.is_real for condition in conditions):
        return [
            _play_on_hardware(condition, f"{n} of {len(conditions)}", console)
            for n, condition in enumerate(conditions, 1)
        ]
    stored = [None] * len(conditions)
    if store is not None and not fresh:
        stored = _load_cells(conditions, store, console)
    missing = list(compress(conditions, [evaluation is None for evaluation in stored]))
    if len(missing) < len(conditions):
        number = len(conditions) - len(missing)
        console.print(f"{number} of {len(conditions)} cells are kept")
    new = iter(_BatchRun(missing, console, place, store).outcomes() if missing else [])
    outcomes = [next(new) if cell is None else Outcome(cell) for cell in stored]
    finished = [o.value for o in outcomes if o and o.error is None]
    pairs = zip(conditions, outcomes, strict=True)
    failures = dict(_failure(c, o) for c, o in pairs if o and o.error is not None)
    if failures:
        raise CellsFailedError(failures, finished)
    if None in outcomes:
        raise KeyboardInterrupt
    return finished


def _load_cells(
    conditions: Sequence[Condition], store: Store, console: Console
) -> list[Evaluation | None]:
    """Load the cells that a store has; one message names those whose files do not fit."""
    cells = list[Evaluation | None]()
    unfit = list[str]()
    for condition in conditions:
        try:
            cells.append(store.get(condition))
        except UnfitCellError as error:
            cells.append(None)
            unfit.append(f"{_cell_name(condition)} ({error})")
    if unfit:
        names = "; ".join(unfit[:_MAX_NAMES])
        others = len(unfit) - _MAX_NAMES
        more = f", and {others} more" if others > 0 else ""
        console.print(f"kept cells that do not fit are played again: {names}{more}")
    return cells


@dataclass
class _BatchRun:
    """A run of conditions, in batches that share worlds."""

    conditions: Sequence[Condition]
    console: Console
    place: Executors
    store: Store | None

    def __post_init__(self) -> None:
        conditions = self.conditions
        steps = rollout.num_steps(conditions)
        local_cores = self.place.jobs or os.cpu_count() or 1
        cores = local_cores if self.place.is_local else len(conditions)

        def length(batch: list[int]) -> int:
            return sum(steps[i] for i in batch)

        batches = make_batches(conditions, cores)
        self._batches = sorted(batches, key=length, reverse=True)
        self._steps = list(map(length, self._batches))
        self._cells = [[conditions[i] for i in batch] for batch in self._batches]
        self._keys = [] if self.store is None else list(map(cell_key, conditions))
        self._played = [0] * len(self._batches)
        self._tally = Tally(len(conditions))
        self._outcomes: list[Outcome | None] = [None] * len(conditions)
        self._show: Show = lambda *_: None

    def outcomes(self) -> list[Outcome | None]:
        """Play, and return outcomes in the order of the conditions; None after Ctrl-C."""
        unit = "control steps"
        totals = {unit: sum(self._steps)}
        with show_progress(self.console, totals, transient=True, unit=unit) as show:
            self._show = show
            if len(self._batches) == 1 and self.place.is_local:
                # in this process, since another one takes seconds to start
                report = partial(self._report, 0)
                outcomes = _evaluate(self._cells[0], report, self.place.jobs)
                self._end(0, Outcome(outcomes))
            else:
                self._play_in_workers()
        return self._outcomes

    def _play_in_workers(self) -> None:
        watch = Watch(self._report, self._end_of_worker, self._print_move)
        arguments = [(cells,) for cells in self._cells]
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) if self.store is None else self.store.folder.parent
            with self.place.open_pool(len(arguments), folder) as pool:
                run_calls(_evaluate_in_worker, arguments, pool, watch)

    def _report(self, batch: int, played: int) -> None:
        numbers = self._batches[batch]
        self._played[batch] = played
        if self._outcomes[numbers[0]] is None:  # a report may arrive after the end
            self._tally.running.update(numbers)
        self._show(0, sum(self._played), self._tally.summary("cells"))

    def _end_of_worker(self, batch: int, outcome: Outcome) -> None:
        """Take the outcomes of a worker, and repeat its warnings here, where each is shown once."""
        if outcome.error is None:
            outcomes, texts = outcome.value
            for text in texts:
                warnings.warn(text, stacklevel=2)
            outcome = Outcome(outcomes)
        self._end(batch, outcome)

    def _end(self, batch: int, outcome: Outcome) -> None:
        """Take the outcomes of the cells of a batch, or the error that ended the whole batch."""
        numbers = self._batches[batch]
        cell_outcomes = outcome.value or [outcome] * len(numbers)
        for number, cell_outcome in zip(numbers, cell_outcomes, strict=True):
            self._outcomes[number] = cell_outcome
            self._tally.end(number, cell_outcome)
            if cell_outcome.error is not None or self.store is None:
                continue
            if not self.store.keep(cell_outcome.value, self._keys[number]):
                name = _cell_name(self.conditions[number])
                cause = "a file that it names changed while it was played"
                self.console.print(f"{name} is not kept: {cause}")
        self._report(batch, self._steps[batch])

    def _print_move(self, batch: int) -> None:
        for name in map(_cell_name, self._cells[batch]):
            self.console.print(f"a worker was lost; {name} is played again")


def make_batches(conditions: Sequence[Condition], cores: int) -> list[list[int]]:
    """Group the numbers of conditions that share a vector environment, which costs less per world.

    Args:
        conditions: Cells to play.
        cores: Number of batches that are played at a time. If possible, there are twice as many
            batches, since they differ in length.
    """
    worlds = sum(condition.episodes for condition in conditions)
    max_size = min(worlds // (2 * cores), MOST_WORLDS)
    batches: list[list[int]] = []
    open_batch: dict[str, tuple[list[int], int]] = {}
    for number, condition in enumerate(conditions):
        if not rollout.can_share_worlds(condition):
            batches.append([number])
            continue
        policy = (condition.policy, condition.member, condition.policy_options)
        settings = rollout.shared_settings(condition)
        key = repr((policy, condition.reference_name, settings))
        batch, size = open_batch.get(key, ([], max_size))
        if size + condition.episodes > max_size:
            batch = []
            size = 0
            batches.append(batch)
        batch.append(number)
        open_batch[key] = batch, size + condition.episodes
    return batches


def _failure(condition: Condition, outcome: Outcome) -> tuple[str, int]:
    """Return message and exit code of a failure; the message of a defect has its traceback."""
    error = outcome.error
    assert error is not None
    defect = f"this is a defect: {type(error).__name__}: {error}\n{outcome.trace}"
    message, code = explain(error) or (defect, DEFECT)
    if isinstance(error, rollout.PolicyFailedError):  # its message names the cell
        return message, code
    return f"{_cell_name(condition)}: {message}", code


def _cell_name(condition: Condition) -> str:
    """Return the name of a cell for a user."""
    name = f"{condition.policy.title!r} in {condition.scenario!r}, {condition.reference_name}"
    swept = "".join(f", {name}={value:g}" for name, value in condition.swept.items())
    seed = None if condition.member is None else condition.member.training_seed
    return f"{name}{swept}" if seed is None else f"{name}{swept}, training seed {seed}"


def _play_on_hardware(condition: Condition, turn: str, console: Console) -> Evaluation:
    (total,) = rollout.num_steps([condition])
    show = plain_progress(console)
    console.print(f"{turn}: {condition.policy.title} plays {condition.reference_name}")
    return evaluate(condition, _step_counter(lambda done: show(done / total)))


def _step_counter(report: Callable[[int], None]) -> Callable[[int], None]:
    """Return a function that takes numbers of played control steps, and reports their sum."""
    done = 0

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        report(done)

    return advance


def _evaluate_in_worker(
    conditions: Sequence[Condition], report: Callable[[int], None]
) -> tuple[list[Outcome], list[str]]:
    """Evaluate conditions in a worker; return its warnings too, which it does not show."""
    with warnings.catch_warnings(record=True) as caught:
        outcomes = _evaluate(conditions, report)
    return outcomes, [warning_text(w.message, w.category, w.filename, w.lineno) for w in caught]


def _evaluate(
    conditions: Sequence[Condition], report: Callable[[int], None], num_threads: int = 1
) -> list[Outcome]:
    """Evaluate conditions in shared worlds, and report the number of played control steps.

    If the policy fails, or a robot does not stand, each condition is played alone, to find out
    which ones fail.
    """
    try:
        evaluations = evaluate_together(conditions, _step_counter(report), num_threads)
        return [Outcome(evaluation) for evaluation in evaluations]
    except SystemFailedError:
        raise
    except ElasticError as error:
        if len(conditions) == 1:
            return [Outcome(error=error.with_traceback(None))]
    quiet = (lambda _: None, num_threads)
    return list(chain(*(_evaluate([condition], *quiet) for condition in conditions)))
