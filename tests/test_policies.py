"""The named policies and `Compensated`: one contract on scalar and vector environments, with and
without state."""

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.catalogue import ON_JOINTS, ON_THE_WALKER
from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.memory_rows import select_rows
from baselines.compensation.policy import Zero
from baselines.walking.controller import WalkingGains
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array

ID = "elastic_env/Testbed-v0"
SHORT = {"kind": "multisine", "amplitude": 0.01, "middle": 0.4, "duration_s": 0.1, "onset_s": 0.1}
NAMES = ("zero", "uncompensated", "input", "dynamic", "oracle")
WITH_MEMORY = ("input", "dynamic", "oracle")
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in NAMES},
    "newton": ("input", {"output": "newton", "gravity": "tree", "ramp_s": 0.1}),
}
PERIOD_S = 0.004
AT_ONCE = {"ramp_s": PERIOD_S}
"""Options with which the compensation is there from the first step."""


def at_once(name: str) -> dict[str, float]:
    """The same, for a policy that compensates."""
    return AT_ONCE if name in WITH_MEMORY else {}


def scalar(**arguments: Any) -> Any:
    """The scalar environment."""
    return gymnasium.make(ID, **{"reference": SHORT, "scenario": "nominal", **arguments})


def vector(num_envs: int, **arguments: Any) -> Any:
    """The vector environment."""
    return gymnasium.make_vec(
        ID,
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        **{"reference": SHORT, "scenario": "nominal", **arguments},
    )


def column(env: Any, name: str) -> int:
    """Where an observation holds a signal."""
    return env.unwrapped.task.observation_table.names.index(name)


def scalar_actions(
    variant: str, seed: int, steps: int, restart_at: int | None
) -> tuple[list[Array], list[float]]:
    """Actions and rewards of one world that is reset where its episode ends, and once before."""
    env = scalar()
    name, options = VARIANTS[variant]
    policy = baselines.make(name, env, **options)
    observation, _ = env.reset(seed=seed)
    state = None
    start = True
    actions = []
    rewards = []
    for step in range(steps):
        if step == restart_at:
            observation = env.reset()[0]
            start = True
        action, state = policy.predict(observation, state, np.array(start))
        observation, reward, terminated, truncated, _ = env.step(action)
        actions.append(action)
        rewards.append(reward)
        start = terminated or truncated
        if start:
            observation, _ = env.reset()
    return actions, rewards


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in (*WITH_MEMORY, "newton")))
        for name in VARIANTS  # the others have no memory
    ],
)
def test_vector_actions_are_the_scalar_ones_row_by_row(variant: str) -> None:
    """Catches memory that leaks between worlds or episodes, and formulas that depend on the size
    of the batch."""
    env = vector(2, autoreset_mode=AutoresetMode.SAME_STEP)
    steps = env.unwrapped.task.num_steps + 30
    restart_at = 270
    name, options = VARIANTS[variant]
    policy = baselines.make(name, env, **options)
    observation, _ = env.reset(seed=11)
    state = None
    start = np.ones(2, dtype=np.bool_)
    actions = []
    rewards = []
    starts = 0
    for step in range(steps):
        if step == restart_at:  # only the second world
            start = np.array([False, True])
            observation, _ = env.reset(options={"reset_mask": start})
        action, state = policy.predict(observation, state, start)
        observation, reward, terminated, truncated, _ = env.step(action)
        actions.append(action)
        rewards.append(reward)
        start = terminated | truncated
        starts += int(start.sum())
    assert starts == 1  # the restarted world has not come to its end
    for world in range(2):
        alone = scalar_actions(variant, 11 + world, steps, restart_at if world == 1 else None)
        np.testing.assert_array_equal(np.array(actions)[:, world], np.array(alone[0]))
        np.testing.assert_array_equal(np.array(rewards)[:, world], np.array(alone[1]))


@pytest.mark.parametrize(
    "name",
    [
        "input",
        *(pytest.param(n, marks=pytest.mark.slow) for n in NAMES if n != "input"),
    ],
)
def test_evaluate_policy_of_sb3_gives_the_return_of_a_plain_loop(name: str) -> None:
    """Catches a signature, a shape or a state that Stable-Baselines3 cannot use, and lost
    episode starts."""
    env = scalar()
    worlds = DummyVecEnv([lambda: env])
    worlds.seed(3)
    returns, lengths = evaluate_policy(
        baselines.make(name, env),
        worlds,
        n_eval_episodes=2,
        return_episode_rewards=True,
        warn=False,
    )
    steps = env.unwrapped.task.num_steps
    _, rewards = scalar_actions(name, 3, 2 * steps, None)
    expected = (
        np.array(rewards, dtype=np.float32).astype(np.float64).reshape(2, steps).sum(axis=1)
    )  # SB3's precision
    np.testing.assert_allclose(returns, expected, rtol=1e-12)
    assert lengths == [steps, steps]


@pytest.mark.parametrize("name", NAMES)
def test_actions_are_float32_of_the_shape_of_the_observations(name: str) -> None:
    """Catches float64 actions, and a batch dimension that is lost or added; one row alone is the
    same."""
    env = scalar()
    worlds = vector(2)
    single, _ = env.reset(seed=4)
    rows, _ = worlds.reset(seed=4)
    action, _ = baselines.make(name, env, **at_once(name)).predict(single)
    actions, _ = baselines.make(name, worlds, **at_once(name)).predict(rows)
    row, _ = baselines.make(name, env, **at_once(name)).predict(single[None])
    assert (action.dtype, action.shape) == (np.float32, (1,))
    assert (actions.dtype, actions.shape) == (np.float32, (2, 1))
    assert row.shape == (1, 1)
    assert env.action_space.contains(action)
    assert worlds.action_space.contains(actions)
    np.testing.assert_array_equal(action, actions[0])
    np.testing.assert_array_equal(action, row[0])


@pytest.mark.parametrize("name", WITH_MEMORY)
@pytest.mark.parametrize(
    "make_env", [scalar, lambda **kw: vector(2, **kw)], ids=["scalar", "vector"]
)
def test_predict_without_state_in_mid_episode_is_an_error(name: str, make_env: Any) -> None:
    """Catches a policy that silently starts its ramp anew because the caller forgot the state."""
    env = make_env()
    policy = baselines.make(name, env)
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation)
    observation, *_ = env.step(action)
    with pytest.raises(ElasticError, match="without `state`"):
        policy.predict(observation)


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_predict_without_state_is_an_error_where_no_episode_starts(name: str) -> None:
    """Catches episode_start that is not believed: one world in the middle of an episode is
    enough."""
    env = vector(2)
    observation, _ = env.reset(seed=0)
    with pytest.raises(ElasticError, match="without `state`"):
        baselines.make(name, env).predict(observation, None, np.array([True, False]))


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_state_of_another_number_of_worlds_is_an_error(name: str) -> None:
    """Catches a state that is broadcast over the worlds."""
    env = vector(2)
    policy = baselines.make(name, env)
    observation, _ = env.reset(seed=0)
    _, state = policy.predict(observation)
    with pytest.raises(ElasticError, match="2, got 1"):
        policy.predict(observation, select_rows(state, np.array([True, False])))


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_episode_start_clears_its_rows_and_no_others(name: str) -> None:
    """Catches memory that survives a new episode, and a new episode that clears the memory of
    its neighbours."""
    env = vector(2)
    policy = baselines.make(name, env)
    observation, _ = env.reset(seed=0)
    first, state = policy.predict(observation)
    for _ in range(50):
        last, state = policy.predict(observation, state)
    assert np.all(np.abs(last) > np.abs(first))  # the ramp has grown
    ahead, _ = policy.predict(observation, state)
    mixed, _ = policy.predict(observation, state, np.array([True, False]))
    np.testing.assert_array_equal(mixed, [first[0], ahead[1]])


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_predict_changes_neither_state_nor_observation(name: str) -> None:
    """Catches memory written in place: the same state must give the same action again."""
    env = vector(2)
    policy = baselines.make(name, env)
    observation, _ = env.reset(seed=0)
    before = observation.copy()
    _, state = policy.predict(observation)
    again = [policy.predict(observation, state)[0] for _ in range(2)]
    np.testing.assert_array_equal(again[0], again[1])
    np.testing.assert_array_equal(observation, before)


def test_zero_and_uncompensated_play_the_reference_back() -> None:
    """Catches an offset where there is no controller to add one: on the testbed both are
    nothing."""
    env = vector(2)
    observation, _ = env.reset(seed=0)
    for name in ("zero", "uncompensated"):
        action, _ = baselines.make(name, env).predict(observation)
        assert np.all(action == 0.0)


@pytest.mark.parametrize("name", ["zero", "uncompensated", "input", "dynamic"])
def test_policies_other_than_the_oracle_get_along_without_the_truth(name: str) -> None:
    """Catches a policy that reads the plant: it gets by with the assumed model and the names of
    its observations."""
    env = vector(2, scenario="soft+payload")
    inside = env.unwrapped
    task = SimpleNamespace(observation_table=inside.task.observation_table)
    blind = SimpleNamespace(
        unwrapped=SimpleNamespace(assumed_model=inside.assumed_model, task=task)
    )
    observation, _ = env.reset(seed=0)
    actions = [
        baselines.make(name, e, **at_once(name)).predict(observation)[0] for e in (env, blind)
    ]
    np.testing.assert_array_equal(actions[0], actions[1])


@pytest.mark.parametrize("name", NAMES)
def test_only_the_oracle_asks_for_the_truth(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a policy that cheats while it runs, and an oracle that does not look."""
    env = scalar(scenario="soft")
    asked = []
    truth = env.unwrapped.truth

    def watched() -> Any:
        asked.append(name)
        return truth()

    monkeypatch.setattr(env.unwrapped, "truth", watched)
    policy = baselines.make(name, env)
    observation, _ = env.reset(seed=0)
    state = None
    for _ in range(5):
        action, state = policy.predict(observation, state)
        observation, *_ = env.step(action)
    assert bool(asked) == (name == "oracle")


def compensation(env: Any, **options: Any) -> tuple[float, float]:
    """First action of `input` without ramp, and the reference angle."""
    observation, _ = env.reset(seed=0)
    action, _ = baselines.make("input", env, **AT_ONCE, **options).predict(observation)
    return float(action[0]), float(observation[column(env, "reference_angle")])


@pytest.mark.parametrize("scenario", ["nominal", "soft", "stiff", "payload", "backlash"])
def test_input_knows_the_assumed_model_and_not_the_scenario(scenario: str) -> None:
    """Catches a compensator that is told the true stiffness or mass: it takes 1001 N·m/rad and
    60 N·m everywhere."""
    env = scalar(scenario=scenario)
    assert env.unwrapped.assumed_model.stiffness == pytest.approx([1001.0])
    action, q_ref = compensation(env)
    assert action == np.float32(60.0 * np.sin(q_ref) / 1001.0)


def test_scenario_changes_the_true_stiffness() -> None:
    """Catches a `soft` that is soft for nobody."""
    assert scalar(scenario="soft").unwrapped.truth().model.stiffness == pytest.approx([700.7])


@pytest.mark.parametrize("kind", ["float", "int", "list", "path", "text", "numpy", "array"])
def test_stiffness_can_be_a_number_a_list_or_an_identification(kind: str, tmp_path: Path) -> None:
    """Catches an option that is read but not used, or that only some types reach."""
    path = tmp_path / "identification.json"
    path.write_text(json.dumps({"stiffness_nm_per_rad": 640.0, "points": 12}))
    given = {
        "float": 640.0,
        "int": 640,
        "list": [640.0],
        "path": path,
        "text": str(path),
        "numpy": np.float32(640.0),
        "array": np.array([640]),
    }[kind]
    action, q_ref = compensation(scalar(), stiffness=given)
    assert action == np.float32(60.0 * np.sin(q_ref) / 640.0)


def test_stiffness_of_the_environment_is_the_one_that_input_assumes() -> None:
    """Catches `stiffness=` that changes the plant alone."""
    action, q_ref = compensation(scalar(stiffness=300.0))
    assert action == np.float32(60.0 * np.sin(q_ref) / 300.0)


@pytest.mark.parametrize("value", [["900"], [True], np.array(["900"]), True, [[900.0], [1.0, 2.0]]])
def test_stiffness_that_is_no_number_is_an_error(value: object) -> None:
    """Catches text and truth that NumPy converts."""
    with pytest.raises(ConfigurationError, match=r"stiffness must be (a )?numbers? \[N·m/rad\]"):
        baselines.make("input", scalar(), stiffness=value)


@pytest.mark.parametrize("value", [-5.0, 0.0, np.nan, np.inf])
def test_impossible_stiffness_says_which_unit_and_bound(value: float) -> None:
    """Catches NaN that slips through, and messages that speak of Pydantic's unions instead of
    the stiffness."""
    with pytest.raises(ConfigurationError) as caught:
        baselines.make("input", scalar(), stiffness=value)
    assert re.fullmatch(
        r"[^\n]*stiffness must be a finite number > 0 \[N·m/rad\], got [^\n]*", str(caught.value)
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "no file"), ("{}", "is no identification"), ("K = 3", "is no identification")],
)
def test_a_file_without_identification_is_an_error(
    content: str | None, message: str, tmp_path: Path
) -> None:
    """Catches a bare KeyError or FileNotFoundError."""
    path = tmp_path / "other.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigurationError, match=f"{message}.*|.*{message}") as caught:
        baselines.make("input", scalar(), stiffness=path)
    assert "other.json" in str(caught.value)


def test_unknown_policy_names_itself_and_the_choices() -> None:
    """Catches a KeyError, and a list that leaves a policy out."""
    with pytest.raises(ConfigurationError) as caught:
        baselines.make("inputt", scalar())
    assert "unknown policy of the testbed 'inputt'" in str(caught.value)
    assert "Did you mean 'input'?" in str(caught.value)
    assert all(name in str(caught.value) for name in NAMES)
    assert set(baselines.policy_names()) >= set(NAMES)


def test_the_table_of_make_has_every_policy_where_it_is() -> None:
    """Catches a policy that the docs leave out, or promise on a robot that does not have it."""
    rows = [
        line.strip(" |").split(" | ")
        for line in (baselines.make.__doc__ or "").splitlines()
        if "| `" in line
    ]
    for column, known in ((1, ON_JOINTS), (2, ON_THE_WALKER)):
        named = {
            name for row in rows for name in re.findall(r"`(\w+)`", row[0]) if row[column] != "–"
        }
        assert named == set(known)


def test_unknown_option_names_itself_and_the_choices() -> None:
    """Catches an option that is silently ignored because it is spelt wrong."""
    with pytest.raises(
        ConfigurationError,
        match=r"'input' on the testbed 'stifness'; .*: stiffness, .*, gravity, ramp_s\..*'stiffness'",
    ):
        baselines.make("input", scalar(), stifness=900.0)


@pytest.mark.parametrize(
    ("option", "choices"), [("output", ("taylor", "newton")), ("gravity", ("hinge", "tree"))]
)
def test_unknown_method_lists_the_choices(option: str, choices: tuple[str, ...]) -> None:
    """Catches a method that falls back to the default."""
    with pytest.raises(ConfigurationError) as caught:
        baselines.make("input", scalar(), **{option: "magic"})
    assert all(word in str(caught.value) for word in (option, "magic", *choices))


@pytest.mark.parametrize("ramp_s", [0.0, 1e9])
def test_ramp_must_be_positive_and_end(ramp_s: float) -> None:
    """Catches a division by zero in the ramp, and a table of it that no memory holds."""
    with pytest.raises(
        ConfigurationError,
        match=rf"ramp_s must be a finite number > 0 and <= 3600 \[s\], got {ramp_s}",
    ):
        baselines.make("input", scalar(), ramp_s=ramp_s)


@pytest.mark.parametrize("name", ["input", "residual:testbed/seed_0", "iterative:nowhere"])
def test_an_environment_that_is_not_ours_is_named(name: str) -> None:
    """Catches an AttributeError of a folder that is read before the environment is looked at."""
    with pytest.raises(ConfigurationError, match="an assumed model, got CartPoleEnv; make one"):
        baselines.make(name, gymnasium.make("CartPole-v1"))


def test_arguments_of_the_wrong_type_are_one_sentence() -> None:
    """Catches an AttributeError."""
    number: Any = 3
    with pytest.raises(ConfigurationError, match="assumed model, got NoneType"):
        baselines.make("input", None)
    with pytest.raises(ConfigurationError, match="unknown policy 3; choose one of: zero"):
        baselines.make(number, scalar())


def test_oracle_takes_no_stiffness() -> None:
    """Catches an option of the oracle that would be ignored."""
    with pytest.raises(
        ConfigurationError, match=r"does not use stiffness but knows the true one; .*: ramp_s$"
    ):
        baselines.make("oracle", scalar(), stiffness=np.array([900.0]))


FAST = WalkingGains(force_difference=1e-6)


@pytest.mark.parametrize(
    ("name", "option", "message"),
    [
        (
            "zero",
            {"stiffness": 5},
            "'zero' of the testbed does not use stiffness; it has no options$",
        ),
        (
            "uncompensated",
            {"ramp_s": 1.0},
            "'uncompensated' of the testbed does not use ramp_s; it has no options$",
        ),
        (
            "input",
            {"com_feedback": True},
            "com_feedback; .*: stiffness, stiffness_scale, output, gravity, ramp_s$",
        ),
        (
            "dynamic",
            {"gains": FAST},
            "gains; its options are: stiffness, stiffness_scale, output, gravity, ramp_s$",
        ),
        ("oracle", {"output": "newton"}, "output; its options are: ramp_s$"),
    ],
)
def test_an_option_without_effect_is_an_error(
    name: str, option: dict[str, Any], message: str
) -> None:
    """Catches an option of the walker, or of a compensator that is not there, which changes
    nothing."""
    with pytest.raises(ConfigurationError, match=message):
        baselines.make(name, scalar(), **option)


def test_an_option_that_is_none_is_not_given() -> None:
    """Catches a default that is handed on and refused."""
    assert isinstance(baselines.make("zero", scalar(), stiffness=None, output=None), Zero)


def test_oracle_integrates_the_true_link_error_up_to_its_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Catches an integrator of the wrong sign, in another unit of time, or without bound: 1 per
    s up to 50 mrad."""
    env = scalar()
    policy = baselines.make("oracle", env, **AT_ONCE)
    observation, _ = env.reset(seed=0)
    q_ref = observation[column(env, "reference_angle")]
    here = env.unwrapped.truth()
    truth = dataclasses.replace(here, q=np.array([[q_ref - 0.02]]))
    monkeypatch.setattr(env.unwrapped, "truth", lambda: truth)
    state = None
    actions = []
    for _ in range(800):
        action, state = policy.predict(observation, state)
        actions.append(float(action[0]) - float(actions[0] if actions else 0.0))
    np.testing.assert_allclose(
        actions[1:600:100], 0.02 * PERIOD_S * np.arange(1, 600, 100), rtol=0.0, atol=1e-7
    )
    np.testing.assert_allclose(actions[700:], 0.05, rtol=0.0, atol=1e-7)


def test_foreign_environment_is_an_error_with_a_cure() -> None:
    """Catches an AttributeError from deep inside."""
    with pytest.raises(ConfigurationError, match=r"assumed model, got CartPoleEnv.*Testbed-v0"):
        baselines.make("input", gymnasium.make("CartPole-v1"))


def test_ramp_grows_to_the_full_offset_within_its_time() -> None:
    """Catches compensation that starts with a jump, overshoots, or ends below the full offset."""
    env = scalar(
        reference={
            "kind": "sine",
            "amplitude": 0.005,
            "middle": 0.5,
            "duration_s": 0.1,
            "onset_s": 0.1,
        }
    )
    policy = baselines.make("input", env, ramp_s=0.2)
    observation, _ = env.reset(seed=0)
    state = None
    actions = []
    for _ in range(60):
        action, state = policy.predict(observation, state)
        observation, *_ = env.step(action)
        actions.append(float(action[0]))
    full = 60.0 * np.sin(0.5) / 1001.0
    assert actions[0] < 1e-3 * full
    assert np.all(np.diff(actions[:50]) > 0.0)
    np.testing.assert_allclose(actions[24], full / 2.0, rtol=1e-6)  # the blend is symmetric
    np.testing.assert_array_equal(actions[49:], [float(np.float32(full))] * 11)


class Proportional:
    """A user's own controller: pushes the link it sees towards the reference, and counts its
    calls in its state."""

    gain = 0.4

    def __init__(self, env: Any) -> None:
        self._theta = column(env, "encoder_angle")
        self._q_ref = column(env, "reference_angle")
        self.seen: list[Array] = []

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Array, Any]:
        """An offset for every observation, and {"calls": number of calls so far}."""
        self.seen.append(observation.copy())
        error = observation[..., self._q_ref] - observation[..., self._theta]
        return self.gain * error[..., None], {"calls": 1 + (0 if state is None else state["calls"])}


def compensated(env: Any, user: Proportional) -> baselines.Compensated:
    """The user's controller with the paper's compensator around it, without ramp."""
    inside = env.unwrapped
    compensator = GravityCompensator(inside.assumed_model, output="newton")
    return baselines.Compensated(user, compensator, ramp_s=PERIOD_S)


@pytest.mark.parametrize(
    "make_env", [scalar, lambda **kw: vector(2, **kw)], ids=["scalar", "vector"]
)
def test_wrapped_policy_sees_the_link_where_the_observation_has_the_encoder(make_env: Any) -> None:
    """Catches a wrapper that shows encoder angles, changes other columns, or hands rows to a
    policy of one world."""
    env = make_env(scenario="ideal")
    user = Proportional(env)
    observation, _ = env.reset(seed=0)
    compensated(env, user).predict(observation)
    theta = column(env, "encoder_angle")
    rate = column(env, "encoder_rate")
    seen = user.seen[0]
    assert seen.shape == observation.shape
    q = env.unwrapped.truth().q.reshape(seen[..., theta].shape)
    np.testing.assert_allclose(
        seen[..., theta], q, rtol=0.0, atol=1e-12
    )  # the plant starts at rest
    assert np.all(np.abs(observation[..., theta] - q) > 0.01)
    others = [i for i in range(seen.shape[-1]) if i not in (theta, rate)]
    np.testing.assert_array_equal(seen[..., others], observation[..., others])


def test_wrapped_policy_sees_the_rate_of_the_link() -> None:
    """Catches an encoder rate handed on as the link's: while gravity helps the motion the link
    is faster or slower."""
    env = scalar(scenario="ideal", stiffness=300.0)
    user = Proportional(env)
    observation, _ = env.reset(seed=0)
    rate = column(env, "encoder_rate")
    observation[rate] = 0.5
    compensated(env, user).predict(observation, None, np.array(True))
    q = env.unwrapped.truth().q[0, 0]
    expected = 300.0 * 0.5 / (300.0 + 60.0 * np.cos(q))
    assert user.seen[0][rate] == pytest.approx(expected, rel=1e-9)


def test_compensation_is_that_of_the_link_angle_that_the_policy_wants() -> None:
    """Catches Eq. 9 taken at the reference alone, and a user action that gets lost: a + 60/K
    sin(q_ref + a)."""
    env = vector(2, scenario="nominal")
    user = Proportional(env)
    observation, _ = env.reset(seed=0)
    action, _ = compensated(env, user).predict(observation)
    own, _ = Proportional(env).predict(user.seen[0])
    q_ref = observation[:, [column(env, "reference_angle")]]
    expected = own + 60.0 / 1001.0 * np.sin(q_ref + own)
    assert np.all(np.abs(own) > 1e-3)
    np.testing.assert_allclose(action, expected, rtol=0.0, atol=1e-8)


def test_state_of_the_wrapped_policy_travels_inside() -> None:
    """Catches a nested state that is dropped, or handed to the wrong call."""
    env = scalar()
    policy = compensated(env, Proportional(env))
    observation, _ = env.reset(seed=0)
    state = None
    for _ in range(4):
        action, state = policy.predict(observation, state)
        observation, *_ = env.step(action)
    assert state.inner.state == [{"calls": 4}]


@pytest.mark.parametrize(
    ("name", "options", "tolerance"),
    [("input", {"output": "newton"}, 1e-12), ("input", {}, 2e-4), ("oracle", {}, 0.0)],
    ids=["newton", "taylor", "oracle"],
)
@pytest.mark.parametrize(
    "make_env", [scalar, lambda **kw: vector(2, **kw)], ids=["scalar", "vector"]
)
def test_link_estimate_at_rest_is_the_link_angle(
    name: str, options: Any, tolerance: float, make_env: Any
) -> None:
    """Catches an estimate of the wrong sign or shape: the ideal plant starts at rest, where Eq.
    10 is exact."""
    env = make_env(scenario="ideal")
    policy = baselines.make(name, env, **options)
    observation, _ = env.reset(seed=0)
    _, state = policy.predict(observation)
    estimate = policy.link_estimate(observation, state)
    q = env.unwrapped.truth().q.reshape(estimate.shape)
    assert estimate.shape == (*observation.shape[:-1], 1)
    np.testing.assert_allclose(estimate, q, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("name", [pytest.param("input", marks=pytest.mark.slow), "dynamic"])
def test_link_estimate_in_motion_is_what_the_policy_saw(name: str) -> None:
    """Catches an estimate of the next control period beside the encoders of this one."""
    env = vector(2, scenario="ideal")
    seen = []

    class Watching:
        def predict(self, observation: Any, state: Any = None, *_: Any) -> Any:
            seen.append(observation[:, [column(env, "encoder_angle")]])
            return np.zeros((len(observation), 1)), state

    policy = baselines.Compensated(Watching(), baselines.make(name, env).compensator)
    observation, _ = env.reset(seed=0)
    state = None
    for _ in range(300):
        action, state = policy.predict(observation, state)
        np.testing.assert_array_equal(policy.link_estimate(observation, state), seen[-1])
        observation = env.step(action)[0]
    assert np.ptp(seen) > 0.01


def test_zero_takes_the_encoder_for_the_link() -> None:
    """Catches an uncompensated policy that is credited with an estimate it does not make."""
    env = vector(2)
    observation, _ = env.reset(seed=0)
    estimate = baselines.make("uncompensated", env).link_estimate(observation, None)
    np.testing.assert_array_equal(estimate, observation[:, [column(env, "encoder_angle")]])


def test_oracle_refuses_an_environment_that_is_not_its_own() -> None:
    """Catches a truth of another world, read in silence."""
    policy = baselines.make("oracle", scalar())
    other = scalar()
    observation, _ = other.reset(seed=1)
    with pytest.raises(ElasticError, match="that it was made for"):
        policy.predict(observation + 1e-3)


def test_observation_of_another_table_is_refused() -> None:
    """Catches columns that are taken for others."""
    policy = baselines.make("input", scalar())
    with pytest.raises(ElasticError, match="columns of its table"):
        policy.predict(np.zeros(5))


def test_compensated_takes_its_columns_from_the_compensator() -> None:
    """Catches the fixed form baselines.Compensated(policy, compensator) that does not work."""
    env = scalar()
    observation, _ = env.reset(seed=0)
    inner = baselines.make("zero", env)
    policy = baselines.Compensated(inner, baselines.GravityCompensator(env.unwrapped.assumed_model))
    expected, _ = baselines.make("input", env).predict(observation)
    np.testing.assert_array_equal(policy.predict(observation)[0], expected)


def of_ones_own(env: Any, first_command: float) -> tuple[Any, Array]:
    """An environment that knows an assumed model and a table alone, and its first observation."""
    inside = env.unwrapped
    observation, _ = env.reset(seed=0)
    observation = observation.copy()
    observation[..., column(env, "last_command")] = first_command
    task = SimpleNamespace(observation_table=inside.task.observation_table, name="my arm")
    return (
        SimpleNamespace(unwrapped=SimpleNamespace(assumed_model=inside.assumed_model, task=task)),
        observation,
    )


@pytest.mark.parametrize("name", ["input", "dynamic"])
def test_an_environment_of_ones_own_begins_with_no_command(name: str) -> None:
    """Catches a first observation that is taken for the middle of an episode for want of a
    clock."""
    own, observation = of_ones_own(scalar(), first_command=0.0)
    baselines.make(name, own).predict(observation)
    own, observation = of_ones_own(scalar(), first_command=0.3)
    with pytest.raises(
        ElasticError, match=r"known by a reference at rest, and no command yet.*episode_start=True"
    ):
        baselines.make(name, own).predict(observation)
    baselines.make(name, own).predict(observation, None, np.array([True]))


def test_the_oracle_says_what_an_environment_of_ones_own_lacks() -> None:
    """Catches an error that speaks of mixtures to somebody who has none."""
    own, _ = of_ones_own(scalar(), first_command=0.0)
    with pytest.raises(
        ConfigurationError, match=r"by a method truth\(\) of the environment, which SimpleNamespace"
    ):
        baselines.make("oracle", own)


class Half(GravityCompensator):
    """A user's compensator: half of Eq. 9."""

    def offset(self, motion: Any, memory: Array) -> tuple[Array, Array]:
        offset, memory = super().offset(motion, memory)
        return 0.5 * offset, memory


class Counting:
    """A compensator of a user that derives from nothing: it leads by a microradian per control
    step."""

    modelled = 1.0

    def __init__(self, model: Any) -> None:
        self.model = model

    def at(self, rows: Array) -> "Counting":
        return self

    def begin(self, motion: Any) -> Array:
        return np.zeros((len(motion.q), 1))

    def offset(self, motion: Any, memory: Array) -> tuple[Array, Array]:
        return np.full_like(motion.q, 1e-6) * (memory + 1.0), memory + 1.0

    def deflection(self, offset: Array, memory: Array) -> Array:
        return offset

    def link_angle(self, theta: Array, memory: Array) -> Array:
        return theta - 0.25

    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        return theta_dot


@pytest.mark.parametrize(
    "make_env", [scalar, lambda **kw: vector(2, **kw)], ids=["scalar", "vector"]
)
def test_compensators_of_users_work(make_env: Any) -> None:
    """Catches an interface that asks more of a compensator than the docs do, and memory that
    does not come back."""
    env = make_env()
    model = env.unwrapped.assumed_model
    zero = baselines.make("zero", env)
    observation, _ = env.reset(seed=0)
    whole, _ = baselines.make("input", env, **AT_ONCE).predict(observation)
    half, _ = baselines.Compensated(zero, Half(model), **AT_ONCE).predict(observation)
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-6)
    counting = baselines.Compensated(zero, Counting(model), **AT_ONCE)
    state = None
    for step in range(1, 4):
        action, state = counting.predict(observation, state)
        np.testing.assert_allclose(action, 1e-6 * step, rtol=1e-6)
    theta = observation[..., [column(env, "encoder_angle")]]
    np.testing.assert_array_equal(counting.link_estimate(observation, state), theta - 0.25)


def test_a_policy_of_a_user_is_told_how_it_was_called() -> None:
    """Catches a flag that gets lost on the way, and an episode start of another world."""
    env = vector(2)
    calls = []

    class Listening:
        def predict(
            self,
            rows: Array,
            state: Any = None,
            episode_start: Any = None,
            deterministic: bool = True,
        ) -> Any:
            calls.append((state, np.array(episode_start).tolist(), deterministic))
            return np.zeros((len(rows), 1)), len(calls)

    policy = baselines.Compensated(Listening(), GravityCompensator(env.unwrapped.assumed_model))
    observation, _ = env.reset(seed=0)
    _, state = policy.predict(observation, deterministic=False)
    _, state = policy.predict(observation, state)
    policy.predict(observation, state, np.array([False, True]))
    assert calls == [
        (None, [True, True], False),
        (1, [False, False], True),
        (2, [False, True], True),
    ]
