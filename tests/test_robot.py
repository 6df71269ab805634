"""`elastic_env/Robot-v0`: any robot from a model file and its joints."""

import copy
import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import baselines
import elastic_env  # noqa: F401  registers the environment
from elastic_env.core.errors import ConfigurationError
from elastic_env.joint.held_joints import hold_other_joints
from elastic_env.robots.robot.environment import EXAMPLE, configure_robot
from elastic_env.robots.robot.joints import home_of_joints
from elastic_env.world.robot_model import joint_ranges
from tests.played import metrics_of
from tests.trees import TREE
from train.commands.cli import main
from train.evaluate.environments import environment

JOINTS = {"*": {"stiffness": 800.0}, "wrist": 400.0}
QUICK = {"kind": "sine", "amplitude": 0.2, "duration_s": 1.0, "onset_s": 0.5}
ARM = EXAMPLE.read_text()


def scalar(**arguments: Any) -> Any:
    given = {
        "model": ARM,
        "joints": JOINTS,
        "end_effector": "tool",
        "reference": QUICK,
        "scenario": "ideal",
    }
    return gymnasium.make("elastic_env/Robot-v0", **{**given, **arguments})


def with_actuators(actuators: str, also: str = "") -> str:
    return ARM.replace("<keyframe>", f"<actuator>{actuators}</actuator>{also}<keyframe>")


def test_held_joints_are_where_the_keyframe_has_them() -> None:
    """Catches hinges and slides that are taken out in another place: MuJoCo's own kinematics are
    the judge."""
    ref = 'knee" axis="0 -1 0.1" pos="0.01 0.02 0" ref="-0.5"'
    assert ref in TREE
    whole = mujoco.MjSpec.from_string(
        TREE.replace(
            "</mujoco>", '<keyframe><key qpos="0.4 -0.3 0.9 0.5 -0.2 0.7"/></keyframe></mujoco>'
        )
    )
    moving = ["pitch", "hip", "twist"]
    model = whole.compile()
    part = hold_other_joints(whole, moving).compile()
    data = mujoco.MjData(model)
    of_part = mujoco.MjData(part)
    generator = np.random.default_rng(1)
    for _ in range(5):
        data.qpos[:] = model.key_qpos[0]
        for name, angle in zip(moving, generator.uniform(-1.0, 1.0, 3), strict=True):
            data.joint(name).qpos = of_part.joint(name).qpos = angle
        mujoco.mj_forward(model, data)
        mujoco.mj_forward(part, of_part)
        np.testing.assert_allclose(of_part.xipos, data.xipos, atol=1e-12)
        np.testing.assert_allclose(of_part.ximat, data.ximat, atol=1e-12)
        for name in moving:
            np.testing.assert_allclose(
                of_part.joint(name).qfrc_bias, data.joint(name).qfrc_bias, atol=1e-11
            )


def test_a_limit_that_no_joint_reaches_is_none() -> None:
    """Catches a home pose of 10¹¹ rad, a tenth of the range from the end of it."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><geom size=".1"/><joint name="one" range="-2 2e12"/>
        <body pos="1 0 0"><geom size=".1"/><joint name="other" range="-2 2" axis="0 1 0"/></body>
        </body></worldbody><compiler angle="radian"/></mujoco>"""
    )
    lowest, highest = joint_ranges(model, ["one", "other"])
    assert lowest.tolist() == [-2.0, -2.0]
    assert highest.tolist() == [np.inf, 2.0]
    assert home_of_joints(model, ["one", "other"]).tolist() == [0.0, 0.0]


def test_what_is_not_given_comes_from_the_model() -> None:
    """Catches gains without their gear, a limit of the wrong actuator, and friction that is
    taken twice."""
    model = with_actuators(
        '<position joint="base" kp="300" kv="7" gear="2" forcerange="-30 40"/>'
        '<motor joint="shoulder" gear="5" ctrlrange="-12 12"/>'
    ).replace(
        'name="wrist" axis', 'name="wrist" armature="0.03" frictionloss="0.4" damping="0.6" axis'
    )
    config = configure_robot(model, JOINTS)
    wrist = config.joints["wrist"]
    base, shoulder, *_ = config.robot.plant(config).true.servos
    assert (base.position_gain, base.velocity_gain, base.integral_gain) == (1200.0, 28.0, 0.0)
    assert base.torque_limit == 60.0
    assert shoulder.torque_limit == 60.0
    assert shoulder.integral_gain > 0.0
    assert (wrist.rotor_inertia, wrist.coulomb_friction, wrist.viscous_friction) == (0.03, 0.4, 0.6)
    assert [joint.stiffness for joint in config.joints.values()] == [800.0, 800.0, 800.0, 400.0]
    played = config.robot.plant(config).model
    assert played.joint("wrist").frictionloss[0] == pytest.approx(0.4)
    assert played.joint("wrist").damping[0] == pytest.approx(0.6)
    assert config.robot.home == [0.0, 0.6, 0.9, 0.4]


def test_the_file_of_an_identification_is_taken(tmp_path: Path) -> None:
    """Catches a format that the command writes and the environment does not read."""
    file = tmp_path / "joints.yaml"
    file.write_text(
        "# stiffness [N·m/rad], by elastic identify\nbase: {stiffness: 900}  # ± 2 %\nelbow:"
        " {stiffness: 700}\n"
    )
    config = configure_robot(ARM, file)
    assert {name: joint.stiffness for name, joint in config.joints.items()} == {
        "base": 900.0,
        "elbow": 700.0,
    }


CORD = '<tendon><fixed name="cord" stiffness="5"><joint joint="grip" coef="1"/></fixed></tendon>'
NO_MASS = (
    '<mujoco><worldbody><body><joint name="a"/><geom size="0.1"'
    ' mass="0"/></body></worldbody></mujoco>'
)
NO_HINGE = (
    '<mujoco><worldbody><body><joint name="a" type="slide"/><geom'
    ' size="0.1"/></body></worldbody></mujoco>'
)
FLOATS = NO_HINGE.replace('name="a" type="slide"', 'name="a" type="free"').replace(
    "</body>", '<body><joint name="b"/><geom size="0.1"/></body></body>'
)
NO_MESH = (
    '<mujoco><asset><mesh name="m" file="lost.stl"/></asset><worldbody><body name="link"><joint'
    ' name="a"/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"joints": None}, r"no joint its stiffness K.*elastic identify --robot"),
        ({"joints": {}}, r"no joint its stiffness K"),
        (
            {"joints": {"*": {"damping": 3.0}}},
            r"'base' needs its stiffness K.*elastic identify --robot",
        ),
        ({"joints": {"*": 0.0}}, r"joint 'base':.*stiffness.*>= 1e-09"),
        ({"joints": {"*": "stiff"}}, r"joint 'base':.*stiffness.*number"),
        (
            {"joints": {"*": 800.0, "ellbow": 300.0}},
            r"unknown joint or pattern .* 'ellbow'.*Did you mean 'elbow'",
        ),
        (
            {"joints": {"grip": 800.0}},
            r"unknown joint or pattern of joints 'grip'; choose one of: base, shoulder",
        ),
        ({"joints": "none.yaml"}, r"no configuration file at none.yaml"),
        ({"joints": {"*": {"stiffness": 1.0, "colour": 2}}}, r"joint 'base':.*colour"),
        ({"model": None}, r"needs a model beside joints"),
        ({"model": "none.xml"}, r"no model at none.xml; give a file of MJCF"),
        ({"model": 3}, r"model must be a file of MJCF"),
        ({"model": "<mujoco>"}, r"is no XML"),
        (
            {"joints": {"*": 1e12}},
            (
                r"too stiff.*explode with a physics step of 4e-06 s.*less stiffness, or more rotor"
                r".*fastest are those of joint 'wrist': .* kg·m² on a spring of 1e.12 N·m/rad"
            ),
        ),
        ({"model": NO_HINGE}, r"the model has no hinge.*rotary joints"),
        ({"model": FLOATS}, r"joint 'a' is free or a ball joint; a fixed base"),
        (
            {"model": NO_MASS},
            r"mass and inertia of moving bodies.*needs a mass .kg. and an inertia",
        ),
        (
            {"model": NO_MESH},
            (
                r"body 'link'.*has its mass from a mesh that cannot be read.*give the body an"
                r" <inertial>"
            ),
        ),
        (
            {"end_effector": "tol"},
            r"unknown site or body for end_effector 'tol'.*Did you mean 'tool'",
        ),
        ({"home": {"elbo": 1.0}}, r"unknown joint of home 'elbo'"),
        (
            {"reference": {**QUICK, "amplitude": 2.5}},
            r"moves joint 'shoulder' from.*to.*rad, and its range is",
        ),
        (
            {"model": with_actuators('<position joint="base" kp="300" timeconst="0.1"/>')},
            r"no single position servo.*position_gain.*under `servo`",
        ),
        (
            {
                "model": with_actuators(
                    "", '<equality><joint joint1="elbow" joint2="wrist"/></equality>'
                )
            },
            (
                r"equality constraint of elbow and wrist, whose torque is not known in advance;"
                r" take it out"
            ),
        ),
        (
            {"model": with_actuators("", CORD.replace("grip", "elbow"))},
            r"tendon 'cord' has stiffness.*take it out",
        ),
    ],
)
def test_what_cannot_be_says_what_to_do(arguments: dict[str, Any], message: str) -> None:
    """Catches tracebacks of MuJoCo, and models that are played as something else than they are."""
    with pytest.raises(ConfigurationError, match=message):
        scalar(**arguments)


def test_bodies_without_names_get_some_where_no_hinge_moves_a_named_one() -> None:
    """Catches an arm that is refused as only its carriage has a name."""
    arm = (
        "<mujoco><worldbody><body name='body_2'><joint type='slide'/><geom size='0.1'/><body>"
        "<joint name='a' axis='0 1 0'/><geom size='0.1' pos='0.2 0 0'/><body pos='0.4 0 0'>"
        "<joint name='b' axis='0 1 0'/><geom size='0.1' pos='0.2 0 0'/></body></body></body>"
        "</worldbody></mujoco>"
    )
    config = configure_robot(arm, {"*": 500.0})
    assert config.robot.end_effector == "body_3"


def test_what_holds_is_taken_out_without_a_word() -> None:
    """Catches a gripper whose tendon, coupling and actuator keep a robot from being played."""
    also = CORD + '<equality><joint joint1="grip"/></equality>'
    config = configure_robot(
        with_actuators('<position joint="grip" kp="300"/><position tendon="cord"/>', also), JOINTS
    )
    assert list(config.joints) == ["base", "shoulder", "elbow", "wrist"]


def test_missing_meshes_are_drawn_as_capsules_and_said_once() -> None:
    """Catches a model that cannot be played because of what it looks like, and a picture without
    a robot."""
    inertial = '<inertial mass="1" pos="0 0 0.1" diaginertia="0.01 0.01 0.01"/>'
    model = NO_MESH.replace("<geom", f'{inertial}<body pos="0 0 0.4">{inertial}</body><geom')
    with pytest.warns(UserWarning, match=r"1 meshes .* missing or in a format .* lost.stl") as said:
        env = scalar(model=model, joints={"*": 800.0}, end_effector="link", render_mode="rgb_array")
    assert len([one for one in said if "meshes" in str(one.message)]) == 1
    env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.ptp(env.render()[100:-60]) > 100  # the robot, not the background alone
    env.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on(copied: Any) -> None:
    """Catches specifications of MuJoCo, which do not travel."""
    env = scalar(scenario="sensor")
    env.reset(seed=1)
    twin = copied(env)
    action = np.full(4, 0.01, dtype=np.float32)
    for _ in range(20):
        np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])


@pytest.mark.slow
def test_worlds_of_a_vector_are_the_scalar_ones() -> None:
    """Catches a world that depends on its neighbours."""
    arguments = {
        "scenario": "sensor",
        "reference": {"kind": "multisine", "amplitude": 0.2, "duration_s": 0.2, "onset_s": 0.2},
    }
    given = {
        "model": ARM,
        "joints": JOINTS,
        "vectorization_mode": "vector_entry_point",
        **arguments,
    }
    many = gymnasium.make_vec("elastic_env/Robot-v0", num_envs=2, **given)
    seen = [many.reset(seed=5)[0]]
    action = np.full((2, 4), 0.01, dtype=np.float32)
    seen += [many.step(action)[0] for _ in range(280)]
    for world in range(2):
        env = scalar(**arguments)
        alone = [env.reset(seed=5 + world)[0]] + [env.step(action[0])[0] for _ in range(280)]
        np.testing.assert_array_equal(np.array(alone), np.array(seen)[:, world])


def test_a_payload_hangs_at_the_end_effector() -> None:
    """Catches a load that nobody carries: its torque is that of a point mass in MuJoCo's own
    model."""
    config = configure_robot(
        ARM, JOINTS, scenario="ideal+payload", end_effector="tool", load_kg=5.0
    )
    plant = config.robot.plant(config)
    loaded = mujoco.MjSpec.from_string(
        ARM.replace(
            '<site name="tool" pos="0 0 0.15"/>',
            '<body pos="0 0 0.15"><geom type="sphere" size="0.01" mass="1"/></body>',
        )
    )
    model = loaded.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(
        plant.static_torque(data.qpos[None, :4])[0], data.qfrc_bias[:4], rtol=1e-9, atol=1e-9
    )
    assert plant.assumed.rigid.body_mass.sum() == pytest.approx(12.1)
    assert plant.true.rigid.body_mass.sum() == pytest.approx(13.1)


@pytest.mark.slow
def test_compensators_take_the_motion_of_the_end_effector_back() -> None:
    """Catches a compensator that knows another friction, servo or load than the robot has."""
    without, compensated = (metrics_of(scalar(), policy) for policy in ("uncompensated", "dynamic"))
    assert without["end_effector_error_rms_m"] > 2e-3
    assert compensated["end_effector_error_rms_m"] < 0.05 * without["end_effector_error_rms_m"]


MOTION = "{kind: sine, amplitude: 0.2, duration_s: 0.3, onset_s: 0.2}"


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The file of a robot in a folder below the working directory."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "arm.xml").write_text(ARM)
    (folder / "arm.yaml").write_text(EXAMPLE.with_suffix(".yaml").read_text())
    (folder / "arm.robot.yaml").write_text("model: arm.xml\njoints: arm.yaml\nend_effector: tool\n")
    return "mine/arm.robot.yaml"


def test_a_command_plays_a_robot_from_its_file(mine: str) -> None:
    """Catches a command that needs Python for a robot, and paths that hang on the working
    directory."""
    main(["evaluate", "--env", mine, "--policy", "dynamic", "--reference", MOTION])
    assert "end_effector_error_rms_m" in Path("runs/evaluate/episodes.csv").read_text()
    Path("no.yaml").write_text("name: no\n")
    with pytest.raises(
        ConfigurationError,
        match=r"no.yaml must be a file of a robot, with the keys model and joints",
    ):
        environment("no.yaml")


@pytest.mark.slow
def test_every_command_plays_a_robot_from_its_file(mine: str, tmp_path: Path) -> None:
    """Catches a report or a bench that knows the robots of the package alone."""
    (tmp_path / "one.yaml").write_text(
        f"name: one\nenv: {mine}\nreferences: [{MOTION}]\nscenarios: [ideal]\npolicies: [input]\n"
    )
    main(["compare", "one.yaml", "--jobs", "1"])
    assert "end effector error" in (tmp_path / "runs" / "one" / "report.html").read_text()
    (tmp_path / "bench.yaml").write_text(
        f"cases: [{{env: {mine}, policy: input, reference: {MOTION}, "
        "figures: {end_effector_error_rms_m: null}}]\n"
    )
    main(["bench", "bench.yaml", "--update"])
    main(["bench", "bench.yaml"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "name"),
    [("arm.robot.yaml", "robot"), pytest.param("own.py:ARM", "arm", marks=pytest.mark.slow)],
)
def test_a_residual_is_trained_on_a_robot_of_ones_own_and_compared(
    env: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a residual that is kept under the name of a file, which no environment has."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "arm.robot.yaml").write_text(
        "model: arm.xml\njoints: {'*': 800}\nend_effector: tool\n"
    )
    (tmp_path / "own.py").write_text(Path(__file__).with_name("three_joints.py").read_text())
    (tmp_path / "train.yaml").write_text(
        f"name: learned\nenv: {env}\nreference: {{kind: sine, duration_s: 0.5, onset_s:"
        " 0.5}\nscenarios: [soft]\nbase: input\nworlds: 2\ndecisions: 8\nevaluate_every:"
        " 8\ncheckpoint_every: 8\nalgorithm_options: {n_steps: 4, batch_size: 8, n_epochs: 1}\n"
    )
    main(["train", "train.yaml"])
    (tmp_path / "compare.yaml").write_text(
        f"name: compared\nenv: {env}\nreferences: [{{kind: sine, duration_s: 0.5, onset_s: 0.5}}]\n"
        'scenarios: [soft, spread]\npolicies: ["residual:runs/learned/seed_0/last"]\n'
    )
    main(["compare", "compare.yaml"])
    table = (tmp_path / "runs" / "compared" / "statistics.csv").read_text()
    assert "held out" in table
    with pytest.raises(
        ConfigurationError, match=f"is a residual for the {name}, the environment is the testbed"
    ):
        baselines.make(
            "residual:runs/learned/seed_0/last", gymnasium.make("elastic_env/Testbed-v0")
        )


def test_link_encoders_tell_the_stiffness_of_every_joint() -> None:
    """Catches an estimate that mixes joints up or does not reach the command: the true K is the
    judge."""
    env = scalar(scenario="ideal+spread", sensors=["link_encoder"], timestep_s=0.001)
    policy = baselines.make("link_encoder", env)
    state = None
    done = False
    info = {}
    observation, _ = env.reset(seed=2)
    factor = env.unwrapped.truth().stiffness[0] / env.unwrapped.assumed_model.stiffness
    while not done:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    correction = 1.0 + state.correction[0]
    np.testing.assert_allclose(correction[1:3], 1.0 / factor[1:3], rtol=0.02)
    np.testing.assert_allclose(
        policy.link_estimate(observation, state), env.unwrapped.truth().q[0], atol=1e-3
    )
    fixed = metrics_of(scalar(scenario="ideal+spread", timestep_s=0.001), "dynamic")[
        "end_effector_error_rms_m"
    ]
    assert info["episode_metrics"]["end_effector_error_rms_m"] < 0.5 * fixed


def test_an_action_that_cannot_take_the_weight_back_is_said_before_it_is_played() -> None:
    """Catches half of a sag that stays as actions are cut, without a word. The need is τ/k_p, in
    closed form."""
    soft = {"*": {"stiffness": 1e4, "servo": {"position_gain": 60.0}}}
    config = configure_robot(ARM, soft, reference="poses", scenario="ideal", end_effector="tool")
    with pytest.warns(
        UserWarning, match=r"'poses' bends joint 'shoulder' by up to .* actions are cut at"
    ) as said:
        plant = config.robot.plant(config)
    plan = plant.motion.plan(np.random.default_rng(0), 0.004)
    torque = np.abs(plant.static_torque(plan.q)[:, 1]).max()
    text = next(str(one.message) for one in said if "actions are cut" in str(one.message))
    assert float(re.findall(r"together need ([0-9.]+) N", text)[0]) == pytest.approx(
        torque / 0.3, rel=0.01
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="the weight")
        stiff = configure_robot(ARM, {"*": 5e3}, scenario="ideal", end_effector="tool")
        stiff.robot.plant(stiff)
