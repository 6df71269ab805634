"""The named policies on the walker: compositions, assumed model, scalar and vector alike, and
the figures they give."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environments
from baselines.catalogue import ON_JOINTS, ON_THE_WALKER, QUICK_WALKING
from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.dynamic_compensator import DynamicCompensator
from baselines.compensation.gravity_torque import make_gravity
from baselines.compensation.oracle import Oracle, TrueSensors
from baselines.compensation.policy import Zero
from baselines.policies import sensors_needed
from baselines.walking.controller import WalkingController, WalkingGains
from baselines.walking.refined_plan import RefinedWalk, refine_model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array

ID = "elastic_env/WalkInPlace-v0"
NAMES = (
    "zero",
    "uncompensated_open",
    "uncompensated",
    "input_open",
    "input",
    "input_output",
    "input_wrench",
    "dynamic",
    "oracle",
)
COMPENSATED = NAMES[3:]
EVERY = tuple(ON_THE_WALKER)
PERIOD_S = 0.004
AT_ONCE = {"ramp_s": PERIOD_S}
"""Options with which everything is there from the first step."""
SHORT = [0.3, 0.5, 0.3]


def scalar(scenario: str = "nominal", name: str = "zero") -> Any:
    """An environment of one short step, with the sensors that a policy needs.

    Policies of the same sensors share it.
    """
    return scalar_with(scenario, tuple(sensors_needed(name)))


@cache
def scalar_with(scenario: str, sensors: tuple[str, ...]) -> Any:
    return gymnasium.make(
        ID, step_period=SHORT, num_steps=1, scenario=scenario, sensors=list(sensors)
    )


def vector(name: str = "zero") -> Any:
    """Two of them."""
    return vector_with(tuple(sensors_needed(name)))


@cache
def vector_with(sensors: tuple[str, ...]) -> Any:
    return gymnasium.make_vec(
        ID,
        num_envs=2,
        vectorization_mode="vector_entry_point",
        num_threads=1,
        step_period=SHORT,
        num_steps=1,
        scenario="nominal",
        sensors=list(sensors),
    )


def first(env: Any, seed: int = 0) -> Array:
    """The first observation of an episode."""
    observation: Array = env.reset(seed=seed)[0]
    return observation


def run(policy: Any, env: Any, steps: int, seed: int = 0) -> tuple[Array, Array]:
    """Observations and actions of the beginning of an episode, (steps, ...) each."""
    observation = first(env, seed)
    state = None
    observations = []
    actions = []
    for step in range(steps):
        observations.append(observation)
        action, state = policy.predict(
            observation, state, np.full(observation.shape[:-1], step == 0)
        )
        observation, *_ = env.step(action)
        actions.append(action)
    return np.array(observations), np.array(actions)


def replayed(policy: Any, observations: Array) -> Array:
    """Actions for recorded observations of one world."""
    state = None
    actions = []
    for step, observation in enumerate(observations):
        action, state = policy.predict(observation, state, step == 0)
        actions.append(action)
    return np.array(actions)


@cache
def recording() -> Array:
    """Every eighth observation of the uncompensated walker, which stands for a second and then
    makes most of a step."""
    env = scalar()
    observations, _ = run(baselines.make("uncompensated", env), env, 400)
    return observations[::8]


@cache
def standing_with(sensors: tuple[str, ...]) -> Array:
    """A few observations of the walker that stands, with further sensors."""
    env = scalar_with("nominal", sensors)
    observations, _ = run(baselines.make("uncompensated", env), env, 40)
    return observations[::4]


@pytest.mark.parametrize("name", EVERY)
def test_vector_actions_are_the_scalar_ones_row_by_row(name: str) -> None:
    """Catches memory that leaks between worlds, and formulas or truths that depend on the size
    of the batch."""
    worlds = vector(name)
    world = scalar(name=name)
    _, together = run(baselines.make(name, worlds), worlds, 15, seed=21)
    assert together.dtype == np.float32
    for number in range(2):
        _, alone = run(baselines.make(name, world), world, 15, seed=21 + number)
        np.testing.assert_array_equal(together[:, number], alone)
    assert (name == "zero") == (not together.any())


@pytest.mark.parametrize("name", EVERY)
def test_first_observation_is_known_as_the_start_of_an_episode(name: str) -> None:
    """Catches a plan that already moves in its first row taken for the middle of an episode."""
    env = scalar(name=name)
    observation = first(env)
    policy = baselines.make(name, env)
    action, _ = policy.predict(observation, None)
    np.testing.assert_array_equal(action, policy.predict(observation, None, True)[0])


@cache
def commanded(name: str) -> Array:
    """Actions of a named policy for the recording."""
    return replayed(baselines.make(name, scalar()), recording())


def composition(name: str, model: Any) -> Any:
    """What the name stands for, put together by hand."""
    plain = WalkingController(model)
    blind = WalkingController(model, com_feedback=False)
    compensated = baselines.Compensated
    return {
        "zero": lambda: Zero(model),
        "uncompensated_open": lambda: blind,
        "uncompensated": lambda: plain,
        "input_open": lambda: compensated(blind, GravityCompensator(model, "none")),
        "input": lambda: compensated(plain, GravityCompensator(model, "none")),
        "input_output": lambda: compensated(plain, GravityCompensator(model, "taylor")),
        "input_wrench": lambda: compensated(plain, GravityCompensator(model, "wrench")),
        "dynamic": lambda: compensated(plain, DynamicCompensator(model, "wrench")),
    }[name]()


@pytest.mark.parametrize("name", NAMES[:-1])
def test_name_stands_for_its_composition(name: str) -> None:
    """Catches a name with another's compensator, output method or feedback; all of them command
    different things."""
    by_hand = replayed(composition(name, scalar().unwrapped.assumed_model), recording())
    np.testing.assert_array_equal(by_hand, commanded(name))
    for other in NAMES[:-1]:
        assert other == name or np.abs(by_hand - commanded(other)).max() > 1e-5


def test_input_is_the_controller_that_takes_motors_for_links_and_equation_9() -> None:
    """Catches Eq. 9 at the reference instead of where the controller wants the links, and a
    controller that sees q."""
    env = scalar()
    model = env.unwrapped.assumed_model
    observations = recording()
    own = replayed(WalkingController(model, **AT_ONCE), observations).astype(np.float64)
    q_ref = observations[:, model.observation_table.group("reference_angle")]
    offset = make_gravity(model, "com").at(observations).gravity_torque(q_ref + own) / 1001.0
    actions = replayed(baselines.make("input", env, **AT_ONCE), observations)
    np.testing.assert_allclose(actions, own + offset, rtol=0.0, atol=1e-8)
    assert np.abs(own).max() > 1e-3


FAST = WalkingGains(dcm=1.0, force_difference=1e-4)


@pytest.mark.parametrize(
    ("option", "value", "controller", "compensator"),
    [
        ("com_feedback", False, {"com_feedback": False}, {}),
        ("gains", FAST, {"gains": FAST}, {}),
        ("output", "newton", {}, {"output": "newton"}),
        ("gravity", "lumped", {}, {"method": "lumped"}),
    ],
)
def test_options_reach_the_part_that_they_are_for(
    option: str, value: Any, controller: Any, compensator: Any
) -> None:
    """Catches an option that is read and not used, or that the policy's name overrules."""
    env = scalar()
    model = env.unwrapped.assumed_model
    by_hand = baselines.Compensated(
        WalkingController(model, **controller),
        GravityCompensator(model, **{"output": "wrench", **compensator}),
    )
    made = replayed(baselines.make("input_wrench", env, **{option: value}), recording())
    np.testing.assert_array_equal(made, replayed(by_hand, recording()))
    assert np.abs(made - commanded("input_wrench")).max() > 1e-5


@pytest.mark.parametrize(
    "given", [{"stiffness_scale": 0.5}, {"stiffness": 500.5}, {"stiffness": [500.5] * 12}]
)
def test_half_the_stiffness_takes_twice_the_offset(given: dict[str, Any]) -> None:
    """Catches an assumed stiffness that does not reach the walker's compensation, or only some
    of its joints."""
    env = scalar("ideal")
    observation = first(env)
    nominal, soft = (
        baselines.make("input_open", env, **AT_ONCE, **o).predict(observation, None, True)[0]
        for o in ({}, given)
    )
    np.testing.assert_allclose(soft, 2.0 * nominal, rtol=1e-4, atol=1e-6)
    assert np.abs(nominal).max() > 0.02


def test_stiffness_per_joint_reaches_its_joint() -> None:
    """Catches stiffnesses in another order: only the left knee and the right ankle are told to
    be softer."""
    env = scalar("ideal")
    model = env.unwrapped.assumed_model
    observation = first(env)
    K = np.full(12, 1001.0)
    K[[3, 10]] = 400.0
    offset = make_gravity(model).at(observation[None]).gravity_torque(model.plan.q[1:2])[0] / K
    action, _ = baselines.make("input_open", env, stiffness=K, **AT_ONCE).predict(
        observation, None, True
    )
    np.testing.assert_allclose(action, offset, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("option", [{"stiffness": 900.0}, {"stiffness_scale": 0.7}])
def test_oracle_takes_no_stiffness(option: dict[str, Any]) -> None:
    """Catches an option of the oracle that would be ignored."""
    with pytest.raises(
        ConfigurationError,
        match=r"knows the true one; its options are: gains, com_feedback, ramp_s, posture, zmp_offset,",
    ):
        baselines.make("oracle", scalar(), **option)


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("zero", {"stiffness": 5}),
        ("zero", {"gains": FAST}),
        ("uncompensated_open", {"com_feedback": True}),
        ("uncompensated", {"output": "taylor"}),
        ("uncompensated", {"gravity": "com"}),
        ("input_open", {"com_feedback": False}),
        ("oracle", {"gravity": "com"}),
    ],
)
def test_an_option_without_effect_is_an_error(name: str, option: dict[str, Any]) -> None:
    """Catches an option that is read and not used, because the policy's name has settled it or
    has no such part."""
    with pytest.raises(
        ConfigurationError, match=rf"{name!r} of the walk.* does not use {next(iter(option))}; it"
    ):
        baselines.make(name, scalar(), **option)


@pytest.mark.parametrize(
    "name", ["uncompensated_open", "uncompensated", "input_open", "input", "dynamic"]
)
def test_a_sweep_of_the_stiffness_reaches_every_policy_that_assumes_one(name: str) -> None:
    """Catches the controller alone, which turns torques into the ankles' offsets by K, left out
    of a sweep."""
    env = scalar()
    half = replayed(baselines.make(name, env, stiffness_scale=0.5), recording())
    assert np.abs(half - commanded(name)).max() > 1e-4


def test_oracle_knows_the_true_stiffness_and_mass() -> None:
    """Catches an oracle with the assumed model: at rest its knees get the true torque over the
    true stiffness."""
    offsets = {}
    for scenario in ("ideal", "ideal+soft", "ideal+payload"):
        env = scalar(scenario)
        action, _ = baselines.make("oracle", env, **AT_ONCE).predict(first(env), None, True)
        offsets[scenario] = float(action[3])
    assert offsets["ideal+soft"] / offsets["ideal"] == pytest.approx(1.0 / 0.7, rel=0.01)
    assert offsets["ideal+payload"] / offsets["ideal"] == pytest.approx(
        1.0 + 5.0 / 45.1, rel=0.03
    )  # over the knees


def test_oracle_is_its_composition_with_the_true_model() -> None:
    """Catches a controller inside the oracle that knows the assumed masses and ankles, and
    friction wound twice. Without friction there is no feedback around it."""
    env = scalar("ideal+soft+payload")
    true = env.unwrapped.truth().model
    assumed = env.unwrapped.assumed_model
    settings = {"friction": False, "integral_gain": 0.0, **AT_ONCE}
    walked = refine_model(true)
    by_hand, wrong = (
        RefinedWalk(Oracle(env, controller, walked, **settings), true, walked)
        for controller in (
            WalkingController(model, gains=QUICK_WALKING, **AT_ONCE)
            for model in (walked, refine_model(assumed))
        )
    )
    _, actions = run(baselines.make("oracle", env, **AT_ONCE), env, 20)
    np.testing.assert_array_equal(run(by_hand, env, 20)[1], actions)
    assert np.abs(run(wrong, env, 20)[1] - actions).max() > 1e-4


def test_the_sensors_of_the_oracle_show_the_truth() -> None:
    """Catches noise, a bias or a delay that the oracle sees, and columns of another sensor."""
    env = scalar("sensor+payload")
    seen: list[Any] = []

    class Recorder(Zero):
        def act(self, rows: Any, memory: None, inputs: Any) -> Any:
            seen.append(rows.copy())
            return super().act(rows, memory, inputs)

    model = env.unwrapped.assumed_model
    run(TrueSensors(env, Recorder(model)), env, 20)
    table = model.observation_table
    observation, *_ = env.step(np.zeros(12, dtype=np.float32))
    columns = table.group("imu_attitude")
    assert np.abs(seen[-1][0, columns] - observation[columns]).max() > 1e-5
    TrueSensors(env, Recorder(model)).predict(observation, None, np.array([True]))
    truth = env.unwrapped.truth()
    np.testing.assert_array_equal(seen[-1][0, columns], truth.attitude[0])
    np.testing.assert_array_equal(seen[-1][0, table.group("imu_rate")], truth.pelvis_rate[0])
    np.testing.assert_array_equal(seen[-1][0, table.group("wrench")], truth.wrench[0].ravel())
    kept = table.group("encoder_angle")
    np.testing.assert_array_equal(seen[-1][0, kept], observation[kept])


def test_unknown_names_are_told_those_of_the_robot() -> None:
    """Catches a KeyError, and policies of the walker offered to, or built for, the testbed."""
    with pytest.raises(ConfigurationError) as caught:
        baselines.make("input_wrensch", scalar())
    assert "Did you mean 'input_wrench'?" in str(caught.value)
    assert all(name in str(caught.value) for name in NAMES)
    testbed = gymnasium.make("elastic_env/Testbed-v0", reference="sine")
    for name in ("uncompensated_open", "input_open", "input_output", "input_wrench"):
        with pytest.raises(
            ConfigurationError, match=f"'{name}' is a policy of the walker, not of the testbed"
        ) as caught:
            baselines.make(name, testbed)
        choices = str(caught.value).split(f"'{name}'")[1]
        assert f"choose one of: {', '.join(ON_JOINTS)}, residual:PATH" in choices


@pytest.mark.parametrize("name", [name for name in EVERY if name != "oracle"])
def test_policies_know_the_assumed_model_and_not_the_scenario(name: str) -> None:
    """Catches a policy that is told the true stiffness or mass: the same observations must give
    the same actions."""
    worlds = [scalar(scenario, name) for scenario in ("nominal", "soft", "payload")]
    inside = worlds[0].unwrapped
    task = SimpleNamespace(observation_table=inside.task.observation_table)
    blind = SimpleNamespace(
        unwrapped=SimpleNamespace(assumed_model=inside.assumed_model, task=task)
    )
    shown = standing_with(tuple(sensors_needed(name)))
    actions = [replayed(baselines.make(name, env), shown) for env in (*worlds, blind)]
    for other in actions[1:]:
        np.testing.assert_array_equal(other, actions[0])
    truth = worlds[1].unwrapped.truth().model
    assert truth.stiffness == pytest.approx(np.full(12, 700.7))  # and soft is soft for somebody


@pytest.mark.parametrize("name", EVERY)
def test_only_the_oracle_asks_for_the_truth(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a policy that cheats while it runs, and an oracle that does not look."""
    env = scalar(name=name)
    truth = env.unwrapped.truth
    asked = []
    monkeypatch.setattr(env.unwrapped, "truth", lambda: asked.append(name) or truth())
    run(baselines.make(name, env), env, 3)
    assert bool(asked) == (name == "oracle")


class Leaning:
    """A user's own policy: turns the hips by an offset that counts its calls, and keeps what it
    has seen."""

    def __init__(self) -> None:
        self.seen: list[Array] = []

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Array, Any]:
        """An offset of the hip rolls of every world, and {"calls": number of calls so far}."""
        self.seen.append(observation.copy())
        calls = 1 + (0 if state is None else state["calls"])
        action = np.zeros((*observation.shape[:-1], 12))
        action[..., [1, 7]] = 0.01 * calls
        return action, {"calls": calls}


@pytest.mark.parametrize("make_env", [scalar, vector])
def test_compensation_around_a_users_policy(make_env: Any) -> None:
    """Catches a user's action or state that gets lost, Eq. 9 beside the links it wants, and
    motors shown for links."""
    env = make_env()
    model = env.unwrapped.assumed_model
    user = Leaning()
    policy = baselines.Compensated(user, GravityCompensator(model, "newton"), **AT_ONCE)
    observations, actions = run(policy, env, 4)
    table = model.observation_table
    n = len(model.observation_table)
    theta = table.group("encoder_angle")
    rate = table.group("encoder_rate")
    others = np.setdiff1d(np.arange(n), [*range(n)[theta], *range(n)[rate]])
    for step in range(4):
        rows = observations[step].reshape(-1, n)
        shown = user.seen[step].reshape(-1, n)
        wanted = rows[:, table.group("reference_angle")] + 0.01 * (step + 1) * np.isin(
            np.arange(12), [1, 7]
        )
        offset = make_gravity(model).at(rows).gravity_torque(wanted) / 1001.0
        expected = wanted - rows[:, table.group("reference_angle")] + offset
        np.testing.assert_allclose(actions[step].reshape(-1, 12), expected, rtol=0.0, atol=1e-8)
        assert user.seen[step].shape == observations[step].shape
        np.testing.assert_array_equal(shown[:, others], rows[:, others])
        # Eq. 10: what is shown stands where the assumed springs hold it
        tau = make_gravity(model).at(rows, level=False).gravity_torque(shown[:, theta])
        np.testing.assert_allclose(
            1001.0 * (rows[:, theta] - shown[:, theta]), tau, rtol=0.0, atol=1e-8
        )


@pytest.mark.parametrize("name", COMPENSATED)
def test_link_estimate_is_a_row_for_every_world(name: str) -> None:
    """Catches an estimate of the wrong shape or sign: at rest it must not be further off than
    the motors are."""
    for env in (scalar("ideal"), vector()):
        observation = first(env)
        policy = baselines.make(name, env)
        _, state = policy.predict(observation, None, np.full(observation.shape[:-1], True))
        estimate = policy.link_estimate(observation, state)
        assert estimate.shape == (*observation.shape[:-1], 12)
        truth = env.unwrapped.truth()
        q = truth.q.reshape(estimate.shape)
        theta = truth.theta.reshape(estimate.shape)
        share = {"input_open": 1.0, "input": 1.0, "oracle": 0.0}.get(name, 0.2)
        assert np.abs(estimate - q).max() <= share * np.abs(theta - q).max() + 1e-5


# ----------------------------------------------------------------------------------------- figures,
# friction aside


def roll_rms(step_period: float, names: tuple[str, ...], num_steps: int) -> dict[str, float]:
    """Roll error of the pelvis over a short walk without friction or noise, rms [rad];
    infinite after a fall."""
    env: Any = gymnasium.make_vec(
        ID,
        num_envs=len(names),
        vectorization_mode="vector_entry_point",
        num_threads=1,
        step_period=step_period,
        num_steps=num_steps,
        scenario="ideal",
    )
    policies = [baselines.make(name, env) for name in names]
    observation = first(env)
    states = [None] * len(names)
    walking = env.unwrapped.task.plan.timing.walking
    fell = np.zeros(len(names), dtype=np.bool_)
    squares = np.zeros(len(names))
    for step in range(int(np.flatnonzero(walking)[-1])):
        actions = np.zeros((len(names), 12), dtype=np.float32)
        for world in np.flatnonzero(~fell):
            actions[world], states[world] = policies[world].predict(
                observation[world], states[world], step == 0
            )
        observation, _, terminated, _, info = env.step(actions)
        fell |= terminated
        squares += walking[step + 1] * info["pelvis_roll"] ** 2
    return dict(
        zip(names, np.where(fell, np.inf, np.sqrt(squares / walking.sum())).tolist(), strict=True)
    )


def test_fast_walk_needs_the_dynamic_torque() -> None:
    """Catches a broken dynamic feedforward or feedback: at 1.1 s a step it holds the pelvis, and
    nothing does not."""
    rms = roll_rms(1.1, ("uncompensated", "dynamic"), 1)
    assert rms["dynamic"] < 0.010
    assert rms["uncompensated"] > 5.0 * rms["dynamic"]


def test_every_part_of_the_compensation_helps_at_the_papers_gait() -> None:
    """Catches a compensator that does harm: at 3 s a step input and output compensator take their
    share of the error.

    The measured wrenches know no more than the plan where nothing is amiss, but must not know less.
    """
    rms = roll_rms(3.0, ("uncompensated", "input", "input_output", "input_wrench"), 1)
    assert rms["uncompensated"] > 2.0 * rms["input"]
    assert rms["input"] > 2.0 * rms["input_output"]
    assert rms["input_wrench"] < 1.1 * rms["input_output"]
    assert rms["input_wrench"] < 0.0025
