"""Pictures: shape and type, and that one sees in them what they are for."""

import warnings
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ConfigurationError, ElasticError
from elastic_env.core.signals import Array, Signals
from elastic_env.rendering.deviation_picture import ENLARGEMENT, enlarge_deviation
from elastic_env.rendering.picture import _window
from elastic_env.rigid.leg_kinematics import rotation_x, rotation_y
from elastic_env.robots.testbed.model import Pendulum
from elastic_env.robots.testbed.picture import TestbedPicture
from elastic_env.robots.thormang.config import WalkConfig
from elastic_env.robots.thormang.picture import (
    LARGEST_FACTOR,
    Posture,
    WalkerPicture,
    enlarge_posture,
)
from elastic_env.robots.thormang.task import WalkTask

ID = "elastic_env/Testbed-v0"
WALKER_ID = "elastic_env/WalkInPlace-v0"
CAPTION_ROWS = 60
"""Rows at the top, which hold clock and numbers."""


def signals(
    reference: float = 0.3, link_error: float = 0.0, deflection: float = 0.0, time_s: float = 1.0
) -> Signals:
    """What a picture is drawn from."""
    return {
        "time_s": np.array([time_s]),
        "reference_angle": np.array([reference]),
        "link_angle": np.array([reference - link_error]),
        "link_error": np.array([link_error]),
        "deflection": np.array([deflection]),
    }


@pytest.fixture(scope="module")
def picture() -> Any:
    """One picture for all tests."""
    drawn = TestbedPicture(Pendulum())
    yield drawn
    drawn.close()


def scene(picture: TestbedPicture, **values: float) -> Array:
    """The picture without its caption."""
    return picture.rgb(signals(**values))[CAPTION_ROWS:].astype(np.float64)


def centre(image: Array, rgb: tuple[float, float, float]) -> Array:
    """Mean row and column of the pixels whose hue is close to a colour."""
    direction = np.array(rgb) / np.linalg.norm(rgb)
    brightness = np.linalg.norm(image, axis=-1)
    similar = (image @ direction) / np.maximum(brightness, 1.0)
    rows, columns = np.nonzero((similar > 0.985) & (brightness > 60.0))
    assert len(rows) > 50
    return np.array([rows.mean(), columns.mean()])


@pytest.mark.parametrize(
    ("angle", "reference", "factor", "drawn"),
    [
        (0.31, 0.3, 8.0, 0.38),
        (0.29, 0.3, 8.0, 0.22),
        (0.3, 0.3, 8.0, 0.3),
        (-0.02, 0.0, 3.0, -0.06),
    ],
)
def test_deviations_from_the_reference_are_enlarged(
    angle: float, reference: float, factor: float, drawn: float
) -> None:
    """Catches an angle that is enlarged as a whole, and a deviation drawn to the wrong side."""
    assert enlarge_deviation(angle, reference, factor) == pytest.approx(drawn, abs=1e-15)


def test_default_factor_is_the_one_that_the_caption_shows(picture: TestbedPicture) -> None:
    """Catches a caption that names another factor than the picture has."""
    assert enlarge_deviation(1.01, 1.0) == pytest.approx(1.0 + 0.01 * ENLARGEMENT)
    picture.rgb(signals(reference=0.2, link_error=0.01))
    assert picture._data.joint("link").qpos[0] == pytest.approx(0.2 - 0.01 * ENLARGEMENT)


def test_environment_returns_rgb_pictures_that_change_with_the_motion() -> None:
    """Catches another shape or type, an empty picture, one that stands still, one that steps or
    moves the physics, and a renderer that is used after it was freed."""
    reference = {
        "kind": "sine",
        "amplitude": 0.2,
        "frequency_hz": 0.5,
        "duration_s": 0.25,
        "onset_s": 0.25,
    }
    env = gymnasium.make(ID, render_mode="rgb_array", reference=reference)
    blind = gymnasium.make(ID, reference=reference)
    env.reset(seed=0)
    blind.reset(seed=0)
    pictures: list[Any] = []
    for step in range(env.unwrapped.task.num_steps):
        action = np.full(1, 0.01 * np.sin(step), dtype=np.float32)
        observation = env.step(action)[0]
        np.testing.assert_array_equal(observation, blind.step(action)[0])
        if step == 70:  # in motion
            pictures.append(env.render())
    pictures.append(env.render())
    for _ in range(2):
        env.unwrapped.close()
    np.testing.assert_array_equal(env.render(), pictures[-1])
    env.close()
    for image in pictures:
        assert image.shape == (480, 640, 3)
        assert image.dtype == np.uint8
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    assert np.any(pictures[-1][CAPTION_ROWS:] != pictures[0][CAPTION_ROWS:])


def test_picture_draws_again_after_it_was_closed(picture: TestbedPicture) -> None:
    """Catches a renderer that is not freed, and a picture that keeps one that it has freed."""
    first = picture.rgb(signals())
    picture.close()
    picture.close()
    assert picture._renderer is None
    np.testing.assert_array_equal(picture.rgb(signals()), first)


def test_without_render_mode_there_is_no_picture() -> None:
    """Catches a renderer that is made for nobody."""
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    assert env.render() is None


def test_a_machine_without_a_display_is_told_of_videos(
    monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """Catches GLFW's own warning before the error."""
    glfw = pytest.importorskip("glfw")

    def fail() -> bool:
        warnings.warn("X11: no display", glfw.GLFWError, stacklevel=2)
        return False

    monkeypatch.setattr(glfw, "init", fail)
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(ElasticError, match="make a video by --video FILE"):
        _window(model, mujoco.MjData(model))
    assert not recwarn


def test_unknown_render_mode_lists_the_choices() -> None:
    """Catches a mode that is silently ignored."""
    with pytest.raises(ConfigurationError, match=r"unknown render mode 'ascii'.*rgb_array, human"):
        gymnasium.make(ID, render_mode="ascii", disable_env_checker=True)


def test_deflection_moves_the_rotor_and_not_the_link(picture: TestbedPicture) -> None:
    """Catches a deflection that one cannot see, or a rotor drawn behind the link instead of
    ahead of it."""
    rest = scene(picture)
    bent = scene(picture, deflection=0.03)
    assert np.any(rest != bent)
    blue = (38.0, 102.0, 217.0)
    orange = (217.0, 115.0, 38.0)
    moved = centre(bent, blue) - centre(rest, blue)
    assert moved[1] > 3.0  # a motor that leads stands further towards +x, to the right
    np.testing.assert_allclose(centre(bent, orange), centre(rest, orange), atol=0.5)


def test_link_error_moves_the_link_away_from_its_reference(picture: TestbedPicture) -> None:
    """Catches a link that lags drawn ahead: q = q_ref − error hangs further to the left, eight
    times as far."""
    orange = (217.0, 115.0, 38.0)
    rest = scene(picture)
    late = scene(picture, link_error=0.02)
    assert centre(late, orange)[1] < centre(rest, orange)[1] - 20.0


def test_positive_angles_are_on_the_right(picture: TestbedPicture) -> None:
    """Catches a mirrored camera: q grows towards +x, which the front view shows on the right."""
    orange = (217.0, 115.0, 38.0)
    left = scene(picture, reference=-0.5)
    right = scene(picture, reference=0.5)
    assert centre(left, orange)[1] < 320.0 < centre(right, orange)[1]


def test_caption_shows_time_deflection_and_link_error(picture: TestbedPicture) -> None:
    """Catches numbers that are not those of this step: each of them changes the caption and
    nothing else does."""

    def caption(**values: float) -> Array:
        return picture.rgb(signals(**values))[:CAPTION_ROWS]

    same = caption()
    again = caption()
    np.testing.assert_array_equal(same, again)
    for change in ({"time_s": 2.0}, {"deflection": 0.001}, {"link_error": 0.001}):
        assert np.any(caption(**change) != same)


def test_drawing_model_hangs_like_the_testbed(picture: TestbedPicture) -> None:
    """Catches a picture whose pendulum has another length or turns the other way than the
    simulated one."""
    picture.rgb(signals(reference=0.6))
    model = picture._model
    data = picture._data
    bob = data.geom("link_bob").xpos
    reach = Pendulum().com_distance
    np.testing.assert_allclose(bob[[0, 2]], [reach * np.sin(0.6), -reach * np.cos(0.6)], atol=1e-9)
    assert model.joint("reference").type == mujoco.mjtJoint.mjJNT_HINGE


ROW = 600
"""A row of the plan in which the left foot carries the robot."""


@pytest.fixture(scope="module")
def walk() -> WalkTask:
    """The rules of a walk, of which no step is simulated."""
    return WalkTask(WalkConfig(), num_worlds=1)


class Walker:
    """A walker's picture of any posture: what the task says of its state is said by the test."""

    def __init__(self, walk: WalkTask) -> None:
        self.walk = walk
        self.robot = walk.truth().model.biped
        self.planned = Posture.from_plan(walk.plan, ROW)
        self.fell = False
        task: Any = SimpleNamespace(
            config=walk.config,
            plan=walk.plan,
            truth=lambda: self.truth,
            has_fallen=lambda: np.array([self.fell]),
        )
        self.picture = WalkerPicture(task)

    def posture(
        self, roll: float = 0.0, pitch: float = 0.0, shift: float = 0.0, feet: float = 0.0
    ) -> Posture:
        """The planned posture with a tilt [rad] and a shift to the left [m] of the pelvis, and
        one of the feet [m]."""
        left = np.array([0.0, 1.0, 0.0])
        tilt = rotation_x(np.array(roll)) @ rotation_y(np.array(pitch))
        planned = self.planned
        return Posture(
            planned.pelvis + shift * left, tilt, planned.ankles + feet * left, planned.feet_R
        )

    def stand(self, fell: bool = False, **deviations: float) -> Posture:
        """Let the robot have a posture."""
        true = self.posture(**deviations)
        self.fell = fell
        self.truth = SimpleNamespace(
            pelvis=true.pelvis[None],
            pelvis_R=true.R[None],
            ankles=true.ankles[None],
            q=true.joint_angles(self.robot)[None],
            model=self.walk.truth().model,
        )
        return true

    def signals(
        self, zmp: tuple[float, float] = (0.3, 0.0), reference: tuple[float, float] = (0.0, 0.105)
    ) -> Signals:
        """Signals of the task that go with it, so far as they are drawn."""
        deviation = float(np.hypot(zmp[0] - reference[0], zmp[1] - reference[1]))
        timing = self.walk.plan.timing
        values = {
            "time_s": timing.time[ROW],
            "single_support": timing.single[ROW],
            "support": timing.support[ROW],
            "pelvis_roll": 0.01,
            "pelvis_pitch": -0.02,
            "zmp_deviation": deviation,
            "zmp_x": zmp[0],
            "zmp_y": zmp[1],
            "zmp_reference_x": reference[0],
            "zmp_reference_y": reference[1],
        }
        return {name: np.array([value]) for name, value in values.items()}

    def scene(self, **points: tuple[float, float]) -> Array:
        """The picture, white where its words are."""
        image = self.picture.rgb(self.signals(**points)).astype(np.float64)
        image[:90] = image[-40:] = 255.0
        return image

    def caption(self, **points: tuple[float, float]) -> list[str]:
        """The words that go with the picture."""
        return self.picture._update(self.signals(**points), 0)

    def pixel(self, point: tuple[float, float, float]) -> Array:
        """Row and column at which a point is seen."""
        model = self.picture._model
        data = self.picture._data
        eye = data.cam("front").xpos
        R = data.cam("front").xmat.reshape(3, 3)
        right, up, back = (np.array(point) - eye) @ R
        height = model.vis.global_.offheight
        width = model.vis.global_.offwidth
        focus = 0.5 * height / np.tan(0.5 * np.radians(model.cam_fovy[0]))
        return np.array([0.5 * height + focus * up / back, 0.5 * width - focus * right / back])


@pytest.fixture(scope="module")
def walker(walk: WalkTask) -> Any:
    """One picture of the walker for all tests."""
    drawn = Walker(walk)
    yield drawn
    drawn.picture.close()


def magenta(image: Array) -> Array:
    """Rows and columns of the pixels of the ZMP's marker."""
    red, green, blue = np.moveaxis(image, -1, 0)
    return np.argwhere((red > 120.0) & (green < 0.35 * red) & (blue > 0.3 * red))


def test_tilt_and_shift_of_the_pelvis_are_enlarged_and_the_feet_stay(walker: Walker) -> None:
    """Catches a deviation drawn as it is, a pelvis enlarged about the wrong point, and feet that
    leave the floor."""
    true = walker.posture(roll=0.02, shift=0.01)
    planned = walker.planned
    drawn, factor = enlarge_posture(true, planned, 0.0, walker.robot, largest=4.0)
    assert factor == 4.0
    np.testing.assert_allclose(drawn.R, rotation_x(np.array(0.08)), atol=1e-12)
    np.testing.assert_allclose(
        drawn.pelvis, planned.pelvis + np.array([0.0, 0.04, 0.0]), atol=1e-12
    )
    np.testing.assert_array_equal(drawn.ankles, true.ankles)


def test_robot_that_stands_elsewhere_is_not_tilted(walker: Walker) -> None:
    """Catches a pelvis that is pulled away from feet that slipped as far as it did."""
    true = walker.posture(shift=0.03, feet=0.03)
    for share in (0.0, 0.4, 1.0):
        drawn, _ = enlarge_posture(true, walker.planned, share, walker.robot)
        np.testing.assert_allclose(drawn.pelvis, true.pelvis, atol=1e-12)


def test_factor_is_as_large_as_the_legs_allow(walker: Walker) -> None:
    """Catches a fall drawn with legs that are too short: the factor ends at one, which is the
    truth."""
    tilts = np.linspace(0.0, 0.4, 9)
    postures = [walker.posture(roll=-tilt, shift=0.6 * tilt) for tilt in tilts]
    factors = [enlarge_posture(true, walker.planned, 0.0, walker.robot)[1] for true in postures]
    assert factors[0] == LARGEST_FACTOR
    assert all(before >= after >= 1.0 for before, after in pairwise(factors))
    assert factors[-1] < 2.0


@pytest.mark.parametrize(
    "deviations", [{}, {"roll": 0.03, "pitch": -0.02, "shift": 0.01, "feet": 0.005}]
)
def test_drawn_feet_are_where_the_true_ones_are(
    walker: Walker, deviations: dict[str, float]
) -> None:
    """Catches joint angles that do not belong to the posture, by MuJoCo's own kinematics."""
    true = walker.stand(**deviations)
    walker.picture._update(walker.signals(), 0)
    data = walker.picture._data
    for side, ankle in zip("lr", true.ankles, strict=True):
        np.testing.assert_allclose(data.body(f"{side}_foot").xpos, ankle, atol=1e-9)
        np.testing.assert_allclose(
            data.body(f"{side}_foot").xmat.reshape(3, 3), np.eye(3), atol=1e-9
        )
    roll = deviations.get("roll", 0.0)
    pitch = deviations.get("pitch", 0.0)
    drawn = data.body("upper_body").xmat.reshape(3, 3)
    assert drawn[2, 1] == pytest.approx(LARGEST_FACTOR * roll, rel=0.02)
    assert -drawn[2, 0] == pytest.approx(LARGEST_FACTOR * pitch, rel=0.02)


def test_translucent_robot_is_the_plan(walker: Walker) -> None:
    """Catches a plan of another row, and one that moves with the robot."""
    walker.stand(roll=0.05)
    walker.picture._update(walker.signals(), 0)
    rigid = walker.robot.rigid
    data = mujoco.MjData(rigid)
    plan = walker.walk.plan
    data.qpos[:3] = plan.pelvis[ROW]
    data.qpos[3:7] = [1.0, 0.0, 0.0, 0.0]
    for joint, angle in zip(walker.robot.joint_names, plan.q[ROW], strict=True):
        data.joint(joint).qpos = angle
    mujoco.mj_kinematics(rigid, data)
    for body in ("upper_body", "l_foot", "r_shank", "r_foot"):
        np.testing.assert_allclose(
            walker.picture._data.body(f"plan_{body}").xpos, data.body(body).xpos, atol=1e-9
        )


def edges(image: Array) -> Array:
    """First and last column in which one sees head and chest of the robot."""
    darker = (image[100:250] < 190.0).any(axis=(0, 2))
    return np.flatnonzero(darker)[[0, -1]]


def test_walker_that_leans_to_its_right_is_seen_to_lean_to_the_left(walker: Walker) -> None:
    """Catches a mirrored tilt, and a camera behind the robot, which looks at the camera."""
    walker.stand()
    upright = edges(walker.scene())
    walker.stand(roll=0.04)  # about x, forward: the head moves towards -y, the robot's right
    to_the_left = edges(walker.scene())
    assert to_the_left[0] < upright[0] - 10
    assert to_the_left[1] < upright[1] + 10


def test_marker_of_the_zmp_is_where_the_zmp_is(walker: Walker) -> None:
    """Catches a marker of something else, swapped axes, and one that is enlarged like the
    pelvis."""
    walker.stand(roll=0.02)
    zmp = (0.2, 0.3)
    seen = magenta(walker.scene(zmp=zmp))
    assert len(seen) > 50
    np.testing.assert_allclose(seen.mean(axis=0), walker.pixel((*zmp, 0.02)), atol=4.0)


def test_marker_of_the_reference_is_where_the_reference_is(walker: Walker) -> None:
    """Catches a reference that stands still: only the pixels around the two places differ."""
    walker.stand()
    places = ((0.35, -0.1), (0.3, 0.25))
    one, other = (walker.scene(reference=place, zmp=(0.0, 0.0)) for place in places)
    changed = np.argwhere(np.abs(one - other).max(axis=-1) > 20.0)
    assert len(changed) > 200
    distances = [np.linalg.norm(changed - walker.pixel((*place, 0.01)), axis=1) for place in places]
    assert np.min(distances, axis=0).max() < 25.0
    assert all((distance < 25.0).sum() > 100 for distance in distances)


def test_without_ground_contact_there_is_no_zmp(walker: Walker) -> None:
    """Catches a marker at an old or a meaningless place, and a caption with nan."""
    walker.stand()
    nowhere = (np.nan, np.nan)
    assert len(magenta(walker.scene(zmp=nowhere))) == 0
    assert "nan" not in " ".join(walker.caption(zmp=nowhere))


def test_caption_of_the_walker_says_what_is_drawn(walker: Walker) -> None:
    """Catches another phase, number or factor than that of the picture, and a fall that nobody
    mentions."""
    walker.stand()
    first, second, third = walker.caption(zmp=(0.0, 0.095))
    assert first.split() == ["t", "=", "2.40", "s", "left", "support"]
    assert second.split() == [
        "roll",
        "+10.0",
        "mrad",
        "pitch",
        "-20.0",
        "mrad",
        "ZMP",
        "deviation",
        "10.0",
        "mm",
    ]
    assert f"x {LARGEST_FACTOR:g} " in third
    true = walker.stand(fell=True, roll=-0.1, shift=0.05)
    first, _, third = walker.caption()
    assert "fell" in first
    factor = enlarge_posture(true, walker.planned, walker.walk.plan.share[ROW], walker.robot)[1]
    assert 1.0 < factor < LARGEST_FACTOR
    assert f"x {factor:.2g} " in third


def test_walking_environment_renders_its_walk() -> None:
    """Catches another shape or type, a picture that stands still while the robot moves, and one
    that steps or moves the physics."""
    walk: dict[str, Any] = {"step_period": 1.1, "num_steps": 1}
    env = gymnasium.make(WALKER_ID, **walk, render_mode="rgb_array")
    blind = gymnasium.make(WALKER_ID, **walk)
    env.reset(seed=0)
    blind.reset(seed=0)
    action = np.full(12, 0.03, dtype=np.float32)
    first: Any = env.render()
    for step in range(10):
        observation = env.step(action)[0]
        if step == 4:
            later: Any = env.render()
        np.testing.assert_array_equal(observation, blind.step(action)[0])
    env.close()
    for image in (first, later):
        assert isinstance(image, np.ndarray)
        assert image.shape == (720, 720, 3)
        assert image.dtype == np.uint8
    assert np.any(first[90:] != later[90:])
