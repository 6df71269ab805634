"""What a residual computes in every control step, compiled, row by row.

`baselines.residual.residual` and `baselines.residual.correction` have the formulas.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel calls stands in this
file, and every size comes from a type.
"""

from typing import Any

import numpy as np

from elastic_env.core.compiled import compiled
from elastic_env.core.signals import Array, IntArray


@compiled
def count_due(memory: Array) -> int:
    """Worlds that decide now: whose count, the first column, is zero, or less before their first decision."""
    due = 0
    for world in range(len(memory)):
        if memory[world, 0] <= 0.0:
            due += 1
    return due


@compiled
def count_step(memory: Array, period: int) -> None:
    """Count a control step since the last decision in the first column, modulo the decision period, in place."""
    for world in range(len(memory)):
        memory[world, 0] = (memory[world, 0] + 1.0) % period


@compiled
def approach(before: Array, residual: Array, source: IntArray, bounds: Array, share: float, now: Array) -> None:
    """First-order low-pass of the columns of all inputs, on their way to their bounds times the residual.

    Args:
        before: Values before, (num_worlds, width).
        residual: Within [−1, 1], (num_worlds, k).
        source: Number of the residual that each column takes, or -1 where it has none, (width,).
        bounds: Of the columns, (width,).
        share: Share of its way that a value makes now [1].
        now: To be filled, (num_worlds, width).
    """
    for world in range(len(now)):
        for column in range(len(source)):
            wanted = 0.0
            if source[column] >= 0:
                wanted = bounds[column] * residual[world, source[column]]
            now[world, column] = before[world, column] + share * (wanted - before[world, column])


@compiled
def affine(rows: Any, W: Any, b: Any) -> Any:
    """Give x W + b of every row x, in single precision, (n, k) to (n, m); all rows are added up in the same order."""
    out = np.empty((len(rows), len(b)), dtype=np.float32)
    for row in range(len(rows)):
        for j in range(len(b)):
            out[row, j] = b[j]
        for i in range(W.shape[0]):  # along the outputs, whose sums are apart, the processor works on several at once
            x = rows[row, i]
            for j in range(len(b)):
                out[row, j] += x * W[i, j]
    return out
