"""Policies of the walker as headers in C99: equal to Python, in random states and on a walk."""

import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from tests.test_c_export import (
    AS_RELEASED,
    CHECKED,
    COMPILERS,
    QUICKLY,
    RELEASED,
    compiled,
    require_no_library,
)
from train.commands.cli import main
from train.export.c_walker import c_walker
from train.export.walker_vectors import PlayedSteps, play_observations, play_steps

TOLERANCE = 1e-12
WALKER = "elastic_env/WalkInPlace-v0"
CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "adaptive": {"policy": "adaptive_posture"},
    "adaptive_quick": {
        "policy": "adaptive_posture",
        "adaptation": {"period_s": 0.02, "filter_s": 0.01, "limit": 0.2},
        "posture": {"integral": 0.0, "trim": 4.0, "swing_s": 0.0, "limit_rad": 0.01},
        "ramp_s": 0.2,
        "gains": {"weight_filter_s": None},
    },
    "weighing": {
        "gains": {"weight_filter_s": 0.5, "dcm": 2.0, "force_difference": 0.05},
        "stiffness": [600.0] * 6 + [1400.0] * 6,
    },
    "open": {"com_feedback": False, "gravity": "ankle", "ramp_s": 0.3},
}
PLAYED = [
    *("adaptive_quick", "weighing", "open"),
    # those without options play in the test of bad numbers, by the header's own vectors
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("default", "adaptive")),
]
DRIVER = r"""
#include "arm.h"
#include <stddef.h>
#include <stdio.h>

int main(int count, char **paths) {
    FILE *from = fopen(paths[1], "rb"), *to = fopen(paths[2], "wb");
    double support, out[25];
    arm_shown shown;
    arm_plan plan;
    arm_state state;
    arm_begin(&state);
    while (count == 3 && fread(&shown, offsetof(arm_shown, support), 1, from) == 1) {
        int k;
        if (fread(&support, 8, 1, from) != 1 || fread(&plan, sizeof plan, 1, from) != 1) return 1;
        shown.support = (int)support;
        out[0] = arm_step(&state, &shown, &plan, out + 1);
        for (k = 0; k < 12; k++) out[13 + k] = state.links[k];
        fwrite(out, sizeof out, 1, to);
    }
#if ARM_IS_ADAPTIVE
    fwrite(state.correction, sizeof state.correction, 1, to);
    fwrite(state.unknowns, sizeof state.unknowns + sizeof state.covariance, 1, to);
    fwrite(state.tilt, 8 * sizeof state.tilt[0], 1, to);
#endif
    fclose(from);
    return fclose(to);
}
"""


def walk(scenario: str = "nominal", num_steps: int = 4, **options: Any) -> Any:
    """A walk that turns and goes forward, so that no frame is another one."""
    options = {"step_period": [0.3, 0.4, 0.3]} | options
    return gymnasium.make(
        WALKER,
        num_steps=num_steps,
        gait={"step_length_m": 0.1, "turn_rad": 0.1},
        scenario=scenario,
        **options,
    )


@cache
def assumed_walk() -> Any:
    """One for all policies that are made of it."""
    return walk()


def walker(policy: str = "input_output", **options: Any) -> Any:
    return baselines.make(policy, assumed_walk(), **options)


def played_in_c(
    policy: Any, steps: PlayedSteps, compiler: str, folder: Path, options: str
) -> tuple[Array, Array, Array, Array]:
    """Statuses, offsets and link angles; then what it remembers of the last step."""
    program = compiled(folder, c_walker(policy, "arm"), compiler, DRIVER, options)
    count = len(steps.offset)
    fields = [values.reshape(count, -1) for values in (*steps.shown, *steps.plan)]
    np.hstack(fields).astype(np.float64).tofile(folder / "in")
    subprocess.run([program, "in", "out"], cwd=folder, check=True, timeout=300)
    found, last = np.split(np.fromfile(folder / "out"), [25 * count])
    found = found.reshape(count, 25)
    return found[:, 0], found[:, 1:13], found[:, 13:], last


def remembered(memory: Any) -> Array:
    """What the header of adaptive_posture remembers, from the policy's memory; else nothing."""
    if not hasattr(memory, "own"):
        return np.empty(0)
    feedback = memory.own[0]
    estimate = memory.inner.estimator.observer[0]
    rolls = [estimate["unknowns"][:, 0], estimate["covariance"][:, 0]]
    posture = [feedback[name] for name in ("tilt", "integral", "trim", "leg_pitch")]
    return np.concatenate([memory.inner.correction[0, [1, 7]], *map(np.ravel, rolls), *posture])


def compare(
    policy: Any, steps: PlayedSteps, compiler: str, folder: Path, options: str = QUICKLY
) -> None:
    status, offset, links, last = played_in_c(policy, steps, compiler, folder, options)
    assert not status.any()
    np.testing.assert_allclose(links, steps.links, rtol=0.0, atol=TOLERANCE)
    np.testing.assert_allclose(last, remembered(steps.memory), rtol=0.0, atol=TOLERANCE)
    # Python hands on offsets in single precision
    np.testing.assert_array_almost_equal_nulp(offset.astype(np.float32), steps.offset, nulp=1)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("case", PLAYED)
def test_the_header_computes_what_python_does(case: str, compiler: str, tmp_path: Path) -> None:
    """Catches a wrong frame, foot, gain, filter or row of the plan, and a load on the wrong leg."""
    policy = walker(**CASES[case])
    compare(policy, play_steps(policy, 50, seed=1), compiler, tmp_path)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_adaptive_posture_in_c_walks_as_python_does(compiler: str, tmp_path: Path) -> None:
    """Catches an estimate at another time, a trim before the walk, and a leg that does not keep
    its pitch: on legs that are softer than assumed, measured as the robot measures."""
    env = walk("soft", num_steps=2, step_period=[0.2, 0.3, 0.2])
    policy = baselines.make("adaptive_posture", env, posture={"trim": 4.0})
    observation, _ = env.reset(seed=3)
    rows = []
    state = None
    is_over = False
    while not is_over:
        rows.append(observation)
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        is_over = terminated or truncated
    assert not info["episode_metrics"]["fell"]
    steps = play_observations(policy, np.array(rows, dtype=np.float64))
    np.testing.assert_array_equal(steps.memory.inner.correction, state.inner.correction)
    assert (steps.memory.inner.correction[0, [1, 7]] > 0.1).all()
    assert np.all(steps.memory.own["trim"] != 0.0)
    compare(policy, steps, compiler, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("case", CASES)
def test_the_header_computes_what_python_does_in_ten_thousand_states(
    case: str, compiler: str, tmp_path: Path
) -> None:
    policy = walker(**CASES[case])
    compare(policy, play_steps(policy, 10_000, seed=1), compiler, tmp_path, CHECKED)


@pytest.mark.parametrize("name", ["input_output", "adaptive_posture"])
def test_bad_numbers_and_soft_springs_change_nothing(name: str, tmp_path: Path) -> None:
    """Catches a step that counts, a force that is not looked at, and a leg that has tipped over."""
    policy = walker(name)
    program = """#define ARM_TEST
        #include "arm.h"
        int main(void) {
            arm_shown shown = arm_test_shown_[0];
            arm_plan plan = arm_test_plan_[0];
            double offset[12] = {7.0};
            arm_state state;
            arm_begin(&state);
            #if ARM_IS_ADAPTIVE
            shown.wrench[1][5] = NAN;
            #else
            shown.force[1] = NAN;
            #endif
            if (arm_step(&state, &shown, &plan, offset) != ARM_NOT_FINITE) return 1;
            shown = arm_test_shown_[0];
            shown.support = 2;
            if (arm_step(&state, &shown, &plan, offset) != ARM_NOT_FINITE) return 2;
            plan.soles_in_world[1][0] = INFINITY;
            if (arm_step(&state, &arm_test_shown_[0], &plan, offset) != ARM_NOT_FINITE) return 3;
            plan = arm_test_plan_[0];
            shown = arm_test_shown_[0];
            shown.zmp[0] = 1e5;
            if (arm_step(&state, &shown, &plan, offset) != ARM_NO_EQUILIBRIUM) return 4;
            return !(state.steps == 0 && offset[0] == 7.0 && arm_test() < 1e-12);
        }"""
    header = c_walker(policy, "arm")
    subprocess.run([compiled(tmp_path, header, "gcc", program, "-std=c99 -O0")], check=True)


BOTH = [pytest.param("input_output", marks=pytest.mark.slow), "adaptive_posture"]
"""The second one has all functions of the first one."""


@pytest.mark.parametrize("policy", BOTH)
def test_it_needs_no_heap(policy: str, tmp_path: Path) -> None:
    function = """int all(arm_state *state, arm_shown *shown, arm_plan *plan, double *offset) {
        arm_begin(state);
        return arm_step(state, shown, plan, offset);
    }"""
    require_no_library(tmp_path, c_walker(walker(policy), "arm"), function)


@pytest.mark.parametrize("policy", BOTH)
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("options", AS_RELEASED)
def test_the_command_writes_it(
    policy: str,
    compiler: str,
    options: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches an example of another header, and what is not there in C; at night also an option
    that is ignored, for which a walk is planned."""
    monkeypatch.chdir(tmp_path)
    main(["export", "c", policy, "--prefix", "arm", "-o", "arm.h", "--example"])
    example = Path("arm_example/arm_main.c").read_text()
    folder = tmp_path / "arm_example"
    program = compiled(folder, Path("arm.h").read_text(), compiler, example, options)
    said = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert "us per control step" in said
    capsys.readouterr()
    refused = [(["--env", "testbed"], policy)]
    if options == RELEASED:
        refused += [(["--ramp-s", "2"], "--ramp-s")]
    for wrong, named in refused:
        with pytest.raises(SystemExit):
            main(["export", "c", policy, *wrong])
        assert named in capsys.readouterr().err
    env = assumed_walk()
    for other in ("input", "dynamic", "uncompensated", "adaptive", "posture", "foothold"):
        with pytest.raises(ConfigurationError, match="only input_output and adaptive_posture"):
            c_walker(baselines.make(other, env), "arm")
    with pytest.raises(ConfigurationError, match="only input_output and adaptive_posture"):
        c_walker(baselines.make("adaptive_posture", env, base="dynamic"), "arm")
