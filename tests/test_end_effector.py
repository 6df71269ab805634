"""The end effector of a robot: where it is, how far off, and how its figures reach the commands."""

import csv
from pathlib import Path

import mujoco
import numpy as np
import pytest

from elastic_env import JointRobot
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.rigid.tree.end_effector import EndEffector, outermost_body
from tests.three_joints import ARM, rigid_arm
from tests.trees import ORDER, TREE
from train.commands.cli import main

NAMES = list(ORDER)
SITED = TREE.replace(
    '<body name="shank"',
    '<site name="sole" pos="0.1 0.2 -0.3" quat="0.8 0.1 -0.3 0.2"/><body name="shank"',
)


def poses(count: int) -> Array:
    return np.random.default_rng(5).uniform(-1.5, 1.5, (count, len(NAMES)))


def of_mujoco(model: mujoco.MjModel, q: Array, name: str) -> tuple[Array, Array]:
    data = mujoco.MjData(model)
    for joint, angle in zip(NAMES, q, strict=True):
        data.joint(joint).qpos = angle
    mujoco.mj_kinematics(model, data)
    if name == "sole":
        return data.site(name).xpos.copy(), data.site(name).xmat.reshape(3, 3).copy()
    return data.body(name).xpos.copy(), data.body(name).xmat.reshape(3, 3).copy()


@pytest.mark.parametrize("name", ["sole", "shank", "box"])
def test_its_pose_is_that_of_mujoco(name: str) -> None:
    """Catches anchors, references, turned frames and columns that are mixed up: MuJoCo's
    kinematics are the judge."""
    model = mujoco.MjModel.from_xml_string(SITED)
    position, R = EndEffector(model, NAMES, name).pose(poses(12).reshape(3, 4, -1))
    for q, p, turned in zip(poses(12), position.reshape(-1, 3), R.reshape(-1, 3, 3), strict=True):
        expected, expected_R = of_mujoco(model, q, name)
        np.testing.assert_allclose(p, expected, atol=1e-12)
        np.testing.assert_allclose(turned, expected_R, atol=1e-12)


@pytest.mark.parametrize("name", ["sole", "box"])
def test_its_jacobian_is_that_of_mujoco(name: str) -> None:
    """Catches columns of other joints and a lever about another point, also where joints do not
    move the tool."""
    model = mujoco.MjModel.from_xml_string(SITED)
    data = mujoco.MjData(model)
    tool = EndEffector(model, NAMES, name)
    dofs = [int(model.joint(joint).dofadr[0]) for joint in NAMES]
    for q, moved, turned in zip(poses(5), *tool.jacobian(poses(5)), strict=True):
        expected_p, _ = of_mujoco(model, q, name)
        for joint, angle in zip(NAMES, q, strict=True):
            data.joint(joint).qpos = angle
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jacp, jacr = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, jacp, jacr, expected_p, tool.body)
        np.testing.assert_allclose(moved, jacp[:, dofs], atol=1e-12)
        np.testing.assert_allclose(turned, jacr[:, dofs], atol=1e-12)


def test_the_outermost_body_is_one_that_a_joint_moves() -> None:
    """Catches a camera on a mast, further from the base than the hand that moves."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="hand"><joint name="one"/><geom size=".1"/></body>
        <body name="mast"><body name="pan"><body name="camera"/></body></body></worldbody></mujoco>"""
    )
    assert outermost_body(model) == "hand"
    mast = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="mast"/></worldbody></mujoco>'
    )
    with pytest.raises(ConfigurationError, match="no body that the joints move"):
        outermost_body(mast)


def test_its_errors_are_those_of_mujoco() -> None:
    """Catches a distance in other units, and a tilt whose small angles are lost to rounding."""
    model = mujoco.MjModel.from_xml_string(SITED)
    for size in (1e-6, 0.3):
        q_ref = poses(6)
        q = q_ref + size * poses(6)[::-1]
        distance, tilt = EndEffector(model, NAMES, "sole").errors(q_ref, q)
        for row in range(6):
            p, R = of_mujoco(model, q[row], "sole")
            p_ref, R_ref = of_mujoco(model, q_ref[row], "sole")
            between = np.zeros(4)
            turn = np.zeros(3)
            mujoco.mju_mat2Quat(between, (R_ref.T @ R).ravel())
            mujoco.mju_quat2Vel(turn, between, 1.0)
            assert distance[row] == pytest.approx(np.linalg.norm(p - p_ref), rel=1e-6)
            assert tilt[row] == pytest.approx(np.linalg.norm(turn), rel=1e-6)


def test_what_is_no_end_effector_says_why() -> None:
    """Catches a KeyError, and an end effector that cannot move."""
    with pytest.raises(
        ConfigurationError,
        match=r"unknown site or body for end_effector 'hnd'.*Did you mean 'hand'",
    ):
        JointRobot("lost", rigid_arm, ARM.joints, end_effector="hnd").robot.make()
    fixed = rigid_arm()
    fixed.worldbody.add_site(name="table")
    with pytest.raises(ConfigurationError, match="'table' is on 'world', which no joint moves"):
        EndEffector(fixed.compile(), list(ARM.joints), "table")


@pytest.mark.slow
def test_the_commands_judge_by_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches figures that stay in the environment; a compensated hand is nearer."""
    monkeypatch.chdir(tmp_path)
    source = Path(__file__).with_name("three_joints.py").read_text()
    source = source.replace('JointRobot("arm"', 'JointRobot("handed_arm"')
    (tmp_path / "handed.py").write_text(
        source.replace('imu="hand")', 'imu="hand", end_effector="hand")')
    )
    (tmp_path / "arm.yaml").write_text(
        "name: arm\nenv: handed.py:ARM\nreferences: [{kind: sine, amplitude: 0.3, duration_s: 1.0,"
        " onset_s: 0.5}]\nscenarios: [ideal]\npolicies: [uncompensated, dynamic]\n"
    )
    main(["compare", "arm.yaml", "--jobs", "1"])
    folder = tmp_path / "runs" / "arm"
    without, compensated = csv.DictReader((folder / "episodes.csv").open())
    assert 1e-3 < float(without["end_effector_error_rms_m"]) < 0.1
    assert float(compensated["end_effector_error_rms_m"]) < 0.05 * float(
        without["end_effector_error_rms_m"]
    )
    assert float(compensated["end_effector_tilt_rms_rad"]) < 0.05 * float(
        without["end_effector_tilt_rms_rad"]
    )
    assert "end effector error" in (folder / "report.html").read_text()
