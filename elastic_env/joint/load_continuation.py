r"""Equilibria of links on soft springs, followed under a load that grows from zero.

The link angle q at rest solves q = θ − C τ(q) with the compliance C = K⁻¹. Where the load bends a
spring far, the equation may have several solutions, and Newton's steps from θ may fail or end at
any of them. With the share λ of the load from 0 to 1, the solutions of q = θ − λ C τ(q) form a path
from θ. Along it 1 + λ C ∂τ/∂q has positive eigenvalues as long as the pose is stable. Where one of
them reaches zero, the link tips over and the path ends.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from elastic_env.core.signals import Array, BoolArray, IntArray

TorqueFunction = Callable[[Array], Array]

_MOST_STEPS = 200
_MOST_NEWTON_STEPS = 12
_FARTHEST_RAD = 0.5
"""Largest motion in one step: a larger one might leave the path."""
_WOUND_RAD = np.pi
"""Largest deflection of other equilibria that count: half a turn of the spring."""
_SCANS = 96
"""Angles of a joint at which other equilibria are searched."""
_OTHER_RAD = 1e-2
"""Least distance of two different equilibria."""


@dataclass(frozen=True)
class LoadPath:
    """End of the path of each row.

    Attributes:
        q: Last stable link angles on the path, (..., n) [rad].
        load: Share of the load there, (..., 1); 1 where the path leads to an equilibrium.
        joint: Joint that gives way most easily there, (...).
        other: Up to two other stable equilibria of that joint, nan where none is known, (..., 2)
            [rad].
        lost: Rows without a unique equilibrium, (..., 1). If one row is lost, others may be
            incomplete.
    """

    q: Array
    load: Array
    joint: IntArray
    other: Array
    lost: BoolArray

    def reason(self, compliance: Array, names: Sequence[str] | None = None) -> str:
        """Explain why the first lost row has no equilibrium, with the joint.

        Args:
            compliance: C, broadcast against (..., n) [rad/(N·m)].
            names: Names of the joints; None to count them.
        """
        row = tuple(np.argwhere(self.lost[..., 0])[0])
        joint = int(self.joint[row])
        K = 1.0 / float(np.broadcast_to(compliance, self.q.shape)[(*row, joint)])
        name = f"joint {joint + 1} of {self.q.shape[-1]}"
        if names is not None:
            name = names[joint]
        question = f"is the stiffness of {name} ({K:.6g} N·m/rad) too low for its load?"
        angles = self.other[row][~np.isnan(self.other[row])]
        others = [f"at {angle:.4g} rad" for angle in angles]
        if self.load[row] < 1.0:
            rest = "which pose it comes to rest in is not known"
            if others:
                rest = f"it can rest {' and '.join(others)}"
            return (
                f"{question} At {100.0 * float(self.load[row][0]):.3g} % of the load K"
                f" + ∂τ_g/∂q becomes singular: the link tips over, and {rest}"
            )
        poses = " and ".join([f"at {self.q[(*row, joint)]:.4g} rad", *others])
        return f"{question} The pose is bistable: the link can rest {poses}"


def follow_load(
    theta: Array,
    compliance: Array,
    torque: TorqueFunction,
    torque_gradient: TorqueFunction,
    *,
    tolerance: float,
    rows: BoolArray | None = None,
    within: tuple[Array, Array] | None = None,
    unique: bool = True,
    names_rest: bool = True,
    finest: float = 1e-8,
) -> LoadPath:
    """Follow the equilibrium from no load to the whole load.

    A row does not depend on the other rows.

    Args:
        theta: Motor side, (..., n) [rad].
        compliance: 1/K, broadcast against (..., n); zero for a rigid joint [rad/(N·m)].
        torque: τ(q), from (..., n) to (..., n) [N·m].
        torque_gradient: ∂τ/∂q, from (..., n) to (..., n, n) [N·m/rad].
        tolerance: Largest accepted residual of the equation, times 1 + max |q| [rad].
        rows: Rows to follow, (..., 1); the others stay at θ with the whole load. None for all.
        within: Lowest and highest angles of other equilibria that count, (n,) each [rad].
        unique: True to search for other equilibria.
        names_rest: True to search where a link that tips over can rest.
        finest: Least share of the load in a step. A path that needs smaller steps has ended.
    """
    C = np.broadcast_to(compliance, theta.shape)
    springs = _Springs(theta, C, torque, torque_gradient, tolerance)
    is_open = np.ones((*theta.shape[:-1], 1), dtype=np.bool_) if rows is None else rows
    q = theta
    load = np.where(is_open, 0.0, 1.0)
    step = np.ones_like(load)
    lost = ~is_open
    for _ in range(_MOST_STEPS):
        target = np.minimum(load + step, 1.0)
        trial, is_stable = springs.settle(q, target, is_open)
        advances = is_open & is_stable
        q = np.where(advances, trial, q)
        load = np.where(advances, target, load)
        step = np.where(advances, 2.0 * step, 0.25 * step)
        is_open = is_open & (load < 1.0)
        lost = is_open & (step < finest)
        if lost.any() or not is_open.any():
            break
    else:
        lost = is_open
    joint = np.zeros(theta.shape[:-1], dtype=np.int64)
    other = np.full((*theta.shape[:-1], 2), np.nan)
    if lost.any():
        joint = springs.softest(q, load)
        if names_rest:
            found, other = springs.others(q, lost, within)
            joint = np.where(np.isnan(other[..., 0]), joint, found)
    elif unique:
        rows = np.ones_like(lost) if rows is None else rows
        joint, other = springs.others(q, rows, within)
        lost = ~np.isnan(other[..., :1])
    return LoadPath(q, load, joint, other, lost)


@dataclass(frozen=True)
class _Springs:
    """Links on springs; attributes as the arguments of `follow_load`."""

    theta: Array
    compliance: Array
    torque: TorqueFunction
    torque_gradient: TorqueFunction
    tolerance: float

    def settle(self, start: Array, load: Array, rows: BoolArray) -> tuple[Array, BoolArray]:
        """Find equilibria under shares of the load by Newton's steps; True for stable ones."""
        C = load * self.compliance
        q = start
        is_good = rows
        is_done = ~rows
        for _ in range(_MOST_NEWTON_STEPS):
            residual = q - self.theta + C * self.torque(q)
            matrix = self._matrix(q, C, is_good)
            eigenvalues = np.real(np.linalg.eigvals(matrix))
            is_good = is_good & (eigenvalues.min(axis=-1, keepdims=True) > 0.0)
            size = self.tolerance * (1.0 + np.abs(q).max(axis=-1, keepdims=True))
            is_done = is_done | (np.abs(residual).max(axis=-1, keepdims=True) <= size)
            moves = is_good & ~is_done
            if not moves.any():
                break
            matrix = np.where(moves[..., None], matrix, np.eye(q.shape[-1]))
            step = np.linalg.solve(matrix, residual[..., None])[..., 0]
            q = np.where(moves, q - step, q)
            is_near = np.abs(q - start).max(axis=-1, keepdims=True) <= _FARTHEST_RAD
            q = np.where(is_near, q, start)
            is_good = is_good & is_near
        return q, is_good & is_done

    def softest(self, q: Array, load: Array) -> IntArray:
        """Return the joint that moves most in the direction of least stiffness, (...)."""
        every = np.ones_like(load, dtype=np.bool_)
        values, vectors = np.linalg.eig(self._matrix(q, load * self.compliance, every))
        least = np.real(values).argmin(axis=-1)[..., None, None]
        softest = np.take_along_axis(vectors, least, axis=-1)[..., 0]
        return np.abs(softest).argmax(axis=-1)

    def others(
        self, q: Array, rows: BoolArray, within: tuple[Array, Array] | None
    ) -> tuple[IntArray, Array]:
        """Return joints that can rest elsewhere, (...), and their angles, (..., 2), nan for none.

        Each joint is searched alone; then all joints settle from there.
        """
        n = q.shape[-1]
        lowest, highest = within or (np.full(n, -np.inf), np.full(n, np.inf))
        other = np.full((*q.shape[:-1], 2), np.nan)
        joint = np.zeros(q.shape[:-1], dtype=np.int64)
        whole = np.ones_like(rows, dtype=np.float64)
        for i in range(n):
            for start in self._crossings(q, i):
                is_of_other_joint = ~np.isnan(other[..., :1]) & (joint != i)[..., None]
                is_open = np.isnan(other[..., 1:]) & ~is_of_other_joint
                is_new = rows & is_open & ~np.isnan(start)[..., None]
                if not is_new.any():
                    continue
                begin = q.copy()
                begin[..., i] = np.where(is_new[..., 0], start, q[..., i])
                found, is_stable = self.settle(begin, whole, is_new)
                is_apart = (np.abs(found - q) > _OTHER_RAD).any(axis=-1, keepdims=True)
                is_allowed = np.abs(found - self.theta) <= _WOUND_RAD
                is_allowed = is_allowed & (found >= lowest) & (found <= highest)
                is_allowed = is_allowed.all(axis=-1, keepdims=True)
                # False for NaN
                is_known = np.abs(found[..., i] - other[..., 0]) <= _OTHER_RAD
                is_rest = (is_new & is_stable & is_apart & is_allowed)[..., 0]
                is_other = is_rest & ~is_known
                is_first = is_other & np.isnan(other[..., 0])
                joint = np.where(is_first, i, joint)
                for number, takes in enumerate((is_first, is_other & ~is_first)):
                    other[takes, number] = found[takes, i]
        return joint, other

    def _crossings(self, q: Array, i: int) -> list[Array]:
        """Return angles at which joint i balances while the others stay, nan for none."""
        moved = q.copy()
        values = []
        scan = np.linspace(-_WOUND_RAD, _WOUND_RAD, _SCANS)
        angles = self.theta[..., i] + scan.reshape(-1, *[1] * (q.ndim - 1))
        for angle in angles:
            moved[..., i] = angle
            balance = moved - self.theta + self.compliance * self.torque(moved)
            values.append(balance[..., i])
        starts = []
        for (left, low), (right, high) in pairwise(zip(angles, values, strict=True)):
            is_crossed = (low < 0.0) & (high >= 0.0)
            if is_crossed.any():
                change = np.where(is_crossed, low - high, 1.0)
                share = np.where(is_crossed, low / change, 0.0)
                start = left + share * (right - left)
                starts.append(np.where(is_crossed, start, np.nan))
        return starts

    def _matrix(self, q: Array, C: Array, rows: BoolArray) -> Array:
        """Return 1 + C ∂τ/∂q for some rows, (..., n, n), and 1 for the others."""
        matrix = np.eye(q.shape[-1]) + C[..., None] * self.torque_gradient(q)
        is_finite = np.isfinite(matrix).all(axis=(-2, -1), keepdims=True)
        return np.where(rows[..., None] & is_finite, matrix, np.eye(q.shape[-1]))
