"""The cells of a comparison, played side by side: what is kept, and what one that fails leaves of the others."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from elastic_env.core.errors import ElasticError
from train.cells.key import cell_key
from train.cells.store import Store
from train.evaluate.conditions import Condition
from train.evaluate.evaluate import Evaluation, PolicyFailedError, evaluate, num_steps
from train.runs.failures import DEFECT, explained
from train.runs.progress import Show, plain_progress, show_progress
from train.workers.calls import Outcome, Tally, Watch, run_calls
from train.workers.places import HERE, Place


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
    conditions: Sequence[Condition], console: Console, place: Place = HERE, store: Store | None = None,
    fresh: bool = False,
) -> list[Evaluation]:  # fmt: skip
    """Evaluate conditions, the long ones first, and return their results in the order given.

    The results do not depend on where they are played. On hardware the conditions come one after the other, in this
    process, at whose terminal somebody can agree to them; nothing is kept of them.

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
            _on_hardware(condition, f"{n} of {len(conditions)}", console) for n, condition in enumerate(conditions, 1)
        ]
    kept = [None if store is None or fresh else store.get(condition) for condition in conditions]
    missing = [condition for condition, found in zip(conditions, kept, strict=True) if found is None]
    if len(missing) < len(conditions):
        console.print(f"{len(conditions) - len(missing)} of {len(conditions)} cells are kept", soft_wrap=True)
    played = iter(_Playing(missing, console, place, store).results() if missing else [])
    results = [next(played) if found is None else Outcome(found) for found in kept]
    finished = [result.value for result in results if result is not None and result.error is None]
    why = [_said(c, r) for c, r in zip(conditions, results, strict=True) if r is not None and r.error is not None]
    if why:
        raise CellsFailedError(why, finished)
    if None in results:
        raise KeyboardInterrupt
    return finished


class _Playing:
    """Conditions that are being played."""

    def __init__(self, conditions: Sequence[Condition], console: Console, place: Place, store: Store | None) -> None:
        self._conditions, self._console, self._place, self._store = conditions, console, place, store
        steps = num_steps(conditions)
        self._longest_first = sorted(range(len(conditions)), key=lambda number: -steps[number])
        self._steps = [steps[number] for number in self._longest_first]
        self._keys = [] if store is None else [cell_key(conditions[number]) for number in self._longest_first]
        self._played = [0] * len(conditions)
        self._note = ""
        self._show: Show = lambda *_: None

    def results(self) -> list[Outcome | None]:
        """Outcomes in the order of the conditions; None for those that Ctrl-C kept from starting."""
        ordered = [self._conditions[number] for number in self._longest_first]
        with show_progress(self._console, {"control steps": sum(self._steps)}, transient=True) as self._show:
            if len(ordered) == 1 and self._place.is_local:  # a process of its own takes seconds to start
                found: list[Outcome | None] = [self._in_this_process(ordered[0])]
            else:
                found = self._beside(ordered)
        return [found[self._longest_first.index(number)] for number in range(len(ordered))]

    def _beside(self, ordered: Sequence[Condition]) -> list[Outcome | None]:
        watch = Watch(self._reported, self._ended, self._tallied, self._moved)
        with tempfile.TemporaryDirectory() as own:
            folder = Path(own) if self._store is None else self._store.folder.parent
            with self._place.opened(len(ordered), folder) as pool:
                return run_calls(_evaluate, [(condition,) for condition in ordered], pool, watch)

    def _in_this_process(self, condition: Condition) -> Outcome:
        try:
            outcome = Outcome(_evaluate(condition, lambda played: self._reported(0, played), self._place.jobs))
        except PolicyFailedError as error:
            return Outcome(error=error.with_traceback(None))
        self._ended(0, outcome)
        return outcome

    def _reported(self, number: int, played: int) -> None:
        self._played[number] = played
        self._show(0, sum(self._played), self._note)

    def _tallied(self, tally: Tally) -> None:
        self._note = tally.in_words("cells")
        self._show(0, sum(self._played), self._note)

    def _ended(self, number: int, outcome: Outcome) -> None:
        self._played[number] = self._steps[number]
        if outcome.error is not None or self._store is None or self._store.keep(outcome.value, self._keys[number]):
            return
        name = _name(self._conditions[self._longest_first[number]])
        self._console.print(f"{name} is not kept: a file that it names changed while it was played", soft_wrap=True)

    def _moved(self, number: int) -> None:
        name = _name(self._conditions[self._longest_first[number]])
        self._console.print(f"a worker was lost; {name} is played again", soft_wrap=True)


def _said(condition: Condition, outcome: Outcome) -> tuple[str, int]:
    """What failed and the exit code; a defect's traceback goes to the terminal."""
    error = outcome.error
    assert error is not None
    found = explained(error)
    said, code = found or (f"this is a defect: {type(error).__name__}: {error}\n{outcome.trace}", DEFECT)
    return said if isinstance(error, PolicyFailedError) else f"{_name(condition)}: {said}", code


def _name(condition: Condition) -> str:
    """What a user calls a cell."""
    swept = "".join(f", {name}={value:g}" for name, value in condition.swept.items())
    member = condition.member
    seed = "" if member is None or member.training_seed is None else f", training seed {member.training_seed}"
    return f"{condition.policy.title!r} in {condition.scenario!r}, {condition.reference_name}{swept}{seed}"


def _on_hardware(condition: Condition, which: str, console: Console) -> Evaluation:
    (total,), done, say = num_steps([condition]), 0, plain_progress(console)
    console.print(f"{which}: {condition.policy.title} plays {condition.reference_name}", soft_wrap=True)

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        say(done / total)

    return evaluate(condition, advance)


def _evaluate(condition: Condition, report: Callable[[int], None], num_threads: int = 1) -> Evaluation:
    """An evaluation that reports how many control steps it has played."""
    done = 0

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        report(done)

    return evaluate(condition, progress=advance, num_threads=num_threads)
