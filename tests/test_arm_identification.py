"""Stiffness of an arm from static poses: against equilibria of MuJoCo, with intervals that hold
the truth."""

import csv
import io
import json
import math
import re
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from baselines import PositionCompensator
from baselines.identification.arm_fit import ArmFit, fit_arm, information_of
from baselines.identification.arm_result import JointStiffness, bounded_compliance, describe_fit
from baselines.identification.holdout import FITTED, RIGID, HeldOut, HoldoutProblem, judge, split
from baselines.identification.pose_checks import reverse_joint
from baselines.identification.pose_log import Kind, PoseLog, read_log, write_poses
from baselines.identification.pose_model import PoseModel
from baselines.identification.pose_plan import candidate_poses, plan_further
from baselines.identification.pose_unknowns import PoseUnknowns
from baselines.identification.rivals import RIVALS
from baselines.identification.static_arm import StaticArm
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.core.yaml_text import parse_yaml
from elastic_env.joint.elastic_joint import ElasticJoint
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.joint.make_elastic import make_elastic
from train.commands.arm_problem import ArmProblem
from train.commands.cli import main
from train.commands.held_out import judge_poses
from train.commands.identify_arm_tables import result_table
from train.commands.identify_options import ArmOptions, HoldoutOptions
from train.figures.identification_plots import deflections

FOLDER = Path(__file__).parents[1] / "docs" / "identification"
ARM = mujoco.MjModel.from_xml_path(str(FOLDER / "arm.xml"))
JOINTS = tuple(ARM.joint(i).name for i in range(ARM.njnt))
K = np.array([2000.0, 1800.0, 1100.0, 900.0, 300.0, 250.0, 180.0])
OFFSET = np.array([4.0, -6.0, 3.0, 5.0, -4.0, 6.0, -5.0]) * 1e-3
FRICTION = np.array([2.0, 2.0, 1.5, 1.0, 0.5, 0.4, 0.3])
COUNT = 2.0 * np.pi / 501_923
NOISE: dict[Kind, float] = {
    "end_effector": 3e-4,
    "link_encoders": 1e-4,
    "imu": 5e-4,
    "torques": 0.05,
}
TURN = Rotation.from_euler("xyz", [0.4, -0.2, 2.0])
RANGES = {joint: tuple(ARM.joint(joint).range) for joint in JOINTS}


def equilibria(theta: Array, load: Array, model: mujoco.MjModel = ARM) -> Array:
    """Link angles at which springs hold MuJoCo's bias force and a further load, (N, n) [rad]."""
    data = mujoco.MjData(model)

    def imbalance(q: Array, theta: Array, load: Array) -> Array:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        return theta - q - (data.qfrc_bias + load) / K

    return np.array(
        [
            root(imbalance, row, (row, own), tol=1e-13).x
            for row, own in zip(theta, load, strict=True)
        ]
    )


def shown(kind: Kind, q: Array, load: Array) -> Array:
    """What a sensor without noise shows, by MuJoCo: a tracker that is shifted and an IMU that is
    mounted askew."""
    if kind == "link_encoders":
        return q
    data = mujoco.MjData(ARM)
    rows = []
    for row, own in zip(q, load, strict=True):
        data.qpos[:] = row
        mujoco.mj_forward(ARM, data)
        attitude = Rotation.from_matrix(data.site("marker").xmat.reshape(3, 3)) * TURN
        _, pitch, roll = attitude.as_euler("ZYX")
        rows.append(
            {
                "end_effector": data.site("marker").xpos + np.array([0.4, -1.2, 0.3]),
                "imu": np.array([roll, pitch]),
                "torques": data.qfrc_bias + own,
            }[kind]
        )
    return np.array(rows)


def poses(count: int, generator: np.random.Generator) -> Array:
    """Motor angles within the ranges, (count, n) [rad]."""
    return 0.9 * generator.uniform(*ARM.jnt_range.T, size=(count, len(JOINTS)))


def log_of(
    kind: Kind, seed: int, count: int = 40, friction: float = 0.0, **options: Any
) -> PoseLog:
    """The log of an arm of known truth: noise in its usual size, and encoders that count."""
    generator = np.random.default_rng(seed)
    theta = options.get("theta", poses(count, generator))
    direction = generator.choice([-1.0, 1.0], size=theta.shape)
    load = friction * FRICTION * direction
    measured = shown(kind, equilibria(theta, load), load)
    measured = measured + options.get("noise", 1.0) * NOISE[kind] * generator.standard_normal(
        measured.shape
    )
    columns = {"end_effector": ("x", "y", "z"), "imu": ("roll", "pitch")}.get(kind, JOINTS)
    read = (
        np.round((theta + OFFSET) / COUNT) * COUNT if options.get("noise", 1.0) else theta + OFFSET
    )
    return PoseLog(
        JOINTS, read, kind, columns, measured, direction if options.get("sides") else None
    )


def model_of(log: PoseLog, elastic: tuple[str, ...] = JOINTS, **options: Any) -> PoseModel:
    """The model of a log."""
    arm = StaticArm(ARM, JOINTS, "marker", options.get("payload"))
    return PoseModel(
        arm,
        log,
        PoseUnknowns.from_log(log, elastic, options.get("frame", "offset"), "payload" in options),
    )


def errors(fit: ArmFit) -> Array:
    """Relative errors of the compliances, (k,)."""
    return fit.estimate("compliance")[0] * K - 1.0


LOADED = slice(1, None)  # gravity does not load the vertical axis of the base


def test_equilibrium_is_one_of_an_elastic_arm_in_mujoco() -> None:
    """Catches a spring with the wrong sign, torque at θ in place of q, and a payload that is not
    where it is said."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "arm.xml"))
    body = spec.body("link7").add_body(name="weight", pos=[0.16, 0, 0.16])
    body.mass = 0.8
    body.ipos = [0.0] * 3
    body.inertia = [1e-9] * 3
    body.explicitinertial = True
    elastic = make_elastic(
        spec,
        {
            joint: ElasticJoint(stiffness=k, rotor_inertia=0.1)
            for joint, k in zip(JOINTS, K, strict=True)
        },
    ).compile()
    log = PoseLog(
        JOINTS, poses(3, np.random.default_rng(0)), "link_encoders", JOINTS, np.zeros((3, 7))
    )
    model = model_of(log, payload="marker")
    unknowns = np.zeros(model.unknowns.size)
    unknowns[model.unknowns.slices["compliance"]] = 1.0 / K
    unknowns[model.unknowns.slices["payload"]] = 0.8
    at = JointAddresses.of(elastic, JOINTS)
    data = mujoco.MjData(elastic)
    for theta, q in zip(log.theta, model.link_angles(unknowns)[0], strict=True):
        data.qpos[at.theta] = theta
        data.qpos[at.q] = q
        mujoco.mj_forward(elastic, data)
        np.testing.assert_allclose(data.qfrc_passive[at.q_dot], data.qfrc_bias[at.q_dot], atol=1e-8)


@pytest.mark.parametrize("kind", NOISE)
@pytest.mark.parametrize("frame", ["offset", "pose"])
def test_derivatives_are_those_of_finite_differences(kind: Kind, frame: str) -> None:
    """Catches a missing term of the implicit derivative, for every unknown and every
    measurement."""
    model = model_of(log_of(kind, 1, count=3, sides=True), payload="link7", frame=frame)
    unknowns = model.start_with(0.03)
    unknowns += 0.01 * model.scale * np.random.default_rng(2).standard_normal(len(unknowns))
    turn = model.unknowns.slices["rotation"]
    unknowns[turn] = 0.0  # its derivative is that of a first turn
    steps = np.diag(1e-5 * model.scale)
    numeric = [
        (model.predict(unknowns + s)[0] - model.predict(unknowns - s)[0]) / 2e-5 for s in steps
    ]
    gradient = model.predict(unknowns)[1] * model.scale
    np.testing.assert_allclose(
        gradient, np.stack(numeric, axis=-1), atol=2e-6 * np.abs(gradient).max()
    )


def test_a_known_torque_tells_a_joint_that_gravity_does_not_load(tmp_path: Path) -> None:
    """Weights on a rope pull the vertical axis of the base; forward is positive."""
    generator = np.random.default_rng(11)
    theta = poses(20, generator)
    pull = np.zeros_like(theta)
    pull[:, 0] = generator.uniform(-40.0, 40.0, 20)
    columns = {f"theta.{joint}": theta[:, i] for i, joint in enumerate(JOINTS)}
    q = equilibria(theta, -pull)  # what the springs hold
    columns |= {f"q.{joint}": q[:, i] for i, joint in enumerate(JOINTS)}
    path = write_poses(tmp_path / "poses.csv", columns | {"tau_known.base_yaw": pull[:, 0]})
    log = read_log(path, RANGES)
    assert log.known_torque is not None
    np.testing.assert_allclose(log.known_torque, pull, rtol=1e-8)
    assert np.abs(errors(fit_arm(model_of(log)))).max() < 1e-4


@pytest.mark.parametrize("kind", ["end_effector", "link_encoders", "imu", "torques"])
@pytest.mark.parametrize("friction", [0.0, 1.0])
def test_exact_poses_give_the_truth(kind: Kind, friction: float) -> None:
    """Catches signs, frames and offsets: without noise the truth is what is left."""
    fit = fit_arm(model_of(log_of(kind, 3, noise=0.0, friction=friction, sides=True)))
    seen = (
        slice(1, 6) if kind == "imu" else LOADED
    )  # the marker's tilt does not depend on how it is turned upright
    np.testing.assert_allclose(errors(fit)[seen], 0.0, atol=2e-4)
    np.testing.assert_allclose(
        fit.estimate("friction")[0][seen], friction * FRICTION[seen], atol=2e-3
    )
    if kind != "imu":
        np.testing.assert_allclose(fit.estimate("offset")[0][LOADED], OFFSET[LOADED], atol=2e-5)


def test_a_tracker_that_stands_anywhere_is_found() -> None:
    """Catches a frame whose directions are taken for the model's, and one whose shift is not
    sought with them."""
    log = log_of("end_effector", 4, noise=0.0)
    turned = TURN.apply(log.measured) + np.array([3.0, 0.0, -1.0])
    fit = fit_arm(model_of(replace(log, measured=turned), frame="pose"))
    np.testing.assert_allclose(errors(fit)[LOADED], 0.0, atol=2e-4)


def test_payload_is_found_with_the_stiffness() -> None:
    """Catches a payload in the wrong place, and one that is taken for soft joints."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "arm.xml"))
    spec.body("link7").mass -= 0.9  # the log's arm carries it, this one does not
    ipos = np.array(spec.body("link7").ipos)
    place = (3.6 * ipos - 2.7 * ipos) / 0.9
    spec.body("link7").add_site(name="weight", pos=place)
    log = log_of("end_effector", 5, count=60)
    arm = StaticArm(spec.compile(), JOINTS, "marker", "weight")
    fit = fit_arm(PoseModel(arm, log, PoseUnknowns.from_log(log, JOINTS, "offset", payload=True)))
    mass, half = fit.estimate("payload")
    assert abs(mass[0] - 0.9) < half[0] < 0.3
    compliance, width = fit.estimate("compliance")
    assert (np.abs(compliance - 1.0 / K) < 1.5 * width)[LOADED].all()


def test_intervals_hold_the_truth_and_are_no_wider_than_they_must_be() -> None:
    """Catches an interval of the prior, of half the width, or of noise that friction is not part
    of."""
    runs = 16
    hits = np.zeros(7)
    widths = []
    found = []
    for seed in range(runs):
        fit = fit_arm(model_of(log_of("end_effector", 100 + seed, friction=0.3)))
        compliance, half = fit.estimate("compliance")
        hits += np.abs(compliance - 1.0 / K) <= half
        widths.append(half * K)
        found.append(compliance * K)
    assert hits[LOADED].mean() >= 0.9 * runs
    assert (hits >= 0.75 * runs).all()
    ratio = np.mean(widths, axis=0)[LOADED] / (2.0 * np.std(found, axis=0)[LOADED])
    assert 0.8 < np.median(ratio) < 1.5


def test_target_of_forty_poses_and_a_tracker_to_three_tenths_of_a_millimetre(
    tmp_path: Path,
) -> None:
    """Catches K beyond 3 % of a joint that is told apart, and a correction that leaves a fifth
    of the sag."""
    fit = fit_arm(model_of(log_of("end_effector", 6)))
    result = describe_fit(fit, within=0.03, assumed=None)
    told = np.array([not joint.reason for joint in result.joints])
    assert told.tolist() == [False, True, True, True, False, True, False]
    found = np.array([joint.stiffness_nm_per_rad for joint in result.joints])
    assert (np.abs(found / K - 1.0)[told] < 0.03).all()
    result.save(tmp_path)
    stiffness = parse_yaml((tmp_path / "joints.yaml").read_text())
    compensator = PositionCompensator.from_model(ARM, stiffness)
    wanted = 0.8 * poses(40, np.random.default_rng(7))
    none = np.zeros_like(wanted)
    where = lambda q: shown("end_effector", q, np.zeros_like(q))  # noqa: E731
    corrected = np.array([compensator.command(row) for row in wanted])
    before, after = (
        np.sqrt(np.mean(np.sum((where(equilibria(command, none)) - where(wanted)) ** 2, axis=1)))
        for command in (wanted, corrected)
    )
    assert before > 0.005
    assert after < 0.2 * before


def test_joints_that_poses_do_not_tell_apart_are_named_with_the_reason() -> None:
    """Catches a number for a joint that carries nothing, that the sensor does not show, or that
    has a twin."""
    why = {
        joint.joint: joint
        for joint in describe_fit(fit_arm(model_of(log_of("end_effector", 8))), 0.03, 700.0).joints
    }
    assert why["base_yaw"].reason == "gravity does not load it in these poses"
    assert (why["base_yaw"].source, why["base_yaw"].stiffness_nm_per_rad) == ("assumed", 700.0)
    assert why["base_yaw"].stiffness_high_nm_per_rad is None
    assert "small beside the noise" in why["wrist_roll"].reason
    log = log_of("link_encoders", 8)
    half = replace(log, columns=JOINTS[:-1], measured=log.measured[:, :-1])
    assert (
        describe_fit(fit_arm(model_of(half)), 0.03, None).joints[-1].reason
        == "the measurement does not show its angle"
    )


def test_joints_that_move_alike_are_named_together() -> None:
    """Catches twins that are told apart by the prior: elbow and wrist of a planar arm that only
    turns its shoulder."""
    xml = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="a" axis="0 1 0"/>
      <inertial mass="1" pos="0.2 0 0" diaginertia="0.01 0.01 0.01"/>
      <body><joint name="b" axis="0 1 0"/><inertial mass="1" pos="0.3 0 0" diaginertia="0.01 0.01 0.01"/>
      <body name="tip" pos="0.4 0 0"><inertial mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/></body>
      </body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    generator = np.random.default_rng(9)
    arm = StaticArm(model, ("a", "b"), "tip")
    theta = np.stack([generator.uniform(-1.5, 1.5, 30), np.zeros(30)], axis=-1)
    angle = theta.sum(axis=-1) - arm.torque(theta) @ [1e-3, 2e-3]
    measured = 0.4 * np.stack([np.cos(angle), 0.0 * angle, -np.sin(angle)], -1) + generator.normal(
        0, 1e-4, (30, 3)
    )
    log = PoseLog(("a", "b"), theta, "end_effector", ("x", "y", "z"), measured)
    fit = fit_arm(
        PoseModel(arm, log, PoseUnknowns.from_log(log, ("a", "b"), "known", payload=False))
    )
    reasons = [joint.reason for joint in describe_fit(fit, 0.03, 1000.0).joints]
    assert reasons == [
        "these poses do not separate it from b",
        "these poses do not separate it from a",
    ]


def test_planned_poses_tell_more_than_random_ones_and_are_free() -> None:
    """Catches a plan that is no better than chance, poses beyond the ranges, and poses in which
    the arm touches."""
    log = log_of("end_effector", 10, sides=True)
    fit = fit_arm(model_of(log))
    candidates = candidate_poses(fit.model.arm, ARM, log, np.random.default_rng(11))
    plan = plan_further(fit, candidates, 10)
    own = replace(fit.model, log=candidates)
    own.__dict__["scale"] = fit.model.scale
    rows, _ = information_of(own, fit.unknowns, fit.spread)
    drawn = [np.random.default_rng(seed).choice(len(rows), 10, replace=False) for seed in range(20)]

    def region(information: Array) -> float:
        """Log of the volume of the confidence region of the compliances, up to a constant."""
        return 0.5 * float(np.linalg.slogdet(np.linalg.inv(information)[:7, :7])[1])

    random = [region(fit.information + np.einsum("npi,npj->ij", rows[d], rows[d])) for d in drawn]
    assert region(plan.information) < min(random) - 0.2
    data = mujoco.MjData(ARM)
    for theta in plan.theta:
        data.qpos[:] = theta
        mujoco.mj_forward(ARM, data)
        assert data.ncon == 0
    assert ((plan.theta > ARM.jnt_range[:, 0]) & (plan.theta < ARM.jnt_range[:, 1])).all()
    assert len(np.unique(plan.theta, axis=0)) == 10
    assert plan.direction is not None
    assert set(np.unique(plan.direction)) == {-1.0, 1.0}


@pytest.mark.parametrize("kind", ["end_effector", pytest.param("imu", marks=pytest.mark.slow)])
def test_plan_says_in_advance_what_its_poses_then_tell(kind: Kind) -> None:
    """Catches an information in other units, or one that leaves the log out."""
    log = log_of(kind, 12)
    fit = fit_arm(model_of(log))
    candidates = candidate_poses(fit.model.arm, ARM, log, np.random.default_rng(13))
    plan = plan_further(fit, candidates, 40)
    expected = [
        j.planned_half_width for j in describe_fit(fit, 0.03, None, plan.information).joints
    ]
    further = log_of(kind, 14, theta=plan.theta)
    both = replace(
        log,
        theta=np.concatenate([log.theta, further.theta]),
        measured=np.concatenate([log.measured, further.measured]),
    )
    then = [joint.half_width for joint in describe_fit(fit_arm(model_of(both)), 0.03, None).joints]
    np.testing.assert_allclose(then[1:], np.array(expected, dtype=float)[1:], rtol=0.35)


@pytest.mark.parametrize("kind", ["end_effector", "link_encoders"])
def test_figure_shows_the_deflections_of_the_springs(kind: Kind) -> None:
    """Catches deflections in another sign or unit, and residuals that are taken away in place of
    added."""
    log = log_of(kind, 17)
    exact = equilibria(log.theta - OFFSET, np.zeros_like(log.theta))
    fit = fit_arm(model_of(log))
    predicted, measured = deflections(fit)
    true = (log.theta - OFFSET - exact)[:, LOADED]
    np.testing.assert_allclose(predicted[:, LOADED], true, atol=3e-3)
    assert np.std(predicted[:, LOADED] - true) < 1e-3
    if kind == "link_encoders":
        direct = log.theta - fit.estimate("offset")[0] - log.measured
        np.testing.assert_allclose(measured[:, LOADED], direct[:, LOADED], atol=1e-4)


# From here on the command, its files, and what it refuses.

EXAMPLE = FOLDER / "poses.csv"
RESULT = describe_fit(fit_arm(model_of(log_of("link_encoders", 8))), 0.03, None)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str) -> None:
    """The command on the arm of the docs."""
    main(["identify", "--robot", str(FOLDER / "arm.xml"), "--end-effector", "marker", *arguments])


def test_command_on_the_example_writes_what_the_compensator_takes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches files that are missing or that nothing reads, and an example log that no longer
    fits its arm."""
    run("--log", str(EXAMPLE), "--plan", "5", "--output", "found", "--assume", "1500")
    said = capsys.readouterr().out
    assert said.startswith("held out: ")
    found = json.loads(Path("found/identification.json").read_text())
    assert HeldOut.model_validate(found["held_out"]).is_ahead
    assert "base_yaw; gravity does not load it" in said
    names = {path.name for path in Path("found").iterdir()}
    assert {"identification.json", "joints.yaml", "identification.png", "plan.csv"} <= names
    stiffness = parse_yaml(Path("found/joints.yaml").read_text())
    assert stiffness["base_yaw"] == {"stiffness": 1500.0}
    np.testing.assert_allclose(
        [own["stiffness"] for own in stiffness.values()][LOADED], K[LOADED], rtol=0.12
    )
    assert PositionCompensator.from_model(FOLDER / "arm.xml", "found/joints.yaml").joints == JOINTS
    rows = list(csv.reader(Path("found/plan.csv").read_text().splitlines()))
    assert len(rows) == 6
    assert rows[0][0] == "theta.base_yaw [rad]"


@pytest.mark.parametrize("column", ["theta.a" + " " * 9000 + "x]", "theta.a[" + " " * 9000 + "x"])
def test_a_column_with_a_long_name_is_read_at_once(column: str) -> None:
    """Catches a search for the unit that takes a time with the cube of the name."""
    Path("log.csv").write_text(f"{column},q.a\n0.1,0.1\n")
    begin = time.process_time()
    with pytest.raises(ConfigurationError) as error:
        read_log(Path("log.csv"), {"a": (-1.0, 1.0)}, None)
    assert time.process_time() - begin < 2.0
    assert len(str(error.value)) < 700


@pytest.mark.parametrize("assumed", ["1e-320", "1e300"])
def test_a_stiffness_that_no_reader_takes_is_not_assumed(
    assumed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a joints.yaml that its own readers refuse."""
    with pytest.raises(SystemExit):
        run("--log", str(EXAMPLE), "--output", "found", "--assume", assumed)
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(r"assume must be a finite number >= 1e-09 and <= 1e\+09 \[N·m/rad\]", said)
    assert not Path("found").exists()


def test_a_joint_of_which_the_poses_say_nothing_is_rigid_for_every_reader() -> None:
    """Catches a stiff joint that is written as soft as another one, and a file that one of its
    readers refuses."""
    fit = fit_arm(model_of(read_log(EXAMPLE, RANGES)))
    described, joints = describe_fit(fit, 0.03, None).save(Path())[:2]
    assert parse_yaml(joints.read_text())["base_yaw"] == {"stiffness": math.inf}
    of_base = json.loads(described.read_text())["joints"][0]
    assert (of_base["source"], of_base["stiffness_nm_per_rad"], of_base["friction_nm"]) == (
        "rigid",
        None,
        None,
    )
    compensator = PositionCompensator.from_model(FOLDER / "arm.xml", joints)
    q = np.full(7, 0.3)
    np.testing.assert_allclose(
        compensator.command(q) - q, [0.0, *(compensator.torque(q) / K)[1:]], rtol=0.12
    )
    env: Any = gymnasium.make(
        "elastic_env/Robot-v0", model=str(FOLDER / "arm.xml"), joints=str(joints)
    )
    assert env.action_space.shape == (6,)


def test_joints_that_are_not_sought_stand_in_the_file_as_rigid() -> None:
    """Catches a file that the compensator refuses, since it lacks joints that the docs call
    rigid."""
    options = ArmOptions(log=[str(EXAMPLE)], joints=["elbow", "wrist_*"], end_effector="marker")
    problem = ArmProblem.from_options(options, ARM, Console(), 0)
    file = describe_fit(fit_arm(problem.model(problem.log)), 0.03, None).save(Path())[1]
    stiffness = parse_yaml(file.read_text())
    assert set(stiffness) == set(JOINTS)
    assert stiffness["shoulder_pitch"] == {"stiffness": math.inf}
    compensator = PositionCompensator.from_model(FOLDER / "arm.xml", file)
    q = np.full(7, 0.3)
    assert (compensator.command(q) == q).tolist() == [True, True, True, False, True, False, False]
    assert (
        RESULT.replace(held_joints=("no",))
        .save(Path())[1]
        .read_text()
        .endswith("'no': held  # not in the log\n")
    )


def of_elbow(compliance: float, half_width: float) -> JointStiffness:
    """What is written of a joint whose 1/K is estimated in the middle of an interval; the others
    are well known."""
    fit = fit_arm(model_of(log_of("end_effector", 8)))
    own = fit.model.unknowns.slices["compliance"]
    unknowns = fit.unknowns.copy()
    covariance = fit.covariance.copy()
    unknowns[own.start + 3] = compliance
    covariance[own.start + 3, own.start + 3] = (half_width / fit.quantile) ** 2
    return describe_fit(replace(fit, unknowns=unknowns, covariance=covariance), 0.03, None).joints[
        3
    ]


def test_an_estimate_is_written_as_it_is_and_a_negative_one_as_rigid() -> None:
    """Catches the largest K of other joints in place of a joint's own, and a negative 1/K in
    silence."""
    stiff = of_elbow(1e-5, 2e-5)
    assert (stiff.source, stiff.stiffness_nm_per_rad) == ("no upper end", pytest.approx(1e5))
    assert stiff.stiffness_low_nm_per_rad == pytest.approx(1.0 / 3e-5)
    negative = of_elbow(-1e-5, 2e-5)
    assert (negative.source, negative.stiffness_nm_per_rad, negative.is_negative) == (
        "rigid",
        math.inf,
        True,
    )


def test_a_negative_estimate_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a joint that is stiffer than the log can tell, and of which neither file nor
    output says so."""
    log = log_of("link_encoders", 8)
    measured = log.measured.copy()
    rigid = (log.theta - OFFSET)[:, 3]
    noise = 3e-4 * np.random.default_rng(1).standard_normal(len(log))
    measured[:, 3] = (
        rigid + 0.01 * (rigid - measured[:, 3]) + noise
    )  # it hardly bends, and to the wrong side
    joints = describe_fit(fit_arm(model_of(replace(log, measured=measured))), 0.03, None)
    assert [joint.joint for joint in joints.joints if joint.is_negative] == ["elbow"]
    file = joints.save(tmp_path)[1].read_text()
    assert (
        "elbow: {stiffness: .inf}  # rigid: stiffer than the log can tell; the estimate is negative"
        in file
    )


ONE = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="j1" axis="0 1 0" range="-2 2"/>
  <geom type="sphere" size="0.02" pos="0 0 {z}" mass="0.75"/></body></worldbody></mujoco>"""
TWO = """<mujoco><compiler angle="radian"/><worldbody><body pos="0 0 0.1"><joint name="j1" axis="0 1 0" range="-2 2"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.02" mass="2"/><body pos="0 0 0.3">
  <joint name="j2" axis="0.3 1 0" range="-2 2"/><geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.02" mass="1"/>
  </body></body></worldbody></mujoco>"""


def encoders(xml: str, stiffness: list[float], count: int = 12) -> tuple[StaticArm, PoseLog]:
    """An arm and its log of link encoders in the resolution of micrometres; MuJoCo's torque
    bends the springs."""
    model = mujoco.MjModel.from_xml_string(xml)
    joints = tuple(model.joint(i).name for i in range(model.njnt))
    q = np.random.default_rng(3).uniform(-1.2, 1.2, (count, len(joints)))
    data = mujoco.MjData(model)
    theta = q.copy()
    for row, own in zip(theta, q, strict=True):
        data.qpos[:] = own
        mujoco.mj_forward(model, data)
        row += data.qfrc_bias / stiffness
    return StaticArm(model, joints), PoseLog(
        joints, np.round(theta, 6), "link_encoders", joints, np.round(q, 6)
    )


def fit_of(arm: StaticArm, log: PoseLog) -> Array:
    """K of all joints, (n,) [N·m/rad]."""
    return (
        1.0
        / fit_arm(
            PoseModel(arm, log, PoseUnknowns.from_log(log, log.joints, "offset", payload=False))
        ).estimate("compliance")[0]
    )


def test_encoders_that_are_swapped_are_named() -> None:
    """Catches a contradiction to the model that is told as noise."""
    arm, log = encoders(ONE.format(z=0.3), [300.0])
    np.testing.assert_allclose(fit_of(arm, log), 300.0, rtol=1e-3)
    with pytest.raises(
        ConfigurationError,
        match=r"deflect against their load: are theta and q swapped.*joint j1\)\?",
    ):
        fit_of(arm, replace(log, theta=log.measured, measured=log.theta))
    with pytest.raises(
        ConfigurationError, match=r"run against each other: a sign is wrong \(joint j1\)"
    ):
        fit_of(arm, replace(log, measured=-log.measured))


@pytest.mark.parametrize("joint", ["j1", "j2"])
def test_a_joint_that_turns_the_other_way_is_named(joint: str) -> None:
    """Catches a wrong sign of one joint of several, by a fit that is bad and one that is good
    with the sign turned."""
    arm, log = encoders(TWO, [300.0, 150.0], count=20)
    np.testing.assert_allclose(fit_of(arm, log), [300.0, 150.0], rtol=2e-3)
    with pytest.raises(ConfigurationError, match=rf"a sign is wrong \(joint .*{joint}.*\)"):
        fit_of(arm, reverse_joint(log, joint))
    markers = log_of("end_effector", 8)
    with pytest.raises(ConfigurationError, match=r"a sign is wrong \(joint elbow\)"):
        fit_arm(model_of(reverse_joint(markers, "elbow")))


def test_soft_springs_are_identified() -> None:
    """Catches link angles that are refused where the load bends a spring by more than a radian."""
    arm, log = encoders(ONE.format(z=-0.3), [1.8], count=30)  # m·g·l is 2.2 N·m
    np.testing.assert_allclose(fit_of(arm, log), 1.8, rtol=1e-3)


def test_twins_of_which_one_is_negative_share_what_both_explain() -> None:
    """Catches a joint that is written as too soft, beside a twin whose negative estimate made up
    for it."""
    fit = fit_arm(model_of(log_of("end_effector", 8)))
    own = fit.model.unknowns.slices["compliance"]
    information = fit.information.copy()
    unknowns = fit.unknowns.copy()
    size = fit.model.scale[own]
    twins = np.zeros((7, 7))
    twins[5:, 5:] = [[1.0, 0.999], [0.999, 1.0]]  # the log tells their sum alone
    information[own, own] += 1e9 * twins
    unknowns[own][5:] = np.array([0.03, -0.02]) * size[5:]
    best = bounded_compliance(replace(fit, unknowns=unknowns, information=information)) / size
    assert best[6] == 0.0
    assert best[5] == pytest.approx(0.01, abs=1e-4)


def test_offsets_that_the_poses_do_not_tell_are_not_shown(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches hundreds of milliradians that are the prior's, in table and file."""
    log = log_of("link_encoders", 8)
    without_base = replace(log, columns=JOINTS[1:], measured=log.measured[:, 1:])
    result = describe_fit(fit_arm(model_of(without_base)), 0.03, None)
    assert result.joints[0].offset_rad is None
    assert result.joints[1].offset_rad == pytest.approx(OFFSET[1], abs=1e-3)
    Console(file=sys.stdout, width=200).print(result_table(result))
    of_base = next(line for line in capsys.readouterr().out.splitlines() if "base_yaw" in line)
    assert of_base.split() == ["base_yaw", "–", "–", ">", "100", "%", "–"]


@settings(max_examples=25)
@given(
    names=st.lists(
        st.text("01no.~e\"'#: -[]{}é", min_size=1, max_size=6), min_size=7, max_size=7, unique=True
    )
)
def test_joints_of_any_name_are_read_back(names: list[str]) -> None:
    """Catches names that the file's reader takes for numbers, truth values or YAML."""
    joints = tuple(
        joint.replace(joint=name) for joint, name in zip(RESULT.joints, names, strict=True)
    )
    renamed = RESULT.replace(joints=joints)
    with tempfile.TemporaryDirectory() as folder:
        file = renamed.save(Path(folder))[1]
        assert list(parse_yaml(file.read_text(encoding="utf-8"))) == names


def test_a_joint_whose_name_ends_in_brackets_is_read_back() -> None:
    """Catches a part of the name that is taken for the unit."""
    columns = {f"{what}.j[1]": np.array([-1.0, 1.0]) for what in ("theta", "q", "direction")}
    log = read_log(write_poses(Path("log.csv"), columns), {"j[1]": (-2.0, 2.0)})
    assert log.joints == ("j[1]",)
    np.testing.assert_array_equal(log.direction, [[-1.0], [1.0]])


def test_first_poses_are_planned_without_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a plan that needs what it is made for, and one that promises a joint that gravity
    does not load."""
    run("--plan", "8", "--measured-by", "end_effector", "--output", "plan")
    assert "base_yaw" in capsys.readouterr().out
    assert len(Path("plan/plan.csv").read_text().splitlines()) == 9


def test_example_log_is_that_of_its_script(tmp_path: Path) -> None:
    """Catches an arm or a script that was changed without the log."""
    log = read_log(EXAMPLE, RANGES)
    assert log.direction is not None
    theta = log.theta - OFFSET
    load = FRICTION * log.direction
    markers = shown("end_effector", equilibria(theta, load), load)
    assert np.std(log.measured - markers) == pytest.approx(3e-4, rel=0.2)


def test_samples_of_one_pose_count_once(tmp_path: Path) -> None:
    """Catches intervals that shrink because a sensor was written down more often, and poses that
    are lost."""
    head, rows = table()
    several = [row for row in rows for _ in range(5)]
    for number, row in enumerate(several):
        several[number] = [str(float(row[0]) + 1e-5 * (number % 5 - 2)), *row[1:]]
    with Path("several.csv").open("w", newline="") as file:
        csv.writer(file).writerows([head, *several])
    once = read_log(EXAMPLE, RANGES)
    often = read_log(Path("several.csv"), RANGES)
    np.testing.assert_allclose(often.theta, once.theta, atol=1e-12)
    np.testing.assert_allclose(often.measured, once.measured, atol=1e-12)
    np.testing.assert_array_equal(often.direction, once.direction)


def table() -> tuple[list[str], list[list[str]]]:
    """Header and rows of the example."""
    head, *rows = csv.reader(EXAMPLE.read_text().splitlines())
    return head, rows


def changed(
    column: str, value: Any, name: str | None = None, pose: int | None = None
) -> list[list[str]]:
    """The example with a column renamed, or with values that a function or a text replaces."""
    head, rows = table()
    at = next(i for i, own in enumerate(head) if own.startswith(column))
    for number, row in enumerate(rows):
        if pose in (None, number):
            row[at] = value(row[at]) if callable(value) else value
    head[at] = head[at] if name is None else name
    return [head, *rows]


def kept(but: str) -> list[list[str]]:
    """The example without columns of a quantity."""
    head, rows = table()
    at = [i for i, own in enumerate(head) if not own.startswith(but)]
    return [[row[i] for i in at] for row in (head, *rows)]


def alike() -> list[list[str]]:
    head, rows = table()
    return [head, *[rows[0]] * 40]


def both_kinds() -> list[list[str]]:
    head, rows = table()
    return [[*head, "imu.roll [rad]", "imu.pitch [rad]"], *[[*row, "0.1", "0.2"] for row in rows]]


def in_degrees() -> list[list[str]]:
    head, rows = table()
    at = [i for i, own in enumerate(head) if own.startswith("theta")]
    return [
        head,
        *[
            [str(math.degrees(float(v))) if i in at else v for i, v in enumerate(row)]
            for row in rows
        ],
    ]


def same(value: str) -> str:
    return value


BAD: Mapping[str, tuple[Any, list[str]]] = {
    "other joint": (
        lambda: changed("theta.elbow", same, "theta.elbo [rad]"),
        ["'elbo'", "Did you mean 'elbow'"],
    ),
    "few poses": (
        lambda: [*table()[:1], *table()[1][:9]],
        ["24 unknowns", "at least 11 poses", "has 9", "--joints"],
    ),
    "alike": (alike, ["all 40 poses", "alike", "--plan"]),
    "nan": (
        lambda: changed("theta.elbow", "nan", pose=4),
        ["pose 5", "theta.elbow", "finite", "'nan'"],
    ),
    "text": (
        lambda: changed("end_effector.y", "far", pose=0),
        ["pose 1", "end_effector.y", "[m]", "'far'"],
    ),
    "degrees": (in_degrees, ["theta.", "beyond", "look like degrees", "radians"]),
    "unit": (
        lambda: changed("theta.elbow", same, "theta.elbow [deg]"),
        ["must be [rad]", "[deg]", "convert"],
    ),
    "millimetres": (
        lambda: changed("end_effector.x", same, "end_effector.x [mm]"),
        ["must be [m]", "[mm]"],
    ),
    "no measurement": (
        lambda: kept("end_effector"),
        ["needs a measurement", "q.JOINT", "end_effector", "torque"],
    ),
    "no encoders": (lambda: kept("theta"), ["no motor encoders", "theta.JOINT"]),
    "both kinds": (both_kinds, ["end_effector, imu", "--measured-by"]),
    "one axis": (
        lambda: kept("end_effector.z"),
        ["end_effector needs exactly", "x, y, z", "got x, y"],
    ),
    "column": (lambda: changed("end_effector.x", same, "tool_x"), ["'tool_x'", "theta.JOINT"]),
    "twice": (lambda: changed("theta.elbow", same, "theta.wrist_roll"), ["theta.wrist_roll twice"]),
    "direction": (
        lambda: changed("direction.elbow", "0.5", pose=2),
        ["1 (approached from below)", "0.5"],
    ),
    "short line": (lambda: [*table()[:1], ["1", "2"]], ["pose 1", "17 values", "got 2"]),
    "empty": (lambda: [], ["is empty"]),
    "header alone": (lambda: list(table()[:1]), ["1 to 10000 poses", "has 0"]),
    "metres": (
        lambda: changed("end_effector.x", lambda v: str(1e3 * float(v))),
        ["end_effector", "spread over", "millimetres"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_log_is_one_sentence_that_says_what_to_do(
    case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches tracebacks, fits of nonsense, and folders left behind."""
    content, words = BAD[case]
    with Path("bad.csv").open("w", newline="") as file:
        csv.writer(file).writerows(content())
    with pytest.raises(SystemExit) as ended:
        run("--log", "bad.csv")
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert [word for word in words if word not in said] == []
    assert "Traceback" not in said
    assert not Path("runs").exists()


def test_a_joint_without_a_column_is_named() -> None:
    """Catches a forgotten column, which looks like a log that tells no stiffness."""
    with Path("miss.csv").open("w", newline="") as file:
        csv.writer(file).writerows(kept("theta.upper_roll"))
    options = ArmOptions(log=["miss.csv"], end_effector="marker")
    with pytest.warns(UserWarning, match=r"theta\.JOINT are held: upper_roll at 0 rad$"):
        ArmProblem.from_options(options, ARM, Console(), 0)


def test_degrees_are_named_where_a_joint_has_no_range(capsys: pytest.CaptureFixture[str]) -> None:
    """Exporters write a hundred turns and more for a joint without a limit: catches degrees that
    are taken for radians."""
    elbow = '"elbow" axis="0 1 0" range="-2.4 2.4"'
    free = (FOLDER / "arm.xml").read_text().replace(elbow, elbow.replace("2.4", "1e9"))
    Path("free.xml").write_text(free)
    with Path("bad.csv").open("w", newline="") as file:
        csv.writer(file).writerows(changed("theta.elbow", lambda v: str(math.degrees(float(v)))))
    with pytest.raises(SystemExit):
        main(["identify", "--robot", "free.xml", "--log", "bad.csv", "--end-effector", "marker"])
    assert "look like degrees" in " ".join(capsys.readouterr().err.split())


REFUSED: Mapping[str, tuple[list[str], list[str]]] = {
    "missing log": (["--log", "none.csv"], ["no log at none.csv"]),
    "neither": ([], ["--log", "--plan", "--measured-by"]),
    "joint": (["--log", str(EXAMPLE), "--joints", "wrst_*"], ["'wrst_*'", "wrist_roll"]),
    "payload": (["--log", str(EXAMPLE), "--payload", "hand"], ["'hand'", "link7", "marker"]),
    "kind": (["--log", str(EXAMPLE), "--measured-by", "imu"], ["none of imu"]),
    "within": (["--log", str(EXAMPLE), "--within", "0"], ["--within must be", "> 0"]),
    "plan": (["--log", str(EXAMPLE), "--plan", "201"], ["--plan must be", "<= 200"]),
    "testbed": (["--log", str(EXAMPLE), "--scenario", "soft"], ["--scenario", "testbed"]),
    "no servo": (["--log", str(EXAMPLE), "--mass-kg", "1"], ["--mass-kg", f"{EXAMPLE} has the"]),
    "no table": (["--log", str(FOLDER / "arm.xml"), "--mass-kg", "1"], ["arm.xml"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_option_says_what_and_which_choices(
    case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches options that are ignored, and names that are not listed."""
    arguments, words = REFUSED[case]
    with pytest.raises(SystemExit) as ended:
        run(*arguments)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert [word for word in words if word not in said] == []
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--measured-by", "imu", "--geometry", "dh"], "needs positions"),
        (["--measured-by", "end_effector", "--lateral"], "--lateral: for a fit of the geometry"),
        (["--measured-by", "end_effector", "--free", "elbow"], "--free: for a fit of the geometry"),
    ],
)
def test_a_geometry_needs_positions_and_is_asked_for(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a traceback, and options of the geometry that are dropped without a word."""
    with Path("log.csv").open("w", newline="") as file:
        csv.writer(file).writerows(both_kinds())
    with pytest.raises(SystemExit) as ended:
        run("--log", "log.csv", *options)
    assert ended.value.code == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_log_that_no_springs_explain_is_refused() -> None:
    """Catches an endless fit, and a stiffness from measurements of another arm."""
    log = log_of("link_encoders", 15)
    with pytest.raises(
        (ElasticError, ConfigurationError), match=r"signs|rigid|springs|tell no stiffness"
    ):
        describe_fit(
            fit_arm(model_of(replace(log, measured=2.0 * log.theta - log.measured))), 0.03, None
        )


@pytest.mark.parametrize("kind", sorted(NOISE))
def test_held_out_errors_are_those_of_fits_that_did_not_see_the_poses(kind: Kind) -> None:
    """Catches a fit that saw what it predicts, and a frame or a unit that is not the log's."""
    log = log_of(kind, 21, 40, friction=1.0, sides=True)
    parts = split(40, share=0.3, folds=1, seed=3)
    held_out = judge(HoldoutProblem.from_poses(model_of(log)), parts, 3, lambda done: None)
    errors = {error.name: error.rms for error in held_out.errors}
    assert list(errors) == [RIGID, *RIVALS, FITTED]
    assert (held_out.poses, held_out.held_out) == (28, 12)
    assert held_out.curve[-1].rms == pytest.approx(errors[FITTED])
    scale = {"N·m": 1.0}.get(held_out.unit, 1e3)
    noise = scale * NOISE[kind] * {"end_effector": 3.0, "imu": 2.0}.get(kind, 1.0) ** 0.5
    assert 0.5 * noise < errors[FITTED] < 4.0 * noise
    if kind != "torques":  # they change little with the deflection
        assert errors[FITTED] < 0.5 * min(errors[name] for name in errors if name != FITTED)


def test_the_rigid_error_is_that_of_the_model_as_given() -> None:
    """By hand: link encoders less motor encoders; torques less those of the rigid arm."""
    part = split(40, share=0.3, folds=1, seed=3)
    for kind in ("link_encoders", "torques"):
        log = log_of(kind, 22, 40)
        held_out = judge(HoldoutProblem.from_poses(model_of(log)), part, 3, lambda done: None)
        rigid = log.theta if kind == "link_encoders" else model_of(log).arm.torque(log.theta)
        scale = 1e3 if kind == "link_encoders" else 1.0
        missed = scale * (log.measured - rigid)[part[0]]
        assert held_out.errors[0].rms == pytest.approx(np.sqrt(np.mean(missed**2)))
        assert held_out.errors[0].worst == pytest.approx(np.abs(missed).max())


def test_a_log_of_too_few_poses_is_fitted_whole() -> None:
    """Catches an identification that is refused for the sake of its judgement."""
    said = io.StringIO()
    console = Console(file=said, width=200)
    judged = HoldoutProblem.from_poses(model_of(log_of("link_encoders", 23, 20)))
    assert judge_poses(judged, HoldoutOptions(), console, seed=0) is None
    assert said.getvalue().startswith(
        "nothing is held out: 20 poses leave 14 to fit and 6 to hold out"
    )


def test_folds_of_nothing_are_refused() -> None:
    """Catches folds that are asked for and silently not held out."""
    with pytest.raises(ConfigurationError, match="holdout = 0 holds nothing out, got folds = 5"):
        HoldoutOptions(holdout=0.0, folds=5)


def test_chosen_joints_alone_are_sought() -> None:
    """Catches a pattern that is ignored: all other joints stay rigid."""
    stiff = np.where(np.isin(JOINTS, ["elbow", "wrist_pitch"]), K, 1e12)
    theta = poses(40, np.random.default_rng(16))
    data = mujoco.MjData(ARM)
    rows = []

    def imbalance(q: Array, own: Array) -> Array:
        data.qpos[:] = q
        mujoco.mj_forward(ARM, data)
        return own - q - data.qfrc_bias / stiff

    for own in theta:
        rows.append(root(imbalance, own, (own,), tol=1e-13).x)
    measured = shown("end_effector", np.array(rows), np.zeros_like(theta))
    log = PoseLog(JOINTS, theta, "end_effector", ("x", "y", "z"), measured)
    fit = fit_arm(model_of(log, elastic=("elbow", "wrist_pitch")))
    np.testing.assert_allclose(1.0 / fit.estimate("compliance")[0], [900.0, 250.0], rtol=1e-4)


def test_help_tells_options_of_testbed_arm_and_servo_apart(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Catches options of different robots in one list."""
    with pytest.raises(SystemExit):
        main(["identify", "--help"])
    said = capsys.readouterr().out
    groups = re.split(r"(?m)^\W+(\S+) options ", said)
    by_name = dict(zip(groups[1::2], groups[2::2], strict=True))
    for group, option in (
        ("testbed", "--scenario"),
        ("hardware", "--port"),
        ("arm", "--robot"),
        ("arm.judgement", "--holdout"),
        ("arm.geometry", "--lateral"),
        ("arm.servo", "--mass-kg"),
    ):
        has = [name for name, text in by_name.items() if re.search(rf"(?m)^\W+{option}[ ,]", text)]
        assert has == [group]
