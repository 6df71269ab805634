"""The cells of a comparison, played side by side: what one that fails leaves of the others."""

from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console

from elastic_env.core.errors import ElasticError
from train.evaluate.conditions import Condition
from train.evaluate.evaluate import Evaluation, PolicyFailedError, evaluate, num_steps
from train.runs.workers import WorkerKilledError, plain_progress, show_progress, side_by_side


class CellsFailedError(ElasticError):
    """Some conditions have no result, for a policy that fails or a process that was killed.

    Attributes:
        finished: Evaluations of the others.
    """

    def __init__(self, why: Sequence[ElasticError], finished: list[Evaluation]) -> None:
        super().__init__("\n".join(dict.fromkeys(map(str, why))))
        self.finished = finished
        self.exit_code = max(error.exit_code for error in why)  # type: ignore[misc]


def run_conditions(conditions: Sequence[Condition], console: Console, jobs: int = 0) -> list[Evaluation]:
    """Evaluate conditions, the long ones first, and return their results in the order given.

    The results do not depend on the number of processes. On hardware the conditions come one after the other, in this
    process, at whose terminal somebody can agree to them.

    Raises:
        CellsFailedError: Some of them have no result; it has those of the others.
    """
    if any(condition.environment.is_real for condition in conditions):
        return [
            _on_hardware(condition, f"{n} of {len(conditions)}", console) for n, condition in enumerate(conditions, 1)
        ]
    steps = num_steps(conditions)
    longest_first = sorted(range(len(conditions)), key=lambda number: -steps[number])
    done = 0
    with show_progress(console, {"control steps": sum(steps)}, transient=True) as show:

        def advance(_: int, played: int) -> None:
            nonlocal done
            done += played
            show(0, done)

        why: list[ElasticError] = []
        try:
            results: list[Any]
            if len(conditions) == 1:  # a process of its own takes seconds to start
                results = [_evaluate(conditions[0], lambda played: advance(0, played), num_threads=jobs)]
            else:
                results = side_by_side(_evaluate, [(conditions[number],) for number in longest_first], jobs, advance)
        except WorkerKilledError as error:
            results = error.results
            why.append(error)
        show(0, sum(steps))
    played = [results[longest_first.index(number)] for number in range(len(conditions))]
    why += [result for result in played if isinstance(result, PolicyFailedError)]
    if why:
        raise CellsFailedError(why, [result for result in played if isinstance(result, Evaluation)])
    return played


def _on_hardware(condition: Condition, which: str, console: Console) -> Evaluation:
    (total,), done, say = num_steps([condition]), 0, plain_progress(console)
    console.print(f"{which}: {condition.policy.title} plays {condition.reference_name}", soft_wrap=True)

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        say(done / total)

    return evaluate(condition, advance)


def _evaluate(
    condition: Condition, report: Callable[[int], None], num_threads: int = 1
) -> Evaluation | PolicyFailedError:
    """An evaluation, or why there is none: the other conditions go on."""
    try:
        return evaluate(condition, progress=report, num_threads=num_threads)
    except PolicyFailedError as error:
        return error.with_traceback(None)
