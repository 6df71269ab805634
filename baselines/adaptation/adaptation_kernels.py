"""What online adaptation computes in every control step, compiled, row by row.

`baselines.adaptation.online_stiffness` has the formula.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel calls stands in this
file, and every size comes from a type.
"""

from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array


@compiled
def count_due(memory: Array, every: int) -> int:
    """Worlds whose number of steps, the first column, is a multiple of `every`."""
    due = 0
    for world in range(len(memory)):
        if memory[world, 0] % every == 0.0:
            due += 1
    return due


@compiled
def follow(memory: Array, joints: int, gain: float) -> None:
    """A first-order filter follows its target, and the step is counted, in place.

    Args:
        memory: Steps, targets and filtered values of the joints, and anything else, (num_worlds, at least 1 + 2 n).
        joints: n.
        gain: Share of a step that the filter makes in a control period [1].
    """
    for world in range(len(memory)):
        own = memory[world]
        for i in range(joints):
            own[1 + joints + i] += gain * (own[1 + i] - own[1 + joints + i])
        own[0] += 1.0
