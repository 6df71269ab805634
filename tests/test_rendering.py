"""Pictures of the testbed: shape and type, and that one sees in them what they are for."""

from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import elastic_env  # noqa: F401  registers the environments
from elastic_env.errors import ConfigurationError
from elastic_env.rendering import EXAGGERATION, TestbedPicture, exaggerated
from elastic_env.robots.testbed import Pendulum
from elastic_env.signals import Array, Signals

ID = "elastic_env/Testbed-v0"
CAPTION_ROWS = 60
"""Rows at the top, which hold clock and numbers."""


def signals(reference: float = 0.3, link_error: float = 0.0, deflection: float = 0.0, time_s: float = 1.0) -> Signals:
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
    [(0.31, 0.3, 8.0, 0.38), (0.29, 0.3, 8.0, 0.22), (0.3, 0.3, 8.0, 0.3), (-0.02, 0.0, 3.0, -0.06)],
)
def test_deviations_from_the_reference_are_enlarged(
    angle: float, reference: float, factor: float, drawn: float
) -> None:
    """Catches an angle that is enlarged as a whole, and a deviation drawn to the wrong side."""
    assert exaggerated(angle, reference, factor) == pytest.approx(drawn, abs=1e-15)


def test_default_factor_is_the_one_that_the_caption_shows(picture: TestbedPicture) -> None:
    """Catches a caption that names another factor than the picture has."""
    assert exaggerated(1.01, 1.0) == pytest.approx(1.0 + 0.01 * EXAGGERATION)
    picture.rgb(signals(reference=0.2, link_error=0.01))
    assert picture._data.joint("link").qpos[0] == pytest.approx(0.2 - 0.01 * EXAGGERATION)


def test_environment_returns_rgb_pictures_that_change_with_the_motion() -> None:
    """Catches another shape or type, an empty picture, and one that stands still."""
    reference = {"kind": "sine", "amplitude": 0.2, "frequency_hz": 0.5, "duration_s": 0.5, "onset_s": 0.5}
    env = gymnasium.make(ID, render_mode="rgb_array", reference=reference)
    env.reset(seed=0)
    pictures: list[Any] = []
    for step in range(env.unwrapped.task.num_steps):
        if step % 250 == 0:
            pictures.append(env.render())
        env.step(np.zeros(1, dtype=np.float32))
    pictures.append(env.render())
    env.close()
    for image in pictures:
        assert image.shape == (480, 640, 3)
        assert image.dtype == np.uint8
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    assert np.any(pictures[-1][CAPTION_ROWS:] != pictures[0][CAPTION_ROWS:])


def test_rendering_does_not_change_the_rollout() -> None:
    """Catches a picture that steps or moves the physics."""
    results = []
    for render_mode in (None, "rgb_array"):
        env = gymnasium.make(ID, render_mode=render_mode, reference="sine")
        env.reset(seed=0)
        for _ in range(20):
            observation, *_ = env.step(np.full(1, 0.01, dtype=np.float32))
            if render_mode is not None:
                env.render()
        results.append(observation)
        env.close()
    np.testing.assert_array_equal(results[0], results[1])


def test_environment_renders_again_after_it_was_closed() -> None:
    """Catches a renderer that is used after it was freed."""
    env = gymnasium.make(ID, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    first = env.render()
    env.close()
    env.close()
    np.testing.assert_array_equal(env.render(), first)
    env.close()


def test_picture_draws_again_after_it_was_closed() -> None:
    """Catches a picture that keeps the renderer that it has freed."""
    drawn = TestbedPicture(Pendulum())
    first = drawn.rgb(signals())
    drawn.close()
    drawn.close()
    np.testing.assert_array_equal(drawn.rgb(signals()), first)
    drawn.close()


def test_without_render_mode_there_is_no_picture() -> None:
    """Catches a renderer that is made for nobody."""
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    assert env.render() is None


def test_unknown_render_mode_lists_the_choices() -> None:
    """Catches a mode that is silently ignored."""
    with pytest.raises(ConfigurationError, match=r"unknown render mode 'ascii'.*rgb_array, human"):
        gymnasium.make(ID, render_mode="ascii", disable_env_checker=True)


def test_deflection_moves_the_rotor_and_not_the_link(picture: TestbedPicture) -> None:
    """Catches a deflection that one cannot see, or a rotor drawn behind the link instead of ahead of it."""
    rest, bent = scene(picture), scene(picture, deflection=0.03)
    assert np.any(rest != bent)
    blue, orange = (38.0, 102.0, 217.0), (217.0, 115.0, 38.0)
    moved = centre(bent, blue) - centre(rest, blue)
    assert moved[1] > 3.0  # a motor that leads stands further towards +x, to the right
    np.testing.assert_allclose(centre(bent, orange), centre(rest, orange), atol=0.5)


def test_link_error_moves_the_link_away_from_its_reference(picture: TestbedPicture) -> None:
    """Catches a link that lags drawn ahead: q = q_ref − error hangs further to the left, eight times as far."""
    orange = (217.0, 115.0, 38.0)
    rest, late = scene(picture), scene(picture, link_error=0.02)
    assert centre(late, orange)[1] < centre(rest, orange)[1] - 20.0


def test_positive_angles_are_on_the_right(picture: TestbedPicture) -> None:
    """Catches a mirrored camera: q grows towards +x, which the front view shows on the right."""
    orange = (217.0, 115.0, 38.0)
    left, right = scene(picture, reference=-0.5), scene(picture, reference=0.5)
    assert centre(left, orange)[1] < 320.0 < centre(right, orange)[1]


def test_caption_shows_time_deflection_and_link_error(picture: TestbedPicture) -> None:
    """Catches numbers that are not those of this step: each of them changes the caption and nothing else does."""

    def caption(**values: float) -> Array:
        return picture.rgb(signals(**values))[:CAPTION_ROWS]

    same, again = caption(), caption()
    np.testing.assert_array_equal(same, again)
    for change in ({"time_s": 2.0}, {"deflection": 0.001}, {"link_error": 0.001}):
        assert np.any(caption(**change) != same)


def test_drawing_model_hangs_like_the_testbed(picture: TestbedPicture) -> None:
    """Catches a picture whose pendulum has another length or turns the other way than the simulated one."""
    picture.rgb(signals(reference=0.6))
    model, data = picture._model, picture._data
    bob = data.geom("link_bob").xpos
    reach = Pendulum().com_distance
    np.testing.assert_allclose(bob[[0, 2]], [reach * np.sin(0.6), -reach * np.cos(0.6)], atol=1e-9)
    assert model.joint("reference").type == mujoco.mjtJoint.mjJNT_HINGE
