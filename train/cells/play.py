"""The cells of a comparison, played side by side: what is kept, and what one that fails leaves
of the others.
"""

import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from elastic_env.core.errors import ElasticError
from train.cells.key import cell_key
from train.cells.store import Store, UnfitCellError
from train.evaluate.conditions import Condition
from train.evaluate.episodes import MOST_WORLDS, Evaluation, evaluate, evaluate_together
from train.evaluate.rollout import PolicyFailedError, can_share_worlds, num_steps, shared_settings
from train.runs.failures import DEFECT, explain
from train.runs.progress import Show, plain_progress, show_progress
from train.runs.warned import each_once, said_so_far
from train.workers.calls import Outcome, Tally, Watch, run_calls
from train.workers.executors import LOCAL_EXECUTORS, Executors

_MOST_NAMED = 5
"""Cells that one line names."""


class CellsFailedError(ElasticError):
    """Some conditions have no result, for a policy that fails or a process that was killed.

    Attributes:
        finished: Evaluations of the others.
    """

    def __init__(self, why: Sequence[tuple[str, int]], finished: list[Evaluation]) -> None:
        super().__init__("\n".join(dict.fromkeys(said for said, _ in why)))
        self.finished = finished
        self.exit_code = max(code for _, code in why)  # type: ignore[misc]


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
    kept = (
        [None] * len(conditions)
        if store is None or fresh
        else _load_kept(conditions, store, console)
    )
    missing = [
        condition for condition, found in zip(conditions, kept, strict=True) if found is None
    ]
    if len(missing) < len(conditions):
        console.print(f"{len(conditions) - len(missing)} of {len(conditions)} cells are kept")
    played = iter(_Playing(missing, console, place, store).results() if missing else [])
    results = [next(played) if found is None else Outcome(found) for found in kept]
    finished = [result.value for result in results if result is not None and result.error is None]
    why = [
        _failure_text(c, r)
        for c, r in zip(conditions, results, strict=True)
        if r is not None and r.error is not None
    ]
    if why:
        raise CellsFailedError(why, finished)
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
        more = f", and {len(unfit) - _MOST_NAMED} more" if len(unfit) > _MOST_NAMED else ""
        said = (
            f"kept cells that do not fit are played again: {'; '.join(unfit[:_MOST_NAMED])}{more}"
        )
        console.print(said, markup=False, highlight=False)
    return found


class _Playing:
    """Conditions that are being played, in batches that share worlds."""

    def __init__(
        self,
        conditions: Sequence[Condition],
        console: Console,
        place: Executors,
        store: Store | None,
    ) -> None:
        self._conditions = conditions
        self._console = console
        self._place = place
        self._store = store
        steps = num_steps(conditions)
        cores = (place.jobs or os.cpu_count() or 1) if place.is_local else len(conditions)
        batches = [
            (batch, sum(steps[number] for number in batch))
            for batch in in_batches(conditions, cores)
        ]
        longest_first = sorted(batches, key=lambda batch: -batch[1])
        self._batches = [batch for batch, _ in longest_first]
        self._steps = [steps for _, steps in longest_first]
        self._keys = [] if store is None else [cell_key(condition) for condition in conditions]
        self._played = [0] * len(self._batches)
        self._running = set[int]()
        self._done = 0
        self._failed = 0
        self._outcomes: list[Outcome | None] = [None] * len(conditions)
        self._show: Show = lambda *_: None

    def results(self) -> list[Outcome | None]:
        """Outcomes in the order of the conditions; None for those that Ctrl-C kept from
        starting.
        """
        unit = "control steps"
        totals = {unit: sum(self._steps)}
        with show_progress(self._console, totals, transient=True, unit=unit) as self._show:
            if (
                len(self._batches) == 1 and self._place.is_local
            ):  # a process of its own takes seconds to start
                cells = _evaluate(
                    self._of(0), lambda played: self._report(0, played), self._place.jobs
                )
                self._end(0, Outcome(cells))
            else:
                self._beside()
        return self._outcomes

    def _of(self, batch: int) -> list[Condition]:
        return [self._conditions[number] for number in self._batches[batch]]

    def _beside(self) -> None:
        watch = Watch(self._report, self._end, moved=self._say_moved)
        with tempfile.TemporaryDirectory() as own:
            folder = Path(own) if self._store is None else self._store.folder.parent
            with self._place.open(len(self._batches), folder) as pool:
                said = said_so_far()
                given = [(self._of(batch), said) for batch in range(len(self._batches))]
                run_calls(_evaluate_beside, given, pool, watch)

    def _report(self, batch: int, played: int) -> None:
        self._played[batch] = played
        if self._outcomes[self._batches[batch][0]] is None:  # a report may come behind the end
            self._running.add(batch)
        self._show_progress()

    def _show_progress(self) -> None:
        running = sum(len(self._batches[batch]) for batch in self._running)
        tally = Tally(self._done, running, self._failed, len(self._conditions))
        self._show(0, sum(self._played), tally.in_words("cells"))

    def _end(self, batch: int, outcome: Outcome) -> None:
        """Take the outcomes of a batch, or what ended all of it."""
        self._played[batch] = self._steps[batch]
        self._running.discard(batch)
        numbers = self._batches[batch]
        for number, own in zip(numbers, outcome.value or [outcome] * len(numbers), strict=True):
            self._outcomes[number] = own
            self._done += own.error is None
            self._failed += own.error is not None
            if (
                own.error is None
                and self._store is not None
                and not self._store.keep(own.value, self._keys[number])
            ):
                name = _name(self._conditions[number])
                said = f"{name} is not kept: a file that it names changed while it was played"
                self._console.print(said)
        self._show_progress()

    def _say_moved(self, batch: int) -> None:
        for condition in self._of(batch):
            self._console.print(f"a worker was lost; {_name(condition)} is played again")


def in_batches(conditions: Sequence[Condition], cores: int) -> list[list[int]]:
    """Conditions, by their numbers, that are played in one vector environment: many worlds cost
    less each.

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
        if not can_share_worlds(condition):
            batches.append([number])
            continue
        policy = (
            condition.policy,
            condition.member,
            condition.policy_options,
            condition.reference_name,
        )
        key = repr((policy, shared_settings(condition)))
        batch, size = open_batch.get(key, ([], most))
        if size + condition.episodes > most:
            batch = []
            size = 0
            batches.append(batch)
        batch.append(number)
        open_batch[key] = batch, size + condition.episodes
    return batches


def _failure_text(condition: Condition, outcome: Outcome) -> tuple[str, int]:
    """Text and exit code of a failure; a defect's traceback goes to the terminal."""
    error = outcome.error
    assert error is not None
    found = explain(error)
    said, code = found or (
        f"this is a defect: {type(error).__name__}: {error}\n{outcome.trace}",
        DEFECT,
    )
    return said if isinstance(error, PolicyFailedError) else f"{_name(condition)}: {said}", code


def _name(condition: Condition) -> str:
    """Name of a cell for a user."""
    swept = "".join(f", {name}={value:g}" for name, value in condition.swept.items())
    member = condition.member
    seed = (
        ""
        if member is None or member.training_seed is None
        else f", training seed {member.training_seed}"
    )
    return (
        f"{condition.policy.title!r} in {condition.scenario!r},"
        f" {condition.reference_name}{swept}{seed}"
    )


def _on_hardware(condition: Condition, which: str, console: Console) -> Evaluation:
    (total,) = num_steps([condition])
    done = 0
    say = plain_progress(console)
    console.print(f"{which}: {condition.policy.title} plays {condition.reference_name}")

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        say(done / total)

    return evaluate(condition, advance)


def _evaluate_beside(
    conditions: Sequence[Condition], said: frozenset[str], report: Callable[[int], None]
) -> list[Outcome]:
    """Evaluations in a process of their own, without the warnings that were shown before."""
    with each_once(said):
        return _evaluate(conditions, report)


def _evaluate(
    conditions: Sequence[Condition], report: Callable[[int], None], num_threads: int = 1
) -> list[Outcome]:
    """Evaluations, side by side, that report how many control steps they have played.

    Where the policy fails beside others, each is played alone, to say which ones it fails in.
    """
    done = 0

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        report(done)

    try:
        return [
            Outcome(evaluation)
            for evaluation in evaluate_together(conditions, advance, num_threads)
        ]
    except PolicyFailedError as error:
        if len(conditions) == 1:
            return [Outcome(error=error.with_traceback(None))]
    return [
        outcome
        for condition in conditions
        for outcome in _evaluate([condition], lambda _: None, num_threads)
    ]
