"""`elastic robot`: a robot from its model, made elastic, played with and without compensation.

Its folder holds the robot's file, a comparison with report, a picture, and the two tables that it
prints.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import PIL.Image
import tyro
from pydantic import Field
from rich import box
from rich.console import Console
from rich.table import Table

from baselines import PositionCompensator
from elastic_env.core.config import Locator, Model, read_mapping
from elastic_env.core.errors import ConfigurationError, ElasticError, quote
from elastic_env.core.files import is_file
from elastic_env.core.signals import Array
from elastic_env.core.yaml_text import yaml_of
from elastic_env.joint.friction import dry_friction
from elastic_env.joint.model_text import is_text, name_of, without_declaration
from elastic_env.motion.arm_references import Poses
from elastic_env.rendering.picture import Image, with_text
from elastic_env.rendering.sag import ENLARGED, SagViews
from elastic_env.robots.gallery import GALLERY, gallery_file, gallery_joints, gallery_robot
from elastic_env.robots.joint_robot import JointRobotConfig
from elastic_env.robots.robot.environment import configure_robot
from elastic_env.world.joint_task import JointPlant
from train.commands.compare import CompareConfig, compare
from train.commands.options import Motion, StiffnessOrFile
from train.commands.play import play
from train.evaluate.conditions import Condition, PolicySpec, Seed
from train.evaluate.episodes import Evaluation
from train.evaluate.robot_file import ENDINGS, read_robot_file
from train.figures import plots
from train.report.write import require_libraries
from train.runs.console import make_table, print_files
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
    """Try a robot of your own: make its joints elastic and say what compensation gains.

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
    seed: Seed = 0
    """Seed of the episodes."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/robot, numbered if taken."""
    figure_format: plots.FigureFormat = "png"
    """Of the figures of the comparison: pdf and svg have no resolution, and png has 300 dpi."""
    video: bool = False
    """Film the motion, uncompensated and with input.

    Off by default: a second of motion is 50 frames to draw.
    """

    def run(self, console: Console) -> None:
        """Play, write, print."""
        print_files(*try_robot(self, console), console)


def try_robot(trial: Robot, console: Console) -> tuple[Path, list[Path]]:
    """Make a robot elastic, play it with every policy, write its folder, and print its tables.

    Args:
        trial: The robot and its motion.
        console: Where progress and tables go.

    Returns:
        The folder and its files.

    Raises:
        ConfigurationError: The model, its joints or the motion cannot be used; found before a
            folder is made.
        ResultsExistError: The output folder holds results.
        MissingExtraError: A package for reports or videos is missing.
    """
    plots.require_matplotlib()
    require_libraries()
    arguments = robot_arguments(trial)
    played = {**arguments, "scenario": SCENARIO}
    moving = configure_robot(**played, reference=trial.motion)
    config = configure_robot(**played, reference=trial.poses)
    moving.robot.plant(moving)  # refuses what its servos cannot follow
    plant = config.robot.plant(config)
    if trial.stiffness is None and trial.model in GALLERY:
        text = f"K of {trial.model} is assumed, as nobody publishes it; name yours by --stiffness"
        console.print(text)
    recorded = trial.model_dump(mode="json", exclude={"output", "figure_format", "video"})
    with run_folder("robot", recorded, trial.seed, trial.output) as folder:
        file = write_robot(arguments, folder)
        compared = CompareConfig(
            name="robot",
            env=str(file),
            references=[trial.poses.model_dump(mode="json"), trial.motion],
            scenarios=[SCENARIO],
            policies=[PolicySpec(name=name) for name in POLICIES],
            seed=trial.seed,
        )
        comparison = compare(
            compared, console, folder / "comparison", figure_format=trial.figure_format
        )
        placed = [_placement(one) for one in comparison.evaluations]
        shares = joint_shares(plant)
        files = [
            file,
            comparison.folder / "report.html",
            write_records(placed, folder / "end_effector.csv"),
            write_records(shares.to_dict("records"), folder / "joints.csv"),
        ]
        try:
            image = picture(config, plant)
        except ElasticError as error:  # this machine cannot draw
            console.print(f"no picture: {error}")
        else:
            files.append(folder / "picture.png")
            PIL.Image.fromarray(image).save(files[-1], optimize=True)
        if trial.video:
            files += _films(trial, file, folder, console)
    console.print(_placed_table(placed))
    console.print(_shares_table(shares))
    return folder, files


def robot_arguments(trial: Robot) -> dict[str, Any]:
    """Arguments of `elastic_env/Robot-v0`, without reference and scenario.

    Raises:
        ConfigurationError: There is no such file or robot, or the stiffness is missing.
    """
    arguments = _of_model(trial.model)
    stiffness = trial.stiffness
    if isinstance(stiffness, str):
        arguments["joints"] = dict(read_mapping(Path(stiffness)))
    elif stiffness is not None:
        if not stiffness > 0.0:
            problem = f"stiffness must be > 0 N·m/rad or a file of joints, got {quote(stiffness)}"
            raise ConfigurationError(problem)
        arguments["joints"] = {"*": stiffness}
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
    assumed = gallery_joints(name)
    joints = {joint: own.model_dump(include=_ASSUMED) for joint, own in assumed.items()}
    return {
        "model": model,
        "joints": joints,
        "end_effector": end_effector,
        "home": dict(known.home),
    }


_ASSUMED = {"stiffness", "damping", "rotor_inertia", "servo"}
"""What is known of a joint of the gallery, as a file has it."""


def write_robot(arguments: Mapping[str, Any], folder: Path) -> Path:
    """Write a robot's file and its joints into a folder; the model stays, unless it is text.

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


def _placement(evaluation: Evaluation) -> dict[str, Any]:
    """Distance of the end effector from its target, rms and peak [m]; nan for a failed episode."""

    def only(metric: str) -> float:
        return next(map(float, evaluation.values(metric)), float("nan"))

    return {
        "motion": evaluation.condition.reference_name,
        "policy": evaluation.condition.policy.title,
        "error_rms_m": only("end_effector_error_rms_m"),
        "error_peak_m": only("end_effector_error_peak_m"),
    }


def rest_poses(plant: JointPlant) -> Array:
    """The static poses of a reference, (poses, n) [rad]."""
    plan = plant.motion.plan(np.random.default_rng(0), plant.true.control_period_s)
    numbers, first = np.unique(plan.rest, return_index=True)
    return plan.q[first[numbers >= 0]]


def joint_shares(plant: JointPlant) -> pd.DataFrame:
    r"""Shares of the joints in the error of the end effector at rest, in closed form.

    Nothing is played: a link rests where spring and weight balance, K(θ − q) = τ_g(q), with θ =
    q_ref. With column J_j of the end effector's Jacobian the error is, to first order, the sum over
    the joints

    .. math:: e = \sum_j J_j(q_{ref}) (q_j - q_{ref,j}), \quad s_j = \frac{\sum e \cdot e_j}{\sum e \cdot e}

    with e_j the term of joint j, and sums over the poses. The shares s_j add up to 1; that of a
    joint that helps another is negative.

    Args:
        plant: A robot with an end effector, and static poses as its reference.

    Returns:
        A row for each joint: K; the gain k_p of its servo, infinite where that holds its angle;
        rms over the poses of gravity torque, of deflection from the command, of what that alone
        moves the end effector, and of how far friction F can hold it off by F/K; and its share.
    """  # noqa: E501
    tool = plant.end_effector
    assert tool is not None
    q_ref = rest_poses(plant)
    q = plant.rest_angle(q_ref)
    parts = tool.parts(q_ref, q)
    error = parts.sum(axis=-1)
    whole = max(float(np.sum(error**2)), np.finfo(np.float64).tiny)
    lever = np.linalg.norm(tool.jacobian(q_ref)[0], axis=1)
    joints = plant.true
    friction = dry_friction(
        speed=np.zeros_like(q),
        load=plant.static_torque(q),
        coulomb=joints.coulomb_friction,
        load_ratio=joints.load_friction,
        static=joints.static_friction,
        stribeck_speed=joints.stribeck_speed,
    )
    friction = lever * friction / joints.rest_stiffness("tendon")
    with np.errstate(divide="ignore"):
        position_gain = 1.0 / plant.true.servo_compliance
    return pd.DataFrame(
        {
            "joint": plant.joint_names,
            "stiffness_Nm_per_rad": plant.true.stiffness,
            "position_gain_Nm_per_rad": position_gain,
            "gravity_torque_rms_Nm": _rms(plant.static_torque(q)),
            "deflection_rms_rad": _rms(q - q_ref),
            "end_effector_rms_m": _rms(np.linalg.norm(parts, axis=1)),
            "share": np.einsum("pi,pij->j", error, parts) / whole,
            "friction_leaves_m": _rms(friction),
        }
    )


def _rms(values: Array) -> Array:
    """Over the poses."""
    return np.sqrt(np.mean(values**2, axis=0))


def picture(config: JointRobotConfig, plant: JointPlant) -> Image:
    """The poses with the largest sag, in rows: left without compensation, right with it.

    It is in closed form, as `joint_shares`. Deviations from the translucent reference are enlarged.

    Raises:
        ElasticError: The machine cannot draw.
    """
    tool = plant.end_effector
    assert tool is not None
    known = plant.assumed
    # spring and servo: the command leads both
    in_series = known.rest_stiffness("tendon").tolist()
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
            "at rest without friction; deviations from the translucent reference drawn x"
            f" {ENLARGED:g}",
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


def _placed_table(placed: Sequence[dict[str, Any]]) -> Table:
    rows = []
    for motion in dict.fromkeys(one["motion"] for one in placed):
        errors = [1e3 * one["error_rms_m"] for one in placed if one["motion"] == motion]
        best = pd.Series(errors[1:]).min()  # of those that did not fail
        left = best / errors[0] if errors[0] > 0.0 else np.nan
        share = "-" if np.isnan(left) else f"{100.0 * left:.1f} %"
        cells = ["failed" if np.isnan(error) else f"{error:.3f}" for error in errors]
        rows.append([motion, *cells, share])
    head = ["motion", *POLICIES, "left by the best"]
    return make_table("end effector, rms error [mm]", head, rows, **_STYLE)


_SHARES = {
    "K\nNm/rad": ("stiffness_Nm_per_rad", 1.0, ".4g"),
    "k_p\nNm/rad": ("position_gain_Nm_per_rad", 1.0, ".4g"),
    "torque\nNm": ("gravity_torque_rms_Nm", 1.0, ".2f"),
    "deflection\nmrad": ("deflection_rms_rad", 1e3, ".2f"),
    "alone\nmm": ("end_effector_rms_m", 1e3, ".2f"),
    "share\n%": ("share", 100.0, ".1f"),
    "F/K\nmm": ("friction_leaves_m", 1e3, ".2f"),
}
"""Columns of the table of joints: figure, factor and format."""


def _shares_table(shares: pd.DataFrame) -> Table:
    columns = {"joint": list(shares["joint"])}
    for head, (name, factor, form) in _SHARES.items():
        columns[head] = [format(factor * value, form) for value in shares[name]]
    if not np.isfinite(shares["position_gain_Nm_per_rad"]).any():
        del columns["k_p\nNm/rad"]
    caption = (
        "closed form, uncompensated: springs and servos that give way; F/K is what friction can"
        " leave"
    )
    rows = zip(*columns.values(), strict=True)
    title = "where the error at rest comes from"
    table = make_table(title, list(columns), rows, caption=caption, **_STYLE)
    for column in table.columns[1:]:
        column.vertical = "bottom"
    return table
