"""No bit of a rollout changes unnoticed: environments, noise, delay, policies, residuals,
metrics."""

import numpy as np
import pytest

from tests.fingerprints import Case, cases, fingerprint, numerics, recorded


def _played() -> list[Case]:
    """Each scenario in a vector environment, each policy and each whole episode in a scalar one."""
    return [
        case
        for case in cases()
        if (case.worlds == 1) == (case.scenario == "nominal" or case.arguments != "{}")
    ]


def test_every_case_is_recorded() -> None:
    assert {case.name for case in cases()} == set(recorded()[1])


@pytest.mark.parametrize("case", _played(), ids=lambda case: case.name)
def test_a_rollout_is_that_of_before(case: Case) -> None:
    """The same bits; on a processor that calculates otherwise, the same sums."""
    processor, known = recorded()
    found = fingerprint(case)
    if numerics() == (known[case.name].numerics or processor):
        assert found.digest == known[case.name].digest
    for name, level in known[case.name].levels.items():
        np.testing.assert_allclose(found.levels[name], level, rtol=1e-5, atol=1e-9, err_msg=name)
