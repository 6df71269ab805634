"""Pictures of MuJoCo models that are only drawn: an image with a caption, or a window."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Signals
from elastic_env.rendering.headless import CURE

Image: TypeAlias = npt.NDArray[np.uint8]
Rgba: TypeAlias = tuple[float, float, float, float]
Legend: TypeAlias = Sequence[tuple[str, Rgba]]
"""Words under a picture, each in the colour of the part that it names."""

CAMERA = "front"
"""The camera through which a display model is seen."""

_BACKGROUND = (0.96, 0.97, 0.98)
_TEXT_RGB = (30, 34, 40)
_MARGIN = 12
_WITHOUT_WINDOW = 'make a video by --video FILE, or use render_mode="rgb_array"'
_CHARACTERS_PER_ROW = 37
"""Width of a picture divided by the size of its letters."""


class Picture(ABC):
    """Draws the present state of a task by a display model, which is posed and never stepped.

    Args:
        spec: The display model, with a camera named `CAMERA`.
        legend: Words under the image.
    """

    def __init__(self, spec: mujoco.MjSpec, legend: Legend) -> None:
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._legend = legend
        self._renderer: Any = None
        self._viewer: Any = None

    @abstractmethod
    def _pose(self, now: dict[str, float], world: int) -> None:
        """Move the display model to the present state of a world, by its signals."""

    @abstractmethod
    def _caption(self, now: dict[str, float], world: int) -> list[str]:
        """Return the lines of text for the state that was posed last."""

    def rgb(self, signals: Signals, world: int = 0) -> Image:
        """Return an image of a world, (height, width, 3)."""
        caption = self._update(signals, world)
        if self._renderer is None:
            self._renderer = renderer(self._model)
        self._renderer.update_scene(self._data, camera=CAMERA)
        return with_text(self._renderer.render(), caption, self._legend)

    def show(self, signals: Signals) -> None:
        """Update the window, which shows the first world."""
        caption = self._update(signals, 0)
        if self._viewer is None:
            self._viewer = _window(self._model, self._data)
        corner = mujoco.mjtGridPos.mjGRID_TOPLEFT
        large = mujoco.mjtFontScale.mjFONTSCALE_150
        self._viewer.set_texts([(large, corner, "\n".join(caption), "")])
        self._viewer.sync()

    def close(self) -> None:
        """Free renderer and window."""
        if self._renderer is not None:
            self._renderer.close()
        if self._viewer is not None:
            self._viewer.close()
        self._renderer = self._viewer = None

    def _update(self, signals: Signals, world: int) -> list[str]:
        """Pose the display model, and return its caption."""
        now = {name: float(values[world]) for name, values in signals.items()}
        self._pose(now, world)
        mujoco.mj_forward(self._model, self._data)
        return self._caption(now, world)


def paint(spec: mujoco.MjSpec, rgba: Rgba) -> None:
    """Give all shapes one colour."""
    for geom in spec.geoms:
        geom.rgba = rgba
        geom.material = ""


def set_stage(spec: mujoco.MjSpec, width: int, height: int) -> None:
    """Set the size of the images [pixels], a light background and soft light."""
    spec.compiler.degree = False
    spec.visual.global_.offwidth = width
    spec.visual.global_.offheight = height
    spec.visual.headlight.ambient = [0.5] * 3
    spec.visual.headlight.diffuse = [0.15] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.visual.rgba.haze = [*_BACKGROUND, 1.0]
    kind = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    flat = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    sky = spec.add_texture(name="sky", type=kind, builtin=flat, width=64, height=64)
    sky.rgb1 = sky.rgb2 = _BACKGROUND


def _window(model: mujoco.MjModel, data: mujoco.MjData) -> Any:
    try:
        # imported late: a machine without a screen may have neither GLFW nor a display
        import glfw
        import mujoco.viewer as views
    except (ImportError, RuntimeError) as error:
        raise ElasticError(f"no window can be opened here ({error}); {_WITHOUT_WINDOW}") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)  # the error below says it
        has_display = glfw.init()
    if not has_display:  # the viewer itself would end the process
        raise ElasticError(f"no window can be opened here; {_WITHOUT_WINDOW}")
    viewer = views.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
    viewer.cam.fixedcamid = model.camera(CAMERA).id
    return viewer


def renderer(model: mujoco.MjModel) -> Any:
    """Return a renderer of images in the size that the model sets.

    Raises:
        ElasticError: The machine cannot draw.
    """
    try:
        size = model.vis.global_
        return mujoco.Renderer(model, size.offheight, size.offwidth)
    except Exception as error:  # MuJoCo's OpenGL backends raise errors of many types
        raise ElasticError(f"the renderer could not start ({error}); {CURE}") from error


def with_text(image: Image, lines: list[str], legend: Legend = ()) -> Image:
    """Return the image with its caption above and its legend below."""
    import PIL.Image  # Pillow comes with Gymnasium's MuJoCo extra
    import PIL.ImageDraw
    import PIL.ImageFont

    picture = PIL.Image.fromarray(image)
    draw = PIL.ImageDraw.Draw(picture)
    size = picture.width // _CHARACTERS_PER_ROW
    font = PIL.ImageFont.load_default(size=size)
    for row, line in enumerate(lines):
        draw.text((_MARGIN, 10 + row * 1.25 * size), line, fill=_TEXT_RGB, font=font)
    x = float(_MARGIN)
    for word, rgba in legend:
        rgb = tuple(round(255 * share) for share in rgba[:3])
        draw.text((x, picture.height - 1.6 * size), word, fill=rgb, font=font)
        x += draw.textlength(word, font=font) + size
    return np.asarray(picture)
