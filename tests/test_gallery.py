"""Known robots with elastic joints: stable, rigid in the limit, and of one gravity torque,
whoever computes it."""

import copy
import csv
import re
import struct
import xml.etree.ElementTree as ET
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest

from docs.pages.gallery import AtRest, measure
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.joint_names import motor_name
from elastic_env.joint.make_elastic import make_elastic, transform_hinges
from elastic_env.joint.model_joints import hinges_of
from elastic_env.joint.time_step import largest_stable_timestep
from elastic_env.joint.urdf import keep_shapes, urdf_spec
from elastic_env.rendering.simple_bodies import add_simple_bodies
from elastic_env.rigid.rigid_body import RigidBody
from elastic_env.robots import gallery
from elastic_env.robots.assumed_joints import random_poses
from elastic_env.robots.gallery import (
    GALLERY,
    gallery_file,
    gallery_joints,
    gallery_robot,
    home_pose,
)
from tests.gallery_files import FOLDER, PACKAGED, excerpt

pytestmark = pytest.mark.filterwarnings("error::UserWarning")


MORE_RIGID = ["ur5", "talos_arm", "so101", "pusher"]


def some_tonight(*now: str) -> list[object]:
    """All robots: some with every commit, and the others at night."""
    return [pytest.param(n, marks=[pytest.mark.slow] * (n not in now)) for n in GALLERY]


@cache
def rigid(name: str) -> mujoco.MjModel:
    """The model as it was; the slides of grippers are held."""
    return gallery_robot(name, FOLDER).compile()


def elastic(name: str, stiffness_scale: float = 1.0) -> mujoco.MjModel:
    """With elastic hinges, all of them."""
    joints = {
        hinge: joint.replace(stiffness=stiffness_scale * joint.stiffness)
        for hinge, joint in gallery_joints(name, FOLDER).items()
    }
    return make_elastic(gallery_robot(name, FOLDER), joints).compile()


def sides(model: mujoco.MjModel, hinges: list[str]) -> tuple[list[int], list[int]]:
    """Addresses of the rotors and of the links, which are those of the degrees of freedom too."""
    of = lambda name: int(model.joint(name).qposadr[0])  # noqa: E731
    return [of(motor_name(hinge)) for hinge in hinges], [of(hinge) for hinge in hinges]


@pytest.mark.parametrize("name", some_tonight("panda", "talos_arm", "so101"))
def test_a_robot_with_elastic_hinges_moves_for_four_seconds(name: str) -> None:
    """Catches a hinge that stayed rigid, a spring that explodes or swings up, and a reset that
    would hide it."""
    model = elastic(name)
    hinges = hinges_of(rigid(name))
    assert len(hinges) == rigid(name).nv == model.ntendon
    data = mujoco.MjData(model)
    home = home_pose(name, hinges)
    rotors, links = sides(model, hinges)
    data.qpos[rotors] = data.qpos[links] = home
    omega = 2.0 * np.pi * np.linspace(0.2, 0.5, len(hinges))
    largest = 0.0
    early = 0.0
    for step in range(1000):
        data.ctrl[:] = home + 0.2 * np.sin(omega * data.time)
        mujoco.mj_step(model, data, 4)
        largest = max(largest, float(np.abs(data.qpos[rotors] - data.qpos[links]).max()))
        early = largest if step == 500 else early
    assert data.time == pytest.approx(4.0)
    assert not data.warning.number.any()
    assert 5e-3 < largest < 0.05
    assert largest < 1.5 * early, "it swings up"


@pytest.mark.parametrize("name", some_tonight("panda", "talos_arm", "so101", "ur3"))
def test_the_limit_of_rigid_joints_is_the_model_as_it_was(name: str) -> None:
    """Catches weight, damping or limits that a rotor brings along or loses.

    For K → ∞ the deflection vanishes, and what is left is Tᵀ M T q̈ = Tᵀ f. q̈ must be that of
    MuJoCo for the model as it was, with the rotors' inertia as armature, pushed by the same
    torques.
    """
    model = copy.copy(rigid(name))
    stiff = elastic(name)
    hinges = hinges_of(rigid(name))
    expected = mujoco.MjData(model)
    data = mujoco.MjData(stiff)
    rotors, links = sides(stiff, hinges)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    model.dof_armature[:] = stiff.dof_armature[rotors]
    generator = np.random.default_rng(1)
    for _ in range(5):
        q = home_pose(name, hinges)
        speed = generator.uniform(-1, 1, model.nv)
        push = generator.uniform(-5, 5, model.nv)
        expected.qpos[:] = q
        expected.qvel[:] = speed
        expected.qfrc_applied[:] = push
        data.qpos[rotors] = data.qpos[links] = q
        data.qvel[rotors] = data.qvel[links] = speed
        mujoco.mj_forward(model, expected)
        mujoco.mj_forward(stiff, data)
        M = np.zeros((stiff.nv, stiff.nv))
        T = np.zeros((stiff.nv, model.nv))
        mujoco.mj_fullM(stiff, data, M)
        T[rotors, range(model.nv)] = T[links, range(model.nv)] = 1.0
        force = T.T @ (data.qfrc_passive - data.qfrc_bias) + push
        size = np.abs(
            expected.qacc
        ).max()  # a rotor has 1e-12 kg·m² of its own, which the lightest gripper feels
        np.testing.assert_allclose(
            np.linalg.solve(T.T @ M @ T, force), expected.qacc, rtol=0.0, atol=1e-7 * size
        )


@pytest.mark.parametrize(
    "name", ["panda", *(pytest.param(n, marks=pytest.mark.slow) for n in MORE_RIGID)]
)
def test_stiffer_joints_move_ever_more_like_rigid_ones(name: str) -> None:
    """Catches a limit that is right on paper and not in motion: ten times the stiffness is a
    tenth of the deviation."""
    hinges = hinges_of(rigid(name))
    joints = gallery_joints(name, FOLDER)

    def fallen(form: str, scale: float, timestep_s: float | None = None) -> Array:
        """Link angles after a fall of 50 ms from home."""
        scaled = {
            hinge: ElasticJoint(
                stiffness=scale * joint.stiffness, rotor_inertia=joint.rotor_inertia
            )
            for hinge, joint in joints.items()
        }
        spec = transform_hinges(gallery_robot(name, FOLDER), scaled, form)  # type: ignore[arg-type]
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
        model = spec.compile()
        steps = int(np.ceil(0.05 / min(timestep_s or 1.0, 0.3 * largest_stable_timestep(model))))
        model.opt.timestep = 0.05 / steps
        data = mujoco.MjData(model)
        home = home_pose(name, hinges)
        at = [model.joint(hinge).qposadr[0] for hinge in hinges]
        data.qpos[at] = home
        if form == "tendon":
            data.qpos[sides(model, hinges)[0]] = home
        mujoco.mj_step(model, data, steps)
        assert not data.warning.number.any()
        return data.qpos[at]

    as_it_was = fallen("rigid", 1.0, 1e-4)
    moved = np.abs(as_it_was - home_pose(name, hinges)).max()
    deviations = [np.abs(fallen("tendon", scale) - as_it_was).max() / moved for scale in (1e2, 1e3)]
    assert deviations[0] < 0.1
    assert deviations[1] < 0.2 * deviations[0]


@pytest.mark.parametrize("name", GALLERY)
def test_everybody_computes_the_same_gravity_torque(name: str) -> None:
    """Catches a mass, an axis or a frame that is lost between URDF, MuJoCo, Pinocchio and our
    tree."""
    model = rigid(name)
    hinges = hinges_of(model)
    data = mujoco.MjData(model)
    poses = random_poses(model, np.random.default_rng(3), 10)
    ours = RigidBody(model, hinges).gravity_torque(poses)
    size = np.abs(ours).max()
    for pose, torque in zip(poses, ours, strict=True):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        springs = model.jnt_stiffness * (pose - model.qpos_spring)
        np.testing.assert_allclose(torque, data.qfrc_bias + springs, rtol=0.0, atol=1e-9 * size)
        if name in PACKAGED:
            np.testing.assert_allclose(
                torque, from_urdf(name, hinges, pose), rtol=0.0, atol=1e-9 * size
            )


@cache
def urdf_model(name: str) -> pinocchio.Model:
    """Pinocchio's own reading of the robot."""
    return pinocchio.buildModelFromUrdf(str(gallery_file(name, FOLDER)))


def from_urdf(name: str, hinges: list[str], pose: Array) -> Array:
    """Gravity torque by Pinocchio, (n,) [N·m]; a joint without limits has two numbers there."""
    model = urdf_model(name)
    at = [model.joints[model.getJointId(hinge)].idx_v for hinge in hinges]
    turn = np.zeros(model.nv)
    turn[at] = pose
    q = pinocchio.integrate(model, pinocchio.neutral(model), turn)
    return pinocchio.computeGeneralizedGravity(model, model.createData(), q)[at]


ROOT = Path(__file__).parents[1]


def rows() -> dict[str, dict[str, str]]:
    """What the page of the gallery shows."""
    with (ROOT / "docs" / "results" / "gallery.csv").open(newline="", encoding="utf-8") as file:
        return {row["robot"]: row for row in csv.DictReader(file)}


@pytest.mark.parametrize("name", some_tonight("panda", "talos_arm", "so101", "ur3"))
def test_the_figures_of_the_page_are_those_of_robots_at_rest(name: str) -> None:
    """Catches figures that are old, and a pose in which MuJoCo's elastic robot would not rest."""
    row = asdict(measure(name, FOLDER))
    assert row.pop("input_rms_m") < 1e-9
    for column, value in row.items():
        found = rows()[name][column]
        assert (
            found == str(value)
            if isinstance(value, str)
            else float(found) == pytest.approx(value, rel=1e-4)
        ), column
    robot = AtRest(name, FOLDER)
    model = elastic(name)
    rotors, links = sides(model, robot.hinges)
    data = mujoco.MjData(model)
    q_ref = random_poses(robot.model, np.random.default_rng(5), 3)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    for theta in (q_ref, robot.commands(q_ref)):
        for motor, link in zip(theta, robot.links(theta), strict=True):
            data.qpos[rotors] = motor
            data.qpos[links] = link
            mujoco.mj_forward(model, data)
            load = data.qfrc_bias[links]
            np.testing.assert_allclose(
                data.qfrc_passive[links], load, rtol=0.0, atol=1e-9 * np.abs(load).max()
            )


def test_the_page_shows_every_robot() -> None:
    """Catches a robot without a picture, or in the page and no longer in the gallery."""
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert list(rows()) == list(GALLERY)
    assert set(re.findall(r"images/gallery/(\w+)\.png", page)) == set(GALLERY)
    pictures = list((ROOT / "docs" / "images" / "gallery").iterdir())
    assert {picture.stem for picture in pictures} == set(GALLERY)
    assert sum(picture.stat().st_size for picture in pictures) < 500_000
    assert all(f"`{name}`" in page for name in GALLERY)


def test_rods_weigh_nothing() -> None:
    """Catches a robot that is drawn by rods and gets heavier by them."""
    spec = gallery_robot("panda", FOLDER)
    add_simple_bodies(spec)
    model = spec.compile()
    np.testing.assert_array_equal(model.body_mass, rigid("panda").body_mass)
    np.testing.assert_array_equal(model.body_inertia, rigid("panda").body_inertia)
    assert model.ngeom > 5
    assert not model.geom_contype.any()


def test_the_excerpts_are_those_of_the_package() -> None:
    """Catches a robot that has changed in the package; without the package there is nothing to
    compare."""
    try:
        found = {name: excerpt(gallery_file(name)) for name in PACKAGED}
    except ConfigurationError as error:
        assert "pip install" in str(error)  # noqa: PT017  what a user is told who has no package
        return
    assert found == {
        name: gallery_file(name, FOLDER).read_text(encoding="utf-8") for name in PACKAGED
    }


def test_what_is_missing_is_said_with_its_cure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a traceback of files where the extra is not installed."""
    with pytest.raises(ConfigurationError, match=r"unknown robot 'pandas'.*'panda'"):
        gallery_robot("pandas")
    with pytest.raises(ConfigurationError, match=r"no model at .*pip install .*'\.\[robots\]'"):
        gallery_robot("panda", tmp_path)

    def missing(_: str) -> None:
        raise PackageNotFoundError

    monkeypatch.setattr(gallery, "distribution", missing)
    with pytest.raises(
        ConfigurationError, match=r"package example-robot-data; .*pip install .*'\.\[robots\]'"
    ):
        gallery_robot("panda")


LINK = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="2"/><origin xyz=".1 0 0"/>
  <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><geometry><mesh filename="package://robots/meshes/{visual}"/></geometry></visual>
  <collision><geometry><mesh filename="package://robots/meshes/wedge.stl"/></geometry></collision></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""


@pytest.mark.parametrize(
    ("visual", "drawn"),
    [("wedge.stl", "wedge"), ("wedge.dae", "wedge"), ("lost.stl", "wedge"), (None, None)],
)
def test_meshes_are_drawn_where_mujoco_reads_them(
    tmp_path: Path, visual: str | None, drawn: str | None
) -> None:
    """Catches shapes that add mass or touch something, and a picture without the link whose
    visual is of COLLADA."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
    faces = [corners[[0, 2, 1]], corners[[0, 1, 3]], corners[[0, 3, 2]], corners[[1, 2, 3]]]
    (tmp_path / "robots" / "meshes").mkdir(parents=True)
    content = b"".join(struct.pack("<3f", 0, 0, 0) + face.tobytes() + b"\0\0" for face in faces)
    (tmp_path / "robots" / "meshes" / "wedge.stl").write_bytes(
        b" " * 80 + struct.pack("<I", len(faces)) + content
    )
    (tmp_path / "robots" / "meshes" / "wedge.dae").write_text("<COLLADA/>")
    root = ET.fromstring(LINK.format(visual=visual or "wedge.stl"))
    lost = keep_shapes(root, tmp_path / "robots" / "urdf" if visual else None)
    model = urdf_spec(root, "the link").compile()
    assert lost == []
    assert [model.mesh(i).name for i in range(model.nmesh)] == ([drawn] if drawn else [])
    assert model.body("arm").mass[0] == 2.0
    np.testing.assert_allclose(model.body("arm").ipos, [0.1, 0.0, 0.0])
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
