"""The cells of a comparison, played side by side; one that fails leaves the others."""

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, compress
from pathlib import Path

from rich.console import Console

from elastic_env.core.errors import ElasticError, SystemFailedError
from train.cells.store import Store, UnfitCellError, cell_key
from train.evaluate import rollout
from train.evaluate.conditions import Condition
from train.evaluate.episodes import MOST_WORLDS, Evaluation, evaluate, evaluate_together
from train.runs.console import shown_warnings, warn_once
from train.runs.failures import DEFECT, explain
from train.runs.progress import Show, plain_progress, show_progress
from train.workers.calls import Outcome, Tally, Watch, run_calls
from train.workers.executors import LOCAL_EXECUTORS, Executors

_MOST_NAMED = 5
"""Cells that one line names."""


class CellsFailedError(ElasticError):
    """Some conditions have no result, for a policy that fails or a process that was killed.

    Attributes:
        finished: Evaluations of the others.
    """

    def __init__(self, why: dict[str, int], finished: list[Evaluation]) -> None:
        super().__init__("\n".join(why))
        self.finished = finished
        self.exit_code = max(why.values())  # type: ignore[misc]


def run_conditions(
    conditions: Sequence[Condition],
    console: Console,
    place: Executors = LOCAL_EXECUTORS,
    store: Store | None = None,
    fresh: bool = False,
) -> list[Evaluation]:
    """Evaluate conditions, the long ones first, and return their results in the order given.

    The results do not depend on where they are played. On hardware the conditions come one after
    the other, in this process, at whose terminal somebody can agree to them; nothing is kept of
    them.

    Args:
        conditions: What to play.
        console: Where progress goes.
        place: Where to play them.
        store: Where finished cells are kept; those that it has are not played again.
        fresh: Whether they are.

    Raises:
        CellsFailedError: Some of them have no result; it has those of the others.
        KeyboardInterrupt: Ctrl-C; what had been running is finished and kept.
    """
    if any(condition.environment.is_real for condition in conditions):
        return [
            _on_hardware(condition, f"{n} of {len(conditions)}", console)
            for n, condition in enumerate(conditions, 1)
        ]
    kept = [None] * len(conditions)
    if store is not None and not fresh:
        kept = _load_kept(conditions, store, console)
    missing = list(compress(conditions, [own is None for own in kept]))
    if len(missing) < len(conditions):
        number = len(conditions) - len(missing)
        console.print(f"{number} of {len(conditions)} cells are kept")
    played = iter(_Playing(missing, console, place, store).results() if missing else [])
    results = [next(played) if own is None else Outcome(own) for own in kept]
    ended = [result for result in results if result is not None]
    finished = [result.value for result in ended if result.error is None]
    failed = dict(
        _explain_failure(condition, result)
        for condition, result in zip(conditions, results, strict=True)
        if result is not None and result.error is not None
    )
    if failed:
        raise CellsFailedError(failed, finished)
    if None in results:
        raise KeyboardInterrupt
    return finished


def _load_kept(
    conditions: Sequence[Condition], store: Store, console: Console
) -> list[Evaluation | None]:
    """Cells that a store has; those whose files do not fit are said, once, and not taken."""
    found = list[Evaluation | None]()
    unfit = list[str]()
    for condition in conditions:
        try:
            found.append(store.get(condition))
        except UnfitCellError as error:
            found.append(None)
            unfit.append(f"{_name(condition)} ({error})")
    if unfit:
        named = "; ".join(unfit[:_MOST_NAMED])
        others = len(unfit) - _MOST_NAMED
        more = f", and {others} more" if others > 0 else ""
        console.print(f"kept cells that do not fit are played again: {named}{more}")
    return found


@dataclass
class _Playing:
    """Conditions that are being played, in batches that share worlds."""

    conditions: Sequence[Condition]
    console: Console
    place: Executors
    store: Store | None

    def __post_init__(self) -> None:
        conditions = self.conditions
        steps = rollout.num_steps(conditions)
        cores = len(conditions)
        if self.place.is_local:
            cores = self.place.jobs or os.cpu_count() or 1

        def length(batch: list[int]) -> int:
            return sum(steps[i] for i in batch)

        self._batches = sorted(in_batches(conditions, cores), key=length, reverse=True)
        self._steps = list(map(length, self._batches))
        self._cells = [[conditions[i] for i in batch] for batch in self._batches]
        self._keys = [] if self.store is None else list(map(cell_key, conditions))
        self._played = [0] * len(self._batches)
        self._tally = Tally(len(conditions))
        self._outcomes: list[Outcome | None] = [None] * len(conditions)
        self._show: Show = lambda *_: None

    def results(self) -> list[Outcome | None]:
        """Outcomes in the order of the conditions; None for those that Ctrl-C prevented."""
        unit = "control steps"
        totals = {unit: sum(self._steps)}
        with show_progress(self.console, totals, transient=True, unit=unit) as show:
            self._show = show
            if len(self._batches) == 1 and self.place.is_local:
                # a process of its own takes seconds to start
                report = partial(self._report, 0)
                threads = self.place.jobs
                self._end(0, Outcome(_evaluate(self._cells[0], report, threads)))
            else:
                self._play_beside()
        return self._outcomes

    def _play_beside(self) -> None:
        watch = Watch(self._report, self._end, self._say_moved)
        given = [(cells, shown_warnings()) for cells in self._cells]
        with tempfile.TemporaryDirectory() as own:
            folder = Path(own) if self.store is None else self.store.folder.parent
            with self.place.open_pool(len(given), folder) as pool:
                run_calls(_evaluate_beside, given, pool, watch)

    def _report(self, batch: int, played: int) -> None:
        numbers = self._batches[batch]
        self._played[batch] = played
        if self._outcomes[numbers[0]] is None:  # a report may come behind the end
            self._tally.running.update(numbers)
        self._show(0, sum(self._played), self._tally.in_words("cells"))

    def _end(self, batch: int, outcome: Outcome) -> None:
        """Take the outcomes of a batch, or what ended all of it."""
        numbers = self._batches[batch]
        outcomes = outcome.value or [outcome] * len(numbers)
        for number, own in zip(numbers, outcomes, strict=True):
            self._outcomes[number] = own
            self._tally.end(number, own)
            if own.error is not None or self.store is None:
                continue
            if not self.store.keep(own.value, self._keys[number]):
                name = _name(self.conditions[number])
                cause = "a file that it names changed while it was played"
                self.console.print(f"{name} is not kept: {cause}")
        self._report(batch, self._steps[batch])

    def _say_moved(self, batch: int) -> None:
        for name in map(_name, self._cells[batch]):
            self.console.print(f"a worker was lost; {name} is played again")


def in_batches(conditions: Sequence[Condition], cores: int) -> list[list[int]]:
    """Numbers of conditions that share a vector environment: many worlds cost less each.

    Args:
        conditions: What to play.
        cores: Batches that are played at a time. There are twice as many, if there can be: not all
            last as long.
    """
    worlds = sum(condition.episodes for condition in conditions)
    most = min(worlds // (2 * cores), MOST_WORLDS)
    batches: list[list[int]] = []
    open_batch: dict[str, tuple[list[int], int]] = {}
    for number, condition in enumerate(conditions):
        if not rollout.can_share_worlds(condition):
            batches.append([number])
            continue
        policy = (condition.policy, condition.member, condition.policy_options)
        settings = rollout.shared_settings(condition)
        key = repr((policy, condition.reference_name, settings))
        batch, size = open_batch.get(key, ([], most))
        if size + condition.episodes > most:
            batch = []
            size = 0
            batches.append(batch)
        batch.append(number)
        open_batch[key] = batch, size + condition.episodes
    return batches


def _explain_failure(condition: Condition, result: Outcome) -> tuple[str, int]:
    """Text and exit code of a failure; a defect's traceback goes to the terminal."""
    error = result.error
    assert error is not None
    defect = f"this is a defect: {type(error).__name__}: {error}\n{result.trace}"
    said, code = explain(error) or (defect, DEFECT)
    if isinstance(error, rollout.PolicyFailedError):  # which names the cell itself
        return said, code
    return f"{_name(condition)}: {said}", code


def _name(condition: Condition) -> str:
    """Name of a cell for a user."""
    name = f"{condition.policy.title!r} in {condition.scenario!r}, {condition.reference_name}"
    swept = "".join(f", {name}={value:g}" for name, value in condition.swept.items())
    seed = None if condition.member is None else condition.member.training_seed
    return f"{name}{swept}" if seed is None else f"{name}{swept}, training seed {seed}"


def _on_hardware(condition: Condition, which: str, console: Console) -> Evaluation:
    (total,) = rollout.num_steps([condition])
    say = plain_progress(console)
    console.print(f"{which}: {condition.policy.title} plays {condition.reference_name}")
    return evaluate(condition, _count(lambda done: say(done / total)))


def _count(report: Callable[[int], None]) -> Callable[[int], None]:
    """A function that takes control steps that were played, and reports their sum."""
    done = 0

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        report(done)

    return advance


def _evaluate_beside(
    conditions: Sequence[Condition], said: frozenset[str], report: Callable[[int], None]
) -> list[Outcome]:
    """Evaluations in a process of their own, without the warnings that were shown before."""
    with warn_once(said):
        return _evaluate(conditions, report)


def _evaluate(
    conditions: Sequence[Condition], report: Callable[[int], None], num_threads: int = 1
) -> list[Outcome]:
    """Evaluations, side by side, that report how many control steps they have played.

    Where the policy fails beside others, or a robot does not stand, each is played alone, to say
    which ones fail.
    """
    try:
        played = evaluate_together(conditions, _count(report), num_threads)
        return [Outcome(evaluation) for evaluation in played]
    except SystemFailedError:
        raise
    except ElasticError as error:
        if len(conditions) == 1:
            return [Outcome(error=error.with_traceback(None))]
    quiet = (lambda _: None, num_threads)
    return list(chain(*(_evaluate([one], *quiet) for one in conditions)))
