"""Poses of the humanoid Agile Justin: its published geometry, and what identification reaches.

The published Denavit-Hartenberg rows are in the modified convention [Craig1989],
T = Rx(α) Tx(r) Rz(q + θ) Tz(d). The frames of the shoulders and all masses are not published: the
frames are sought, the masses are guessed.
"""

import csv
import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from baselines.identification.geometry_fit import fit_geometry
from baselines.identification.geometry_model import Geometry, GeometryModel
from baselines.identification.geometry_problem import GeometryProblem
from baselines.identification.geometry_result import correct_model
from baselines.identification.holdout import RIGID, rival_errors
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray
from elastic_env.rigid.tree.links import Tree

HALVES = 5
"""Random halves of the poses: one is fitted, the other is held out."""
FEW_POSES = (20, 40, 80)
MASS_RANGE = (0.6, 1.6)
"""Factors that are drawn for each guessed mass, to see how much hangs on the guesses."""
GUESSED = "as guessed"
DRAWN = f"each × {MASS_RANGE[0]:g} to {MASS_RANGE[1]:g}, drawn"


class Row(NamedTuple):
    """A row of Denavit and Hartenberg: α [deg], r [m], θ [deg], d [m]."""

    alpha_deg: float
    r_m: float
    theta_deg: float
    d_m: float


_TORSO = (Row(0, 0, 0, 0.1055), Row(-90, 0, -90, 0), Row(0, 0.3, 0, 0), Row(0, 0.3, 0, 0))
_RIGHT = (
    Row(0, 0, 0, 0),
    Row(90, 0, 0, 0),
    Row(-90, 0, -90, 0.4),
    Row(90, 0, 0, 0),
    Row(-90, 0, -180, 0.39),
    Row(90, 0, 90, 0),
    Row(90, 0, -90, 0),
)
_LEFT = (
    Row(180, 0, 0, 0),
    Row(90, 0, 0, 0),
    Row(-90, 0, -90, -0.4),
    Row(90, 0, 0, 0),
    Row(-90, 0, 0, -0.39),
    Row(-90, 0, 90, 0),
    Row(-90, 0, -90, 0),
)
_MARKERS = {"right": (-0.1, -0.03, 0.1), "left": (-0.1, 0.03, 0.05)}
# guesses
_SHOULDERS = {"right": (0.0, -0.2, 0.1), "left": (0.0, 0.2, 0.1)}
_ARM_KG = (2.7, 2.7, 2.7, 2.7, 1.7, 1.6, 2.3)
_MASSES_KG = np.array([10.0, 6.0, 6.0, 18.0, *_ARM_KG, *_ARM_KG])
_AS_GUESSED = np.ones(len(_MASSES_KG))
_INERTIA_KG_M2 = 0.01
_POSES_OF_SEARCH = 40

TORSO_JOINTS = tuple(f"torso_{j}" for j in range(4))
ARM_JOINTS = {side: tuple(f"{side}_{j}" for j in range(7)) for side in _MARKERS}
JOINTS = (*TORSO_JOINTS, *ARM_JOINTS["right"], *ARM_JOINTS["left"])


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Static poses of the robot.

    Attributes:
        theta: Commands of all joints, (N, 18) [rad]; the passive one of the torso is upright.
        measured: Places of the right and the left marker as the cameras show them, (N, 2, 3) [m].
    """

    theta: Array
    measured: Array

    def of(self, chosen: IntArray) -> "RecordedPoses":
        """Some of the poses."""
        return RecordedPoses(self.theta[chosen], self.measured[chosen])


def read_poses(file: Path) -> RecordedPoses:
    """Read the published table, a CSV or a ZIP of one.

    Raises:
        ConfigurationError: It has other columns.
    """
    content = file.read_bytes()
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            content = archive.read(archive.namelist()[0])
    rows = list(csv.DictReader(io.StringIO(content.decode())))
    try:
        joints = np.array([_numbers(row["joints"]) for row in rows])
        markers = np.array([_numbers(row["markers"]) for row in rows])
        measured = markers.reshape(len(rows), 2, 3)
        upright = -(joints[:, 1] + joints[:, 2])
        theta = np.column_stack([joints[:, :3], upright, joints[:, 3:17]])
    except (KeyError, ValueError, IndexError) as error:
        raise ConfigurationError(
            f"{file} must have the columns joints, 19 numbers, and markers, 6 numbers: {error}"
        ) from None
    return RecordedPoses(theta, measured)


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace("[", " ").replace("]", " ").split()]


def justin_spec(shoulders: dict[str, Rotation], mass_factors: Array = _AS_GUESSED) -> mujoco.MjSpec:
    """The robot as it is published, with guesses for what is not.

    Args:
        shoulders: Rotation from the chest to the first joint of each arm that the model has.
        mass_factors: Factors on the guessed masses of all links, (18,).
    """
    torso_kg, right_kg, left_kg = np.split(mass_factors * _MASSES_KG, (4, 11))
    spec = mujoco.MjSpec()
    between_shoulders = np.mean(list(_SHOULDERS.values()), axis=0)
    chest = _add_chain(spec.worldbody, TORSO_JOINTS, _TORSO, torso_kg, between_shoulders)
    for side, rotation in shoulders.items():
        shoulder = chest.add_body(
            name=f"{side}_shoulder", pos=_SHOULDERS[side], quat=_wxyz(rotation)
        )
        rows = _RIGHT if side == "right" else _LEFT
        masses = right_kg if side == "right" else left_kg
        marker = np.array(_MARKERS[side])
        hand = _add_chain(shoulder, ARM_JOINTS[side], rows, masses, marker)
        hand.add_site(name=f"{side}_hand", pos=marker)
    return spec


def _add_chain(
    parent: mujoco.MjsBody,
    names: tuple[str, ...],
    rows: tuple[Row, ...],
    masses: Array,
    end: Array,
) -> mujoco.MjsBody:
    """Links in a row, each with a hinge; the last one, which reaches to `end`.

    The mass of a link is guessed in the middle of the way to the next joint.
    """
    base_m = 0.0
    reaches = [np.array([after.r_m, 0.0, row.d_m]) for row, after in pairwise(rows)]
    for name, row, mass, reach in zip(names, rows, masses, [*reaches, end], strict=True):
        turn = Rotation.from_euler("x", row.alpha_deg, degrees=True)
        turn = turn * Rotation.from_euler("z", row.theta_deg, degrees=True)
        link = parent.add_body(name=name, pos=(row.r_m, 0.0, base_m), quat=_wxyz(turn))
        link.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0.0, 0.0, 1.0))
        link.explicitinertial = True
        link.mass = mass
        link.ipos = reach / 2.0
        link.inertia = np.full(3, _INERTIA_KG_M2)
        parent = link
        base_m = row.d_m
    return parent


def _wxyz(rotation: Rotation) -> Array:
    return np.roll(rotation.as_quat(), 1)


def find_shoulders(poses: RecordedPoses) -> dict[str, Rotation]:
    """The rotations of the shoulders, among half turns, from which both arms fit best, rigid."""
    turns = Rotation.create_group("D2")
    pairs = [{"right": right, "left": left} for right in turns for left in turns]

    def missed(shoulders: dict[str, Rotation]) -> float:
        problem = _problem(justin_spec(shoulders), poses, tuple(_MARKERS))
        return fit_geometry(problem.as_rigid()).noise_m

    return min(pairs, key=missed)


def find_rigid(poses: RecordedPoses, mass_factors: Array = _AS_GUESSED) -> mujoco.MjSpec:
    """The robot with the shoulders and the places of the markers that fit poses best, rigid."""
    few = poses.of(np.arange(min(_POSES_OF_SEARCH, len(poses.theta))))
    spec = justin_spec(find_shoulders(few), mass_factors)
    problem = _problem(spec, poses, tuple(_MARKERS)).as_rigid()
    return correct_model(spec, _tree(spec, problem.model.joints), fit_geometry(problem))


def _problem(
    spec: mujoco.MjSpec,
    poses: RecordedPoses,
    sides: tuple[str, ...],
    geometry: Geometry = "offsets",
    lateral: bool = False,
) -> GeometryProblem:
    """Both arms, or one, with all joints elastic and the frames of the shoulders unknown."""
    joints = (*TORSO_JOINTS, *(name for side in sides for name in ARM_JOINTS[side]))
    columns = [JOINTS.index(name) for name in joints]
    markers = [list(_MARKERS).index(side) for side in sides]
    model = spec.compile()
    sites = [(f"{side}_hand", model.site(f"{side}_hand")) for side in sides]
    places = [(name, int(site.bodyid[0]), site.pos.copy()) for name, site in sites]
    problem = GeometryProblem(
        model=GeometryModel.from_tree(_tree(spec, joints), joints, model.opt.gravity, places),
        theta=poses.theta[:, columns],
        measured=poses.measured[:, markers],
        geometry=geometry,
        elastic=joints,
        lateral=lateral,
        free=tuple(f"{side}_0" for side in sides),
    )
    return problem.align()


def _tree(spec: mujoco.MjSpec, joints: tuple[str, ...]) -> Tree:
    return Tree.of(spec.compile(), joints, {})


@dataclass(frozen=True)
class Variant:
    """What is sought beside tracker, markers and shoulders.

    Attributes:
        name: What tables call it.
        geometry: How much of the geometry is unknown.
        lateral: Whether compliance across the axes is sought too.
    """

    name: str
    geometry: Geometry
    lateral: bool = False


VARIANTS = (
    Variant("K and encoder offsets", "offsets"),
    Variant("K and geometry", "dh"),
    Variant("K, geometry and lateral compliance", "dh", lateral=True),
)


class HandError(Model):
    """Error of the hands at held-out poses: a row of `recorded_justin.csv`."""

    prediction: str
    """The rigid model, a rival that needs no physics, or what was identified."""
    poses: int
    """Poses that were fitted."""
    held_out: int
    """Poses that were predicted, in each half."""
    halves: int
    """Random halves; the errors are means over them."""
    masses: str
    """`GUESSED` or `DRAWN`."""
    rms_mm: float
    """Root mean square over poses and hands."""
    mean_mm: float
    """Mean over poses and hands."""
    least_mm: float
    """Mean of the best half."""
    most_mm: float
    """Mean of the worst half."""


def num_trials(count: int) -> int:
    """Steps of progress of `hand_errors` for a number of poses."""
    return HALVES * len(_trials(count // 2))


def _trials(half: int) -> list[tuple[int, str]]:
    """Number of poses that are fitted, and masses."""
    few = [(count, GUESSED) for count in FEW_POSES if count < half]
    return [*few, (half, GUESSED), (half, DRAWN)]


def hand_errors(poses: RecordedPoses, progress: Callable[[int], None]) -> list[HandError]:
    """Held-out errors of all variants, beside the rigid model and the rivals.

    Args:
        poses: All poses; half of them are held out, in `HALVES` random halves.
        progress: Called with the number of trials so far; `num_trials` says how many there are.
    """
    count = len(poses.theta)
    found: dict[tuple[str, int, str], list[Array]] = {}
    done = 0
    for half in range(HALVES):
        generator = np.random.default_rng(half)
        order = generator.permutation(count)
        drawn = generator.uniform(*MASS_RANGE, len(_MASSES_KG))
        fitted = order[: count // 2]
        outer = poses.of(order[count // 2 :])
        for number, masses in _trials(len(fitted)):
            factors = drawn if masses == DRAWN else _AS_GUESSED
            errors = _errors_of(poses.of(fitted[:number]), outer, factors)
            for name, own in errors.items():
                found.setdefault((name, number, masses), []).append(own)
            done += 1
            progress(done)
    held_out = count - count // 2
    return [_summary(key, errors, held_out) for key, errors in found.items()]


def _errors_of(inner: RecordedPoses, outer: RecordedPoses, mass_factors: Array) -> dict[str, Array]:
    """Distances of the hands from each prediction at the outer poses, (N, 2) [m]."""
    spec = find_rigid(inner, mass_factors)
    errors = dict[str, Array]()
    for variant in VARIANTS:
        problem = _problem(spec, inner, tuple(_MARKERS), variant.geometry, variant.lateral)
        other = replace(problem, theta=outer.theta, measured=outer.measured)
        if not errors:
            rigid = fit_geometry(problem.as_rigid())
            missed = (rigid.prediction_error(problem), rigid.prediction_error(other))
            rivals = rival_errors(problem.theta, missed[0], other.theta, missed[1])
            errors = {RIGID: np.linalg.norm(missed[1], axis=-1), **rivals}
        errors[variant.name] = np.linalg.norm(
            fit_geometry(problem).prediction_error(other), axis=-1
        )
    return errors


def _summary(key: tuple[str, int, str], errors: list[Array], held_out: int) -> HandError:
    name, number, masses = key
    means = [1e3 * float(own.mean()) for own in errors]
    rms = [1e3 * float(np.sqrt(np.mean(own**2))) for own in errors]
    return HandError(
        prediction=name,
        poses=number,
        held_out=held_out,
        halves=len(errors),
        masses=masses,
        rms_mm=float(np.mean(rms)),
        mean_mm=float(np.mean(means)),
        least_mm=min(means),
        most_mm=max(means),
    )
