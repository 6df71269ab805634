"""`elastic robot`: its tables against what was played and against MuJoCo, its folder, its
errors."""

import csv
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rich.console import Console

import train.commands.comparison
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.motion.arm_references import Poses
from elastic_env.robots.gallery import GALLERY, gallery_file, gallery_joints, gallery_robot
from elastic_env.robots.robot.environment import EXAMPLE, configure_robot
from elastic_env.world.joint_plant import JointPlant
from tests.gallery_files import FOLDER
from train.commands.cli import main
from train.commands.robot import POLICIES, Robot, robot_arguments, try_robot, write_robot
from train.commands.robot_at_rest import joint_shares, rest_poses
from train.evaluate.conditions import Condition
from train.evaluate.environments import environment
from train.evaluate.episodes import Evaluation, evaluate

QUICK = Poses(positions=1, move_s=0.6, settle_s=0.5, measure_s=0.1)
SEVERAL = Poses(positions=5)
SINE = {"kind": "sine", "amplitude": 0.1, "duration_s": 0.5, "onset_s": 0.25}
JOINTS = EXAMPLE.with_suffix(".yaml")


def in_this_process(conditions: Sequence[Condition], *_: object) -> list[Evaluation]:
    return [evaluate(condition, num_threads=1) for condition in conditions]


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as opened:
        return list(csv.DictReader(opened))


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of the made-up arm, and what was printed."""
    root = tmp_path_factory.mktemp("robot")
    files = {"model": str(EXAMPLE), "stiffness": str(JOINTS), "output": root / "arm"}
    trial = Robot(**files, end_effector="tool", poses=QUICK, motion=SINE)
    with pytest.MonkeyPatch.context() as patch, (root / "printed.txt").open("w") as file:
        patch.setattr(train.commands.comparison, "run_conditions", in_this_process)
        folder, files = try_robot(trial, Console(width=160, file=file))
    assert all(made.is_file() for made in files)
    return folder, (root / "printed.txt").read_text()


@pytest.mark.slow
def test_the_table_says_what_was_played(tried: tuple[Path, str]) -> None:
    """Catches columns that are mixed up, a unit that is not that of its title, and a comparison
    without effect."""
    folder, printed = tried
    table = rows(folder / "end_effector.csv")
    episodes = rows(folder / "comparison" / "episodes.csv")
    assert [(row["motion"], row["policy"]) for row in table] == [
        (motion, policy) for motion in ("poses", "sine") for policy in POLICIES
    ]
    for row, episode in zip(table, episodes, strict=True):
        assert (row["motion"], row["policy"]) == (episode["reference"], episode["policy"])
        assert float(row["error_rms_m"]) == float(episode["end_effector_error_rms_m"])
        assert float(row["error_peak_m"]) == float(episode["end_effector_error_peak_m"])
    for motion in ("poses", "sine"):
        errors = [1e3 * float(row["error_rms_m"]) for row in table if row["motion"] == motion]
        assert [motion, *(f"{error:.3f}" for error in errors)] in [
            line.split()[:4] for line in printed.splitlines()
        ]
        assert errors[2] < 0.2 * errors[0]


@pytest.mark.slow
def test_the_folder_goes_on_with_other_commands(tried: tuple[Path, str]) -> None:
    """Catches a file of a robot that names what is not there, and a table, a picture or a report
    that is not written."""
    folder, _ = tried
    assert {file.name for file in folder.iterdir()} == {
        "config.yaml",
        "metadata.json",
        "robot.yaml",
        "joints.yaml",
        "picture.png",
        "end_effector.csv",
        "joints.csv",
        "comparison",
    }
    assert (folder / "comparison" / "report.html").is_file()
    require_the_same_robot(folder)


def test_what_is_written_of_a_robot_is_read_as_the_same(tmp_path: Path) -> None:
    """Catches a file of a robot that names what is not there, and one that describes another
    robot."""
    trial = Robot(model=str(EXAMPLE), stiffness=str(JOINTS), end_effector="tool")
    assert write_robot(robot_arguments(trial), tmp_path) == tmp_path / "robot.yaml"
    require_the_same_robot(tmp_path)


def require_the_same_robot(folder: Path) -> None:
    """Check that the robot of a folder is the made-up arm, to `--env` and to `elastic robot`."""
    again = configure_robot(**environment(str(folder / "robot.yaml")).arguments("poses"))
    given = configure_robot(str(EXAMPLE), str(JOINTS), end_effector="tool")
    tried_again = configure_robot(**robot_arguments(Robot(model=str(folder / "robot.yaml"))))
    for config in (again, tried_again):
        assert config.joints == given.joints
        assert config.robot.end_effector == given.robot.end_effector
    softer = configure_robot(
        **robot_arguments(Robot(model=str(folder / "robot.yaml"), stiffness=300.0))
    )
    assert {joint.stiffness for joint in softer.joints.values()} == {300.0}


def at_rest(model: mujoco.MjModel, stiffness: Array, theta: Array) -> Array:
    """Where links rest, by MuJoCo's own springs about the command and Newton's method on its
    forces."""
    q = theta.copy()
    data = mujoco.MjData(model)

    def unbalanced(at: Array) -> Array:
        data.qpos[:] = at
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        return stiffness * (theta - at) - data.qfrc_bias

    for _ in range(20):
        slope = np.array(
            [(unbalanced(q + h) - unbalanced(q - h)) / 2e-6 for h in 1e-6 * np.eye(len(q))]
        ).T
        q -= np.linalg.solve(slope, unbalanced(q))
    return q


def tool_at(model: mujoco.MjModel, q: Array) -> Array:
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return data.site("tool").xpos.copy()


def arm(**arguments: object) -> JointPlant:
    config = configure_robot(str(EXAMPLE), str(JOINTS), SEVERAL, end_effector="tool", **arguments)  # type: ignore[arg-type]
    return config.robot.plant(config)


def test_shares_are_finite_differences_of_mujoco() -> None:
    """Catches a column of another joint, a deflection of the wrong sign, and shares that do not
    add up."""
    plant = arm()
    step = 1e-4
    model = plant.true.rigid
    names = plant.joint_names
    parts = []
    errors = []
    for q_ref in rest_poses(plant):
        bent = at_rest(model, plant.true.stiffness, q_ref) - q_ref
        columns = [
            tool_at(model, q_ref + step * e) - tool_at(model, q_ref - step * e)
            for e in bent * np.eye(len(bent))
        ]
        parts.append(np.array(columns) / (2.0 * step))
        errors.append(parts[-1].sum(axis=0))
    shares = joint_shares(plant)
    assert list(shares["joint"]) == names
    alone = np.sqrt(np.mean(np.sum(np.square(parts), axis=2), axis=0))
    np.testing.assert_allclose(shares["end_effector_rms_m"], alone, rtol=1e-6, atol=1e-9)
    explained = np.einsum("pji,pi->j", parts, errors) / np.sum(np.square(errors))
    np.testing.assert_allclose(shares["share"], explained, atol=1e-7)
    assert shares["share"].sum() == pytest.approx(1.0)


def test_the_robot_of_the_readme_is_what_its_command_plays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a name that the command does not know, and a robot that its servos or springs
    cannot hold."""
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (name,) = re.findall(r"&& elastic robot (\w+)$", readme, flags=re.MULTILINE)
    for function in (gallery_file, gallery_robot, gallery_joints):
        monkeypatch.setattr(
            f"train.commands.robot.{function.__name__}", partial(function, folder=FOLDER)
        )
    config = configure_robot(**robot_arguments(Robot(model=name)), reference=SEVERAL)
    shares = joint_shares(config.robot.plant(config))
    assert len(shares) == 7
    assert shares["share"].sum() == pytest.approx(1.0)


def test_a_joint_without_weight_has_no_share() -> None:
    """Catches a share of a vertical axis: the turret carries no torque, whatever the pose."""
    base = joint_shares(arm()).iloc[0]
    assert base.joint == "base"
    assert abs(base.share) < 1e-12
    assert base.friction_leaves_m > 0.0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            ["nowhere.urdf", "--stiffness", "900"],
            "give a file of MJCF.*or a robot of the gallery: panda",
        ),
        ([str(EXAMPLE)], "needs? .*stiffness|gives no joint its stiffness K"),
        ([str(EXAMPLE), "--stiffness", "nowhere.yaml"], "nowhere.yaml"),
        ([str(EXAMPLE), "--stiffness", "0"], "stiffness must be > 0"),
        ([str(EXAMPLE), "--stiffness", "[1, 2]"], r"one number for all joints.* got \[1, 2\]"),
        ([str(EXAMPLE), "--stiffness", "900", "--end-effector", "tol"], "tool"),
        ([str(EXAMPLE), "--stiffness", "900", "--motion", "movs"], "moves"),
        ([str(JOINTS), "--stiffness", "900"], "keys model and joints"),
    ],
)
def test_a_wrong_input_says_what_to_do(
    given: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches a traceback, and a folder that is left behind by what could not begin."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["robot", *given])
    assert ended.value.code == 2
    assert re.search(said, capsys.readouterr().err)
    assert not list(tmp_path.glob("runs/*"))


def test_a_robot_of_the_gallery_brings_its_assumed_joints() -> None:
    """Catches joints of another robot, a home that is lost, and the tip of the end effector that
    is not placed."""
    config = configure_robot(**robot_arguments(Robot(model="pusher")))
    for name, joint in gallery_joints("pusher").items():
        assert isinstance(config.joints[name], ElasticJoint)
        assert config.joints[name].stiffness == joint.stiffness
        assert config.joints[name].servo == joint.servo
    home = dict(zip(config.joints, config.robot.home or (), strict=True))
    assert {name: home[name] for name in GALLERY["pusher"].home} == GALLERY["pusher"].home


def test_a_robot_without_a_stiffness_is_told_how_to_find_it() -> None:
    """Catches K that is made up for a robot of which nobody knows it."""
    with pytest.raises(ConfigurationError, match="elastic identify --robot"):
        try_robot(Robot(model=str(EXAMPLE)), Console(quiet=True))
