"""The testbed environment: what any user of Gymnasium may rely on, and the physics that it
promises."""

import copy
import json
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ActionError, ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.dynamixel import ENCODER_COUNTS_PER_TURN, H54_200_S500_R
from elastic_env.joint.elastic_joint import Servo
from elastic_env.motion.references import Hold, Sine
from elastic_env.motion.trajectory import STAND_S
from elastic_env.robots.testbed import environment as testbed
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.environment import make as make_testbed
from elastic_env.robots.testbed.environment import make_vector as make_testbed_vector
from elastic_env.robots.testbed.model import Pendulum
from elastic_env.world.env import ElasticEnv
from elastic_env.world.scenario import make_scenario, scenario_names
from elastic_env.world.vector_env import ElasticVectorEnv
from tests.docstrings import documented_tables

ID = "elastic_env/Testbed-v0"
PERIOD_S = TestbedConfig().control_period_s
SHORT: dict[str, dict[str, Any]] = {
    "hold": {
        "kind": "hold",
        "positions": 2,
        "lower": -0.02,
        "upper": 0.02,
        "overrun": 0.04,
        "rate": 0.4,
        "shortest_move_s": 0.1,
        "settle_s": 0.02,
        "measure_s": 0.02,
    },
    "sine": {"kind": "sine", "amplitude": 0.02, "duration_s": 0.1, "onset_s": 0.1},
    "multisine": {"kind": "multisine", "amplitude": 0.05, "duration_s": 0.3, "onset_s": 0.2},
    "steps": {"kind": "steps", "amplitude": 0.1, "move_s": 0.3, "rest_s": 0.05, "moves": 1},
}
"""References as short as can be: a second of standing, then a moment of motion."""
INFO_KEYS = {
    "time_s",
    "reference_angle",
    "link_angle",
    "link_angle_imu",
    "link_error",
    "link_error_imu",
    "deflection",
    "joint_torque",
    "servo_error",
    "command_rate",
    "rest",
    "clipped",
    "reward_terms",
    "termination",
}


@pytest.fixture(autouse=True)
def _log_of_mujoco_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes its warnings of a divergence into the working directory."""
    monkeypatch.chdir(tmp_path)


def random_actions(steps: int, worlds: int, seed: int = 0) -> Array:
    """Offsets that change at every step and sometimes exceed the bounds, (steps, worlds, 1)."""
    return np.random.default_rng(seed).uniform(-0.02, 0.02, (steps, worlds, 1)).astype(np.float32)


def episode(env: ElasticEnv, seed: int, actions: Array) -> list[tuple[Any, ...]]:
    """Reset, then steps until the end or until the actions are used up; what each of them
    returned."""
    log: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    for action in actions:
        log.append(env.step(action))
        if log[-1][2] or log[-1][3]:
            break
    return log


def break_world(env: Any, world: int = 0, value: float = np.nan) -> None:
    """Put a bad number where MuJoCo will find it."""
    env.unwrapped.simulation.qvel[world, -1] = value


# --------------------------------------------------------------------------------------------------
# Contracts of Gymnasium and Stable-Baselines3
# --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_gymnasium_check_env() -> None:
    """Catches spaces, dtypes, seeding and return types that are not Gymnasium's, with what
    test_gymnasium.py leaves out."""
    env = gymnasium.make(ID, observe_link=True, scenario="sensor", reference="multisine")
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("reference", "scenario"),
    [
        ("multisine", "sensor"),
        *(
            pytest.param(reference, scenario, marks=pytest.mark.slow)
            for reference in SHORT
            for scenario in ("nominal", "sensor")
            if (reference, scenario) != ("multisine", "sensor")
        ),
    ],
)
def test_same_seed_same_rollout_and_other_seed_another(reference: str, scenario: str) -> None:
    """Catches randomness outside the seed, and a seed that is ignored."""
    actions = random_actions(100, 1)[:, 0]
    first, again, other = (
        episode(
            make_testbed(reference=SHORT[reference], scenario=scenario, observe_link=True),
            seed,
            actions,
        )
        for seed in (3, 3, 4)
    )
    assert_equal(first, again)
    assert any(not np.array_equal(a[0], b[0]) for a, b in zip(first, other, strict=False))


def test_episodes_of_one_environment_follow_from_its_first_seed() -> None:
    """Catches a second episode that depends on how the first one ended, or that repeats it."""
    first = []
    second = []
    for steps in (5, 90):
        env = make_testbed(reference=SHORT["multisine"], scenario="sensor", observe_link=True)
        first.append(episode(env, 7, random_actions(steps, 1)[:, 0])[0])
        second.append(env.reset())
    assert_equal(first[0], first[1])
    assert_equal(second[0], second[1])
    assert not np.array_equal(first[0][0], second[0][0])


def assert_equal(a: Any, b: Any, path: str = "") -> None:
    """Exact equality of nested results, nan equal to nan."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), path
        for key in a:
            assert_equal(a[key], b[key], f"{path}[{key!r}]")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), path
        for i in range(len(a)):
            assert_equal(a[i], b[i], f"{path}[{i}]")
    else:
        np.testing.assert_array_equal(a, b, err_msg=path)


@pytest.mark.parametrize("vector", [False, True])
def test_spaces_describe_what_the_environment_takes_and_gives(vector: bool) -> None:
    """Catches a dtype or shape that changes between space, reset and step."""
    arguments = {"reference": SHORT["sine"], "observe_link": True}
    env: Any = make_testbed_vector(num_envs=3, **arguments) if vector else make_testbed(**arguments)
    observation, _ = env.reset(seed=0)
    assert env.action_space.dtype == np.float32
    np.testing.assert_allclose(
        np.abs([env.action_space.low, env.action_space.high]), 0.3, rtol=1e-6
    )
    for _ in range(3):
        assert observation.dtype == np.float64
        assert env.observation_space.contains(observation)
        assert np.isfinite(observation).all()
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    if vector:
        assert reward.shape == terminated.shape == truncated.shape == (3,)
        assert terminated.dtype == truncated.dtype == np.bool_
    else:
        assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)


@pytest.mark.parametrize("vector", [False, True])
def test_results_are_fresh_and_writing_to_them_changes_nothing(vector: bool) -> None:
    """Catches observations, infos, truths or kept actions that are views of the live state."""
    logs = []
    for spoil in (False, True):
        arguments = {"reference": SHORT["sine"], "scenario": "sensor", "observe_link": True}
        env: Any = (
            make_testbed_vector(num_envs=2, **arguments) if vector else make_testbed(**arguments)
        )
        actions = random_actions(20, 2) if vector else random_actions(20, 1)[:, 0]
        results: list[Any] = [env.reset(seed=0)]
        kept = [copy.deepcopy(results[0])]
        for action in actions:
            given = action.copy()
            results.append(env.step(given))
            kept.append(copy.deepcopy(results[-1]))
            if spoil:
                truth = [
                    value for value in vars(env.truth()).values() if isinstance(value, np.ndarray)
                ]
                spoil_arrays([results[-1], given, truth])
        if not spoil:
            assert_equal(results, kept)
        logs.append(kept)
    assert_equal(logs[0], logs[1])


def spoil_arrays(result: Any) -> None:
    """Overwrite every array of numbers in nested results."""
    if isinstance(result, np.ndarray):
        if result.dtype.kind == "f":
            result[...] = np.nan
    elif isinstance(result, dict | list | tuple):
        for value in result.values() if isinstance(result, dict) else result:
            spoil_arrays(value)


def test_no_column_of_the_observation_is_constant() -> None:
    """Catches a column that is never filled, or always the same."""
    env = make_testbed(reference=SHORT["multisine"], observe_link=True)
    log = episode(env, 0, random_actions(400, 1)[:, 0])
    columns = np.array([entry[0] for entry in log])
    names = env.task.observation_table.names
    assert [
        name for name, spread in zip(names, np.ptp(columns, axis=0), strict=True) if spread == 0.0
    ] == []


def test_docstring_of_the_module_is_the_table_of_signals() -> None:
    """Catches a table in the documentation that names, orders or measures the columns otherwise
    than the code."""
    table = make_testbed(observe_link=True).task.observation_table
    rows, info = documented_tables(testbed.__doc__ or "")
    documented = [(int(column), name.strip("`"), unit) for column, name, unit, _ in rows]
    assert documented == [(i, signal.name, signal.unit) for i, signal in enumerate(table)]
    assert make_testbed().task.observation_table.names == table.names[:-1]
    bound = make_testbed().task.action_table.signals[0]
    assert f"[{bound.unit}], within ±{bound.high}" in (testbed.__doc__ or "")
    env: Any = gymnasium.make("elastic_env/Testbed-v0", reference="sine")
    env.reset(seed=0)
    assert info == {*env.step(np.zeros(1, np.float32))[4], "episode_metrics"}


# --------------------------------------------------------------------------------------------------
# One world and many
# --------------------------------------------------------------------------------------------------


class Pair:
    """The vector environment beside Gymnasium's own vectorisation of the scalar one."""

    def __init__(self, num_envs: int, mode: AutoresetMode, **arguments: Any) -> None:
        self.many = make_testbed_vector(num_envs, autoreset_mode=mode, **arguments)
        self.single = SyncVectorEnv(
            [lambda: make_testbed(**arguments)] * num_envs, autoreset_mode=mode
        )

    def reset(self, **arguments: Any) -> None:
        """Reset both and compare."""
        expected = self.single.reset(**copy.deepcopy(arguments))
        result = self.many.reset(**arguments)
        np.testing.assert_array_equal(result[0], expected[0])
        assert_info_of_rows(result[1], expected[1], self.many.num_envs)

    def step(self, actions: Array) -> tuple[Any, ...]:
        """Step both and compare, exactly."""
        expected = self.single.step(actions)
        result = self.many.step(actions)
        for part, (result_part, wanted) in enumerate(zip(result[:4], expected[:4], strict=True)):
            np.testing.assert_array_equal(result_part, wanted, err_msg=f"part {part} of the result")
        assert_info_of_rows(result[4], expected[4], self.many.num_envs)
        return result

    def break_world(self, world: int, value: float) -> None:
        """Put a bad number into the same world of both."""
        break_world(self.many, world, value)
        break_world(self.single.envs[world], 0, value)


def assert_info_of_rows(
    info: dict[str, Any], expected: dict[str, Any], num_envs: int, path: str = "info"
) -> None:
    """Everything that the scalar environments say stands in the vector's info, in the row of the
    same world."""
    for key, values in expected.items():
        if key.startswith("_"):
            continue
        assert key in info, f"{path}[{key!r}] is missing"
        rows = np.flatnonzero(expected[f"_{key}"])
        if isinstance(values, dict):
            assert_info_of_rows(info[key], values, num_envs, f"{path}[{key!r}]")
            continue
        for row in rows:
            np.testing.assert_array_equal(
                info[key][row], values[row], err_msg=f"{path}[{key!r}][{row}]"
            )
        if f"_{key}" in info:
            np.testing.assert_array_equal(
                info[f"_{key}"], expected[f"_{key}"], err_msg=f"{path}['_{key}']"
            )


@pytest.mark.parametrize(
    ("reference", "scenario", "mode"),
    [  # every pair of two of them
        pytest.param("hold", "nominal", AutoresetMode.NEXT_STEP, marks=pytest.mark.slow),
        pytest.param("hold", "sensor", AutoresetMode.SAME_STEP, marks=pytest.mark.slow),
        ("sine", "nominal", AutoresetMode.SAME_STEP),
        pytest.param("sine", "sensor", AutoresetMode.NEXT_STEP, marks=pytest.mark.slow),
        pytest.param("multisine", "nominal", AutoresetMode.NEXT_STEP, marks=pytest.mark.slow),
        pytest.param("multisine", "sensor", AutoresetMode.SAME_STEP, marks=pytest.mark.slow),
        pytest.param("steps", "nominal", AutoresetMode.SAME_STEP, marks=pytest.mark.slow),
        pytest.param("steps", "sensor", AutoresetMode.NEXT_STEP, marks=pytest.mark.slow),
    ],
)
def test_vector_environment_is_the_scalar_one_row_by_row(
    reference: str, scenario: str, mode: AutoresetMode
) -> None:
    """Catches any rule that one of the faces has and the other has not, to the last bit, also
    across autoreset."""
    pair = Pair(2, mode, reference=SHORT[reference], scenario=scenario, observe_link=True)
    pair.reset(seed=11)
    steps = pair.many.task.num_steps + 20
    ended = 0
    for actions in random_actions(steps, 2, seed=5):
        ended += int(pair.step(actions)[3].sum())
    assert ended == 2


@pytest.mark.parametrize(
    "mode",
    [  # those of the walker end in both ways
        AutoresetMode.NEXT_STEP,
        pytest.param(AutoresetMode.SAME_STEP, marks=pytest.mark.slow),
    ],
)
def test_worlds_that_end_at_different_times_keep_apart(mode: AutoresetMode) -> None:
    """Catches an end in one world that shows in the results of another: masks of reset,
    truncation and divergence."""
    moment = {"kind": "multisine", "amplitude": 0.02, "duration_s": 0.1, "onset_s": 0.1}
    pair = Pair(3, mode, reference=moment, scenario="sensor", observe_link=True)
    pair.reset(seed=[5, 6, 5])
    ends = np.zeros(3, dtype=int)
    for k, actions in enumerate(random_actions(pair.many.task.num_steps + 40, 3, seed=6)):
        if k == 10:
            mask = np.array([True, True, False])
            pair.reset(seed=[None, 4, None], options={"reset_mask": mask})
        if k in (30, 33):
            pair.break_world(1 if k == 30 else 2, np.nan if k == 30 else 1e12)
        result = pair.step(actions)
        ends += result[2] | result[3]
    assert ends.tolist() == [1, 2, 2]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_a_world_that_diverges_starts_anew_and_lives_on(value: float) -> None:
    """Catches a warning counter that is never cleared: the world would end at every step from
    then on."""
    env = make_testbed_vector(3, reference=SHORT["multisine"])
    env.reset(seed=0)
    break_world(env, 1, value)
    actions = np.zeros((3, 1), dtype=np.float32)
    observation, reward, terminated, truncated, info = env.step(actions)
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert info["termination"].tolist() == ["", "diverged", ""]
    assert np.isfinite(observation).all()
    assert np.isfinite(reward).all()
    for _ in range(5):
        observation, reward, terminated, truncated, info = env.step(actions)
        assert not (terminated | truncated).any()
        assert np.isfinite(observation).all()
        assert info["termination"].tolist() == ["", "", ""]


def test_results_depend_neither_on_threads_nor_on_the_number_of_worlds() -> None:
    """Catches a world whose noise, start or physics depends on its neighbours or on who computes
    it."""
    actions = random_actions(30, 16, seed=2)
    logs = {}
    for num_envs, num_threads in [(16, 1), (16, 2), (7, 1), (7, 2), (1, 1)]:
        env = make_testbed_vector(
            num_envs,
            num_threads=num_threads,
            reference=SHORT["multisine"],
            scenario="sensor",
            observe_link=True,
        )
        log = [env.reset(seed=100)[0]]
        log += [env.step(action[:num_envs])[0] for action in actions]
        logs[num_envs, num_threads] = np.array(log)
    np.testing.assert_array_equal(logs[16, 2], logs[16, 1])
    for num_envs, num_threads in [(7, 1), (7, 2), (1, 1)]:
        np.testing.assert_array_equal(logs[num_envs, num_threads], logs[16, 1][:, :num_envs])


def test_make_and_make_vec_find_the_environments() -> None:
    """Catches a registration that points elsewhere, and arguments that do not arrive."""
    env = gymnasium.make(ID, scenario="ideal", reference=SHORT["sine"], render_mode=None)
    assert isinstance(env.unwrapped, ElasticEnv)
    assert env.unwrapped.task.config.scenario.name == "ideal"
    many = gymnasium.make_vec(
        ID,
        num_envs=5,
        vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep",
        scenario="soft",
    )
    assert isinstance(many.unwrapped, ElasticVectorEnv)
    assert many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert many.unwrapped.assumed_model.stiffness.tolist() == [1001.0]
    assert many.unwrapped.truth().model.stiffness.tolist() == pytest.approx([0.7 * 1001.0])


# --------------------------------------------------------------------------------------------------
# Physics and scores
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reference", "scenario"),
    [
        pytest.param(
            reference,
            scenario,
            marks=[pytest.mark.slow] * (reference != "raised" and scenario != "backlash"),
        )
        for reference in (*SHORT, "raised")
        for scenario in (
            *scenario_names(walks=False),
            "ideal+soft",
            "ideal+backlash",
            "ideal+sensor",
        )
    ],
)
def test_an_episode_starts_in_static_equilibrium(reference: str, scenario: str) -> None:
    """Catches a start with slack springs or an empty integrator: under zero action nothing may
    move."""
    raised = {"kind": "sine", "middle": 0.8, "amplitude": 0.1}
    env = make_testbed_vector(3, reference=SHORT.get(reference, raised), scenario=scenario)
    env.reset(seed=1)
    start = env.truth()
    for _ in range(25):
        env.step(np.zeros((3, 1), dtype=np.float32))
        truth = env.truth()
        assert np.abs(truth.q_dot).max() < 1e-9
        assert np.abs(truth.theta_dot).max() < 1e-9
    np.testing.assert_allclose(truth.q, start.q, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(truth.deflection, start.deflection, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("middle", [0.0, 0.0005, -0.000875, 0.0009, -0.02])
def test_the_start_is_at_rest_inside_and_outside_the_dead_band(middle: float) -> None:
    """Catches a link that hangs in the gear's play at an angle where nothing holds it."""
    env = make_testbed(reference={"kind": "steps", "middle": middle}, scenario="ideal+backlash")
    env.reset(seed=0)
    start = env.truth()
    for _ in range(50):
        env.step(np.zeros(1, dtype=np.float32))
    assert abs(env.truth().q - start.q) < 1e-12
    assert abs(start.joint_torque - 60.0 * np.sin(start.q)) < 1e-9


@pytest.mark.parametrize(
    ("scenario", "stiffness", "load", "play"),
    [
        ("ideal", 1001.0, 60.0, 0.0),
        ("ideal+soft", 0.7 * 1001.0, 60.0, 0.0),
        ("ideal+stiff", 1.3 * 1001.0, 60.0, 0.0),
        ("ideal+payload", 1001.0, 72.0, 0.0),
        ("ideal+soft+payload", 0.7 * 1001.0, 72.0, 0.0),
        ("ideal+backlash", 1001.0, 60.0, 1.75e-3 / 2),
    ],
)
@pytest.mark.parametrize("angle", [-0.9, 0.6])
def test_uncompensated_at_rest_the_link_error_is_the_deflection(
    scenario: str, stiffness: float, load: float, play: float, angle: float
) -> None:
    """Catches a wrong sign of the link error, a scenario that changes the wrong parameter, and a
    servo that droops."""
    env = make_testbed(
        reference={"kind": "sine", "middle": angle, "amplitude": 0.01}, scenario=scenario
    )
    env.reset(seed=0)
    for _ in range(20):
        info = env.step(np.zeros(1, dtype=np.float32))[4]
    torque = load * np.sin(info["link_angle"])
    assert info["link_error"] == pytest.approx(torque / stiffness + np.sign(angle) * play, abs=1e-9)
    assert info["link_error"] == pytest.approx(info["deflection"], abs=1e-9)
    assert info["joint_torque"] == pytest.approx(torque, abs=1e-7)
    assert info["servo_error"] == pytest.approx(0.0, abs=1e-9)


def test_the_exact_offset_brings_the_link_to_its_reference() -> None:
    """Catches an offset that acts on anything but θ_cmd: with τ_g(q_ref)/K the error at rest
    vanishes."""
    still = {"kind": "sine", "middle": -0.9, "amplitude": 1e-12}
    env = make_testbed(
        reference=still, scenario="ideal", joint=H54_200_S500_R.replace(damping=100.0)
    )
    env.reset(seed=0)
    offset = np.full(1, 60.0 * np.sin(-0.9) / 1001.0)
    for _ in range(500):
        info = env.step(offset)[4]
    assert info["deflection"] == pytest.approx(offset[0], abs=1e-7)
    assert abs(info["link_error"]) < 1e-7


@pytest.mark.parametrize("scenario", ["nominal", "sensor", "soft+payload"])
def test_reward_is_the_sum_of_its_terms_and_the_terms_are_the_documented_ones(
    scenario: str,
) -> None:
    """Catches a term that is missing in info, or computed from another quantity than it is named
    after."""
    env = make_testbed_vector(3, reference=SHORT["multisine"], scenario=scenario)
    env.reset(seed=0)
    weights = env.task.config.reward
    for actions in random_actions(40, 3):
        _, reward, _, _, info = env.step(actions)
        terms = info["reward_terms"]
        np.testing.assert_allclose(reward, sum(terms.values()), rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(
            terms["link_error"], -weights.link_error * np.abs(info["link_error"]), rtol=1e-14
        )
        np.testing.assert_allclose(
            terms["command_rate"], -weights.command_rate * np.abs(info["command_rate"]), rtol=1e-14
        )
        np.testing.assert_array_equal(terms["divergence"], 0.0)


def test_info_holds_the_documented_keys_and_they_agree_with_the_truth() -> None:
    """Catches a key that disappears, and a score that is computed from measurements instead of
    the truth."""
    env = make_testbed(reference=SHORT["multisine"], scenario="sensor")
    observation, info = env.reset(seed=2)
    assert set(info) == INFO_KEYS - {"clipped", "reward_terms", "termination"}
    before = 0.0
    for k, action in enumerate(random_actions(370, 1)[:, 0]):
        reference = observation[2]
        observation, _, _, _, info = env.step(action)
        truth = env.truth()
        assert set(info) == INFO_KEYS
        assert info["time_s"] == pytest.approx((k + 1) * PERIOD_S)
        assert info["reference_angle"] == reference
        assert info["link_angle"] == truth.q[0, 0]
        assert info["link_error"] == reference - truth.q[0, 0]
        assert info["link_error_imu"] == reference - info["link_angle_imu"]
        assert info["deflection"] == truth.theta[0, 0] - truth.q[0, 0]
        rate = truth.theta_dot[0, 0] - truth.q_dot[0, 0]
        assert info["joint_torque"] == pytest.approx(
            1001.0 * info["deflection"] + 10.0 * rate, abs=1e-9
        )
        assert info["command_rate"] == pytest.approx(
            (float(action[0]) - before) / PERIOD_S, abs=1e-12
        )
        assert info["termination"] == ""
        before = float(action[0])


@pytest.mark.parametrize("reference", list(SHORT))
def test_episode_metrics_are_those_of_the_recorded_signals(reference: str) -> None:
    """Catches samples of standing or of the episode before in the scores, and a wrong statistic
    under a right name."""
    env = make_testbed(reference=SHORT[reference], scenario="sensor")
    episode(env, 0, random_actions(30, 1)[:, 0])  # left half-way: must not show in the next
    plan = env.task.config.reference.plan(np.random.default_rng(0), PERIOD_S)
    log = episode(env, 1, random_actions(plan.num_steps, 1, seed=9)[:, 0])[1:]
    assert len(log) == plan.num_steps == env.task.num_steps
    assert log[-1][3]
    assert not any("episode_metrics" in entry[4] for entry in log[:-1])
    recorded = {
        key: np.array([entry[4][key] for entry in log])
        for key in INFO_KEYS - {"reward_terms", "termination"}
    }
    scored = plan.scored[1:]
    assert 0 < scored.sum() < len(log)
    statistics = {
        "rms": lambda x: np.sqrt(np.mean(x**2)),
        "peak": lambda x: np.abs(x).max(),
        "min": np.min,
        "max": np.max,
        "mean": np.mean,
    }
    metrics = log[-1][4]["episode_metrics"]
    assert metrics.pop("diverged") is False
    assert set(metrics) == {metric.name for metric in env.task.metrics}
    for metric in env.task.metrics:
        values = recorded[metric.signal][scored if metric.over == "scored" else slice(None)]
        assert metrics[metric.name] == pytest.approx(
            statistics[metric.statistic](values), rel=1e-9, abs=1e-15
        ), metric


def test_names_of_metrics_end_with_their_unit() -> None:
    """Catches a figure in a table that nobody can read: rad or rad/s, N·m, or a share."""
    names = [metric.name for metric in make_testbed().task.metrics]
    assert len(set(names)) == len(names)
    assert [name for name in names if not name.endswith(("_rad", "_rad_s", "_nm", "_share"))] == []
    required = {f"link_error_{statistic}_rad" for statistic in ("rms", "peak", "min", "max")}
    assert required <= set(names)


# --------------------------------------------------------------------------------------------------
# Measurements
# --------------------------------------------------------------------------------------------------


def test_in_ideal_the_observation_is_the_truth() -> None:
    """Catches noise, counts or delay where there should be none, and columns in another order
    than the table's."""
    reference = Sine(**SHORT["sine"])
    env = make_testbed(reference=reference, scenario="ideal", observe_link=True)
    plan = reference.plan(np.random.default_rng(0), PERIOD_S)
    actions = random_actions(plan.num_steps, 1)[:, 0]
    env.reset(seed=0)
    before = env.truth().theta[0, 0]
    for k, action in enumerate(actions[:-1]):
        observation = env.step(action)[0]
        truth = env.truth()
        theta = truth.theta[0, 0]
        expected = [
            theta,
            (theta - before) / PERIOD_S,
            plan.q[k + 2],
            plan.q_dot[k + 2],
            plan.q_ddot[k + 2],
            plan.q[k + 1] + float(action[0]),
        ]
        np.testing.assert_allclose(observation[:6], expected, rtol=0.0, atol=1e-12)
        before = theta
        if (k + 1) % 5 == 0:  # 100 Hz beside 250 Hz
            assert observation[6] == truth.q[0, 0]


def test_in_nominal_the_encoder_counts_and_the_imu_is_biased_and_noisy() -> None:
    """Catches counts of the wrong size, an IMU that is sampled too often, and noise of the wrong
    size."""
    env = make_testbed(
        reference={"kind": "sine", "amplitude": 0.3, "duration_s": 5.0}, observe_link=True
    )
    log = episode(env, 0, np.zeros((2000, 1), dtype=np.float32))
    observations = np.array([entry[0] for entry in log])
    step = 2.0 * np.pi / ENCODER_COUNTS_PER_TURN
    counts = observations[:, 0] / step
    np.testing.assert_allclose(counts, np.round(counts), rtol=0.0, atol=1e-6)
    theta = np.array([entry[-1]["link_angle"] + entry[-1]["deflection"] for entry in log])
    error = observations[:, 0] - theta
    assert np.abs(error).max() <= step / 2 * (1 + 1e-9)
    assert np.abs(error).max() > step / 4
    imu_error = observations[:, 6] - np.array([entry[-1]["link_angle"] for entry in log])
    fresh = np.r_[True, np.diff(observations[:, 6]) != 0.0]
    assert fresh.mean() == pytest.approx(0.4, abs=1e-3)
    errors = imu_error[fresh]
    imu = make_scenario("nominal").imu
    assert errors.mean() == pytest.approx(
        imu.bias_rad, abs=5 * imu.noise_rad / np.sqrt(len(errors))
    )
    assert errors.std() == pytest.approx(imu.noise_rad, rel=5 / np.sqrt(2 * len(errors)))


def test_in_sensor_measurements_are_one_control_step_old_and_homed_with_an_error() -> None:
    """Catches a delay of two steps or none, a rate that is not that of the angles shown, and a
    bias that wanders."""
    env = make_testbed(reference=SHORT["multisine"], scenario="sensor", observe_link=True)
    log = episode(env, 3, random_actions(400, 1)[:, 0])
    observations = np.array([entry[0] for entry in log])
    theta = np.array([entry[-1]["link_angle"] + entry[-1]["deflection"] for entry in log])
    step = 2.0 * np.pi / ENCODER_COUNTS_PER_TURN
    bias = observations[1:, 0] - theta[:-1]
    assert np.ptp(bias) <= step * (1 + 1e-9)
    assert 1e-5 < abs(bias.mean()) <= make_scenario("sensor").homing_rad[1]
    assert np.ptp(observations[:, 0] - theta) > 5 * step  # without the delay it would not fit
    np.testing.assert_allclose(
        observations[1:, 1], np.diff(observations[:, 0]) / PERIOD_S, rtol=0.0, atol=1e-12
    )


def test_biases_of_the_worlds_are_spread_over_their_interval() -> None:
    """Catches one bias for all worlds, one-sided biases, and half the documented width."""
    env = make_testbed_vector(200, scenario="sensor", observe_link=True)
    observation, info = env.reset(seed=0)
    scenario = make_scenario("sensor")
    encoder = observation[:, 0] - (info["link_angle"] + info["deflection"])
    imu = observation[:, 6] - info["link_angle"] - scenario.imu.bias_rad
    for bias, width, noise in [
        (encoder, scenario.homing_rad[1], 1e-5),
        (imu, scenario.mounting_rad[1], 4 * scenario.imu.noise_rad),
    ]:
        assert np.abs(bias).max() <= width + noise
        assert bias.max() > 0.9 * width
        assert bias.min() < -0.9 * width
        assert abs(bias.mean()) < 5 * width / np.sqrt(3 * 200)
    assert abs(np.corrcoef(encoder, imu)[0, 1]) < 0.3


# --------------------------------------------------------------------------------------------------
# Actions
# --------------------------------------------------------------------------------------------------


@cache
def pair_of_testbeds() -> tuple[Any, ...]:
    """Two of the same, which every example resets."""
    return tuple(make_testbed(reference=SHORT["sine"], scenario="ideal") for _ in range(2))


@settings(max_examples=20)
@given(action=st.floats(-5.0, 5.0, width=32))
def test_actions_beyond_the_bounds_act_as_the_bounds_and_are_counted(action: float) -> None:
    """Catches clipping that is missing, silent or off by the rounding of float32."""
    bound = float(np.float32(0.3))
    env, clipped = pair_of_testbeds()
    env.reset(seed=0)
    clipped.reset(seed=0)
    result = env.step(np.array([action], dtype=np.float32))
    expected = clipped.step(np.clip(np.array([action], dtype=np.float32), -bound, bound))
    assert_equal(result[:4], expected[:4])
    assert result[4]["clipped"] == float(abs(action) > bound)
    assert expected[4]["clipped"] == 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_names_value_bounds_and_shape(value: float) -> None:
    """Catches NaN that reaches the physics, where it would look like a divergence."""
    env = make_testbed(reference=SHORT["sine"])
    env.reset(seed=0)
    with pytest.raises(
        ActionError, match=rf"finite, within ±0\.3 rad, shape \(1,\).* got \[ *{value}\]"
    ):
        env.step(np.array([value], dtype=np.float32))
    many = make_testbed_vector(4, reference=SHORT["sine"])
    many.reset(seed=0)
    actions = np.zeros((4, 1), dtype=np.float32)
    actions[2] = value
    with pytest.raises(
        ActionError, match=rf"finite, within ±0\.3 rad.* got \[ *{value}\] in world 2"
    ):
        many.step(actions)


@pytest.mark.parametrize("shape", [(), (2,), (0,), (1, 1)])
def test_an_action_of_wrong_shape_names_the_right_one(shape: tuple[int, ...]) -> None:
    """Catches broadcasting of actions that were meant otherwise."""
    env = make_testbed(reference=SHORT["sine"])
    env.reset(seed=0)
    with pytest.raises(ActionError) as error:
        env.step(np.zeros(shape, dtype=np.float32))
    assert "shape (1,) [rad], within ±0.3 rad" in str(error.value)
    assert f"got shape {shape}" in str(error.value)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (1, 1), (3, 1), (4, 2), (4, 1, 1)])
def test_actions_of_wrong_shape_name_the_right_one(shape: tuple[int, ...]) -> None:
    """Catches one action that is silently given to all worlds, and NumPy's error in place of
    ours."""
    env = make_testbed_vector(4, reference=SHORT["sine"])
    env.reset(seed=0)
    with pytest.raises(ActionError) as error:
        env.step(np.zeros(shape, dtype=np.float32))
    assert "shape (4, 1) [rad], within ±0.3 rad" in str(error.value)
    assert f"got shape {shape}" in str(error.value)


# --------------------------------------------------------------------------------------------------
# Divergence
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_divergence_ends_the_episode_with_its_reason(value: float) -> None:
    """Catches MuJoCo's silent reset, and NaN in what the policy sees."""
    env = make_testbed(reference=SHORT["multisine"], observe_link=True)
    env.reset(seed=0)
    for action in random_actions(10, 1)[:, 0]:
        env.step(action)
    break_world(env, 0, value)
    observation, reward, terminated, truncated, info = env.step(np.zeros(1, dtype=np.float32))
    assert (terminated, truncated) == (True, False)
    assert info["termination"] == "diverged"
    assert info["reward_terms"]["divergence"] == -env.task.config.reward.divergence
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    assert all(np.isfinite(v) for v in info.values() if isinstance(v, float))
    assert info["episode_metrics"]["diverged"] is True
    observation, _ = env.reset(seed=1)
    result = env.step(np.zeros(1, dtype=np.float32))
    assert not result[2]
    assert result[4]["termination"] == ""


def test_an_unstable_plant_diverges_by_itself() -> None:
    """Catches a divergence that only a written NaN would trigger: a spring far too stiff for the
    physics step."""
    env = make_testbed(reference=SHORT["steps"], scenario="ideal")
    env.reset(seed=0)
    env.simulation.vary("tendon_stiffness")[:] = 1e9
    for _ in range(200):
        observation, reward, terminated, _, info = env.step(np.full(1, 0.2, dtype=np.float32))
        assert np.isfinite(observation).all()
        assert np.isfinite(reward)
        if terminated:
            break
    assert terminated
    assert info["termination"] == "diverged"


# --------------------------------------------------------------------------------------------------
# Arguments
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"scenario": "nominl"},
            r"unknown scenario 'nominl'; choose one of: ideal, nominal, soft, .*'nominal'",
        ),
        (
            {"scenario": "ideal+sof"},
            (
                r"unknown scenario 'sof'; choose one of: ideal, nominal, soft, stiff, spread,"
                r" payload, backlash"
            ),
        ),
        ({"scenario": ""}, r"unknown scenario ''; choose one of: ideal"),
        (
            {"scenario": "soft+ideal"},
            r"'soft\+ideal': 'ideal' is a ground and can only stand first",
        ),
        (
            {"reference": "sin"},
            r"unknown reference 'sin'; choose one of: hold, sine, multisine, steps.*'sine'",
        ),
        ({"reference": {"amplitude": 1.0}}, r"unknown reference None; choose one of: hold, sine"),
        (
            {"reference": {"kind": "sine", "amp": 1}},
            r"unknown parameter of Sine 'amp'; choose one of: .*amplitude",
        ),
        ({"form": "tendons"}, r"form must be 'tendon' or 'rigid', got 'tendons'"),
        ({"form": "series"}, r"form must be 'tendon' or 'rigid', got 'series'"),
        ({"render_mode": "ascii"}, r"unknown render mode 'ascii'; choose one of: rgb_array, human"),
        (
            {"stiffness": -5.0},
            r"ElasticJoint\.stiffness must be a finite number > 0 \[N·m/rad\], got -5",
        ),
        (
            {"stiffness": 0},
            r"ElasticJoint\.stiffness must be a finite number > 0 \[N·m/rad\], got 0",
        ),
        (
            {"stiffness": float("nan")},
            r"ElasticJoint\.stiffness must be .*finite.*\[N·m/rad\], got nan",
        ),
        (
            {"stiffness": "no/such/identification.json"},
            r"number \[N·m/rad\] or an identification file, found no file no/",
        ),
        (
            {"reference": {"kind": "sine", "amplitude": -1.0}},
            r"Sine\.amplitude must be a finite number > 0 and < 3\.14159 \[rad\], got -1",
        ),
        (
            {"reference": {"kind": "hold", "settle_s": -1}},
            r"Hold\.settle_s must be a finite number >= 0 and",
        ),
        (
            {"reference": {"kind": "multisine", "components": 1}},
            r"Multisine\.components must be a whole number >= 2",
        ),
        ({"reference": {"kind": "steps", "seed": -1}}, r"Steps\.seed must be a whole number >= 0"),
        ({"reference": 3}, r"a reference is a name, a mapping or a model, got int"),
        (
            {"reference": {"kind": "sine", "frequency_hz": 20.0}},
            r"'sine' can need .* N·m of a servo limited to 84",
        ),
        ({"joint": H54_200_S500_R.replace(servo=None)}, r"needs a servo, got None"),
    ],
)
def test_a_wrong_argument_names_itself_and_what_exists(
    arguments: dict[str, Any], message: str
) -> None:
    """Catches an argument that is ignored, and an error that sends the user into the source."""
    with pytest.raises(ConfigurationError, match=message):
        make_testbed(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"autoreset_mode": "Next"},
            r"unknown autoreset mode 'Next'; choose one of: NextStep, SameStep, Disabled",
        ),
        ({"num_envs": 0}, r"num_envs must be a whole number >= 1, got 0"),
        (
            {"render_mode": "human"},
            r"unknown render mode of a vector environment 'human'; choose one of: rgb_array",
        ),
    ],
)
def test_a_wrong_argument_of_the_vector_environment_names_itself(
    arguments: dict[str, Any], message: str
) -> None:
    """Catches the same for the arguments that only many worlds have."""
    with pytest.raises(ConfigurationError, match=message):
        make_testbed_vector(**arguments)


def test_a_list_of_seeds_needs_one_per_world() -> None:
    """Catches seeds that are dropped or reused."""
    env = make_testbed_vector(3)
    with pytest.raises(ConfigurationError, match="one seed per world, 3, got 2"):
        env.reset(seed=[1, 2])
    for seed in ([1, 2, "three"], [1, 2, 2.5]):
        with pytest.raises(ConfigurationError, match=r"must be a whole number, one per .* \[1, 2,"):
            env.reset(seed=seed)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"control_period_s": 0.0},
            r"TestbedConfig\.control_period_s must be a finite number > 0 \[s\], got 0",
        ),
        (
            {"timestep_s": -1e-3},
            r"TestbedConfig\.timestep_s must be a finite number > 0 \[s\], got -0\.001",
        ),
        (
            {"timestep_s": 3e-4},
            r"timestep_s must divide the control period of 0\.004 s, got 0\.0003 s",
        ),
        (
            {"perod": 1.0},
            r"unknown parameter of TestbedConfig 'perod'; choose one of: .*control_period_s",
        ),
        (
            {"pendulum": {"mass": -1.0}},
            r"TestbedConfig\.pendulum\.mass must be a finite number >= 0\.001 and <= 10000 \[kg\], got -1",
        ),
        (
            {"pendulum": {"mas": 1.0}},
            r"unknown parameter of pendulum 'mas'; choose one of: gravity_torque, mass",
        ),
        (
            {"reference": {"kind": "sine", "amplitude": -1.0}},
            (
                r"TestbedConfig\.reference\.amplitude must be a finite number > 0 and < 3\.14159"
                r" \[rad\], got -1"
            ),
        ),
        ({"reference": {"kind": "sin"}}, r"(?s)reference.*sin.*hold.*sine.*multisine.*steps"),
        (
            {"joint": {"stiffness": float("nan"), "rotor_inertia": 1.0}},
            r"TestbedConfig\.joint\.stiffness .*finite.*N·m/rad.*nan",
        ),
        ({"form": "tendons"}, r"TestbedConfig\.form must be 'tendon' or 'rigid', got 'tendons'"),
    ],
)
def test_a_wrong_configuration_names_parameter_unit_and_bound(
    values: dict[str, Any], message: str
) -> None:
    """Catches errors of nested models that lose the name, the unit or the choices on their way
    up."""
    with pytest.raises(ConfigurationError, match=message):
        testbed.JointTask(TestbedConfig(**values), 1)


def test_stiffness_can_come_from_an_identification(tmp_path: Path) -> None:
    """Catches a file whose K is read and not used, and a file of another kind that is taken for
    one."""
    file = tmp_path / "identification.json"
    file.write_text(json.dumps({"stiffness_nm_per_rad": 987.0}))
    assert make_testbed(stiffness=file).assumed_model.stiffness.tolist() == [987.0]
    for content in ("{}", "[]", "no json", '{"stiffness_nm_per_rad": null}'):
        file.write_text(content)
        with pytest.raises(ConfigurationError, match=r"is no identification.*stiffness_nm_per_rad"):
            make_testbed(stiffness=str(file))
    file.write_text(" " * 1_000_001)
    with pytest.raises(ConfigurationError, match=r"identification\.json must have at most 1000000"):
        make_testbed(stiffness=file)
    file.write_text('{"stiffness_nm_per_rad": NaN}')
    with pytest.raises(ConfigurationError, match="stiffness"):
        make_testbed(stiffness=str(file))


def test_the_assumed_model_does_not_know_the_scenario() -> None:
    """Catches a compensator that is told the true stiffness or mass."""
    assumed, nominal = (
        make_testbed(scenario=name).assumed_model for name in ("soft+payload+backlash", "ideal")
    )
    for parameter in (
        "stiffness",
        "damping",
        "rotor_inertia",
        "backlash",
        "coulomb_friction",
        "viscous_friction",
    ):
        np.testing.assert_array_equal(
            getattr(assumed, parameter), getattr(nominal, parameter), err_msg=parameter
        )
    np.testing.assert_array_equal(assumed.rigid.body_mass, nominal.rigid.body_mass)


def test_a_second_of_standing_comes_first_and_is_not_scored() -> None:
    """Catches policies that are scored while they ramp in."""
    for name, reference in SHORT.items():
        plan = make_testbed(reference=reference).task.config.reference.plan(
            np.random.default_rng(0), PERIOD_S
        )
        standing = round(STAND_S / PERIOD_S)
        np.testing.assert_array_equal(plan.q[: standing + 1], plan.q[0], err_msg=name)
        assert not plan.scored[: standing + 1].any(), name


def test_the_rigid_form_has_no_deflection() -> None:
    """Catches a rigid testbed that still bends, or whose motor and link angles are read from
    different places."""
    env = make_testbed(reference=SHORT["sine"], scenario="ideal", form="rigid")
    for entry in episode(env, 0, random_actions(60, 1)[:, 0]):
        assert entry[-1]["deflection"] == 0.0
    assert abs(entry[-1]["link_angle"]) > 1e-4


def test_defaults_are_those_of_the_paper() -> None:
    """Catches a default that drifts: the robot, the experiment and the control rate of the
    paper."""
    config = make_testbed().task.config
    assert isinstance(config.reference, Hold)
    assert config.scenario.name == "nominal"
    assert (config.joint.stiffness, config.joint.rotor_inertia, config.joint.coulomb_friction) == (
        1001.0,
        0.839,
        5.4,
    )
    assert config.joint.servo == H54_200_S500_R.servo
    assert isinstance(config.joint.servo, Servo)
    assert config.joint.servo.torque_limit == 84.0
    assert config.pendulum == Pendulum(gravity_torque=60.0)
    assert 1.0 / config.control_period_s == pytest.approx(250.0)
    assert config.timestep_s <= 1.0 / 2000.0


@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_deep_copy_goes_on_as_the_original(num_envs: int) -> None:
    """Catches copies whose arrays are no longer those of the physics, and stand still."""
    env = make_testbed_vector(num_envs, reference="sine", scenario="nominal")
    env.reset(seed=0)
    action = np.full((num_envs, 1), 0.05, dtype=np.float32)
    for _ in range(20):
        env.step(action)
    twin = copy.deepcopy(env)
    for _ in range(60):
        expected = env.step(action)[0]
        observation = twin.step(action)[0]
    np.testing.assert_array_equal(observation, expected)
    assert np.abs(expected[:, 0]).min() > 0.01


def test_a_reference_without_a_scored_step_is_an_error() -> None:
    """Catches metrics that are nan without a word."""
    with pytest.raises(ConfigurationError, match="no scored control step"):
        make_testbed(reference={"kind": "sine", "duration_s": 1e-3})


def test_a_shorter_physics_step_changes_little() -> None:
    """Catches a timestep_s that is taken for another number of steps per control period, or not
    at all."""
    ends = []
    for timestep_s in (None, 2.5e-4):
        env: Any = gymnasium.make(
            "elastic_env/Testbed-v0", scenario="ideal", reference="sine", timestep_s=timestep_s
        )
        env.reset(seed=0)
        for _ in range(500):
            info = env.step(np.zeros(1, np.float32))[4]
        ends.append(
            (env.unwrapped.simulation.model.opt.timestep, info["time_s"], info["link_angle"])
        )
    (coarse, time_s, link), (fine, same_time_s, same_link) = ends
    assert (coarse, fine, time_s) == (5e-4, 2.5e-4, same_time_s)
    assert 0.0 < abs(link - same_link) < 1e-6


def test_the_step_that_residuals_are_trained_with_errs_by_little() -> None:
    """Catches steps so long that what is learned in them is another joint: 0.02 mrad, a
    hundredth of what is left."""
    links = []
    for timestep_s in (1e-3, 1e-4):
        env: Any = gymnasium.make(
            "elastic_env/Testbed-v0", reference="multisine", timestep_s=timestep_s
        )
        env.reset(seed=5)
        links.append([env.step(np.zeros(1, np.float32))[4]["link_angle"] for _ in range(500)])
    off = np.abs(np.subtract(*links))
    assert np.sqrt(np.square(off).mean()) < 5e-5
    assert off.max() < 2e-4
