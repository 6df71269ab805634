"""A robot of three joints that the package does not know: environments, scenarios, policies,
commands, report."""

import copy
import csv
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from baselines.residual_env import ResidualWrapper
from elastic_env import JointRobot
from elastic_env.core.errors import ConfigurationError
from elastic_env.world.scenario import scenario_names
from tests.played import metrics_of
from tests.three_joints import ARM, rigid_arm
from train.commands.cli import main

ARM.register()
ROBOT = Path(__file__).with_name("three_joints.py")
QUICK = {"kind": "sine", "amplitude": 0.3, "duration_s": 2.0, "onset_s": 1.0}
STILL = {"kind": "sine", "amplitude": 1e-9, "duration_s": 0.2, "onset_s": 0.2}


def scalar(**arguments: Any) -> Any:
    return gymnasium.make("elastic_env/Arm-v0", **{"reference": QUICK, **arguments})


def vector(worlds: int, **arguments: Any) -> Any:
    given = {"reference": QUICK, "vectorization_mode": "vector_entry_point", **arguments}
    return gymnasium.make_vec("elastic_env/Arm-v0", num_envs=worlds, **given)


def link_error(policy: str, **arguments: Any) -> float:
    """RMS of an episode [rad]."""
    return float(metrics_of(scalar(**arguments), policy)["link_error_rms_rad"])


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in ("spread", "sensor", "drawn")))
        for name in scenario_names(walks=False)
        if name != "imu"
    ],
)
def test_the_checkers_find_nothing_in_any_scenario(scenario: str) -> None:
    """Catches spaces, seeding and types that several joints break."""
    check_env(scalar(scenario=scenario).unwrapped, skip_render_check=True)
    check_sb3_env(scalar(scenario=scenario).unwrapped, skip_render_check=True)


def test_at_rest_the_links_hang_where_gravity_and_springs_have_them() -> None:
    """Catches joints that are mixed up: K δ is the torque of MuJoCo's own gravity at the link
    angles."""
    env = scalar(scenario="ideal", reference=STILL)
    observation, _ = env.reset(seed=0)
    for _ in range(400):
        observation, *_ = env.step(np.zeros(3, dtype=np.float32))
    truth = env.unwrapped.truth()
    model = rigid_arm().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = truth.q[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(400.0 * (truth.theta - truth.q)[0], data.qfrc_bias, atol=2e-3)
    assert np.abs(data.qfrc_bias[1:]).min() > 5.0
    encoder = env.unwrapped.task.observation_table.group("encoder_angle")
    np.testing.assert_array_equal(observation[encoder], truth.theta[0])


def test_a_spread_gives_every_joint_of_every_robot_a_stiffness_of_its_own() -> None:
    """Catches springs that stay as they were, or as another world has them: MuJoCo's gravity at
    rest is the judge."""
    worlds = vector(4, scenario="ideal+spread", reference=STILL, autoreset_mode="SameStep")
    model = rigid_arm().compile()
    data = mujoco.MjData(model)
    seen = []
    worlds.reset(seed=0)
    for _ in range(2):  # the second episodes have robots of their own
        for _ in range(80):
            worlds.step(np.zeros((4, 3), dtype=np.float32))
        truth = worlds.unwrapped.truth()
        for q, delta, stiffness in zip(truth.q, truth.deflection, truth.stiffness, strict=True):
            data.qpos[:] = q
            mujoco.mj_forward(model, data)
            np.testing.assert_allclose(stiffness * delta, data.qfrc_bias, atol=2e-3)
        seen.append(truth.stiffness)
        for _ in range(worlds.unwrapped.task.num_steps - 80):
            worlds.step(np.zeros((4, 3), dtype=np.float32))
    factors = np.concatenate(seen).ravel() / 400.0
    assert len(np.unique(factors)) == len(factors)
    assert 0.7 < factors.min() < 0.85
    assert 1.15 < factors.max() < 1.3
    again = scalar(scenario="ideal+spread", reference=STILL)
    again.reset(seed=2)
    np.testing.assert_array_equal(again.unwrapped.truth().stiffness[0], seen[0][2])


def test_what_a_model_knows_a_compensator_takes_away() -> None:
    """Catches a compensator that is of one joint: by the true model little is left, by a wrong
    one what it misses."""
    without, statics, dynamics = (
        link_error(name, scenario="ideal") for name in ("uncompensated", "input", "dynamic")
    )
    assert statics < 0.25 * without
    assert dynamics < 0.05 * statics
    soft = link_error("uncompensated", scenario="ideal+soft")
    assert soft == pytest.approx(without / 0.7, rel=0.1)
    left = link_error("dynamic", scenario="ideal+soft")
    assert left == pytest.approx(0.3 * soft, rel=0.15)


@pytest.mark.slow
def test_an_oracle_knows_soft_joints_and_a_payload_bends_all() -> None:
    """Catches an oracle that knows the assumed springs, and a load that is none of this robot."""
    left = link_error("dynamic", scenario="ideal+soft")
    assert link_error("oracle", scenario="soft") < 0.1 * left
    without = link_error("uncompensated", scenario="ideal")
    assert link_error("uncompensated", scenario="ideal+payload") > 1.1 * without


def test_worlds_of_a_vector_are_the_scalar_ones() -> None:
    """Catches a world that depends on its neighbours; random references and homing errors are
    each world's own."""
    arguments = {
        "scenario": "sensor",
        "reference": {"kind": "multisine", "duration_s": 0.2, "onset_s": 0.2},
    }
    many = vector(3, **arguments)
    seen = [many.reset(seed=5)[0]]
    action = np.full((3, 3), 0.01, dtype=np.float32)
    seen += [many.step(action)[0] for _ in range(280)]
    for world in range(3):
        env = scalar(**arguments)
        alone = [env.reset(seed=5 + world)[0]]
        alone += [env.step(action[0])[0] for _ in range(280)]
        np.testing.assert_array_equal(np.array(alone), np.array(seen)[:, world])
    reference = many.unwrapped.task.observation_table.group("reference_angle")
    assert len(np.unique(seen[-1][:, reference])) == 9


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on(copied: Any) -> None:
    """Catches Pinocchio's models, lambdas and views that do not travel."""
    env = vector(2, scenario="sensor")
    env.reset(seed=1)
    action = np.full((2, 3), 0.01, dtype=np.float32)
    env.step(action)
    twin = copied(env)
    env.reset(seed=2)
    twin.reset(seed=2)
    for _ in range(20):
        np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])


def test_an_agent_corrects_its_compensator() -> None:
    """Catches a residual that knows one joint or twelve."""
    env = ResidualWrapper(scalar(scenario="soft"), "input")
    observation, _ = env.reset(seed=0)
    assert env.action_space.shape == (3,)
    assert env.observation_space.contains(observation)
    assert np.isfinite(env.step(np.full(3, 0.2))[1])


@pytest.mark.slow
def test_it_is_drawn() -> None:
    """Catches a camera that looks elsewhere: the picture has the robot, and the robot moves."""
    env = scalar(render_mode="rgb_array", scenario="ideal")
    env.reset(seed=0)
    first = env.render().astype(np.float64)
    assert first.shape == (480, 640, 3)
    for _ in range(300):
        env.step(np.zeros(3, dtype=np.float32))
    later = env.render().astype(np.float64)
    env.close()
    assert np.std(first[100:-60]) > 5.0
    assert np.abs(later - first)[100:-60].max() > 50.0


@pytest.mark.slow
def test_the_commands_play_and_compare_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a command that knows two robots by name: the robot's file is all it needs, in
    workers too."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.py").write_text(ROBOT.read_text())
    reference = "{kind: sine, amplitude: 0.3, duration_s: 1.0, onset_s: 0.5}"
    main(
        [
            "evaluate",
            "--env",
            "arm.py:ARM",
            "--policy",
            "dynamic",
            "--scenario",
            "soft",
            "--reference",
            reference,
        ]
    )
    assert (tmp_path / "runs" / "evaluate" / "episodes.csv").is_file()
    (tmp_path / "arm.yaml").write_text(
        f"name: arm\nenv: arm.py:ARM\nreferences: [{reference}]\nscenarios: [nominal, soft]\n"
        "policies: [uncompensated, input, dynamic]\n"
    )
    main(["compare", "arm.yaml", "--jobs", "1"])
    folder = tmp_path / "runs" / "arm"
    rows = list(csv.DictReader((folder / "episodes.csv").open()))
    assert len(rows) == 6
    assert all(0.0 < float(row["link_error_rms_rad"]) < 0.1 for row in rows)
    assert "link error" in (folder / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "slope"}, "only a walker knows"),
        ({"stiffness": [100.0, 200.0]}, "a list of 3"),
        (
            {"reference": {"kind": "sine", "amplitude": 3.0, "frequency_hz": 2.0}},
            "can need .* of a servo limited to 150",
        ),
        ({"sensors": ["gyro"]}, "unknown sensor 'gyro'"),
        ({"observe_link": True}, "unknown argument of elastic_env/Arm-v0 'observe_link'"),
    ],
)
def test_what_cannot_be_says_why(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        scalar(**arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"home": 0.3}, "home must be a list, got 0.3"),
        ({"home": ["low", 0.0, 0.0]}, "home.0 must be a valid number, got 'low'"),
        ({"home": [0.0, float("nan"), 0.0]}, "home.1 must be a finite number, got nan"),
        ({"load_kg": "heavy"}, "load_kg must be a valid number, got 'heavy'"),
        ({"end_effector": ["tip"]}, r"end_effector must be text, got \['tip'\]"),
        ({"imu": 5}, "imu must be text, got 5"),
        ({"load_kg": 2.0}, "unknown site or body for end_effector None; choose one of: "),
        (
            {"load_kg": 2.0, "end_effector": "nose"},
            "unknown site or body for end_effector 'nose'; choose one of: ",
        ),
    ],
)
def test_values_of_a_robot_that_cannot_be_say_why(options: dict[str, Any], message: str) -> None:
    """Catches a TypeError or ValueError of NumPy or MuJoCo for a wrong value."""
    with pytest.raises(ConfigurationError, match=message):
        JointRobot("wrong", rigid_arm, ARM.joints, **options).robot.make(scenario="payload")


def test_what_is_no_robot_says_why(tmp_path: Path) -> None:
    """Catches an AttributeError for a name that stands for something else."""
    blind = JointRobot("blind", rigid_arm, ARM.joints).robot
    with pytest.raises(ConfigurationError, match="blind has no IMU: name its site"):
        blind.make(sensors=["accelerometer"])
    with pytest.raises(ConfigurationError, match="home must have one angle per joint, 3, got 2"):
        JointRobot("short", rigid_arm, ARM.joints, home=[0.0, 1.0]).robot.make()
    misnamed = JointRobot("misnamed", rigid_arm, ARM.joints, imu="nose").robot
    with pytest.raises(ConfigurationError, match="unknown site for the IMU 'nose'; choose one of"):
        misnamed.make(sensors=["accelerometer"])
    (tmp_path / "other.py").write_text("ARM = 3\n")
    from train.evaluate.environments import environment

    with pytest.raises(ConfigurationError, match=r"is no elastic_env.JointRobot but of type int"):
        environment(f"{tmp_path / 'other.py'}:ARM")
