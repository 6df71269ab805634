"""Worlds of several scenarios in one vector environment, against environments of one scenario
each."""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.compensation.policy import Zero
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from train.cells import play
from train.cells.play import make_batches
from train.evaluate import rollout
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import evaluate, evaluate_together

ID = "elastic_env/WalkInPlace-v0"
SHORT: dict[str, Any] = {"step_period": [0.2, 0.3, 0.2], "num_steps": 1}
SCENARIOS = [
    "nominal",
    "soft",
    "spread",
    "payload",
    "sensor",
    "slope",
    "push",
    "imu",
    "foot_sensors",
    "slip",
    "drawn",
    "soft+backlash",
]
KINDS = ["payload", "sensor", "push", "drawn"]
"""One of each kind: plants, noise, pushes, and a bank with most of them and the floor together."""
SENSORS = ["link_encoder", "joint_torque", "accelerometer"]


def worlds(scenario: str | list[str], num_envs: int, **options: Any) -> Any:
    """A vector environment of a short walk."""
    return gymnasium.make_vec(
        ID,
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=2,
        scenario=scenario,
        **SHORT,
        **options,
    )


def mixed(scenarios: list[str], **options: Any) -> Any:
    """One world of every scenario."""
    return worlds(scenarios, len(scenarios), **options)


def played(env: Any, seeds: list[int], offsets: Array) -> list[Array]:
    """Observations, rewards and signals of a walk from given seeds, under offsets, (steps,
    worlds, 12) [rad]; a push comes after a sixteenth of its time."""
    observation, info = env.reset(seed=seeds)
    env.unwrapped.task._push_begin //= 16
    found = [observation]
    for offset in offsets:
        observation, reward, *_, info = env.step(offset)
        found += [
            observation,
            reward,
            info["zmp_deviation"],
            info["pelvis_error"],
            info["joint_torque"],
        ]
    return [*found, *env.unwrapped.truth().stiffness.T]


def some_offsets(steps: int, num_worlds: int) -> Array:
    """Offsets that move all joints, by some mrad."""
    generator = np.random.default_rng(7)
    return np.cumsum(generator.uniform(-2e-3, 2e-3, (steps, num_worlds, 12)), axis=0).clip(
        -0.02, 0.02
    )


@pytest.mark.parametrize(
    ("scenarios", "sensors"),
    [
        pytest.param(SCENARIOS, [], marks=pytest.mark.slow),
        pytest.param(SCENARIOS, SENSORS, marks=pytest.mark.slow),
        (KINDS, SENSORS),
    ],
)
def test_a_world_is_the_same_beside_worlds_of_other_scenarios(
    scenarios: list[str], sensors: list[str]
) -> None:
    """Catches a scenario that takes its plant, bank, sensors, push or noise from another one, in
    any bit."""
    seeds = list(range(len(scenarios)))
    offsets = some_offsets(40, len(scenarios))
    mixture = mixed(scenarios, sensors=sensors)
    together = played(mixture, seeds, offsets)
    assert 0 < mixture.unwrapped.task._push_begin[scenarios.index("push")] < 30
    for index, scenario in enumerate(scenarios):
        own = slice(index, index + 1)
        alone = played(worlds(scenario, 1, sensors=sensors), seeds[own], offsets[:, own])
        for one, other in zip(together, alone, strict=True):
            np.testing.assert_array_equal(one[own], other, err_msg=scenario)


def test_a_copy_of_a_mixture_goes_on_as_the_original() -> None:
    """Catches models of drawn robots that a copy does not have."""
    names = ["payload", "drawn"]
    first = mixed(names)
    offsets = some_offsets(20, len(names))
    played(first, [5, 7], offsets[:10])
    second = copy.deepcopy(first.unwrapped)
    for offset in offsets[10:]:
        shown = [env.step(offset)[0] for env in (first, second)]
        np.testing.assert_array_equal(shown[1], shown[0])


def test_policies_play_in_a_mixture_and_the_oracle_is_told_that_it_cannot() -> None:
    """Catches an oracle that takes one scenario's parameters for those of all."""
    env = mixed(["nominal", "soft"])
    env.reset(seed=0)
    assert env.unwrapped.assumed_model.stiffness.shape == (12,)
    with pytest.raises(ConfigurationError, match="2 scenarios have no true model in common"):
        baselines.make("oracle", env)


@pytest.mark.parametrize(
    ("scenario", "problem"),
    [
        (["nominal", "soft", "soft"], r"one for each world, 2, got 3"),
        ([], "empty list"),
        (["nominal", "ideal"], "same friction_scale, got 1 of 'nominal' and 0 of 'ideal'"),
        (["nominal", "sloppy"], "sloppy"),
    ],
)
def test_a_list_that_does_not_fit_is_an_error_with_what_it_has(
    scenario: list[str], problem: str
) -> None:
    """Catches a list that is repeated or cut, and worlds whose policies would have to know
    different friction."""
    with pytest.raises(ConfigurationError, match=problem):
        worlds(scenario, 2)
    with pytest.raises(ConfigurationError):
        gymnasium.make(ID, scenario=["nominal", "soft"])


TABLED: dict[str, Any] = {"step_period": 1.1, "num_steps": 1}
"""A short walk at a gait that has a table over the phase."""


def cell(
    policy: str,
    scenario: str,
    episodes: int = 2,
    reference: dict[str, Any] = SHORT,
    **changes: Any,
) -> Condition:
    """A cell of a comparison of short walks."""
    return Condition(
        env="walker",
        policy=PolicySpec(name=policy),
        reference=reference,
        scenario=scenario,
        episodes=episodes,
        seed=4,
        **changes,
    )


LEARNED = "residual:walker_1600ms/seed_0"
FEW = ["drawn", "imu", "nominal"]
MORE = [*FEW, "payload"]


@pytest.mark.parametrize(
    ("policy", "scenarios", "reference", "alone"),
    [
        *(
            pytest.param(policy, MORE, TABLED, range(4), marks=pytest.mark.slow)
            for policy in ("adaptive_posture", "link_encoder", "thormang", LEARNED)
        ),
        ("adaptive", FEW, SHORT, [1]),  # has one before and one behind it
    ],
)
def test_cells_that_are_played_together_are_what_they_are_alone(
    policy: str, scenarios: list[str], reference: dict[str, Any], alone: Sequence[int]
) -> None:
    """Catches policies, scores, traces and seeds that depend on the worlds beside."""
    cells = [cell(policy, scenario, reference=reference) for scenario in scenarios]
    together = evaluate_together(cells, num_threads=2)
    assert [one.condition for one in together] == cells
    for one in (together[number] for number in alone):
        other = evaluate(one.condition, num_threads=1)
        np.testing.assert_equal(one.episodes, other.episodes)  # what fell has no end
        assert {episode["seed"] for episode in one.episodes} == {4, 5}
        assert one.trace.keys() == other.trace.keys()
        for name, values in one.trace.items():
            np.testing.assert_array_equal(values, other.trace[name], err_msg=name)


def test_batches_hold_cells_of_one_policy_and_leave_work_for_every_core() -> None:
    """Catches cells that are lost, that no environment can have in common, and one core that
    waits for the others."""
    scenarios = ("ideal", "nominal", "soft", "push", "slope", "spread")
    cells = [
        cell(name, scenario)
        for scenario in scenarios
        for name in ("input", "oracle", "iterative", "dynamic")
    ]
    batches = make_batches(cells, cores=1)
    assert sorted(number for batch in batches for number in batch) == list(range(len(cells)))
    found = [
        {(cells[number].policy.name, cells[number].scenario) for number in batch}
        for batch in batches
    ]
    for policy in ("input", "dynamic"):
        assert {(policy, "ideal")} in found
        assert {(policy, scenario) for scenario in scenarios[1:]} in found
    alone = [batch for batch in found if {"oracle", "iterative"} & {policy for policy, _ in batch}]
    assert [len(batch) for batch in alone] == [1] * 12
    assert len(make_batches(cells, cores=8)) >= 16
    assert all(len(batch) == 1 for batch in make_batches(cells, cores=len(cells)))
    testbed = [
        Condition(policy=PolicySpec(name="input"), scenario=name) for name in ("nominal", "soft")
    ]
    assert make_batches(testbed, cores=1) == [[0], [1]]


def test_a_map_of_a_scenario_shares_worlds_and_varied_options_do_not() -> None:
    """Catches a policy that plays cells of another value of its option."""
    cells = [
        cell("input", "nominal", swept={"scenario.stiffness": value})
        for value in (0.8, 0.9, 1.0, 1.1)
    ]
    assert make_batches(cells, cores=1) == [[0, 1], [2, 3]]
    cells = [
        cell("input", "nominal", swept={"stiffness_scale": value}) for value in (0.8, 0.9, 1.0, 1.1)
    ]
    assert make_batches(cells, cores=1) == [[0], [1], [2], [3]]


def failing(env: Any) -> Any:
    """A policy that raises in worlds with a load."""

    class Failing(Zero):
        def predict(self, observation: Any, *rest: Any, **named: Any) -> Any:
            if env.unwrapped.task.model.body_mass.sum() > 60.0:
                raise ValueError("too heavy")
            return super().predict(observation, *rest, **named)

    return Failing(env.unwrapped.assumed_model)


def test_of_cells_that_were_to_be_played_together_each_says_whether_it_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a failure in one scenario that takes the results of the others with it, or has
    another's name."""
    monkeypatch.setattr(rollout, "can_share_worlds", lambda condition: True)
    cells = [cell(f"{__name__}:failing", scenario, 1) for scenario in ("payload", "nominal")]
    failed, passed = play._evaluate(cells, lambda _: None)
    assert failed.error is not None
    assert "'payload'" in str(failed.error)
    assert "too heavy" in str(failed.error)
    alone = evaluate(cells[1], num_threads=1)
    np.testing.assert_equal(passed.value.episodes, alone.episodes)  # what fell has no end
