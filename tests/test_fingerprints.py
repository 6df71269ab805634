"""No bit of a rollout changes unnoticed: environments, noise, delay, policies, residuals,
metrics."""

from typing import Any

import numpy as np
import pytest

from tests.fingerprints import Case, cases, fingerprint, numerics, recorded

_OF_THEIR_OWN_KIND = {
    "testbed": ("backlash",),
    "walker": ("spread", "imu", "push", "foot_sensors"),
}
"""Scenarios of each environment that do more than scale a parameter; `sensor` plays a whole
episode of the testbed."""
_IN_ONE_WORLD = ("spread", "sensor")
"""Scenarios of the walker of which seven robots take seconds to settle."""
_PARTS_OF_OTHERS = {
    "testbed": (
        "uncompensated",  # is zero
        "dynamic",  # plays a whole episode
    ),
    "walker": (
        "zero",
        "input",  # plays a whole walk
        "uncompensated_open",
        "uncompensated",
        "input_open",
        "input_output",  # plays the scenarios
        "dynamic",
        "adaptive",
        "posture",
        "adaptive_posture",
        "foothold",
        "hip_sensor",  # is link_encoder with fewer sensors
        "residual:walker_1600ms/seed_0",
    ),
}
"""Policies whose code plays in those of other rows too."""


def _played() -> list[Any]:
    """Each scenario in a vector environment, each policy and each whole episode in a scalar one.

    Every commit plays each kind of scenario, two of the walker in one world alone, a whole episode
    of each environment, and the policies that others do not contain.
    """
    chosen = [
        case
        for case in cases()
        if (case.worlds == 1) == (case.scenario == "nominal" or case.arguments != "{}")
        or _is_of_one_walker(case)
    ]
    return [
        pytest.param(case, id=case.name, marks=[pytest.mark.slow] * _repeats_others(case))
        for case in chosen
    ]


def _is_of_one_walker(case: Case) -> bool:
    """One world of a scenario of the walker, of which many take long."""
    is_whole = case.arguments != "{}"
    return case.env == "walker" and case.scenario in _IN_ONE_WORLD and not is_whole


def _repeats_others(case: Case) -> bool:
    """A scenario that differs from others by a number alone or plays on the other robot, many
    worlds of what one world shows, or a policy that is a part of others."""
    if case.arguments != "{}":
        return case.policy == "zero"
    if case.scenario == "nominal":
        return case.policy in _PARTS_OF_OTHERS[case.env]
    own = case.scenario in _OF_THEIR_OWN_KIND[case.env]
    return not own or (case.worlds > 1 and _is_of_one_walker(case))


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
