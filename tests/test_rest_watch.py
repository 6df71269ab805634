"""The warning of joints that move where they are scored at rest."""

import warnings

import numpy as np
import pytest

from elastic_env.core.signals import Array, IntArray
from elastic_env.world.records import JOINT, Records
from elastic_env.world.rest_watch import RestWatch

REST = np.array([-1, -1, 0, 0, 0, -1, 1, 1, 1, -1])
IS_LAST = np.array([False] * 4 + [True] + [False] * 3 + [True, False])
STEPS = len(REST)


def joints(q: Array) -> Records:
    """Truth of one joint of two worlds, the first of which rests, (steps, 2, 1)."""
    truth = np.zeros((len(q), 2, 1), JOINT)["truth"]
    truth["q"][:, 1, 0] = q
    return truth


def warned(q: Array, parts: list[slice]) -> list[str]:
    """Warnings where the steps are seen in parts."""
    watch = RestWatch(lambda q: np.full(q.shape, 2.0), np.array([100.0]), ["j"], np.array([0.01]))
    rest: IntArray = np.repeat(REST[:, None], 2, axis=1)
    is_last = np.repeat(IS_LAST[:, None], 2, axis=1)
    truth = joints(q)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for part in parts:
            watch.update(rest[part], is_last[part], truth[part])
    assert watch.has_warned == bool(said)
    return [str(one.message) for one in said]


@pytest.mark.parametrize(
    ("step", "position"), [(3, 1), (4, 1), (8, 2), (0, None), (5, None), (9, None)]
)
@pytest.mark.parametrize("split", range(STEPS))
def test_how_many_steps_are_seen_at_once_makes_no_difference(
    step: int, position: int | None, split: int
) -> None:
    """Catches a window that is judged without its first or last step, that of another position,
    and motion between the windows that counts."""
    q = np.zeros(STEPS)
    q[step] = 1e-3
    singly = warned(q, [slice(i, i + 1) for i in range(STEPS)])
    assert warned(q, [slice(0, split), slice(split, None)][split == 0 :]) == singly
    assert len(singly) == (position is not None)
    if position is not None:
        assert f"at position {position} its link moves by 1 mrad" in singly[0]
