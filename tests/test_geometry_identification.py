"""Geometry together with stiffness: MuJoCo's kinematics, difference quotients, known truth."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from baselines.identification.geometry_fit import QUANTILE, fit_geometry
from baselines.identification.geometry_gradient import marker_gradient
from baselines.identification.geometry_model import ArmParameters, AxialTorques, GeometryModel
from baselines.identification.geometry_problem import GeometryProblem
from baselines.identification.geometry_result import correct_model, describe_geometry
from baselines.identification.holdout import (
    FITTED,
    HeldOut,
    HeldOutError,
    HoldoutProblem,
    judge,
    split,
)
from baselines.identification.pose_log import PoseLog, read_log, write_poses
from baselines.identification.rivals import predict_by_kernel, predict_constant, predict_linear
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array
from elastic_env.core.yaml_text import parse_yaml
from elastic_env.joint.model_file import compiled_model
from elastic_env.rigid.tree.links import Tree
from tests import test_arm_identification
from train.commands.cli import main
from train.commands.held_out import verdict
from train.commands.identify_geometry import pose_problem
from train.commands.identify_options import GeometryOptions

ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="base" pos="0 0 0.3">
<joint name="pan" axis="0 0 1" range="-2 2" limited="true"/>
<geom type="capsule" fromto="0 0 0 0.1 0 0.3" size="0.03" mass="4"/>
<body name="upper" pos="0.1 0 0.3"><joint name="lift" axis="0 1 0" range="-2 2" limited="true"/>
<geom type="capsule" fromto="0 0 0 0.4 0.05 0" size="0.03" mass="3"/>
<body name="fore" pos="0.4 0.05 0" euler="0.2 0.3 0.5">
<joint name="elbow" axis="0 1 0.2" range="-2 2" limited="true"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.02" mass="2"/>
<site name="hand" pos="0.3 0 0.1"/></body>
<body name="side" pos="0.2 0.05 0"><joint name="wing" axis="1 0 0" ref="0.3" range="-2 2"
limited="true"/><geom type="capsule" fromto="0 0 0 0.1 0.3 0.1" size="0.02" mass="1.5"/>
<site name="tip" pos="0.1 0.3 0.1"/></body></body></body></worldbody></mujoco>"""
JOINTS = ("pan", "lift", "elbow", "wing")
SITES = ("hand", "tip")


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


@pytest.fixture(scope="module")
def tree(model: mujoco.MjModel) -> Tree:
    return Tree.of(model, JOINTS, {})


@pytest.fixture(scope="module")
def geometry(model: mujoco.MjModel, tree: Tree) -> GeometryModel:
    places = [(name, int(model.site(name).bodyid[0]), model.site(name).pos) for name in SITES]
    return GeometryModel.from_tree(tree, JOINTS, model.opt.gravity, places)


def draw(seed: int, count: int = 6) -> tuple[np.random.Generator, Array]:
    """A generator, and angles of poses."""
    generator = np.random.default_rng(seed)
    return generator, generator.uniform(-1.2, 1.2, (count, len(JOINTS)))


def some_parameters(generator: np.random.Generator) -> ArmParameters:
    """Parameters far from nominal ones, with deflections of a tenth of a radian."""
    return ArmParameters(
        translation=0.1 * generator.standard_normal(3),
        rotation=0.3 * generator.standard_normal(3),
        marker=0.05 * generator.standard_normal((2, 3)),
        offset=0.05 * generator.standard_normal(4),
        length=0.02 * generator.standard_normal((4, 3)),
        angle=0.05 * generator.standard_normal((4, 3)),
        compliance=0.004 * np.abs(generator.standard_normal((4, 3))),
        friction=2.0 * np.abs(generator.standard_normal(4)),
    )


def sides(seed: int, count: int = 6) -> AxialTorques:
    """Sides of approach, and torques that are known."""
    generator = np.random.default_rng(seed)
    size = (count, len(JOINTS))
    return AxialTorques(generator.choice([-1.0, 0.0, 1.0], size=size), generator.normal(size=size))


def test_a_rigid_nominal_arm_is_mujocos(model: mujoco.MjModel, geometry: GeometryModel) -> None:
    """Catches a frame, an anchor, a zero angle or a weight that is not where MuJoCo has it."""
    _, q = draw(0)
    data = mujoco.MjData(model)
    nominal = geometry.nominal_parameters()
    shown = geometry.predict_markers(nominal, q)
    moments = geometry.moments(geometry.posture(nominal, q))
    for i, row in enumerate(q):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        places = [data.site(name).xpos for name in SITES]
        np.testing.assert_allclose(shown[i], places, atol=1e-12)
        np.testing.assert_allclose(moments[i, :, 2], -data.qfrc_bias, atol=1e-12)


@pytest.mark.parametrize("axial", [None, sides(11)], ids=["weight", "friction"])
def test_derivatives_are_difference_quotients(
    geometry: GeometryModel, axial: AxialTorques | None
) -> None:
    """Catches a moment that does not change with a parameter, and a twist about a wrong point:
    along three ways, in which all parameters of a kind change by other amounts."""
    generator, q = draw(1)
    parameters = some_parameters(generator)
    shown, gradient = marker_gradient(geometry, parameters, q, axial)
    np.testing.assert_array_equal(shown, geometry.predict_markers(parameters, q, axial))
    for kind, values in parameters._asdict().items():
        step = {"compliance": 1e-8, "friction": 1e-4}.get(kind, 1e-6)
        size = np.abs(getattr(gradient, kind)).max()
        for way in generator.uniform(-1.0, 1.0, (3, *values.shape)):
            more, less = (
                geometry.predict_markers(
                    parameters._replace(**{kind: values + sign * step * way}), q, axial
                )
                for sign in (1.0, -1.0)
            )
            own = np.tensordot(getattr(gradient, kind), way, way.ndim)
            np.testing.assert_allclose(own, (more - less) / (2.0 * step), atol=1e-7 * size)


def test_deflection_about_the_axis_is_that_of_the_elastic_joint(geometry: GeometryModel) -> None:
    """Eq. 10, q = θ − τ_g(q)/K: catches the sign of the moment."""
    _, theta = draw(2)
    nominal = geometry.nominal_parameters()
    compliance = np.zeros((4, 3))
    compliance[:, 2] = 1.0 / np.array([400.0, 300.0, 200.0, 100.0])
    soft = nominal._replace(compliance=compliance)
    torque = -geometry.moments(geometry.posture(soft, theta))[..., 2]
    rigid = geometry.predict_markers(nominal, theta - torque * compliance[:, 2])
    np.testing.assert_allclose(geometry.predict_markers(soft, theta), rigid, atol=1e-9)


def test_a_joint_that_gravity_overcomes_is_named(geometry: GeometryModel) -> None:
    """Catches a number in the place of the joint's name."""
    nominal = geometry.nominal_parameters()
    compliance = np.zeros((len(JOINTS), 3))
    compliance[1, 2] = 50.0
    with pytest.raises(ElasticError, match=rf"gravity overcomes joint '{JOINTS[1]}' at .* 50 rad"):
        geometry.posture(nominal._replace(compliance=compliance), draw(3)[1])


def test_a_joint_that_gravity_almost_overcomes_still_rests(geometry: GeometryModel) -> None:
    """Catches an iteration that gives up while it still comes nearer. A step leaves κ of the way: a
    turn t = c M grows with the compliance c by dt/dc = M / (1 − κ). From |κ| = 1 on it never ends."""
    nominal = geometry.nominal_parameters()
    poses = draw(3, 500)[1]
    rigid = geometry.moments(geometry.posture(nominal, poses))[:, 1, 2]
    pose = poses[np.abs(rigid).argsort()[1]]  # almost balanced, so that it may be soft

    def turn(softness: float) -> float:
        compliance = np.zeros((len(JOINTS), 3))
        compliance[1, 2] = softness
        rests = geometry.posture(nominal._replace(compliance=compliance), pose[None])
        return float(softness * geometry.moments(rests)[0, 1, 2])

    rests, tips = 1e-3, 10.0
    while tips - rests > 4e-3 * rests:
        softness = 0.5 * (rests + tips)
        try:
            turn(softness)
            rests = softness
        except ElasticError:
            tips = softness
    near, nearer = 0.99 * rests, 0.994 * rests
    turned = turn(nearer)
    slope = (turned - turn(near)) / (nearer - near)
    kappa = 1.0 - turned / nearer / slope
    assert 0.8 < abs(kappa) < 1.0


@pytest.mark.parametrize(
    "text",
    [
        ARM,
        ARM.replace('name="upper"', "").replace('name="side"', ""),
        ARM.replace(
            '<body name="side" pos="0.2', '<frame pos="0.1 0 0"><body name="side" pos="0.1'
        ).replace("</body></body></body></world", "</body></frame></body></body></world"),
    ],
    ids=["named", "without names", "within a frame"],
)
def test_the_corrected_model_is_the_identified_arm(
    tree: Tree, geometry: GeometryModel, text: str
) -> None:
    """Catches a correction in the frame of another body, one that a body without a name does not
    get, and a body that a frame moves a second time."""
    generator, theta = draw(3)
    problem = GeometryProblem(
        geometry,
        theta,
        geometry.predict_markers(geometry.nominal_parameters(), theta),
        "full",
    )
    x = problem.unknowns.prior * generator.standard_normal(len(problem.unknowns.prior))
    fit = fit_geometry(problem)
    fit = type(fit)(problem, x, fit.covariance, fit.noise_m)
    own = fit.parameters
    corrected = correct_model(mujoco.MjSpec.from_string(text), tree, fit).compile()
    data = mujoco.MjData(corrected)
    unmoved = own._replace(marker=np.zeros_like(own.marker))
    places = geometry.posture(unmoved, theta).marker
    for i, row in enumerate(theta):
        data.qpos[:] = row - own.offset
        mujoco.mj_kinematics(corrected, data)
        np.testing.assert_allclose([data.site(name).xpos for name in SITES], places[i], atol=1e-12)


def made_up(
    arm: GeometryModel, seed: int, count: int, noise_m: float, **options: object
) -> tuple[GeometryProblem, Array]:
    """Poses of an arm whose parameters are drawn from their priors, and those parameters."""
    generator, theta = draw(seed, count)
    blank = np.zeros((count, len(SITES), 3))
    problem = GeometryProblem(arm, theta, blank, elastic=JOINTS, **options)  # type: ignore[arg-type]
    prior = problem.unknowns.prior
    truth = prior * generator.standard_normal(len(prior))
    kinds = np.array(problem.unknowns.kinds)
    # what an alignment leaves
    truth[np.isin(kinds, ["translation", "rotation", "marker"])] *= 0.1
    own = np.flatnonzero(kinds == "compliance")
    truth[own] = prior[own] * generator.uniform(0.1, 0.6, len(own))
    shown = arm.predict_markers(problem.parameters(truth), theta, problem.axial)
    measured = shown + noise_m * generator.standard_normal(blank.shape)
    return GeometryProblem(arm, theta, measured, elastic=JOINTS, **options), truth  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [
        # on every commit such a fit is that of the priors below
        pytest.param({"geometry": "dh"}, marks=pytest.mark.slow),
        {"geometry": "offsets", "axial": sides(12, 30)},
        pytest.param({"geometry": "full", "lateral": True}, marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_the_truth(geometry: GeometryModel, options: dict[str, object]) -> None:
    """Of 95 % in at least 90 %: catches a wrong covariance, and a noise that is not estimated."""
    held = []
    for seed in range(2):
        problem, truth = made_up(geometry, seed, count=30, noise_m=5e-4, **options)
        fit = fit_geometry(problem)
        assert fit.noise_m == pytest.approx(5e-4, rel=0.25)
        own = QUANTILE * np.sqrt(np.diag(fit.covariance))
        held.append(np.abs(fit.x - truth) < own)
    assert np.mean(held) > 0.9


def arm_with_friction(seed: int) -> GeometryProblem:
    """Markers of an arm with friction by MuJoCo, which was approached from known sides."""
    log = test_arm_identification.log_of("end_effector", seed, 40, friction=1.0, sides=True)
    arm = test_arm_identification.ARM
    return pose_problem(GeometryOptions(), arm, log, log.joints, "marker")[0]


@pytest.mark.slow
def test_friction_of_known_sides_is_told_apart_from_stiffness() -> None:
    """Of an arm that MuJoCo bends: catches a K that friction pulls, and a sign of the sides."""
    truths = {
        "compliance": 1.0 / test_arm_identification.K,
        "friction": test_arm_identification.FRICTION,
    }
    held = []
    off = []
    for seed in range(8):
        fit = fit_geometry(arm_with_friction(seed))
        found = {(own.kind, own.name): own for own in fit.estimates}
        for kind, truth in truths.items():
            for joint, value in zip(fit.problem.model.joints, truth, strict=True):
                own = found[kind, joint]
                if own.is_told:
                    held.append(abs(own.value - value) < own.half_width)
                    off.append(QUANTILE * (own.value - value) / own.half_width)
    assert len(held) > 60
    assert np.mean(held) > 0.9
    assert abs(np.mean(off)) < 3.0 / np.sqrt(len(off))


def test_sides_of_approach_lower_the_noise() -> None:
    """Catches sides that are read and not used."""
    problem = arm_with_friction(3)
    blind = fit_geometry(replace(problem, axial=None))
    fit = fit_geometry(problem)
    assert fit.noise_m < 0.6 * blind.noise_m
    found = {own.name: own for own in fit.estimates if own.kind == "friction"}
    for joint, truth in zip(problem.model.joints, test_arm_identification.FRICTION, strict=True):
        assert abs(found[joint].value - truth) < 4.0 * found[joint].half_width / QUANTILE
    assert found["elbow"].is_told


def test_what_poses_do_not_tell_keeps_its_prior_and_is_named(geometry: GeometryModel) -> None:
    """The first joint's height is the tracker's, and its axis vertical: catches a parameter that
    runs away, and a K of chance in joints.yaml."""
    problem, _ = made_up(geometry, 0, count=30, noise_m=5e-4, geometry="dh")
    result = describe_geometry(fit_geometry(problem), None)
    assert "pan.z length" in result.prior_parameters
    height = next(p for p in result.parameters if (p.kind, p.name) == ("length", "pan.z"))
    assert abs(height.value) < 2e-3
    joints = {one.joint: one for one in result.joints}
    assert np.isinf(joints["pan"].stiffness_nm_per_rad)
    assert np.isfinite(joints["lift"].stiffness_nm_per_rad)


@pytest.mark.slow
def test_masses_that_are_guessed_hardly_matter(geometry: GeometryModel) -> None:
    """Catches an identification whose held-out error hangs on assumed masses, as K may."""
    problem, _ = made_up(geometry, 4, count=60, noise_m=5e-4, geometry="dh")
    parts = split(60, share=0.5, folds=1, seed=0)
    errors = []
    for scale in (0.6, 1.0, 1.6):
        scaled = replace(
            geometry, weight=scale * geometry.weight, weight_moment=scale * geometry.weight_moment
        )
        own = GeometryProblem(scaled, problem.theta, problem.measured, "dh", JOINTS)
        errors.append(
            judge(HoldoutProblem.from_geometry(own), parts, 0, lambda done: None).errors[-1].rms
        )
    assert np.ptp(errors) < 0.1 * errors[1]


def test_rivals_learn_what_they_can() -> None:
    """Catches a rival that is weaker than its name."""
    generator = np.random.default_rng(0)
    angles = generator.uniform(-1.0, 1.0, (80, 3))
    others = generator.uniform(-1.0, 1.0, (40, 3))
    straight = np.array([[1.0, 2.0, -1.0], [0.5, 0.0, 3.0]]).T
    np.testing.assert_allclose(
        predict_linear(angles, 2.0 + angles @ straight, others), 2.0 + others @ straight, atol=1e-9
    )
    np.testing.assert_allclose(predict_constant(angles, np.full((80, 2), 3.0), others), 3.0)

    def curved(q: Array) -> Array:
        return np.stack([np.sin(2.0 * q[:, 0]) * np.cos(q[:, 1]), q[:, 2] ** 2], axis=1)

    left = {
        name: np.abs(predict(angles, curved(angles), others) - curved(others)).mean()
        for name, predict in (("linear", predict_linear), ("kernel", predict_by_kernel))
    }
    assert left["kernel"] < 0.2 * left["linear"]


@pytest.mark.parametrize(
    ("own", "first"), [(5.0, "held out: 18.00 mm"), (17.0, "kernel regression is ahead")]
)
def test_a_rival_that_is_ahead_comes_first(own: float, first: str) -> None:
    """Catches a table that hides that regression does better."""
    errors = [("rigid", 18.0), ("kernel regression", 16.0), (FITTED, own)]
    held_out = HeldOut(
        of="markers",
        unit="mm",
        poses=10,
        held_out=10,
        errors=tuple(HeldOutError(name=name, rms=rms, mean=rms, worst=rms) for name, rms in errors),
        curve=(),
    )
    assert verdict(held_out).startswith(first)


def log_of(folder: Path, problem: GeometryProblem) -> Path:
    """The poses as a user's log."""
    columns = {f"theta.{name}": problem.theta[:, j] for j, name in enumerate(JOINTS)}
    for k, site in enumerate(SITES):
        columns |= {
            f"marker.{site}.{axis}": problem.measured[:, k, i] for i, axis in enumerate("xyz")
        }
    return write_poses(folder / "poses.csv", columns)


@pytest.mark.slow
def test_the_command_identifies_and_its_files_hold(
    geometry: GeometryModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From a log of two markers to a model that is better at unused poses; on every commit the
    test of meshes."""
    problem, _ = made_up(geometry, 7, count=36, noise_m=3e-4, geometry="dh")
    model = tmp_path / "arm.xml"
    model.write_text(ARM)
    log = log_of(tmp_path, problem)
    out = tmp_path / "out"
    asked = ["identify", "--robot", str(model), "--log", str(log), "--geometry", "dh"]
    main([*asked, "--output", str(out)])
    config = parse_yaml((out / "config.yaml").read_text())
    assert (config["robot"], config["log"]) == (str(model), [str(log)])
    said = capsys.readouterr().out
    assert "held out" in said
    assert "keep their prior" in said
    files = {path.name for path in out.iterdir()}
    assert {"identification.json", "joints.yaml", "model.xml", "identification.png"} <= files
    assert mujoco.MjModel.from_xml_path(str(out / "model.xml")).njnt == len(JOINTS)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (["marker.hand.x", "marker.hand.y"], r"needs the columns marker\.NAME\.x, \.y and \.z"),
        (["marker.x", "marker.y", "marker.z"], r"needs the columns marker\.NAME\.x, \.y and \.z"),
    ],
)
def test_a_marker_has_three_columns(tmp_path: Path, columns: list[str], message: str) -> None:
    """Catches a marker whose height is missing."""
    path = write_poses(
        tmp_path / "poses.csv",
        {"theta.pan": np.linspace(0.0, 1.0, 5), **{name: np.zeros(5) for name in columns}},
    )
    with pytest.raises(ConfigurationError, match=message):
        read_log(path, {"pan": (-2.0, 2.0)})


@pytest.mark.parametrize(
    ("count", "folds", "said"),
    [
        (12, 1, "12 poses leave 8 to fit and 4 to hold out, 10 and 10 are needed; log more poses"),
        (9, 3, "9 poses leave 6 to fit and 9 to hold out"),
        (20, 5, ""),
        (12, 20, ""),
    ],
)
def test_too_few_poses_for_a_split_are_said(
    geometry: GeometryModel, count: int, folds: int, said: str
) -> None:
    """Catches an error of two poses that looks like evidence, and folds judged one by one."""
    judged = HoldoutProblem.from_geometry(made_up(geometry, 7, count=count, noise_m=3e-4)[0])
    parts = split(count, share=0.3, folds=folds, seed=0)
    assert judged.shortage(parts).startswith(said)
    assert bool(judged.shortage(parts)) == bool(said)


def test_the_tracker_is_aligned_before_the_fit(geometry: GeometryModel) -> None:
    """A tracker that is turned by half a turn: catches steps from a wrong side."""
    _, theta = draw(5, 20)
    turned = geometry.nominal_parameters()._replace(
        rotation=np.array([0.0, 0.0, 3.0]), translation=np.array([1.0, -2.0, 0.5])
    )
    measured = geometry.predict_markers(turned, theta)
    own = GeometryProblem(geometry, theta, measured).align().model
    shown = own.predict_markers(own.nominal_parameters(), theta)
    np.testing.assert_allclose(shown, measured, atol=1e-9)


def test_the_written_model_finds_its_meshes(
    geometry: GeometryModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a folder of meshes beside the user's model, which the results do not have; and a
    command that does not write what it has found."""
    (tmp_path / "shapes").mkdir()
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "shapes" / "wedge.obj").write_text(corners)
    wedge = '<asset><mesh name="wedge" file="wedge.obj"/></asset><worldbody>'
    text = ARM.replace("<worldbody>", wedge, 1).replace(
        "<compiler", '<compiler meshdir="shapes"', 1
    )
    hand = '<site name="hand"'
    text = text.replace(hand, f'<geom type="mesh" mesh="wedge" mass="0.1"/>{hand}')
    (tmp_path / "arm.xml").write_text(text)
    problem, _ = made_up(geometry, 7, count=20, noise_m=3e-4)
    log = log_of(tmp_path, problem)
    asked = ["identify", "--robot", str(tmp_path / "arm.xml"), "--log", str(log), "--holdout", "0"]
    main([*asked, "--output", str(tmp_path / "out")])
    written = compiled_model(str(tmp_path / "out" / "model.xml"))
    assert (written.nmesh, written.njnt) == (1, len(JOINTS))
    assert "keep their prior" in capsys.readouterr().out
    config = parse_yaml((tmp_path / "out" / "config.yaml").read_text())
    assert (config["robot"], config["log"]) == (str(tmp_path / "arm.xml"), [str(log)])
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"identification.json", "joints.yaml"} <= files


def test_joints_that_are_not_in_the_log_stand_where_the_keyframe_has_them() -> None:
    """Catches markers behind a joint that is held elsewhere than the compensator holds it."""
    key = '<keyframe><key qpos="0 0 0 0.8"/></keyframe></mujoco>'
    model = mujoco.MjModel.from_xml_string(ARM.replace("</mujoco>", key))
    data = mujoco.MjData(model)
    theta = draw(4, 12)[1]
    measured = []
    for row in theta:
        data.qpos[:] = [*row[:3], 0.8]
        mujoco.mj_forward(model, data)
        measured.append(np.ravel([data.site(name).xpos for name in SITES]))
    columns = tuple(f"{name}.{axis}" for name in SITES for axis in "xyz")
    log = PoseLog(JOINTS[:3], theta[:, :3], "markers", columns, np.array(measured))
    problem, _ = pose_problem(GeometryOptions(), model, log, (), "hand")
    nothing = np.zeros(len(problem.unknowns.prior))
    np.testing.assert_allclose(problem.residual(nothing), 0.0, atol=1e-9)


def test_folds_hold_out_each_pose_once(geometry: GeometryModel) -> None:
    """Catches a pose that is fitted and judged, and a curve over other poses."""
    problem, _ = made_up(geometry, 8, count=30, noise_m=5e-4, geometry="offsets")
    parts = split(30, share=0.3, folds=3, seed=0)
    assert sorted(np.concatenate(parts)) == list(range(30))
    held_out = judge(HoldoutProblem.from_geometry(problem), parts, 0, lambda done: None)
    assert held_out.held_out == 30
    assert held_out.is_ahead
    assert [point.poses for point in held_out.curve] == [10, 20]


@pytest.mark.parametrize(
    "option",
    [
        "--plan 20",
        "--payload hand",
        "--assume 900",
        "--end-effector hand",
        "--frame known",
        "--within 0.1",
    ],
)
def test_an_option_without_use_is_refused(
    geometry: GeometryModel, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    """Catches an option that is dropped without a word."""
    problem, _ = made_up(geometry, 7, count=20, noise_m=3e-4)
    model = tmp_path / "arm.xml"
    model.write_text(ARM)
    log = log_of(tmp_path, problem)
    with pytest.raises(SystemExit):
        main(["identify", "--robot", str(model), "--log", str(log), *option.split()])
    assert f"{option.split()[0]} is not for a fit of the geometry" in capsys.readouterr().err


def test_millimetres_are_named(geometry: GeometryModel) -> None:
    """Catches a fit that takes them for metres, and gives up after minutes."""
    problem, _ = made_up(geometry, 7, count=20, noise_m=3e-4)
    with pytest.raises(ConfigurationError, match="convert millimetres to metres"):
        replace(problem, measured=1e3 * problem.measured).align()
