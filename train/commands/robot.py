"""`elastic robot`: a robot from its model, made elastic, played with and without compensation.

Its folder contains the robot's file, a comparison with report, a picture, and the two printed
tables.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import PIL.Image
import tyro
from pydantic import Field
from rich.console import Console
from rich.table import Table

from elastic_env.core.config import Locator, Model, read_mapping
from elastic_env.core.errors import ConfigurationError, ElasticError, quote
from elastic_env.core.files import is_file
from elastic_env.core.yaml_text import yaml_of
from elastic_env.joint.model_text import is_text, name_of, without_declaration
from elastic_env.motion.arm_references import Poses
from elastic_env.robots.gallery import GALLERY, gallery_file, gallery_joints, gallery_robot
from elastic_env.robots.robot.environment import configure_robot
from train.commands.compare_config import CompareConfig
from train.commands.comparison import compare
from train.commands.options import Motion, StiffnessOrFile
from train.commands.play import play
from train.commands.robot_at_rest import TABLE_STYLE, joint_shares, picture, shares_table
from train.evaluate.conditions import Condition, PolicySpec, Seed
from train.evaluate.episodes import Evaluation
from train.evaluate.robot_file import ENDINGS, read_robot_file
from train.figures import plots
from train.report.write import require_libraries
from train.runs.console import make_table, print_files
from train.runs.escaping import write_records
from train.runs.folders import run_folder

SCENARIO = "nominal"
"""The robot as its joints are described, with friction and encoders, which `ideal` leaves out."""
POLICIES = ("uncompensated", "input", "dynamic")
_TIP = "tip"
"""Site of the end effector that is added to a robot of the gallery."""
_ASSUMED = {"stiffness", "damping", "rotor_inertia", "servo"}
"""Settings of a joint of the gallery."""


class Robot(Model):
    """Try a robot of your own: make its joints elastic and measure the gain of compensation.

    Plays static poses and a motion with the policies uncompensated, input and dynamic, in the
    scenario nominal: with friction and encoders as in the joints file. Prints the error of the end
    effector [mm], and the share of each joint. The folder has robot.yaml (for --env of the other
    commands), joints.yaml, picture.png, end_effector.csv, joints.csv, and a comparison with
    report.html.

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
    """Site or body whose position is compared; default that of the robot's file or of the gallery,
    or the outermost body.
    """
    poses: Annotated[Poses, tyro.conf.Suppress] = Poses(positions=4)
    """Static poses; fewer than in an environment, for a result within a minute."""
    motion: Motion = Field(default={"kind": "moves", "positions": 4})
    """Motion besides the static poses: moves, line, circle, sine, multisine, or a mapping of kind
    and parameters.
    """
    seed: Seed = 0
    """Seed of the episodes."""
    output: Path | None = None
    """Folder for the results, new or empty; default runs/robot, numbered if taken."""
    figure_format: plots.FigureFormat = "png"
    """Format of the comparison's figures: pdf and svg have no resolution, and png has 300 dpi."""
    video: bool = False
    """Film the motion, uncompensated and with input.

    Off by default: a second of motion is 50 frames to draw.
    """

    def run(self, console: Console) -> None:
        """Play the robot, write its folder, and print its tables."""
        print_files(*try_robot(self, console), console)


def try_robot(trial: Robot, console: Console) -> tuple[Path, list[Path]]:
    """Make a robot elastic, play it with every policy, write its folder, and print its tables.

    Args:
        trial: The robot and its motion.
        console: Console for progress and tables.

    Returns:
        The folder and its files.

    Raises:
        ConfigurationError: The model, its joints or the motion cannot be used; found before a
            folder is made.
        ResultsExistError: The output folder contains results.
        MissingExtraError: A package for reports or videos is missing.
    """
    plots.require_matplotlib()
    require_libraries()
    arguments = robot_arguments(trial)
    settings = {**arguments, "scenario": SCENARIO}
    moving = configure_robot(**settings, reference=trial.motion)
    config = configure_robot(**settings, reference=trial.poses)
    moving.robot.plant(moving)  # refuses a motion that its servos cannot follow
    plant = config.robot.plant(config)
    if trial.stiffness is None and trial.model in GALLERY:
        console.print(
            f"K of {trial.model} is assumed, as nobody publishes it; name yours by --stiffness"
        )
    recorded = trial.model_dump(mode="json", exclude={"output", "figure_format", "video"})
    with run_folder("robot", recorded, trial.seed, trial.output) as folder:
        file = write_robot(arguments, folder)
        setup = CompareConfig(
            name="robot",
            env=str(file),
            references=[trial.poses.model_dump(mode="json"), trial.motion],
            scenarios=[SCENARIO],
            policies=[PolicySpec(name=name) for name in POLICIES],
            seed=trial.seed,
        )
        output = folder / "comparison"
        comparison = compare(setup, console, output, figure_format=trial.figure_format)
        errors = [_end_effector_errors(e) for e in comparison.evaluations]
        shares = joint_shares(plant)
        files = [
            file,
            comparison.folder / "report.html",
            write_records(errors, folder / "end_effector.csv"),
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
    console.print(_errors_table(errors))
    console.print(shares_table(shares))
    return folder, files


def robot_arguments(trial: Robot) -> dict[str, Any]:
    """Arguments of `elastic_env/Robot-v0`, without reference and scenario.

    Raises:
        ConfigurationError: There is no such file or robot, or the stiffness is missing.
    """
    arguments = _model_arguments(trial.model)
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


def _model_arguments(name: str) -> dict[str, Any]:
    """Arguments of a file, the text of a model, or a robot of the gallery."""
    if name in GALLERY:
        return _gallery_arguments(name)
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


def _gallery_arguments(name: str) -> dict[str, Any]:
    """Arguments of a robot of the gallery with its assumed joints.

    The model is the robot's file, if no site has to be added.
    """
    entry = GALLERY[name]
    file = gallery_file(name)
    end_effector = entry.end_effector
    model = str(file)
    if file.suffix != ".urdf" or any(entry.tip):
        spec = gallery_robot(name, shapes=True)
        end_effector = _TIP
        spec.body(entry.end_effector).add_site(name=_TIP, pos=entry.tip)
        spec.compile()
        model = spec.to_xml()
    assumed = gallery_joints(name).items()
    joints = {name: joint.model_dump(include=_ASSUMED) for name, joint in assumed}
    return {
        "model": model,
        "joints": joints,
        "end_effector": end_effector,
        "home": dict(entry.home),
    }


def write_robot(arguments: Mapping[str, Any], folder: Path) -> Path:
    """Write a robot's file and its joints into a folder; a model is written only if it is a text.

    Args:
        arguments: Arguments of `elastic_env/Robot-v0`.
        folder: Folder for the files.

    Returns:
        The robot's file, for `--env`.
    """
    robot = {**arguments, "joints": "joints.yaml"}
    model = arguments["model"]
    if is_text(model):
        (folder / "model.xml").write_text(without_declaration(model), encoding="utf-8")
        robot["model"] = "model.xml"
    else:
        robot["model"] = str(Path(model).resolve())
    joints = arguments["joints"]
    mapping = read_mapping(Path(joints)) if isinstance(joints, str) else joints
    for name, content in (("joints.yaml", mapping), ("robot.yaml", robot)):
        (folder / name).write_text(yaml_of(dict(content)), encoding="utf-8")
    return folder / "robot.yaml"


def _end_effector_errors(evaluation: Evaluation) -> dict[str, Any]:
    """Distance of the end effector from its target, rms and peak [m]; nan for a failed episode."""

    def value(metric: str) -> float:
        return next(map(float, evaluation.values(metric)), float("nan"))

    return {
        "motion": evaluation.condition.reference_name,
        "policy": evaluation.condition.policy.title,
        "error_rms_m": value("end_effector_error_rms_m"),
        "error_peak_m": value("end_effector_error_peak_m"),
    }


def _films(trial: Robot, file: Path, folder: Path, console: Console) -> list[Path]:
    """Film the motion without and with `input`."""
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


def _errors_table(records: Sequence[dict[str, Any]]) -> Table:
    rows = []
    for motion in dict.fromkeys(record["motion"] for record in records):
        errors = [1e3 * r["error_rms_m"] for r in records if r["motion"] == motion]
        best = pd.Series(errors[1:]).min()  # ignores failed episodes
        ratio = best / errors[0] if errors[0] > 0.0 else np.nan
        share = "-" if np.isnan(ratio) else f"{100.0 * ratio:.1f} %"
        cells = ["failed" if np.isnan(error) else f"{error:.3f}" for error in errors]
        rows.append([motion, *cells, share])
    head = ["motion", *POLICIES, "left by the best"]
    return make_table("end effector, rms error [mm]", head, rows, **TABLE_STYLE)
