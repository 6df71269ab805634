"""`elastic speed --real-time`: counts that fit the clock, and percentiles of what was timed."""

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from train.commands.cli import main
from train.speed.real_time import summarise

SLOW = """
import os
import time
from pathlib import Path

import numpy as np


class Slow:
    def __init__(self, env):
        self._env, self._calls = env, 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        assert (state is None) == bool(episode_start)
        Path("scheduled").write_text(str(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK))
        time.sleep(0.006)  # one and a half control periods
        return np.zeros(self._env.action_space.shape, dtype=np.float32), 1
"""


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("env", "policy"),
    [
        pytest.param("walker", "adaptive_posture", marks=pytest.mark.slow),
        ("testbed", "input"),
    ],
)
def test_a_policy_plays_against_the_clock(
    env: str, policy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches cycles that are left out or played faster than the clock, and figures that are not
    of one run."""
    begin = time.monotonic()
    main(["speed", "--real-time", "--env", env, "--seconds", "0.3", "--output", "result"])
    assert time.monotonic() - begin > 0.3
    found = json.loads(Path("result/real_time.json").read_text())
    assert (found["env"], found["policy"], found["period_us"], found["cycles"]) == (
        env,
        policy,
        4000.0,
        75,
    )
    assert 0 <= found["late"] <= 75
    assert found["late_share"] == found["late"] / 75
    for title in ("latency", "policy"):
        figures = [found[f"{title}_{name}_us"] for name in ("median", "p99", "p999", "max")]
        assert figures[0] > 0.0
        assert figures == sorted(figures)
    assert found["latency_median_us"] > found["policy_median_us"]
    assert (found["late"] > 0) == (found["latency_max_us"] > 4000.0)
    printed = capsys.readouterr().out
    assert f"late: {found['late']} of 75 cycles" in printed
    assert "result/real_time.json" in printed


def test_a_policy_that_takes_longer_than_a_period_is_late_in_every_cycle() -> None:
    """Catches lateness by the time in the policy alone, which does not add up, and cycles that wait
    for the clock.

    And a loop that is said to have real-time scheduling and has not, or keeps it.
    """
    Path("slow.py").write_text(SLOW)
    command = ["speed", "--real-time", "--env", "testbed", "--policy", "slow.py:Slow"]
    main([*command, "--seconds", "0.2", "--output", "result"])
    found = json.loads(Path("result/real_time.json").read_text())
    assert (found["cycles"], found["late_share"]) == (50, 1.0)
    assert found["policy_median_us"] >= 6000.0
    assert (
        found["latency_max_us"] >= 50 * 6000.0 - 49 * 4000.0
    )  # the last one, behind by half a period of each
    assert found["is_real_time"] == (Path("scheduled").read_text() == str(os.SCHED_FIFO))
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER


def test_late_cycles_and_percentiles_are_those_of_the_samples() -> None:
    """Catches a cycle at the very end of its period that counts as late, and percentiles in
    another unit."""
    latency_s = 1e-6 * np.arange(1.0, 1002.0)
    found = summarise(1000e-6, latency_s, 0.5 * latency_s)
    assert (found["cycles"], found["late"]) == (1001, 1)
    figures = [found[f"latency_{name}_us"] for name in ("median", "p99", "p999", "max")]
    assert figures == pytest.approx([501.0, 991.0, 1000.0, 1001.0])
    assert found["policy_p99_us"] == pytest.approx(495.5)
