"""No bit of a rollout changes unnoticed: environments, noise, delay, policies, residuals,
metrics."""

from typing import Any

import numpy as np
import pytest

from tests.fingerprints import Case, cases, fingerprint, numerics, recorded

_OF_THEIR_OWN_KIND = ("spread", "backlash", "sensor", "imu", "push", "foot_sensors")


def _played() -> list[Any]:
    """Each scenario in a vector environment, each policy and each whole episode in a scalar one.

    Every commit plays the scenarios that do more than scale a parameter.
    """
    chosen = [
        case
        for case in cases()
        if (case.worlds == 1) == (case.scenario == "nominal" or case.arguments != "{}")
    ]
    return [
        pytest.param(case, id=case.name, marks=[pytest.mark.slow] * _differs_by_a_number(case))
        for case in chosen
    ]


def _differs_by_a_number(case: Case) -> bool:
    """A scenario that differs from others by a number alone."""
    return case.worlds > 1 and case.scenario not in _OF_THEIR_OWN_KIND


def test_every_case_is_recorded() -> None:
    assert {case.name for case in cases()} == set(recorded()[1])


@pytest.mark.parametrize("case", _played())
def test_a_rollout_is_that_of_before(case: Case) -> None:
    """The same bits; on a processor that calculates otherwise, the same sums."""
    processor, known = recorded()
    found = fingerprint(case)
    if numerics() == (known[case.name].numerics or processor):
        assert found.digest == known[case.name].digest
    for name, level in known[case.name].levels.items():
        np.testing.assert_allclose(found.levels[name], level, rtol=1e-5, atol=1e-9, err_msg=name)
