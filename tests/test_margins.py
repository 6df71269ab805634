"""Margins: bisection against edges that are known, what is played, and gains that are too strong."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.catalogue import QUICK_POSTURE
from baselines.walking.posture import PostureGains
from docs.pages.cells import read_rows
from elastic_env.core.signals import Array
from elastic_env.world.scenario import make_scenario
from train.commands import margins as command
from train.commands.cli import main
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import evaluate
from train.evaluate.margin_search import (
    CHECKED_SHARE,
    NO_REST,
    QUANTITIES,
    Causes,
    bisect,
    failure_causes,
    find_margins,
    margin_table,
)
from train.evaluate.rollout import make_shared_env

STEP = {"step_period": [0.2, 0.3, 0.2], "num_steps": 1}
GAINS = ("proportional", "integral", "derivative", "trim")
PELVIS = "pelvis_error_rms_rad"


def stronger(gains: PostureGains, factor: float) -> PostureGains:
    """Posture feedback with its gains times a factor.

    Args:
        gains: Proportional, integral and derivative gain, and trim, among others.
        factor: Of all four [1].
    """
    return gains.replace(**{name: factor * getattr(gains, name) for name in GAINS})


@dataclass(frozen=True)
class GainMargin:
    """What stronger gains cost.

    Attributes:
        failed: Episodes that failed with the plain and with the stronger gains.
        ratio: Mean pelvis error with the stronger gains over that with the plain ones [1]; nan
            where an episode failed.
    """

    failed: tuple[int, int]
    ratio: float


def gain_margin(
    condition: Condition, gains: PostureGains, factor: float, num_threads: int = 0
) -> GainMargin:
    """Play the same episodes with plain and with stronger gains of the posture feedback.

    Args:
        condition: A policy with posture feedback, and all that strains it: delay, IMU, length.
        gains: The plain ones.
        factor: Of the stronger ones over the plain ones [1].
        num_threads: Threads of the physics, 0 for all cores.
    """
    failed = []
    errors = []
    for own in (1.0, factor):
        posture = stronger(gains, own).model_dump()
        policy = condition.policy.replace(options={**condition.policy.options, "posture": posture})
        played = evaluate(condition.replace(policy=policy), num_threads=num_threads)
        failed.append(played.num_failed)
        errors.append(played.values(PELVIS).mean() if not played.num_failed else np.nan)
    return GainMargin((failed[0], failed[1]), float(errors[1] / errors[0]))


def walk(policy: str = "input_output", **fields: Any) -> Condition:
    """A short walk of a robot of `spread`."""
    given = {"scenario": "spread", "reference": STEP, **fields}
    return Condition(env="walker", policy=PolicySpec(name=policy), **given)


def fails_beyond(edge: Array, way: Array) -> Any:
    """Trials that fail where a value is beyond its edge, in the direction of `way`."""
    return lambda value: np.where((value - edge) * way > 0.0, "fell", "")


def test_bisection_finds_edges_upwards_and_downwards() -> None:
    """Catches a direction that is mixed up, and intervals that do not halve."""
    first = np.array([0.0, 1.0, 0.0])
    last = np.array([512.0, 0.0, 0.128])
    edge = np.array([100.3, 0.41, 0.05])
    for halvings in (3, 7, 20):
        found = bisect(fails_beyond(edge, last - first), first, last, halvings)
        width = np.abs(last - first) / 2**halvings
        np.testing.assert_allclose(np.abs(found.failed - found.survived), width, rtol=1e-6)
        assert ((edge - found.survived) * (last - first) >= 0.0).all()
        assert (np.abs(edge - found.survived) <= width).all()
        assert set(found.causes) <= {"fell", ""}


def test_bisection_says_where_nothing_or_everything_was_survived() -> None:
    """Catches an edge that nobody has seen."""
    first = np.zeros(2)
    last = np.ones(2)
    found = bisect(fails_beyond(np.array([-1.0, 2.0]), last), first, last, 3)
    np.testing.assert_array_equal(found.survived, [0.0, 7 / 8])
    np.testing.assert_array_equal(found.failed, [1 / 8, np.nan])
    np.testing.assert_array_equal(found.causes, ["fell", ""])


def records_of(edges: dict[str, list[float]]) -> tuple[list[dict[str, Any]], list[Condition]]:
    """Margins of robots with known edges, and all that was played."""
    played: list[Condition] = []
    quantities = [own for own in QUANTITIES if own.field in edges]

    def play(conditions: Sequence[Condition]) -> Causes:
        played.extend(conditions)
        causes = []
        for own in conditions:
            ((name, value),) = own.swept.items()
            field = name.removeprefix("scenario.")
            (known,) = (one for one in quantities if one.field == field)
            beyond = (value - edges[field][own.seed - 3]) * (known.fatal - known.harmless) > 0.0
            causes.append("fell" if beyond else "")
        return np.array(causes)

    robots = len(next(iter(edges.values())))
    return find_margins(walk(seed=3), quantities, robots, 10, play), played


def test_margins_are_those_of_the_worst_robot_and_the_median() -> None:
    """Catches a quantity whose worst edge is the largest one, and robots that are mixed up."""
    edges = {"push_n": [200.0, 100.0, 150.0], "stiffness": [0.4, 0.3, 0.5]}
    (push, softest), played = records_of(edges)
    np.testing.assert_allclose([push["worst"], push["median"]], [100.0, 150.0], atol=0.5)
    np.testing.assert_allclose([softest["worst"], softest["median"]], [0.5, 0.4], atol=0.001)
    np.testing.assert_allclose(push["edges"], edges["push_n"], atol=0.5)
    assert push["worst"] <= 100.0 < push["fails_at"]
    assert softest["fails_at"] < 0.5 <= softest["worst"]
    assert [push["failed_before"], softest["failed_before"], push["robots"]] == [0, 0, 3]
    last = {tuple(own.swept.items()) for own in played[-6:]}
    expected = 1.0 - CHECKED_SHARE * (1.0 - softest["worst"])
    assert last == {
        (("scenario.push_n", CHECKED_SHARE * push["worst"]),),
        (("scenario.stiffness", expected),),
    }


def test_every_quantity_begins_at_the_scenario_itself() -> None:
    """Catches a first value that is a change already, and one that no scenario can have."""
    plain = make_scenario("spread")
    for own in QUANTITIES:
        assert own.harmless == plain.fixed_value(own.field)
        middle = (own.harmless + own.fatal) / 2.0
        assert plain.replace(**{own.field: middle}).fixed_value(own.field) == middle


@pytest.mark.slow
def test_the_default_robots_differ_and_are_the_same_at_every_value() -> None:
    """Catches seeds that draw a robot twice, and a value that draws other robots."""
    robots = [walk(seed=seed) for seed in range(command.Margins().robots)]
    robots += [walk(seed=0, swept={"scenario.slope_rad": 0.02})]
    env = make_shared_env(robots, 1)
    env.reset(seed=[robot.seed for robot in robots])
    stiffness = env.unwrapped.truth().stiffness
    env.close()
    assert len(np.unique(stiffness, axis=0)) == 8
    np.testing.assert_array_equal(stiffness[0], stiffness[8])


def test_causes_are_those_of_every_world_alone() -> None:
    """Catches a robot that cannot stand and ends the others, and a world that is taken for
    another."""
    values = [("push_n", 0.0), ("stiffness", 0.2), ("push_n", 900.0)]
    conditions = [walk("zero", swept={f"scenario.{name}": value}) for name, value in values]
    together = failure_causes(conditions, 1)
    assert together.tolist() == ["", NO_REST, "fell"]
    assert failure_causes(conditions[2:3], 1).tolist() == ["fell"]


def test_gains_are_stronger_and_nothing_else_changes() -> None:
    """Catches a gain that is left out, and a limit that grows with them."""
    gains = PostureGains(proportional=2.0, integral=8.0, derivative=0.2, trim=4.0, leak_s=0.7)
    expected = gains.replace(proportional=2.5, integral=10.0, derivative=0.25, trim=5.0)
    assert stronger(gains, 1.25) == expected
    assert stronger(gains, 1.0) == gains


def test_the_command_writes_a_table_that_reads_as_its_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a table of other figures than those of the files, and results that are lost."""

    def play(conditions: Sequence[Condition], *_: Any) -> Causes:
        pushed = [own.swept.get("scenario.push_n", 0.0) for own in conditions]
        return np.where(np.array(pushed) > 100.0, "fell", "")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "failure_causes", play)
    reference = json.dumps(STEP)
    main(["margins", "--policies", "input_output", "thormang", "--reference", reference])
    folder = Path("runs", "margins")
    records = json.loads((folder / "margins.json").read_text())
    rows = read_rows(folder / "margins.csv")
    assert [len(records), len(rows)] == [2 * len(QUANTITIES)] * 2
    assert margin_table(rows) == margin_table(records)
    head, (first, second) = margin_table(rows)
    assert head[:2] == ["policy", "largest push [N]"]
    assert first[:3] == ["input_output", "100 / 100", "0.00781 or beyond / 0.00781"]
    assert second[1:] == first[1:]
    assert "100 / 100" in capsys.readouterr().out


@pytest.mark.slow
def test_foothold_keeps_a_margin_of_its_gains() -> None:
    """Catches gains that are tuned to the edge: a quarter more, a delayed IMU as it is sold, and
    twenty steps."""
    condition = walk(
        "foothold",
        scenario="imu",
        reference={"step_period": 3, "num_steps": 20},
        env_options={"bank": 1},
        episodes=4,
        seed=9000,
    )
    assert make_scenario("imu").delay_share == 1.0
    found = gain_margin(condition, QUICK_POSTURE, 1.25)
    assert found.failed == (0, 0)
    assert found.ratio <= 1.1
