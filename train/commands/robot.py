"""`elastic robot`: a robot from its model, made elastic, played with and without compensation, in
one call.

Its folder holds the robot's file, a comparison with report, a picture, and the two tables that it
prints.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from pydantic import Field
from rich import box
from rich.console import Console
from rich.table import Table

from baselines import PositionCompensator
from elastic_env.core.config import LARGEST_SEED, Locator, Model, quantity, read_mapping
from elastic_env.core.errors import ConfigurationError, ElasticError, quote
from elastic_env.core.signals import Array
from elastic_env.core.yaml_text import yaml_of
from elastic_env.joint.elasticity import ElasticJoint
from elastic_env.joint.model_text import is_file, is_text, name_of, without_declaration
from elastic_env.motion.arm_references import Poses
from elastic_env.rendering.picture import Image, with_text
from elastic_env.rendering.sag import ENLARGED, SagViews
from elastic_env.robots.gallery import GALLERY, gallery_file, gallery_joints, gallery_robot
from elastic_env.robots.robot.environment import RobotConfig, configure_robot
from elastic_env.world.joint_task import JointPlant
from train.commands.compare import CompareConfig, compare
from train.commands.options import Motion, StiffnessOrFile
from train.commands.play import play
from train.evaluate.conditions import Condition, PolicySpec
from train.evaluate.episodes import Evaluation
from train.evaluate.robot_file import ENDINGS, read_robot_file
from train.figures import plots
from train.report.write import require_libraries
from train.runs.console import make_table
from train.runs.escaping import write_records
from train.runs.folders import run_folder

SCENARIO = "nominal"
"""The robot as its joints are described, friction and encoders included; `ideal` would leave
these out.
"""
POLICIES = ("uncompensated", "input", "dynamic")
_TIP = "tip"
_STYLE: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0)}
_PIXELS = 420
_POSES_SHOWN = 2


class Robot(Model):
    """Try a robot of your own: make its joints elastic, play it with and without compensation, and
    say what it gains.

    Plays static poses and a motion with the policies uncompensated, input and dynamic, in the
    scenario nominal: with friction and encoders as the joints file has them. Prints the error of
    the end effector [mm], and how much of it comes from each joint. The folder has robot.yaml (for
    --env of the other commands), joints.yaml, picture.png, end_effector.csv, joints.csv, and a
    comparison with report.html.

    Example: elastic robot arm.urdf --stiffness joints.yaml --end-effector tool0

    Example, one K for all hinges: elastic robot arm.xml --stiffness 1000

    Example, an arm of the gallery (extra robots): elastic robot panda
    """

    model: Annotated[Locator, tyro.conf.Positional]
    """File of MJCF (.xml) or URDF (.urdf) of a robot on a fixed base, ROBOT.yaml (a file of a
    robot, see docs/robots.md), or a name of the gallery, such as panda, ur5, xarm7, so101."""
    stiffness: StiffnessOrFile = None
    """YAML file of the elastic joints, or one K of all hinges [N·m/rad]. Has no default, as K is a
    property of your robot; elastic identify --robot finds it. K of the gallery is assumed."""
    end_effector: Locator | None = None
    """Site or body that is to be placed; default that of the robot's file or of the gallery, or
    the outermost body.
    """
    poses: Annotated[Poses, tyro.conf.Suppress] = Poses(positions=4)
    """Static poses; fewer than an environment plays, for a result within a minute."""
    motion: Motion = Field(default={"kind": "moves", "positions": 4})
    """Motion beside the static poses: moves, line, circle, sine, multisine, or a mapping of kind
    and parameters.
    """
    seed: int = quantity("1", 0, ge=0, le=LARGEST_SEED)
    """Seed of the episodes."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/robot, numbered if taken."""
    video: bool = False
    """Film the motion, uncompensated and with input.

    Off by default: a second of motion is 50 frames to draw.
    """

    def run(self, console: Console) -> None:
        """Play, write, print."""
        result = try_robot(self, console)
        console.print(f"Results in {result.folder}:", soft_wrap=True)
        for path in result.files:
            console.print(f"  {path}", soft_wrap=True)


@dataclass(frozen=True)
class Placed:
    """How far the end effector is from where it should be, as it was played.

    Attributes:
        motion: Reference that was played.
        policy: Policy that commanded.
        error_rms_m: Distance, rms over what is scored [m]; nan where the episode failed.
        error_peak_m: Its largest [m].
    """

    motion: str
    policy: str
    error_rms_m: float
    error_peak_m: float


@dataclass(frozen=True)
class JointShare:
    """Share of a joint in the error of the end effector at rest, uncompensated and without
    friction.

    Attributes:
        joint: Its name.
        stiffness_Nm_per_rad: K of its transmission.
        position_gain_Nm_per_rad: k_p of a servo that gives way; infinite where the servo holds its
            angle.
        gravity_torque_rms_Nm: Torque that it carries, rms over the poses.
        deflection_rms_rad: How far its link is from the command, rms over the poses; a servo that
            gives way adds to it.
        end_effector_rms_m: How far that alone moves the end effector, rms over the poses.
        share: Part of the error that it explains; the joints together make 1, and one that helps
            another is negative.
        friction_leaves_m: How far friction F can hold the end effector off by F/K, rms over the
            poses.
    """

    joint: str
    stiffness_Nm_per_rad: float
    position_gain_Nm_per_rad: float
    gravity_torque_rms_Nm: float
    deflection_rms_rad: float
    end_effector_rms_m: float
    share: float
    friction_leaves_m: float


@dataclass(frozen=True)
class RobotResult:
    """Results of the trial, and its files."""

    folder: Path
    placed: list[Placed]
    shares: list[JointShare]
    files: list[Path]


def try_robot(trial: Robot, console: Console) -> RobotResult:
    """Make a robot elastic, play it with every policy, write its folder, and print its tables.

    Args:
        trial: The robot and its motion.
        console: Where progress and tables go.

    Raises:
        ConfigurationError: The model, its joints or the motion cannot be used; found before a
            folder is made.
        ResultsExistError: The output folder holds results.
        MissingExtraError: A package for reports or videos is missing.
    """
    plots.require_matplotlib()
    require_libraries()
    arguments = robot_arguments(trial)
    moving, config = (
        configure_robot(**arguments, reference=reference, scenario=SCENARIO)
        for reference in (trial.motion, trial.poses)
    )
    moving.robot.plant(moving)  # refuses what its servos cannot follow
    plant = config.robot.plant(config)
    if trial.stiffness is None and trial.model in GALLERY:
        console.print(
            f"K of {trial.model} is assumed, as nobody publishes it; name yours by --stiffness"
        )
    recorded = trial.model_dump(mode="json", exclude={"output", "video"})
    with run_folder("robot", recorded, trial.seed, trial.output) as folder:
        file = write_robot(arguments, folder)
        comparison = compare(_comparison(trial, file), console, folder / "comparison")
        placed = [_placement(one) for one in comparison.evaluations]
        shares = joint_shares(plant)
        files = [
            file,
            comparison.folder / "report.html",
            write_records([asdict(one) for one in placed], folder / "end_effector.csv"),
            write_records([asdict(one) for one in shares], folder / "joints.csv"),
            *_pictures(config, plant, folder, console),
            *(_films(trial, file, folder, console) if trial.video else []),
        ]
    for table in (_placed_table(placed), _shares_table(shares)):
        console.print(table)
    return RobotResult(folder, placed, shares, files)


def robot_arguments(trial: Robot) -> dict[str, Any]:
    """Arguments of `elastic_env/Robot-v0`, without reference and scenario.

    Raises:
        ConfigurationError: There is no such file or robot, or the stiffness is missing.
    """
    arguments = _of_model(trial.model)
    if trial.stiffness is not None:
        arguments["joints"] = _given_joints(trial.stiffness)
    if trial.end_effector is not None:
        arguments["end_effector"] = trial.end_effector
    return arguments


def _of_model(name: str) -> dict[str, Any]:
    if name in GALLERY:
        return _of_gallery(name)
    if is_text(name):
        return {"model": name, "joints": {}}
    if not is_file(name):
        raise ConfigurationError(
            f"no model at {name_of(name)}; give a file of MJCF (.xml) or URDF (.urdf), a file of a"
            f" robot (.yaml), or a robot of the gallery: {', '.join(GALLERY)}"
        )
    if name.endswith(ENDINGS):
        return read_robot_file(name)
    return {"model": str(Path(name).resolve()), "joints": {}}


def _of_gallery(name: str) -> dict[str, Any]:
    """A robot of the gallery with its assumed joints.

    Its own file, if nothing has to be changed in it.
    """
    known = GALLERY[name]
    file = gallery_file(name)
    end_effector = known.end_effector
    model = str(file)
    if file.suffix != ".urdf" or any(known.tip):
        spec = gallery_robot(name, shapes=True)
        end_effector = _TIP
        spec.body(known.end_effector).add_site(name=_TIP, pos=known.tip)
        spec.compile()
        model = spec.to_xml()
    joints = {name: _settings(joint) for name, joint in gallery_joints(name).items()}
    return {
        "model": model,
        "joints": joints,
        "end_effector": end_effector,
        "home": dict(known.home),
    }


def _settings(joint: ElasticJoint) -> dict[str, Any]:
    """An elastic joint as a file has it."""
    assert joint.servo is not None
    names = ("stiffness", "damping", "rotor_inertia")
    gains = ("position_gain", "velocity_gain", "integral_gain", "torque_limit", "speed_limit")
    return {
        **{name: getattr(joint, name) for name in names},
        "servo": {name: getattr(joint.servo, name) for name in gains},
    }


def _given_joints(stiffness: str | float) -> dict[str, Any]:
    """Elastic joints of a file, or of one K."""
    if isinstance(stiffness, str):
        return dict(read_mapping(Path(stiffness)))
    if not stiffness > 0.0:
        raise ConfigurationError(
            f"stiffness must be > 0 N·m/rad or a file of joints, got {quote(stiffness)}"
        )
    return {"*": stiffness}


def write_robot(arguments: Mapping[str, Any], folder: Path) -> Path:
    """Write a robot's file and its joints into a folder; the model stays where it is, unless it is
    text.

    Args:
        arguments: Of `elastic_env/Robot-v0`.
        folder: Where it goes.

    Returns:
        The robot's file, for `--env`.
    """
    written = dict(arguments)
    model = arguments["model"]
    joints = arguments["joints"]
    if is_text(model):
        (folder / "model.xml").write_text(without_declaration(model), encoding="utf-8")
        written["model"] = "model.xml"
    else:
        written["model"] = str(Path(model).resolve())
    mapping = read_mapping(Path(joints)) if isinstance(joints, str) else joints
    written["joints"] = "joints.yaml"
    for name, content in (("joints.yaml", mapping), ("robot.yaml", written)):
        (folder / name).write_text(yaml_of(dict(content)), encoding="utf-8")
    return folder / "robot.yaml"


def _comparison(trial: Robot, file: Path) -> CompareConfig:
    references = [trial.poses.model_dump(mode="json"), trial.motion]
    return CompareConfig(
        name="robot",
        env=str(file),
        references=references,
        scenarios=[SCENARIO],
        policies=[PolicySpec(name=name) for name in POLICIES],
        seed=trial.seed,
    )


def _placement(evaluation: Evaluation) -> Placed:
    def only(metric: str) -> float:
        values = evaluation.values(metric)
        return float(values[0]) if len(values) else float("nan")

    return Placed(
        evaluation.condition.reference_name,
        evaluation.condition.policy.title,
        only("end_effector_error_rms_m"),
        only("end_effector_error_peak_m"),
    )


def rest_poses(plant: JointPlant) -> Array:
    """The static poses of a reference, (poses, n) [rad]."""
    plan = plant.motion.plan(np.random.default_rng(0), plant.true.control_period_s)
    return plan.q[np.unique(plan.rest, return_index=True)[1][int(plan.rest.min() < 0) :]]


def joint_shares(plant: JointPlant) -> list[JointShare]:
    r"""Shares of the joints in the error of the end effector at rest, in closed form.

    Nothing is played: a link rests where spring and weight balance, K(θ − q) = τ_g(q), with θ =
    q_ref. With column J_j of the end effector's Jacobian the error is, to first order, the sum over
    the joints

    .. math:: e = \sum_j J_j(q_{ref}) (q_j - q_{ref,j}), \quad s_j = \frac{\sum e \cdot e_j}{\sum e \cdot e}

    with e_j the term of joint j, and sums over the poses. The shares s_j add up to 1.

    Args:
        plant: A robot with an end effector, and static poses as its reference.
    """  # noqa: E501
    tool = plant.end_effector
    assert tool is not None
    q_ref = rest_poses(plant)
    q = plant.rest_angle(q_ref)
    parts = tool.parts(q_ref, q)
    torque = plant.static_torque(q)
    error = parts.sum(axis=-1)
    shares = np.einsum("pi,pij->j", error, parts) / max(
        float(np.sum(error**2)), np.finfo(np.float64).tiny
    )
    lever = np.linalg.norm(tool.jacobian(q_ref)[0], axis=1)
    friction = lever * plant.true.coulomb_friction / plant.true.rest_stiffness("tendon")
    with np.errstate(divide="ignore"):
        position_gain = 1.0 / plant.true.servo_compliance
    columns = zip(
        plant.joint_names,
        plant.true.stiffness,
        position_gain,
        _rms(torque),
        _rms(q - q_ref),
        _rms(np.linalg.norm(parts, axis=1)),
        shares,
        _rms(friction),
        strict=True,
    )
    return [JointShare(name, *map(float, values)) for name, *values in columns]


def _rms(values: Array) -> Array:
    """Over the poses."""
    return np.sqrt(np.mean(values**2, axis=0))


def _pictures(config: RobotConfig, plant: JointPlant, folder: Path, console: Console) -> list[Path]:
    """The picture, or none on a machine that cannot draw."""
    try:
        image = picture(config, plant)
    except ElasticError as error:
        console.print(f"no picture: {error}", soft_wrap=True, markup=False)
        return []
    import PIL.Image

    path = folder / "picture.png"
    PIL.Image.fromarray(image).save(path, optimize=True)
    return [path]


def picture(config: RobotConfig, plant: JointPlant) -> Image:
    """The poses with the largest sag, in rows: left without, right with the command of
    `PositionCompensator`.

    It is in closed form, as `joint_shares`. Deviations from the translucent reference are enlarged.

    Raises:
        ElasticError: The machine cannot draw.
    """
    tool = plant.end_effector
    assert tool is not None
    known = plant.assumed
    in_series = known.rest_stiffness(
        "tendon"
    ).tolist()  # of spring and servo, as the command has to lead both
    compensator = PositionCompensator(known.rigid, in_series, joints=known.joint_names)
    q_ref = rest_poses(plant)
    order = np.argsort(-tool.errors(q_ref, plant.rest_angle(q_ref))[0])[:_POSES_SHOWN]
    views = SagViews(config.robot.rigid(), plant.joint_names, _PIXELS)
    rows = []
    for wanted in q_ref[order]:
        twice = np.array([wanted, wanted])
        links = plant.rest_angle(np.array([wanted, compensator.command(wanted)]))
        errors = 1e3 * tool.errors(twice, links)[0]
        caption = [
            f"end effector off by {errors[0]:.2f} mm without, {errors[1]:.3f} mm with compensation",
            (
                "at rest without friction; deviations from the translucent reference drawn x"
                f" {ENLARGED:g}"
            ),
        ]
        rows.append(with_text(views.draw(twice, links), caption))
    return np.concatenate(rows)


def _films(trial: Robot, file: Path, folder: Path, console: Console) -> list[Path]:
    """The motion without and with `input`."""
    films = []
    for policy in POLICIES[:2]:
        condition = Condition(
            env=str(file),
            policy=PolicySpec(name=policy),
            scenario=SCENARIO,
            reference=trial.motion,
            seed=trial.seed,
        )
        films.append(folder / f"{policy}.mp4")
        play(condition, console, films[-1])
    return films


def _placed_table(placed: Sequence[Placed]) -> Table:
    rows = []
    for motion in dict.fromkeys(one.motion for one in placed):
        errors = [1e3 * one.error_rms_m for one in placed if one.motion == motion]
        best = min((error for error in errors[1:] if not np.isnan(error)), default=np.nan)
        left = best / errors[0] if errors[0] > 0.0 else np.nan
        cells = ["failed" if np.isnan(error) else f"{error:.3f}" for error in errors]
        rows.append([motion, *cells, "-" if np.isnan(left) else f"{100.0 * left:.1f} %"])
    return make_table(
        "end effector, rms error [mm]", ["motion", *POLICIES, "left by the best"], rows, **_STYLE
    )


def _shares_table(shares: Sequence[JointShare]) -> Table:
    gives_way = any(np.isfinite(one.position_gain_Nm_per_rad) for one in shares)
    columns = {
        "joint": [one.joint for one in shares],
        "K\nNm/rad": [f"{one.stiffness_Nm_per_rad:.4g}" for one in shares],
        "k_p\nNm/rad": [f"{one.position_gain_Nm_per_rad:.4g}" for one in shares],
        "torque\nNm": [f"{one.gravity_torque_rms_Nm:.2f}" for one in shares],
        "deflection\nmrad": [f"{1e3 * one.deflection_rms_rad:.2f}" for one in shares],
        "alone\nmm": [f"{1e3 * one.end_effector_rms_m:.2f}" for one in shares],
        "share\n%": [f"{100.0 * one.share:.1f}" for one in shares],
        "F/K\nmm": [f"{1e3 * one.friction_leaves_m:.2f}" for one in shares],
    }
    if not gives_way:
        del columns["k_p\nNm/rad"]
    caption = (
        "closed form, uncompensated: springs and servos that give way; F/K is what friction can"
        " leave"
    )
    rows = zip(*columns.values(), strict=True)
    table = make_table(
        "where the error at rest comes from", list(columns), rows, caption=caption, **_STYLE
    )
    for column in table.columns[1:]:
        column.vertical = "bottom"
    return table
