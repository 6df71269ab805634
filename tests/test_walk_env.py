"""The walking environment: what any user of Gymnasium may rely on, and the physics and scores
that it promises."""

import copy
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.spatial.transform import Rotation

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ActionError, ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.joint_names import spring_name
from elastic_env.robots.thormang import config as walk_config
from elastic_env.robots.thormang import task as walk_in_place
from elastic_env.robots.thormang.config import BANK_SIZE, WalkConfig, WalkRewardWeights, robot_bank
from elastic_env.robots.thormang.environment import make as make_walk
from elastic_env.robots.thormang.environment import make_vector as make_walk_vector
from elastic_env.world.env import ElasticEnv
from elastic_env.world.scenario import make_scenario
from elastic_env.world.vector_env import ElasticVectorEnv
from elastic_env.world.walk_reward import distance_penalty, tilt_penalty
from tests.docstrings import documented_tables

ID = "elastic_env/WalkInPlace-v0"
SHORT: dict[str, Any] = {"step_period": [0.3, 0.5, 0.3], "num_steps": 1}
"""The shortest named step, once: a second of standing, 1.1 s of walking, a second of standing."""
WALK_BEGIN = 250
LIFT_OFF = 325
TOUCH_DOWN = 450
WALK_END = 525
NUM_STEPS = 775
"""Its control steps."""
PERIOD_S = WalkConfig().control_period_s
JOINTS = [
    f"{side}_{joint}"
    for side in "lr"
    for joint in ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
]
GRAVITY = 9.81
MASS_KG = 57.0
FOOT_MASS_KG = 1.616
STIFFNESS = 1001.0
FRICTION = 5.4
COUNTS_PER_TURN = 501_923
SCENARIOS = ["nominal", "spread", "push", "slope", "sensor"]
INFO_KEYS = {
    "time_s",
    "pelvis_roll",
    "pelvis_pitch",
    "pelvis_error",
    "pelvis_height",
    "zmp_x",
    "zmp_y",
    "zmp_reference_x",
    "zmp_reference_y",
    "zmp_deviation",
    "zmp_deviation_x",
    "zmp_deviation_y",
    "zmp_in_feet",
    "zmp_in_feet_x",
    "zmp_in_feet_y",
    "foot_drift",
    "foot_drift_x",
    "foot_drift_y",
    "link_error",
    "link_error_lowest",
    "link_error_highest",
    "deflection",
    "joint_torque",
    "servo_torque",
    "command_rate",
    "force_left",
    "force_right",
    "load_share",
    "swing",
    "single_support",
    "support",
    "position_error",
    "heading_error",
    "early_touchdown",
    "clipped",
    "reward_terms",
    "termination",
}


@pytest.fixture(autouse=True)
def _log_of_mujoco_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes its warnings of a divergence into the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module", autouse=True)
def _three_robots_are_enough() -> Iterator[None]:
    """It takes about half a second to find where a robot of the bank rests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(walk_config, "BANK_SIZE", 3)
        yield


def random_actions(steps: int, worlds: int, seed: int = 0, size: float = 0.01) -> Array:
    """Offsets that change at every step, (steps, worlds, 12)."""
    return (
        np.random.default_rng(seed)
        .uniform(-size, size, (steps, worlds, len(JOINTS)))
        .astype(np.float32)
    )


def zeros(*worlds: int) -> Array:
    """Actions that change nothing, (*worlds, 12)."""
    return np.zeros((*worlds, len(JOINTS)), dtype=np.float32)


def walk_env(**arguments: Any) -> ElasticEnv:
    """A short walk in one world, begun."""
    env = make_walk(**{**SHORT, **arguments})
    env.reset(seed=0)
    return env


def walk_worlds(num_envs: int, **arguments: Any) -> ElasticVectorEnv:
    """A short walk in many worlds."""
    return make_walk_vector(num_envs, **{**SHORT, **arguments})


def lean(
    env: Any, roll: float = 0.0, pitch: float = 0.0, world: int = 0, height_m: float = 0.0
) -> None:
    """Turn a robot about its pelvis, and lift it."""
    simulation = env.unwrapped.simulation
    simulation.qpos[world, 2] += height_m
    simulation.qpos[world, 3:7] = Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_quat(
        scalar_first=True
    )
    simulation.qvel[world] = 0.0


def break_world(env: Any, world: int = 0, value: float = np.nan) -> None:
    """Put a bad number where MuJoCo will find it."""
    env.unwrapped.simulation.qvel[world, -1] = value


def wrenches(env: Any) -> Array:
    """Force and moment of both feet on their legs by MuJoCo's sensors, (num_worlds, 12) [N],
    [N·m]."""
    return -np.array(env.unwrapped.simulation.bind("sensordata"))


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
    elif not (isinstance(a, float | str) and a == b):
        np.testing.assert_array_equal(a, b, err_msg=path)


def row_of(results: Any, world: int) -> Any:
    """What nested results say of one world, without Gymnasium's masks, as the scalar environment
    says it."""
    if isinstance(results, dict):
        return {
            key: row_of(value, world) for key, value in results.items() if not key.startswith("_")
        }
    if isinstance(results, tuple):
        return tuple(row_of(value, world) for value in results)
    return results[world]


@dataclass
class Recording:
    """An episode of one world step by step, row 0 the reset, and the truth beside it."""

    env: ElasticEnv
    results: list[tuple[Any, ...]] = field(default_factory=list)
    truths: list[Any] = field(default_factory=list)
    wrenches: list[Array] = field(default_factory=list)
    rates: list[Array] = field(default_factory=list)

    def take(self, result: tuple[Any, ...]) -> None:
        """Keep a result and the state that it is about."""
        self.results.append(result)
        self.truths.append(self.env.truth())
        self.wrenches.append(wrenches(self.env)[0])
        self.rates.append(self.env.simulation.qvel[0, 3:6].copy())

    @property
    def observations(self) -> Array:
        """(T + 1, 95)."""
        return np.array([result[0] for result in self.results])

    def group(self, name: str) -> Array:
        """Columns of the observation, (T + 1, n)."""
        return self.observations[:, self.env.task.observation_table.group(name)]

    def info(self, name: str) -> Array:
        """A signal at every step after the reset, (T,)."""
        return np.array([result[4][name] for result in self.results[1:]])

    def truth(self, name: str) -> Array:
        """A true quantity, (T + 1, ...)."""
        return np.array([getattr(truth, name)[0] for truth in self.truths])

    @property
    def attitude(self) -> Array:
        """True roll and pitch of the pelvis, (T + 1, 2) [rad]."""
        return Rotation.from_matrix(self.truth("pelvis_R")).as_euler("ZYX")[:, :0:-1]


def record(env: ElasticEnv, seed: int, actions: Array) -> Recording:
    """Reset, then steps until the end or until the actions are used up."""
    recording = Recording(env)
    recording.take(env.reset(seed=seed))
    for action in actions:
        recording.take(env.step(action))
        if recording.results[-1][2] or recording.results[-1][3]:
            break
    return recording


HARD = "spread+push+sensor"
"""All that can be drawn: stiffness, push, biases; and a delay."""
HARD_SEED = 20
HARD_ACTIONS = random_actions(NUM_STEPS, 2, seed=1)


@pytest.fixture(scope="module")
def hard_walk() -> Recording:
    """A whole episode under a hard scenario with restless commands."""
    env = make_walk(**SHORT, scenario=HARD)
    record(env, 3, random_actions(30, 1)[:, 0])  # left half-way: must not show in the next
    return record(env, HARD_SEED + 1, HARD_ACTIONS[:, 1])


@pytest.fixture(scope="module")
def open_loop() -> Recording:
    """A whole episode of the reference alone in `ideal`."""
    return record(make_walk(**SHORT, scenario="ideal"), 0, zeros(NUM_STEPS))


# --------------------------------------------------------------------------------------------------
# Contracts of Gymnasium and Stable-Baselines3
# --------------------------------------------------------------------------------------------------


def test_gymnasium_check_env() -> None:
    """Catches spaces, dtypes, seeding and return types that are not Gymnasium's, where much is
    drawn."""
    check_env(gymnasium.make(ID, **SHORT, scenario=HARD).unwrapped, skip_render_check=True)


def test_make_and_make_vec_find_the_environments() -> None:
    """Catches a registration that points elsewhere, and arguments that do not arrive."""
    env = gymnasium.make(
        ID, step_period=[0.4, 0.6, 0.8], num_steps=2, scenario="ideal", render_mode=None
    )
    assert isinstance(env.unwrapped, ElasticEnv)
    assert env.unwrapped.task.config.scenario.name == "ideal"
    assert env.unwrapped.task.num_steps == round((2 * 1.8 + 2.0) / PERIOD_S)
    many = gymnasium.make_vec(
        ID,
        num_envs=5,
        vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep",
        scenario="soft",
        **SHORT,
    )
    assert isinstance(many.unwrapped, ElasticVectorEnv)
    assert many.num_envs == 5
    assert many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert many.unwrapped.task.num_steps == NUM_STEPS
    np.testing.assert_allclose(many.unwrapped.truth().model.stiffness, 0.7 * STIFFNESS)


@pytest.mark.parametrize("vector", [False, True])
def test_spaces_describe_what_the_environment_takes_and_gives(vector: bool) -> None:
    """Catches a dtype or shape that changes between space, reset and step."""
    env: Any = walk_worlds(3) if vector else make_walk(**SHORT)
    observation, _ = env.reset(seed=0)
    lead = (3,) if vector else ()
    assert env.action_space.shape == (*lead, 12)
    assert env.observation_space.shape == (*lead, 95)
    assert env.action_space.dtype == np.float32
    np.testing.assert_allclose(
        np.abs([env.action_space.low, env.action_space.high]), 0.3, rtol=1e-6
    )
    env.action_space.seed(0)
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


def test_docstring_of_the_module_is_the_table_of_signals() -> None:
    """Catches a table in the documentation that names, orders or measures the columns otherwise
    than the code."""
    task = make_walk(**SHORT).task
    signals = list(task.observation_table)
    rows, info = documented_tables(walk_in_place.__doc__ or "")
    next_column = 0
    for columns, names, units, _ in rows:
        first, *last = (int(number) for number in re.findall(r"\d+", columns))
        assert first == next_column, columns
        next_column = (last[-1] if last else first) + 1
        described = signals[first:next_column]
        quoted = re.findall(r"`([^`]+)`", names)
        wanted = [
            name if i == 0 else f"{quoted[0].split('.')[0]}{name}" for i, name in enumerate(quoted)
        ]
        if quoted[0].endswith(".<joint>"):
            wanted = [quoted[0].replace("<joint>", joint) for joint in JOINTS]
        found = [signal.name for signal in described]
        assert wanted == ([found[0], found[-1]] if " to " in names else found), columns
        assert units.split(", ") == list(dict.fromkeys(signal.unit for signal in described)), (
            columns
        )
    assert next_column == len(signals) == 95
    assert task.action_table.names == tuple(f"command_offset.{joint}" for joint in JOINTS)
    assert re.search(
        rf"\[rad\] in the order of the joints, within ±{task.action_table.signals[0].high}\.", DOC
    )
    assert f"joints are {', '.join(JOINTS[:6])}," in DOC
    env = make_walk(**SHORT)
    env.reset(seed=0)
    assert info == {*env.step(np.zeros(12, np.float32))[4], "episode_metrics"}


DOC = " ".join((walk_in_place.__doc__ or "").split())


def test_groups_of_the_table_are_its_neighbouring_columns() -> None:
    """Catches a group that is cut, shifted, or takes in another whose name begins alike."""
    table = make_walk(**SHORT).task.observation_table
    sizes = {
        "encoder_angle": 12,
        "encoder_rate": 12,
        "imu_attitude": 2,
        "imu_rate": 3,
        "wrench": 12,
        "reference_angle": 12,
        "reference_rate": 12,
        "reference_acceleration": 12,
        "clock": 3,
        "load_share": 1,
        "zmp_reference": 2,
        "last_command": 12,
    }
    begin = 0
    for name, size in sizes.items():
        assert table.group(name) == slice(begin, begin + size)
        begin += size
    assert begin == len(table)
    assert table.group("wrench.r_fz") == slice(37, 38)
    with pytest.raises(
        ConfigurationError,
        match=r"unknown signal 'encoder'; choose one of: encoder_angle, encoder_ra",
    ):
        table.group("encoder")


# --------------------------------------------------------------------------------------------------
# Seeds, copies, and results that belong to the caller
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", ["nominal", HARD])
def test_same_seed_same_rollout_and_other_seed_another(scenario: str) -> None:
    """Catches randomness outside the seed, and a seed that is ignored."""
    actions = random_actions(20, 1)[:, 0]
    first, again, other = (
        record(make_walk(**SHORT, scenario=scenario), seed, actions).results for seed in (3, 3, 4)
    )
    assert_equal(first, again)
    for a, b in zip(first, other, strict=True):
        assert not np.array_equal(a[0], b[0])


def test_episodes_of_one_environment_follow_from_its_first_seed() -> None:
    """Catches a second episode that depends on how the first one ended, or that repeats it."""
    first = []
    second = []
    for steps in (2, 30):
        env = make_walk(**SHORT, scenario=HARD)
        first.append(record(env, 7, random_actions(steps, 1)[:, 0]).results[0])
        second.append([env.reset(), *(env.step(action) for action in random_actions(3, 1)[:, 0])])
    assert_equal(first[0], first[1])
    assert_equal(second[0], second[1])
    assert not np.array_equal(first[0][0], second[0][0][0])


@pytest.mark.parametrize("vector", [False, True])
def test_results_are_fresh_and_writing_to_them_changes_nothing(vector: bool) -> None:
    """Catches observations, infos, truths or kept actions that are views of the live state."""
    logs = []
    for spoil in (False, True):
        env: Any = walk_worlds(2, scenario=HARD) if vector else make_walk(**SHORT, scenario=HARD)
        actions = random_actions(12, 2) if vector else random_actions(12, 1)[:, 0]
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


@pytest.mark.parametrize("num_envs", [1, 2])
def test_a_deep_copy_goes_on_as_the_original(num_envs: int) -> None:
    """Catches copies whose arrays, springs or noise are no longer those of the physics."""
    env = walk_worlds(num_envs, scenario=HARD)
    env.reset(seed=0)
    actions = random_actions(20, num_envs, size=0.05)
    for action in actions:
        env.step(action)
    twin = copy.deepcopy(env)
    start = env.truth().theta
    expected = [env.step(action) for action in actions]
    assert_equal([twin.step(action) for action in actions], expected)
    assert np.abs(env.truth().theta - start).max(axis=1).min() > 1e-3


# --------------------------------------------------------------------------------------------------
# One world and many
# --------------------------------------------------------------------------------------------------


def test_a_world_of_the_vector_is_the_scalar_environment_for_a_whole_episode(
    hard_walk: Recording,
) -> None:
    """Catches any rule that one of the faces has and the other has not, to the last bit, end and
    metrics included."""
    env = walk_worlds(2, scenario=HARD, autoreset_mode=AutoresetMode.SAME_STEP)
    log = [env.reset(seed=HARD_SEED)]
    log += [env.step(actions) for actions in HARD_ACTIONS]
    assert len(hard_walk.results) == len(log)
    for result, expected in zip(log[:-1], hard_walk.results[:-1], strict=True):
        assert_equal(row_of(result, 1), expected)
    *end, info = log[-1]
    *expected, expected_info = hard_walk.results[-1]
    assert_equal([part[1] for part in end[1:]], expected[1:])
    np.testing.assert_array_equal(info["final_obs"][1], expected[0])
    assert_equal(row_of(info["final_info"], 1), expected_info)
    assert info["time_s"][1] == 0.0  # begun anew


@pytest.mark.slow  # every commit plays worlds beside others, and 2 threads, in test_mixed_worlds
@pytest.mark.parametrize("scenario", [f"{HARD}+slope", *SCENARIOS])
def test_results_depend_neither_on_threads_nor_on_the_number_of_worlds(scenario: str) -> None:
    """Catches a world whose noise, robot or physics depends on its neighbours or on who computes
    it."""
    actions = random_actions(15, 7, seed=2)
    logs = {}
    for num_envs, num_threads in [(7, 1), (7, 2), (1, 1)]:
        env = walk_worlds(num_envs, num_threads=num_threads, scenario=scenario)
        log = [env.reset(seed=100)[0]]
        log += [env.step(action[:num_envs])[0] for action in actions]
        logs[num_envs, num_threads] = np.array(log)
    np.testing.assert_array_equal(logs[7, 2], logs[7, 1])
    np.testing.assert_array_equal(logs[1, 1], logs[7, 1][:, :1])
    for world in (0, 6):
        scalar = record(make_walk(**SHORT, scenario=scenario), 100 + world, actions[:, world])
        np.testing.assert_array_equal(scalar.observations, logs[7, 1][:, world])


class Pair:
    """The vector environment beside Gymnasium's own vectorisation of the scalar one."""

    def __init__(self, num_envs: int, mode: AutoresetMode, **arguments: Any) -> None:
        self.many = walk_worlds(num_envs, autoreset_mode=mode, **arguments)
        self.single = SyncVectorEnv(
            [lambda: make_walk(**SHORT, **arguments)] * num_envs, autoreset_mode=mode
        )

    def reset(self, **arguments: Any) -> None:
        """Reset both and compare."""
        expected = self.single.reset(**copy.deepcopy(arguments))
        result = self.many.reset(**arguments)
        np.testing.assert_array_equal(result[0], expected[0])
        assert_info_of_rows(result[1], expected[1])

    def step(self, actions: Array) -> tuple[Any, ...]:
        """Step both and compare, exactly."""
        expected = self.single.step(actions)
        result = self.many.step(actions)
        for part, (result_part, wanted) in enumerate(zip(result[:4], expected[:4], strict=True)):
            np.testing.assert_array_equal(result_part, wanted, err_msg=f"part {part} of the result")
        assert_info_of_rows(result[4], expected[4])
        return result

    def disturb(self, world: int, roll: float = 0.0, value: float = 0.0) -> None:
        """Turn a robot over, or put a bad number, into the same world of both."""
        for env, at in ((self.many, world), (self.single.envs[world], 0)):
            if roll:
                lean(env, roll=roll, world=at)
            else:
                break_world(env, at, value)


def assert_info_of_rows(info: dict[str, Any], expected: dict[str, Any], path: str = "info") -> None:
    """Everything that the scalar environments say stands in the vector's info, in the row of the
    same world."""
    for key, values in expected.items():
        if key.startswith("_"):
            continue
        assert key in info, f"{path}[{key!r}] is missing"
        if isinstance(values, dict):
            assert_info_of_rows(info[key], values, f"{path}[{key!r}]")
            continue
        for row in np.flatnonzero(expected[f"_{key}"]):
            np.testing.assert_array_equal(
                info[key][row], values[row], err_msg=f"{path}[{key!r}][{row}]"
            )
        if f"_{key}" in info:
            np.testing.assert_array_equal(
                info[f"_{key}"], expected[f"_{key}"], err_msg=f"{path}['_{key}']"
            )


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(
    "scenario", [f"{HARD}+slope", *(pytest.param(s, marks=pytest.mark.slow) for s in SCENARIOS)]
)
def test_worlds_that_end_at_different_times_keep_apart(scenario: str, mode: AutoresetMode) -> None:
    """Catches an end in one world that shows in the results of another: masks of reset, fall and
    divergence."""
    pair = Pair(3, mode, scenario=scenario)
    pair.reset(seed=11)
    ends: list[str] = []
    for k, actions in enumerate(random_actions(16, 3, seed=5)):
        if k == 3:
            pair.reset(seed=[None, 5, None], options={"reset_mask": np.array([False, True, False])})
        if k == 5:
            pair.disturb(1, roll=0.6)
        if k in (6, 9):
            pair.disturb(2, value=np.nan if k == 6 else 1e12)
        info = pair.step(actions)[4]
        ends += [str(reason) for reason in info.get("final_info", info)["termination"] if reason]
    assert ends == ["fell", "diverged", "diverged"]


def test_one_seed_per_world_or_an_error() -> None:
    """Catches seeds that are dropped or reused."""
    env = walk_worlds(3)
    observation, _ = env.reset(seed=[5, 6, 5])
    np.testing.assert_array_equal(observation[0], observation[2])
    assert not np.array_equal(observation[0], observation[1])
    with pytest.raises(ConfigurationError, match="one seed per world, 3, got 2"):
        env.reset(seed=[1, 2])


@pytest.mark.slow
def test_random_actions_end_in_falls_with_a_reason_and_never_in_bad_numbers() -> None:
    """Catches NaN in what a learner sees, ends without a reason, and a world that starts anew
    without a word."""
    env = walk_worlds(16, autoreset_mode=AutoresetMode.SAME_STEP)
    _, info = env.reset(seed=0)
    time = info["time_s"]
    qpos = env.simulation.qpos.copy()
    ends = 0
    held = np.repeat(random_actions(6, 16, seed=1, size=0.3), 25, axis=0)
    for actions in np.clip(held + random_actions(150, 16, size=0.3), -0.3, 0.3):
        observation, reward, terminated, truncated, info = env.step(actions)
        done = terminated | truncated
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()
        assert not (terminated & truncated).any()
        np.testing.assert_allclose(
            info["time_s"], np.where(done, 0.0, time + PERIOD_S), rtol=0.0, atol=1e-9
        )
        moved = np.abs(env.simulation.qpos - qpos)[~done]
        assert moved.max(initial=0.0) < 0.1  # a silent reset would bring a fallen robot up at once
        assert (
            not {"episode_metrics", "_episode_metrics"} & info.keys()
        )  # of an episode that began, there are none
        assert not (info["clipped"] * done).any()
        if done.any():
            reasons = info["final_info"]["termination"]
            assert np.isin(reasons[terminated], ["fell", "diverged"]).all()
            assert (reasons[~terminated] == "").all()
            np.testing.assert_array_equal(
                info["final_info"]["episode_metrics"]["fell"][done], reasons[done] == "fell"
            )
        time = info["time_s"]
        qpos = env.simulation.qpos.copy()
        ends += int(done.sum())
    assert ends > 4


# --------------------------------------------------------------------------------------------------
# Rest
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scenario",
    [
        *("ideal", "payload", "backlash", "slope"),
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("nominal", "soft", "spread", "sensor", "ideal+slope")
        ),
    ],
)
def test_an_episode_starts_in_static_equilibrium(scenario: str) -> None:
    """Catches a start with slack springs or an empty integrator: while the command stays,
    nothing may move."""
    env = make_walk(**SHORT, scenario=scenario)
    _, info = env.reset(seed=1)
    start = env.truth()
    reference = env.task.assumed_model.plan.q
    weight = (MASS_KG + (5.0 if scenario == "payload" else 0.0)) * GRAVITY
    for k in range(60):
        assert info["force_left"] + info["force_right"] == pytest.approx(weight, abs=0.02)
        assert vertical_forces(env).sum() == pytest.approx(
            weight - 2 * FOOT_MASS_KG * GRAVITY, abs=0.02
        )
        com = env.simulation.bind("subtree_com")[0, env.simulation.model.body("pelvis").id, :2]
        np.testing.assert_allclose([info["zmp_x"], info["zmp_y"]], com, rtol=0.0, atol=1e-4)
        *_, info = env.step((reference[0] - reference[k + 1]).astype(np.float32))
        truth = env.truth()
        assert np.abs(truth.q_dot).max() < 1e-3
        assert np.abs(truth.theta_dot).max() < 1e-3
    for name in ("q", "theta", "pelvis", "ankles"):
        np.testing.assert_allclose(
            getattr(truth, name), getattr(start, name), rtol=0.0, atol=1e-4, err_msg=name
        )


def vertical_forces(env: ElasticEnv) -> Array:
    """What MuJoCo's sensors say of the vertical force of each foot on its leg, (2,) [N]."""
    sites = [env.simulation.model.site(f"{side}_ft").id for side in "lr"]
    frames = np.array(env.simulation.bind("site_xmat")[0, sites]).reshape(2, 3, 3)
    return (frames[:, 2] * wrenches(env).reshape(2, 2, 3)[:, 0]).sum(axis=1)


@pytest.mark.parametrize(
    ("scenario", "factor"),
    [
        ("ideal", 1.0),
        pytest.param("ideal+soft", 0.7, marks=pytest.mark.slow),
        pytest.param("ideal+stiff", 1.3, marks=pytest.mark.slow),
        ("ideal+spread", None),
    ],
)
def test_at_rest_every_servo_carries_its_spring(scenario: str, factor: float | None) -> None:
    """Catches a true stiffness that is not the one of the physics: B θ̈ = 0 needs a servo torque
    of K (θ − q)."""
    env = walk_env(scenario=scenario)
    truth = env.truth()
    torque = np.array(env.simulation.bind("actuator_force")[0])
    np.testing.assert_allclose(
        torque, (truth.stiffness * (truth.theta - truth.q))[0], rtol=0.0, atol=5e-3
    )
    assert np.abs(torque).max() > 10.0
    assert factor is None or truth.stiffness[0].tolist() == pytest.approx([factor * STIFFNESS] * 12)


def test_before_the_walk_the_weight_is_shared_and_in_single_support_it_is_on_the_support_foot(
    open_loop: Recording,
) -> None:
    """Catches left and right exchanged in forces, shares or the sign of y."""
    left = open_loop.info("force_left")
    right = open_loop.info("force_right")
    assert left[0] == pytest.approx(right[0], rel=1e-3)
    middle = (LIFT_OFF + TOUCH_DOWN) // 2
    assert abs(right[middle]) < 0.02 * MASS_KG * GRAVITY  # of the foot's acceleration
    assert left[middle] > 400.0
    assert open_loop.info("zmp_y")[middle] > 0.05
    assert open_loop.info("zmp_reference_y")[middle] == pytest.approx(0.105)
    assert open_loop.info("load_share")[middle] == 0.0
    assert open_loop.info("support")[middle] == 0
    ankles = open_loop.truth("ankles")[middle]
    assert ankles[0, 1] > 0.0 > ankles[1, 1]
    assert ankles[1, 2] > ankles[0, 2] + 0.01


# --------------------------------------------------------------------------------------------------
# Measurements
# --------------------------------------------------------------------------------------------------


def test_in_ideal_the_observation_is_the_truth_and_the_coming_reference(
    open_loop: Recording,
) -> None:
    """Catches noise, counts or delay where there should be none, columns out of order, and rows
    off by one."""
    plan = open_loop.env.task.assumed_model.plan
    theta = open_loop.truth("theta")
    coming = np.minimum(np.arange(NUM_STEPS + 1) + 1, NUM_STEPS)
    expected = {
        "encoder_angle": theta,
        "encoder_rate": np.diff(theta, axis=0, prepend=theta[:1]) / PERIOD_S,
        "imu_attitude": open_loop.attitude,
        "imu_rate": np.array(open_loop.rates),
        "wrench": np.array(open_loop.wrenches),
        "reference_angle": plan.q[coming],
        "reference_rate": plan.q_dot[coming],
        "reference_acceleration": plan.q_ddot[coming],
        "clock": np.stack(
            [coming * PERIOD_S, np.clip((coming - LIFT_OFF) / 125, 0.0, 1.0), 0.0 * coming], axis=1
        ),
        "load_share": plan.share[coming, None],
        "zmp_reference": plan.zmp[coming],
        "last_command": plan.q,  # of the control period that ends here; at the start the first row
    }
    for name, values in expected.items():
        np.testing.assert_allclose(
            open_loop.group(name), values, rtol=0.0, atol=1e-12, err_msg=name
        )
    assert sum(values.shape[1] for values in expected.values()) == 95


def test_columns_are_constant_only_where_the_walk_has_nothing_to_say(hard_walk: Recording) -> None:
    """Catches a column that is never filled, or always the same: here the yaws rest and the left
    foot supports."""
    names = np.array(hard_walk.env.task.observation_table.names)
    constant = set(names[np.ptp(hard_walk.observations, axis=0) == 0.0])
    yaws = {
        f"reference_{kind}.{side}_hip_yaw"
        for kind in ("angle", "rate", "acceleration")
        for side in "lr"
    }
    assert constant == {*yaws, "clock.support", "zmp_reference.x"}


def test_the_last_command_is_reference_plus_offset(hard_walk: Recording) -> None:
    """Catches the command of another step, or one that knows of the homing error."""
    plan = hard_walk.env.task.assumed_model.plan
    np.testing.assert_allclose(
        hard_walk.group("last_command")[1:], plan.q[1:] + HARD_ACTIONS[:, 1], rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("roll", "pitch"), [(0.1, 0.0), (-0.2, 0.0), (0.0, 0.15), (0.0, -0.05), (0.1, -0.1)]
)
def test_roll_lifts_the_left_side_and_pitch_lowers_the_front(roll: float, pitch: float) -> None:
    """Catches signs and axes of the pelvis error: x forward, y left, z up."""
    env = walk_env(scenario="ideal")
    lean(env, roll, pitch, height_m=1.0)
    observation, *_, info = env.step(zeros())
    up = env.truth().pelvis_R[0].T @ [0.0, 0.0, 1.0]  # its components along the pelvis' x, y, z
    assert info["pelvis_roll"] == pytest.approx(roll, abs=0.02)
    assert info["pelvis_pitch"] == pytest.approx(pitch, abs=0.02)
    assert -up[0] == pytest.approx(np.sin(info["pelvis_pitch"]), abs=1e-12)
    assert up[1] == pytest.approx(
        np.sin(info["pelvis_roll"]) * np.cos(info["pelvis_pitch"]), abs=1e-12
    )
    assert info["pelvis_error"] == pytest.approx(np.arccos(up[2]), abs=1e-9)
    assert info["pelvis_height"] == pytest.approx(1.66, abs=0.01)
    np.testing.assert_allclose(
        observation[24:26], [info["pelvis_roll"], info["pelvis_pitch"]], rtol=0.0, atol=1e-15
    )


def test_in_nominal_encoders_count_and_the_other_sensors_have_their_white_noise() -> None:
    """Catches counts of the wrong size, noise of the wrong size, shared between columns, worlds
    or steps, and bias."""
    env = walk_worlds(16)
    scenario = make_scenario("nominal")
    observations = [env.reset(seed=0)[0]]
    errors = []
    thetas = [env.truth().theta]
    for _ in range(60):
        observations.append(env.step(zeros(16))[0])
        thetas.append(env.truth().theta)
        angles = Rotation.from_matrix(env.truth().pelvis_R).as_euler("ZYX")[:, :0:-1]
        true = np.concatenate([angles, env.simulation.qvel[:, 3:6], wrenches(env)], axis=1)
        errors.append(observations[-1][:, 24:41] - true)
    size = 2.0 * np.pi / COUNTS_PER_TURN
    encoder = np.array(observations)[..., :12]
    np.testing.assert_allclose(encoder / size, np.round(encoder / size), rtol=0.0, atol=1e-6)
    assert np.abs(encoder - thetas).max() <= size / 2 * (1 + 1e-9)
    assert np.abs(encoder - thetas).max() > size / 4
    noise = np.array(errors)  # (steps, worlds, sensors)
    count = noise[..., 0].size
    expected = [0.2e-3] * 2 + [1e-3] * 3 + ([1.0] * 3 + [0.05] * 3) * 2
    assert expected[2] == scenario.gyro_noise_rad_s
    np.testing.assert_allclose(noise.std(axis=(0, 1)), expected, rtol=5 / np.sqrt(2 * count))
    scaled = noise / expected
    assert np.abs(scaled.mean(axis=(0, 1))).max() < 5 / np.sqrt(count)
    assert np.abs(np.corrcoef(scaled.reshape(count, -1).T) - np.eye(17)).max() < 5 / np.sqrt(count)
    assert np.abs(np.mean(scaled[1:] * scaled[:-1], axis=(0, 1))).max() < 5 / np.sqrt(count)
    assert np.abs(np.mean(scaled[:, 1:] * scaled[:, :-1], axis=(0, 1))).max() < 5 / np.sqrt(count)


def test_in_sensor_measurements_are_one_control_step_old_and_biased(hard_walk: Recording) -> None:
    """Catches a delay of two steps or none in any sensor, a bias that wanders, and a rate of
    other angles."""
    size = 2.0 * np.pi / COUNTS_PER_TURN
    theta = hard_walk.truth("theta")
    encoder = hard_walk.group("encoder_angle")
    bias = encoder[1:] - theta[:-1]
    assert np.ptp(bias, axis=0).max() <= size * (1 + 1e-9)
    assert np.abs(bias).max() <= make_scenario("sensor").homing_rad[1] + size
    assert len(np.unique(np.round(bias[0] / size))) == 12
    assert np.abs(bias.mean(axis=0)).max() > 1e-3
    np.testing.assert_allclose(
        hard_walk.group("encoder_rate")[1:],
        np.diff(encoder, axis=0) / PERIOD_S,
        rtol=0.0,
        atol=1e-12,
    )
    for name, values, spread in (
        ("imu_attitude", hard_walk.attitude, [0.2e-3] * 2),
        ("imu_rate", np.array(hard_walk.rates), [1e-3] * 3),
        ("wrench", np.array(hard_walk.wrenches), ([1.0] * 3 + [0.05] * 3) * 2),
    ):
        shown = hard_walk.group(name)
        errors = shown[1:] - values[:-1]
        if name == "wrench":  # bias, drift and cross-talk of the feet have tests of their own
            steps = np.arange(len(errors))
            known = np.column_stack([values[:-1], np.ones(len(errors)), steps])
            errors = errors - known @ np.linalg.lstsq(known, errors, rcond=None)[0]
        np.testing.assert_allclose(errors.std(axis=0), spread, rtol=5 / np.sqrt(2 * NUM_STEPS))
        assert ((shown - values).std(axis=0) > 1.5 * np.array(spread)).any(), (
            name
        )  # without the delay it would not fit
    tilt_bias = (hard_walk.group("imu_attitude")[1:] - hard_walk.attitude[:-1]).mean(axis=0)
    assert np.abs(tilt_bias).max() <= 2e-3 + 1e-4
    assert np.abs(tilt_bias).min() > 1e-4


def test_a_homing_error_turns_the_robot_and_not_its_reading() -> None:
    """Catches a bias that the servos do not have: they hold what the encoder says, so the robot
    stands off by it."""
    env = make_walk(**SHORT, scenario="sensor")
    observation, _ = env.reset(seed=2)
    np.testing.assert_allclose(
        observation[:12], env.task.assumed_model.plan.q[0], rtol=0.0, atol=2e-5
    )
    assert np.abs(env.truth().theta[0] - observation[:12]).max() > 5e-4


def test_offsets_of_the_imu_differ_between_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches one offset for all worlds, and half the documented width."""
    monkeypatch.setattr(walk_config, "BANK_SIZE", BANK_SIZE)
    # robots that are homed exactly stand in the same way
    env = walk_worlds(64, scenario=make_scenario("sensor").replace(homing_rad=0.0))
    observation, _ = env.reset(seed=0)
    attitude = Rotation.from_matrix(env.truth().pelvis_R).as_euler("ZYX")[:, :0:-1]
    bias = observation[:, 24:26] - attitude
    assert np.abs(bias).max() <= 2e-3 + 5 * 0.2e-3
    assert bias.min() < -0.9 * 2e-3
    assert bias.max() > 0.9 * 2e-3
    assert abs(np.corrcoef(bias.T)[0, 1]) < 0.5


# --------------------------------------------------------------------------------------------------
# Scenarios, and what a policy may know of them
# --------------------------------------------------------------------------------------------------


def test_the_bank_of_spread_fills_its_interval_and_is_the_same_everywhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches a spread that is too narrow, one-sided, one for all joints, or new in every
    process."""
    monkeypatch.setattr(walk_config, "BANK_SIZE", BANK_SIZE)
    bank = robot_bank(make_scenario("spread"))
    factors = np.array([robot.stiffness for robot in bank])
    assert factors.shape == (256, 12)
    assert 0.7 <= factors.min() < 0.71
    assert 1.29 < factors.max() <= 1.3
    assert np.abs(np.corrcoef(factors.T) - np.eye(12)).max() < 5 / np.sqrt(256)
    assert robot_bank(make_scenario("spread")) == bank
    assert not set(robot_bank(make_scenario("spread"), 1)) & set(bank)
    assert len(robot_bank(make_scenario("nominal"))) == 1


def stiffness_of(env: Any) -> Array:
    """Stiffness of all springs that the physics has, one row per world."""
    models = [env.simulation.model_of(world) for world in range(env.simulation.num_worlds)]
    return np.array([model.tendon_stiffness for model in models])


@pytest.mark.parametrize("vector", [pytest.param(False, marks=pytest.mark.slow), True])
def test_spread_gives_every_joint_a_stiffness_of_its_own_and_tells_the_truth(vector: bool) -> None:
    """Catches a stiffness that is drawn and not used, used and not told, or the same for robots
    and joints."""
    num = 7 if vector else 1
    env: Any = (
        walk_worlds(num, scenario="spread") if vector else make_walk(**SHORT, scenario="spread")
    )
    env.reset(seed=0)
    truth = env.truth().stiffness
    springs = [env.task.model.tendon(spring_name(joint)).id for joint in JOINTS]
    np.testing.assert_array_equal(stiffness_of(env)[:, springs], truth)
    assert truth.shape == (num, 12)
    assert ((truth >= 0.7 * STIFFNESS) & (truth <= 1.3 * STIFFNESS)).all()
    assert len(np.unique(truth[0])) == 12
    assert len(np.unique(truth, axis=0)) == (
        2 if vector else 1
    )  # the seven draw two of the three in the bank
    env.reset(seed=[11] * num if vector else 11)
    np.testing.assert_array_equal(stiffness_of(env)[:, springs], env.truth().stiffness)


def test_payload_is_in_the_plant_and_not_in_the_model() -> None:
    """Catches a payload that the compensators know of, or that weighs nothing."""
    env = walk_env(scenario="payload")
    assert env.simulation.model.body_mass.sum() == pytest.approx(MASS_KG + 5.0, abs=1e-6)
    assert env.truth().model.rigid.body_mass.sum() == pytest.approx(MASS_KG + 5.0, abs=1e-6)
    assert env.assumed_model.rigid.body_mass.sum() == pytest.approx(MASS_KG, abs=1e-6)
    assert np.abs(env.truth().model.plan.torque - env.assumed_model.plan.torque).max() > 1.0


def test_friction_is_there_in_nominal_and_not_in_ideal() -> None:
    """Catches a ground with the other's friction; the ground is what an identification knows of."""
    for scenario, friction in (
        ("ideal", 0.0),
        ("nominal", FRICTION),
        ("soft", FRICTION),
        ("ideal+soft", 0.0),
    ):
        env = make_walk(**SHORT, scenario=scenario)
        links = [env.task.model.joint(joint).dofadr[0] for joint in JOINTS]
        assert env.simulation.model.dof_frictionloss[links].tolist() == [friction] * 12, scenario
        assert env.simulation.model.dof_frictionloss.sum() == pytest.approx(12 * friction), scenario
        assert env.assumed_model.coulomb_friction.tolist() == [friction] * 12, scenario


def test_a_slope_tilts_the_ground_under_the_soles_and_the_robot_stands_on_it() -> None:
    """Catches a slope that is drawn and not built, of another angle, or in one direction for all
    robots."""
    env = walk_env(scenario="slope")
    directions = set()
    for seed in range(6):
        _, info = env.reset(seed=seed)
        data = mujoco.MjData(env.simulation.model)
        data.qpos[:] = env.simulation.qpos[0]
        mujoco.mj_forward(env.simulation.model, data)
        points = data.contact.pos - data.contact.pos.mean(axis=0)
        assert len(points) >= 6
        rise = np.linalg.lstsq(points[:, :2], points[:, 2], rcond=None)[0]
        assert np.arctan(np.linalg.norm(rise)) == pytest.approx(np.deg2rad(1.0), rel=0.02)
        directions.add(round(np.arctan2(rise[1], rise[0]), 1))
        assert info["pelvis_error"] < 0.1
        assert info["pelvis_height"] == pytest.approx(0.66, abs=0.01)
    assert len(directions) > 1


def test_backlash_is_a_dead_band_of_every_spring() -> None:
    """Catches a backlash that the physics does not have, or the truth does not tell."""
    env = walk_env(scenario="backlash")
    springs = [env.task.model.tendon(spring_name(joint)).id for joint in JOINTS]
    np.testing.assert_allclose(
        env.simulation.model.tendon_lengthspring[springs], [[-1.75e-3 / 2, 1.75e-3 / 2]] * 12
    )
    assert env.truth().model.backlash.tolist() == [1.75e-3] * 12


@pytest.mark.parametrize(
    "scenario",
    [
        *("soft", "payload", "spread", "backlash", "sensor", "push", "slope"),
        pytest.param("stiff", marks=pytest.mark.slow),
    ],
)
def test_the_assumed_model_and_the_reference_do_not_know_the_scenario(scenario: str) -> None:
    """Catches a compensator, or a plan, that is told the true stiffness, mass, backlash or
    slope."""
    env = make_walk(**SHORT, scenario=scenario)
    nominal = make_walk(**SHORT)
    observation, wanted = (e.reset(seed=0)[0] for e in (env, nominal))
    np.testing.assert_array_equal(observation[41:], wanted[41:])
    assumed = env.assumed_model
    expected = nominal.assumed_model
    for parameter in (
        "stiffness",
        "damping",
        "rotor_inertia",
        "backlash",
        "coulomb_friction",
        "viscous_friction",
    ):
        np.testing.assert_array_equal(
            getattr(assumed, parameter), getattr(expected, parameter), err_msg=parameter
        )
    assert assumed.stiffness.tolist() == [STIFFNESS] * 12
    np.testing.assert_array_equal(assumed.rigid.body_mass, expected.rigid.body_mass)
    np.testing.assert_array_equal(assumed.plan.torque, expected.plan.torque)
    assert assumed is not env.truth().model


@pytest.mark.parametrize("stiffness", [900.0, [900.0 + i for i in range(12)]])
def test_a_given_stiffness_is_that_of_plant_and_model(stiffness: Any) -> None:
    """Catches a K that arrives in one of them only, or in another order of joints."""
    env = make_walk(**SHORT, stiffness=stiffness, scenario="soft")
    wanted = np.broadcast_to(stiffness, 12)
    np.testing.assert_allclose(env.assumed_model.stiffness, wanted)
    springs = [env.task.model.tendon(spring_name(joint)).id for joint in JOINTS]
    np.testing.assert_allclose(env.task.model.tendon_stiffness[springs], 0.7 * wanted)


def test_a_push_gives_the_robot_its_impulse_once_within_the_walk() -> None:
    """Catches a push that is missing, too long, vertical, repeated, or outside the walk: 50 N
    for 0.1 s are 5 N·s."""
    pushed, calm = (walk_env(scenario=scenario) for scenario in ("ideal+push", "ideal"))
    for env in (pushed, calm):
        lean(env, height_m=100.0)  # where no foot can brace itself; both fall alike
    forces = []
    states = []
    for _ in range(WALK_END + 30):
        for env in (pushed, calm):
            env.step(zeros())
        forces.append(pushed.simulation.bind("xfrc_applied")[0].copy())
        states.append(
            [
                (env.simulation.qpos[0].copy(), env.simulation.qvel[0].copy())
                for env in (pushed, calm)
            ]
        )
    push = np.array(forces)[:, pushed.simulation.model.body("upper_body").id, :3]
    begin, *_, end = np.flatnonzero(push.any(axis=1))
    assert WALK_BEGIN <= begin < WALK_END
    assert end - begin + 1 == round(0.1 / PERIOD_S)
    np.testing.assert_allclose(np.linalg.norm(push[begin : end + 1], axis=1), 50.0)
    assert not push[:, 2].any()
    assert np.sum(forces) == np.sum(push)  # on the torso alone
    before, after, last = (
        np.subtract(*(momentum(pushed.simulation.model, *state) for state in states[step]))
        for step in (begin - 1, end, -1)
    )
    assert np.abs(before).max() == 0.0
    np.testing.assert_allclose(after, 0.1 * push[begin], rtol=0.0, atol=0.02)
    np.testing.assert_allclose(last, after, rtol=0.0, atol=0.02)


def momentum(model: mujoco.MjModel, qpos: Array, qvel: Array) -> Array:
    """Linear momentum of the robot, (3,) [N·s]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qvel[:] = qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    pelvis = model.body("pelvis").id
    return model.body_subtreemass[pelvis] * data.subtree_linvel[pelvis]


def test_pushes_begin_at_drawn_times_in_drawn_directions_and_end_with_the_episode() -> None:
    """Catches one push for all worlds, and a force that stays on a robot that begins anew."""
    env = walk_worlds(12, scenario="push", autoreset_mode=AutoresetMode.SAME_STEP)
    env.reset(seed=0)
    torso = env.task.model.body("upper_body").id
    force = env.simulation.bind("xfrc_applied")[:, torso]
    env.simulation.qpos[:, 2] += 100.0
    seen = np.zeros(12)
    for k in range(WALK_BEGIN + 60):
        env.step(zeros(12))
        pushed = force.any(axis=1)
        assert k >= WALK_BEGIN or not pushed.any()
        seen += pushed
    angles = np.arctan2(force[pushed, 1], force[pushed, 0])
    assert 2 <= pushed.sum() < 12
    assert np.ptp(angles) > 0.5
    assert len(np.unique(seen)) > 3
    worlds = np.flatnonzero(pushed)
    env.reset(options={"reset_mask": pushed})
    env.step(zeros(12))
    assert not force[worlds].any()


@pytest.mark.parametrize(
    "arguments",
    [
        {"form": "rigid"},
        {"robot": {"twin_knee": True}},
        pytest.param({"robot": {"hip_half_spacing": 0.072}}, marks=pytest.mark.slow),
        {"gait": {"transfer": "ramp"}},
    ],
)
def test_options_of_the_robot_stand_and_walk(arguments: dict[str, Any]) -> None:
    """Catches an option that is lost, or that nothing can run with."""
    env = walk_env(**arguments)
    for _ in range(10):
        *_, terminated, truncated, info = env.step(zeros())
        assert not terminated
        assert not truncated
    assert info["pelvis_error"] < 0.05
    truth = env.truth()
    stiffness = env.assumed_model.stiffness
    rigid = arguments.get("form") == "rigid"
    twin = "twin_knee" in arguments.get("robot", {})
    assert (info["deflection"] == 0.0) == rigid
    assert stiffness.tolist() == [
        STIFFNESS * (2 if twin and "knee" in joint else 1) for joint in JOINTS
    ]
    wanted_m = 2 * arguments.get("robot", {}).get("hip_half_spacing", 0.105)
    assert truth.ankles[0, 0, 1] - truth.ankles[0, 1, 1] == pytest.approx(wanted_m, abs=5e-3)


# --------------------------------------------------------------------------------------------------
# Scores
# --------------------------------------------------------------------------------------------------


def test_info_holds_the_documented_keys_and_they_agree_with_the_truth(hard_walk: Recording) -> None:
    """Catches a key that disappears, and a score that is computed from measurements instead of
    the truth."""
    assert set(hard_walk.results[0][1]) == INFO_KEYS - {"clipped", "reward_terms", "termination"}
    assert all(set(result[4]) == INFO_KEYS for result in hard_walk.results[1:-1])
    assert set(hard_walk.results[-1][4]) == INFO_KEYS | {"episode_metrics"}
    plan = hard_walk.env.task.assumed_model.plan
    q, theta, stiffness = (hard_walk.truth(name)[1:] for name in ("q", "theta", "stiffness"))
    slip = (hard_walk.truth("theta_dot") - hard_walk.truth("q_dot"))[1:]
    error = plan.q[1:] - q
    offsets = HARD_ACTIONS[:, 1].astype(np.float64)
    zmp = np.stack([hard_walk.info("zmp_x"), hard_walk.info("zmp_y")], axis=1)
    pelvis_R = hard_walk.truth("pelvis_R")[1:]

    def rms(values: Array) -> Array:
        return np.sqrt(np.mean(values**2, axis=1))

    expected = {
        "time_s": np.arange(1, NUM_STEPS + 1) * PERIOD_S,
        "pelvis_roll": hard_walk.attitude[1:, 0],
        "pelvis_pitch": hard_walk.attitude[1:, 1],
        "pelvis_error": np.arccos(np.clip(hard_walk.truth("pelvis_R")[1:, 2, 2], -1.0, 1.0)),
        "pelvis_height": hard_walk.truth("pelvis")[1:, 2],
        "zmp_reference_x": plan.zmp[1:, 0],
        "zmp_reference_y": plan.zmp[1:, 1],
        "zmp_deviation_x": (zmp - plan.zmp[1:])[:, 0],
        "zmp_deviation_y": (zmp - plan.zmp[1:])[:, 1],
        "zmp_deviation": np.linalg.norm(zmp - plan.zmp[1:], axis=1),
        "link_error": rms(error),
        "link_error_lowest": error.min(axis=1),
        "link_error_highest": error.max(axis=1),
        "deflection": rms(theta - q),
        "joint_torque": np.abs(stiffness * (theta - q) + 10.0 * slip).max(axis=1),
        "command_rate": rms(np.diff(offsets, axis=0, prepend=0.0 * offsets[:1])) / PERIOD_S,
        "load_share": plan.share[1:],
        "swing": plan.timing.swing[1:],
        "single_support": plan.timing.single[1:],
        "support": plan.timing.support[1:],
        "clipped": np.zeros(NUM_STEPS),
        "position_error": np.linalg.norm(
            (hard_walk.truth("ankles")[1:, :, :2] - plan.ankles[1:, :, :2]).mean(axis=1), axis=1
        ),
        "heading_error": np.arctan2(pelvis_R[:, 1, 0], pelvis_R[:, 0, 0]) - plan.heading[1:],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(hard_walk.info(name), values, rtol=0.0, atol=1e-8, err_msg=name)
    assert hard_walk.env.assumed_model.damping.tolist() == [10.0] * 12


def test_zmp_and_forces_are_those_of_the_contacts_of_mujoco() -> None:
    """Catches levers, frames and signs of the wrenches: the contacts themselves must give the
    same ZMP and forces."""
    env = walk_env(scenario="ideal")
    standing = (0.1, 1e-4)
    swinging = (10.0, 4e-3)
    for k in range(TOUCH_DOWN + 20):
        *_, info = env.step(zeros())
        if k % 10 == 0 and (k < 50 or k > LIFT_OFF - 40):
            force, zmp = contact_forces(env)
            force_n, zmp_m = standing if k < 50 else swinging
            np.testing.assert_allclose(
                [info["force_left"], info["force_right"]], force, rtol=0.0, atol=force_n
            )
            np.testing.assert_allclose([info["zmp_x"], info["zmp_y"]], zmp, rtol=0.0, atol=zmp_m)


def contact_forces(env: ElasticEnv) -> tuple[Array, Array]:
    """Vertical force on left and right foot, and the ZMP, from the contacts of the present
    state."""
    model = env.task.model
    simulation = env.simulation
    data = mujoco.MjData(env.task.model)
    data.qpos[:] = simulation.qpos[0]
    data.qvel[:] = simulation.qvel[0]
    data.act[:] = simulation.act[0]
    data.ctrl[:] = simulation.ctrl[0]
    mujoco.mj_forward(model, data)
    force = np.zeros(2)
    zmp = np.zeros(2)
    wrench = np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, wrench)  # the floor is level: normals are vertical
        force[int(model.geom(contact.geom[1]).name == "r_sole")] += wrench[0]
        zmp += wrench[0] * contact.pos[:2]
    return force, zmp / force.sum()


def statistic(name: str, values: Array) -> float:
    """A statistic by its name."""
    return {
        "rms": lambda x: np.sqrt(np.mean(x**2)),
        "peak": lambda x: np.abs(x).max(),
        "min": np.min,
        "max": np.max,
        "mean": np.mean,
        "last": lambda x: x[-1],
        "count": len,
    }[name](values)


def test_episode_metrics_are_those_of_the_recorded_signals(hard_walk: Recording) -> None:
    """Catches samples of standing or of the episode before in the scores, and a wrong statistic
    under a right name."""
    timing = hard_walk.env.task.assumed_model.plan.timing
    walking, single, transition = (
        mask[1:] for mask in (timing.walking, timing.single, timing.transition)
    )
    loaded = ~np.isnan(hard_walk.info("zmp_x"))
    end = np.arange(1, NUM_STEPS + 1) == TOUCH_DOWN
    masks = {
        "scored": walking,
        "all": np.ones_like(walking),
        "double": walking & ~single,
        "single": single,
        "transition": transition,
        "loaded": walking & loaded,
        "unloaded": walking & ~loaded,
        "double_loaded": walking & ~single & loaded,
        "single_loaded": single & loaded,
        "transition_loaded": transition & loaded,
        # of one step both blocks are the whole walk
        **{f"{block}_steps": walking for block in ("first", "last")},
        **{f"{block}_steps_loaded": walking & loaded for block in ("first", "last")},
        "touchdown": end,
        "end": np.arange(1, NUM_STEPS + 1) == NUM_STEPS,
    }
    metrics = dict(hard_walk.results[-1][4]["episode_metrics"])
    assert (metrics.pop("fell"), metrics.pop("diverged")) == (False, False)
    assert set(metrics) == {metric.name for metric in hard_walk.env.task.metrics}
    for metric in hard_walk.env.task.metrics:
        values = hard_walk.info(metric.signal)[masks[metric.over]]
        expected = statistic(metric.statistic, values)
        assert metrics[metric.name] == pytest.approx(expected, rel=1e-12, abs=1e-15), metric
    assert metrics["duration_s"] == pytest.approx(NUM_STEPS * PERIOD_S)
    assert [int(mask.sum()) for mask in (walking, single, transition)] == [275, 124, 202]


def test_names_of_metrics_say_signal_statistic_phase_and_unit() -> None:
    """Catches a figure under a name that belongs to another signal or unit, and a promised one
    that is missing."""
    metrics = make_walk(**SHORT).task.metrics
    names = [metric.name for metric in metrics]
    assert len(set(names)) == len(names)
    assert [name for name in names if not re.search("_(rad|rad_s|nm|m|s|share|count)$", name)] == []
    for metric in metrics:
        is_split = metric.signal.startswith(("pelvis", "zmp", "foot_drift"))
        if is_split and metric.statistic not in ("count", "last"):
            phase = {"scored": "", "loaded": ""}.get(
                metric.over, f"_{metric.over.removesuffix('_loaded')}"
            )
            unit = "rad" if metric.signal.startswith("pelvis") else "m"
            assert metric.name == f"{metric.signal}{phase}_{metric.statistic}_{unit}"
            assert metric.over.endswith("loaded") == (
                unit == "m"
            )  # where there is no ZMP there is no deviation
    required = {
        f"pelvis_{angle}_{s}_rad" for angle in ("roll", "pitch", "error") for s in ("rms", "peak")
    }
    required |= {f"zmp_deviation{axis}_{s}_m" for axis in ("", "_x", "_y") for s in ("rms", "peak")}
    required |= {f"link_error_{s}_rad" for s in ("rms", "min", "max")}
    required |= {f"pelvis_error_{phase}_rms_rad" for phase in ("double", "single", "transition")}
    required |= {f"zmp_deviation_{phase}_rms_m" for phase in ("double", "single", "transition")}
    for block in ("first_steps", "last_steps"):
        required.add(f"pelvis_error_{block}_rms_rad")
        for signal in ("zmp_deviation", "zmp_in_feet", "foot_drift"):
            required.add(f"{signal}_{block}_rms_m")
    assert required <= set(names)
    others = {
        "link_error_rms_rad": ("link_error", "rms", "scored"),
        "link_error_min_rad": ("link_error_lowest", "min", "scored"),
        "link_error_max_rad": ("link_error_highest", "max", "scored"),
        "deflection_rms_rad": ("deflection", "rms", "scored"),
        "servo_torque_rms_nm": ("servo_torque", "rms", "scored"),
        "joint_torque_peak_nm": ("joint_torque", "peak", "all"),
        "early_touchdown_mean_s": ("early_touchdown", "mean", "touchdown"),
        "early_touchdown_max_s": ("early_touchdown", "max", "touchdown"),
        "foot_drift_end_m": ("foot_drift", "last", "loaded"),
        "unloaded_samples_count": ("zmp_deviation", "count", "unloaded"),
        "command_rate_rms_rad_s": ("command_rate", "rms", "all"),
        "command_rate_peak_rad_s": ("command_rate", "peak", "all"),
        "clipped_share": ("clipped", "mean", "all"),
        "duration_s": ("time_s", "max", "all"),
    }
    described = {metric.name: (metric.signal, metric.statistic, metric.over) for metric in metrics}
    assert {name: described[name] for name in others} == others


def test_an_early_touchdown_is_measured_from_the_first_load_on_the_descending_foot(
    open_loop: Recording,
) -> None:
    """Catches earliness of the wrong foot, of lift-off, in steps instead of seconds, or counted
    at every step."""
    rows = np.arange(1, NUM_STEPS + 1)
    descending = (rows > (LIFT_OFF + TOUCH_DOWN) / 2) & (rows < TOUCH_DOWN)
    loaded = open_loop.info("force_right") > 0.05 * MASS_KG * GRAVITY
    first = rows[descending & loaded][0]
    early = (TOUCH_DOWN - first) * PERIOD_S
    assert early > 0.02  # soft legs let the pelvis sink
    recorded = open_loop.info("early_touchdown")
    assert recorded[TOUCH_DOWN - 1] == pytest.approx(early, abs=1e-12)
    assert np.flatnonzero(recorded).tolist() == [TOUCH_DOWN - 1]
    metrics = open_loop.results[-1][4]["episode_metrics"]
    assert (
        metrics["early_touchdown_mean_s"]
        == metrics["early_touchdown_max_s"]
        == pytest.approx(early, abs=1e-12)
    )


def test_a_robot_that_hangs_is_unloaded_has_no_zmp_and_touches_down_never_early() -> None:
    """Catches a ZMP made of next to no force, unloaded samples that are not counted, and
    earliness without contact."""
    env = walk_env(scenario="ideal")
    lean(env, height_m=1.0)
    env.simulation.bind("xfrc_applied")[0, env.task.model.body("upper_body").id, 2] = (
        MASS_KG * GRAVITY
    )
    for step in range(1, TOUCH_DOWN + 11):
        *_, terminated, truncated, info = env.step(zeros())
        assert not terminated
        assert not truncated
        assert info["early_touchdown"] == 0.0
        if step > WALK_BEGIN:
            assert np.isnan([info["zmp_x"], info["zmp_y"], info["zmp_deviation"]]).all()
            assert info["reward_terms"]["zmp"] == 0.0
    lean(env, roll=0.6)
    *_, terminated, _, info = env.step(zeros())
    assert terminated
    metrics = info["episode_metrics"]
    assert metrics["unloaded_samples_count"] == step + 1 - WALK_BEGIN
    assert metrics["early_touchdown_mean_s"] == metrics["early_touchdown_max_s"] == 0.0
    assert np.isnan([metrics["zmp_deviation_rms_m"], metrics["zmp_deviation_single_rms_m"]]).all()
    assert np.isfinite(
        [metrics["pelvis_roll_rms_rad"], metrics["pelvis_roll_single_rms_rad"]]
    ).all()
    assert metrics["duration_s"] == pytest.approx((step + 1) * PERIOD_S)


@pytest.mark.parametrize("scenario", ["nominal", "sensor"])
def test_reward_is_the_sum_of_its_terms_and_the_terms_are_the_documented_ones(
    scenario: str,
) -> None:
    """Catches a term that is missing in info, or computed from another quantity than it is named
    after."""
    env = walk_worlds(3, scenario=scenario)
    env.reset(seed=0)
    for actions in random_actions(15, 3):
        _, reward, _, _, info = env.step(actions)
        expected = {
            "tilt": -info["pelvis_error"] / 0.01,
            "zmp": -info["zmp_deviation"] / 0.03,
            "zmp_in_feet": np.zeros(3),
            "foot_drift": np.zeros(3),
            "effort": -0.001 * info["servo_torque"],
            "smoothness": -0.1 * info["command_rate"],
            "fall": np.zeros(3),
        }
        terms = info["reward_terms"]
        assert terms.keys() == expected.keys()
        np.testing.assert_allclose(reward, sum(terms.values()), rtol=0.0, atol=1e-13)
        for name, values in expected.items():
            np.testing.assert_allclose(terms[name], values, rtol=1e-12, err_msg=name)
    torque = np.array(env.simulation.bind("actuator_force"))
    np.testing.assert_allclose(info["servo_torque"], np.sqrt(np.mean(torque**2, axis=1)))


def test_weights_of_the_reward_can_be_chosen() -> None:
    """Catches an argument that arrives nowhere, and one that resets the other weights."""
    rewards = []
    for reward in (None, {"zmp": 100.0}):
        env = walk_worlds(2, scenario="nominal", reward=reward)
        env.reset(seed=0)
        terms = env.step(np.zeros((2, 12)))[4]["reward_terms"]
        rewards.append(terms)
    np.testing.assert_allclose(rewards[1]["zmp"], 3.0 * rewards[0]["zmp"])
    np.testing.assert_array_equal(rewards[1]["tilt"], rewards[0]["tilt"])


def test_standing_can_be_left_out_of_the_reward_as_it_is_out_of_the_metrics(
    open_loop: Recording,
) -> None:
    """Catches a factor on the walk itself, on other terms, or at other steps than those that the
    metrics leave out, from standing into the walk."""
    env = walk_env(scenario="ideal", reward={"standing": 0.25})
    steps = WALK_BEGIN + 50
    logs = [
        [result[4]["reward_terms"] for result in open_loop.results[1 : steps + 1]],
        [env.step(action)[4]["reward_terms"] for action in zeros(steps)],
    ]
    whole, less = (
        {name: np.array([terms[name] for terms in log]) for name in log[0]} for log in logs
    )
    walking = env.task.plan.timing.walking[1 : steps + 1]
    for name, values in less.items():
        factor = np.where(walking, 1.0, 0.25) if name in ("tilt", "zmp") else 1.0
        np.testing.assert_allclose(values, factor * whole[name], rtol=1e-12, err_msg=name)
    assert 0 < walking.sum() < len(walking)


def test_penalties_never_saturate() -> None:
    """Catches a kernel that hides how bad a large error is: twice the error costs twice as much."""
    errors = np.array([1e-3, 0.01, 0.2, 1.0])
    for penalty in (tilt_penalty, distance_penalty):
        np.testing.assert_allclose(penalty(2.0 * errors), 2.0 * penalty(errors))
        assert (penalty(errors) < 0.0).all()
    env = walk_env(scenario="ideal")
    tilts = []
    for roll in (0.1, 0.2):
        lean(env, roll=roll, height_m=2.0)
        tilts.append(env.step(zeros())[4]["reward_terms"]["tilt"])
    assert tilts[0] == pytest.approx(-0.1 * WalkRewardWeights().tilt, rel=0.05)
    assert tilts[1] == pytest.approx(-0.2 * WalkRewardWeights().tilt, rel=0.05)


# --------------------------------------------------------------------------------------------------
# Ends
# --------------------------------------------------------------------------------------------------


def test_metrics_of_an_episode_come_once() -> None:
    """Catches an episode that is counted again in the step in which its world begins anew."""
    env = walk_worlds(2, autoreset_mode=AutoresetMode.NEXT_STEP)
    env.reset(seed=0)
    actions = np.array([np.full(12, 0.3), np.zeros(12)], dtype=np.float32)
    ends = 0
    for _ in range(250):
        _, _, terminated, truncated, info = env.step(actions)
        done = terminated | truncated
        ends += int(done.sum())
        assert ("episode_metrics" in info) == done.any()
        assert "_episode_metrics" not in info or np.array_equal(info["_episode_metrics"], done)
    assert ends > 1


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 1.0),
        ({"robot": {"friction": 0.4}}, 0.4),
        pytest.param({"robot": {"friction": 1.3}}, 1.3, marks=pytest.mark.slow),
    ],
)
def test_friction_is_that_of_the_soles(options: dict[str, Any], expected: float) -> None:
    """Catches the friction of the floor, which MuJoCo takes where it is the larger one."""
    env = make_walk(**SHORT, **options)
    env.reset(seed=0)
    contact = env.unwrapped.simulation._data.contact
    assert len(contact) > 0
    np.testing.assert_array_equal(contact.friction[:, 0], expected)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_large_constant_offset_makes_the_robot_fall(sign: float) -> None:
    """Catches a fall that is not noticed, called a truncation, or not charged for."""
    env = walk_env()
    log = record(env, 0, np.full((NUM_STEPS, 12), sign * 0.3)).results[1:]
    for *_, info in log[:-1]:
        assert info["termination"] == ""
        assert info["reward_terms"]["fall"] == 0.0
        assert "episode_metrics" not in info
    _, reward, terminated, truncated, info = log[-1]
    assert (terminated, truncated) == (True, False)
    assert info["termination"] == "fell"
    assert info["reward_terms"]["fall"] == -200.0
    assert reward < -200.0
    metrics = info["episode_metrics"]
    assert metrics["fell"] is True
    assert metrics["diverged"] is False
    assert metrics["duration_s"] == pytest.approx(len(log) * PERIOD_S)
    assert np.isnan(metrics["pelvis_roll_rms_rad"])  # it never walked
    assert info["pelvis_error"] > walk_config.FALL_TILT_RAD


@pytest.mark.parametrize(
    ("change", "falls"),
    [
        ({"roll": 0.38}, False),
        ({"roll": 0.42}, True),
        ({"roll": -0.42}, True),
        ({"pitch": -0.38}, False),
        ({"pitch": 0.42}, True),
        ({"roll": 0.32, "pitch": 0.32}, True),
        ({"sink": 0.78}, False),
        ({"sink": 0.72}, True),
    ],
)
def test_a_fall_is_a_tilt_or_a_height_beyond_its_limit(
    change: dict[str, float], falls: bool
) -> None:
    """Catches limits in other units, of roll alone, or of the wrong height."""
    assert (walk_config.FALL_TILT_RAD, walk_config.FALL_HEIGHT_SHARE) == (0.4, 0.75)
    env = walk_env(scenario="ideal")
    if "sink" in change:
        lean(env)
        env.simulation.qpos[0, 2] = change["sink"] * 0.66
    else:
        lean(env, **change, height_m=1.0)
    *_, terminated, truncated, info = env.step(zeros())
    assert terminated == falls
    assert not truncated
    assert info["termination"] == ("fell" if falls else "")


def test_the_end_of_the_plan_truncates(open_loop: Recording) -> None:
    """Catches an episode that ends early, late, or as a failure, and metrics before its end."""
    assert len(open_loop.results) == NUM_STEPS + 1
    assert not any(result[2] or result[3] for result in open_loop.results[1:-1])
    assert not any("episode_metrics" in result[4] for result in open_loop.results[1:-1])
    *_, terminated, truncated, info = open_loop.results[-1]
    assert (terminated, truncated) == (False, True)
    assert info["termination"] == ""
    assert (info["episode_metrics"]["fell"], info["episode_metrics"]["diverged"]) == (False, False)
    assert info["time_s"] == pytest.approx(3.1)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_divergence_ends_the_episode_with_its_reason(value: float) -> None:
    """Catches MuJoCo's silent reset, and NaN in what the policy sees."""
    env = walk_env()
    for action in random_actions(5, 1)[:, 0]:
        env.step(action)
    break_world(env, 0, value)
    observation, reward, terminated, truncated, info = env.step(zeros())
    assert (terminated, truncated) == (True, False)
    assert info["termination"] == "diverged"
    assert info["reward_terms"]["fall"] == -200.0
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    assert all(np.isfinite(v) for v in info.values() if isinstance(v, float))
    assert info["episode_metrics"]["diverged"] is True
    assert info["episode_metrics"]["fell"] is False
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation, make_walk(**SHORT).reset(seed=0)[0])
    *_, terminated, _, info = env.step(zeros())
    assert not terminated
    assert info["termination"] == ""


# --------------------------------------------------------------------------------------------------
# Wrong input
# --------------------------------------------------------------------------------------------------


def test_actions_beyond_the_bounds_act_as_the_bounds_and_are_counted() -> None:
    """Catches clipping that is missing, silent or off by the rounding of float32."""
    results = []
    for size in (5.0, float(np.float32(0.3))):
        env = walk_env(scenario="ideal")
        action = zeros()
        action[3] = -size
        results.append(env.step(action))
    assert_equal(results[0][:4], results[1][:4])
    assert [result[4]["clipped"] for result in results] == [1.0, 0.0]
    assert results[0][4]["command_rate"] == pytest.approx(0.3 / np.sqrt(12) / PERIOD_S, rel=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_names_value_bounds_and_shape(value: float) -> None:
    """Catches NaN that reaches the physics, where it would look like a divergence."""
    env = walk_env()
    many = walk_worlds(3)
    many.reset(seed=0)
    action = zeros(3)
    action[2, 4] = value
    with pytest.raises(
        ActionError, match=rf"finite, within ±0\.3 rad, shape \(12,\).* got (?s:.*){value}"
    ):
        env.step(action[2])
    with pytest.raises(
        ActionError, match=rf"finite, within ±0\.3 rad.* got (?s:.*){value}(?s:.*) in world 2"
    ):
        many.step(action)


@pytest.mark.parametrize("shape", [(), (1,), (11,), (13,), (1, 12), (12, 1)])
def test_an_action_of_wrong_shape_names_the_right_one(shape: tuple[int, ...]) -> None:
    """Catches broadcasting of actions that were meant otherwise."""
    env = walk_env()
    with pytest.raises(ActionError) as error:
        env.step(np.zeros(shape, dtype=np.float32))
    assert "shape (12,) [rad], within ±0.3 rad" in str(error.value)
    assert f"got shape {shape}" in str(error.value)


@pytest.mark.parametrize("shape", [(), (12,), (3,), (12, 3), (2, 12), (3, 11), (3, 12, 1)])
def test_actions_of_wrong_shape_name_the_right_one(shape: tuple[int, ...]) -> None:
    """Catches one action that is silently given to all worlds, and NumPy's error in place of
    ours."""
    env = walk_worlds(3)
    env.reset(seed=0)
    with pytest.raises(ActionError) as error:
        env.step(np.zeros(shape, dtype=np.float32))
    assert "shape (3, 12) [rad], within ±0.3 rad" in str(error.value)
    assert f"got shape {shape}" in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"scenario": "nominl"},
            r"unknown scenario 'nominl'; choose one of: ideal, nominal, soft, .*slope.*'nominal'",
        ),
        ({"scenario": "soft+stiff"}, r"'stiff' sets stiffness a second time"),
        (
            {"step": 3},
            (
                r"unknown argument of elastic_env/WalkInPlace-v0 'step'; choose one of:"
                r" step_period, num_steps"
            ),
        ),
        (
            {"step_period": 2.0},
            r"one of 24, 3, 1\.6, 1\.1 \[s\], or the three durations.* such as .*; got 2\.0",
        ),
        (
            {"step_period": [0.3, 0.5]},
            r"three durations of double, single and double support \[s\].*; got \[0\.3, 0\.",
        ),
        ({"step_period": "fast"}, r"one of 24, 3, 1\.6, 1\.1 \[s\].*; got 'fast'"),
        (
            {"step_period": [0.3, 0.501, 0.3]},
            r"single_support_s must be a multiple of the control period of 0\.004 s, got 0\.501 s; "
            r"the nearest are 0\.5 s and 0\.504 s",
        ),
        (
            {"step_period": [0, 0.5, 0.3]},
            r"Gait\.double_support_s must be a finite number > 0 and <= 3600 \[s\], got 0",
        ),
        ({"num_steps": 0}, r"Gait\.num_steps must be a whole number >= 1 and <= 1000, got 0"),
        ({"num_steps": 1.5}, r"Gait\.num_steps must be a whole number >= 1 and <= 1000, got 1\.5"),
        (
            {"gait": {"hip_height_m": 0.75}},
            r"foot is out of reach at 0\.000 s: 0\.6500 m.*at most 0\.6 m; lower hip_h",
        ),
        (
            {"gait": {"lift": 0.1}},
            (
                r"unknown parameter of gait beside step_period and num_steps 'lift'; choose .*Did"
                r" you mean 'lift_m'"
            ),
        ),
        (
            {"gait": {"lift_m": 0.5}},
            r"too much of joint 'r_\w+' at .* s: it allows .* rad, the plan needs .* rad; use",
        ),
        (
            {"gait": 3.0},
            (
                r"gait must be a mapping of settling_steps, step_length_m, step_width_m, turn_rad,"
                r" lift_m, hip_height_m, transfer, got 3\.0; see also step_period"
            ),
        ),
        (
            {"robot": {"hip": 1}},
            r"unknown parameter of Thormang 'hip'; choose one of: hip_half_spacing, twin_knee",
        ),
        ({"robot": {"friction": -1.0}}, r"Thormang\.friction must be a finite number > 0, got -1"),
        ({"robot": "mk1"}, r"robot must be a Thormang or a mapping of its parameters, got 'mk1'"),
        ({"reward": {"tlit": 1.0}}, r"'tlit'.*Did you mean 'tilt'"),
        (
            {"reward": 2.0},
            r"reward must be a WalkRewardWeights or a mapping of its parameters, got 2.0",
        ),
        ({"joint": 1001}, r"joint must be a ElasticJoint or a mapping of its parameters, got 1001"),
        (
            {"joint": {"servo": None}},
            r"a servo is needed on every joint, but there is none on: l_hip_yaw, .*r_ankle_r",
        ),
        (
            {"stiffness": [1, 2, 3]},
            r"one number or a list of 12 \[N·m/rad\].*l_hip_yaw, .*; got \[1.0, 2.0, 3.0\]",
        ),
        (
            {"stiffness": -5.0},
            r"ElasticJoint\.stiffness must be a finite number > 0 \[N·m/rad\], got -5",
        ),
        (
            {"stiffness": [*[1001.0] * 11, np.nan]},
            r"ElasticJoint\.stiffness must be a finite.* \[N·m/rad\], got nan",
        ),
        (
            {"stiffness": "no/such.json"},
            r"number \[N·m/rad\] or an identification file, found no file no/such",
        ),
        ({"form": "series"}, r"form must be 'tendon' or 'rigid', got 'series'"),
        ({"render_mode": "ascii"}, r"unknown render mode 'ascii'; choose one of: rgb_array, human"),
    ],
)
def test_a_wrong_argument_names_itself_and_what_exists(
    arguments: dict[str, Any], message: str
) -> None:
    """Catches an argument that is ignored, and an error that sends the user into the source."""
    with pytest.raises(ConfigurationError, match=message):
        make_walk(**{**SHORT, **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"autoreset_mode": "Next"},
            r"unknown autoreset mode 'Next'; choose one of: NextStep, SameStep, Disabled",
        ),
        ({"num_envs": 0}, r"num_envs must be a whole number >= 1, got 0"),
        ({"num_threads": -1}, r"num_threads must be a whole number >= 0, 0 for all, got -1"),
        ({"num_threads": "x"}, r"num_threads must be a whole number >= 0, 0 for all, got 'x'"),
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
        make_walk_vector(**{**SHORT, **arguments})


def test_a_robot_too_soft_to_stand_says_so() -> None:
    """Catches an episode that begins in a fall."""
    env = make_walk(**SHORT, stiffness=100.0)
    with pytest.raises(
        ValueError, match=r"the robot does not stand: pelvis at .* m \(planned 0\.660 m\).*too soft"
    ):
        env.reset(seed=0)


def test_defaults_are_those_of_the_paper() -> None:
    """Catches a default that drifts: the robot, the gait and the control rate."""
    config = make_walk().task.config
    gait = config.gait
    assert (gait.double_support_s, gait.single_support_s, gait.last_double_support_s) == (
        1.1,
        0.8,
        1.1,
    )
    assert gait.num_steps == 4
    assert config.scenario.name == "nominal"
    assert config.robot.hip_half_spacing == 0.105
    assert not config.robot.twin_knee
    assert 1.0 / config.control_period_s == pytest.approx(250.0)
    assert config.timestep_s == 1e-3
    env = make_walk(step_period=24, num_steps=1)
    assert env.task.num_steps == round(26.0 / PERIOD_S)
    assert env.assumed_model.joint_names == JOINTS
    assert env.assumed_model.rigid.body_mass.sum() == pytest.approx(MASS_KG)
