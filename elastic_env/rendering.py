"""Pictures in which one sees a deflection of milliradians: deviations from the reference are drawn larger.

What is drawn at angle x stands at q_ref + factor · (x − q_ref); the factor is written into the picture. The translucent
pendulum is the reference, the solid one the link, the blue pointer the rotor.
"""

from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from elastic_env.errors import ElasticError
from elastic_env.headless import CURE
from elastic_env.robots.testbed import Pendulum
from elastic_env.signals import Signals

EXAGGERATION = 8.0
"""Factor by which deviations from the reference are enlarged."""

_WIDTH, _HEIGHT = 640, 480
_REFERENCE_RGBA = (0.35, 0.65, 0.45, 0.35)
_LINK_RGBA = (0.85, 0.45, 0.15, 1.0)
_STEEL_RGBA = (0.42, 0.44, 0.48, 1.0)
_HOUSING_RGBA = (0.2, 0.22, 0.26, 1.0)
_ROTOR_RGBA = (0.15, 0.4, 0.85, 1.0)
_BACKGROUND = (0.96, 0.97, 0.98)


class Picture(Protocol):
    """Draws the present state of a task from its signals."""

    def rgb(self, signals: Signals) -> npt.NDArray[np.uint8]:
        """An image, (height, width, 3)."""
        ...

    def show(self, signals: Signals) -> None:
        """Update the window."""
        ...

    def close(self) -> None:
        """Free renderer and window."""
        ...


class WalkerPicture:
    """To come."""


def exaggerated(angle: float, reference: float, factor: float = EXAGGERATION) -> float:
    """Angle at which something is drawn, its deviation from the reference enlarged [rad]."""
    return reference + factor * (angle - reference)


class TestbedPicture:
    """The testbed of Fig. 4: housing, rotor pointer, pendulum, and the reference as a translucent pendulum."""

    __test__ = False

    def __init__(self, pendulum: Pendulum) -> None:
        self._model = _display_spec(pendulum).compile()
        self._data = mujoco.MjData(self._model)
        self._renderer: Any = None
        self._viewer: Any = None

    def rgb(self, signals: Signals) -> npt.NDArray[np.uint8]:
        """See `Picture`."""
        self._pose(signals)
        if self._renderer is None:
            self._renderer = _renderer(self._model)
        self._renderer.update_scene(self._data, camera="front")
        return _with_caption(self._renderer.render().copy(), _caption(signals))

    def show(self, signals: Signals) -> None:
        """See `Picture`."""
        self._pose(signals)
        if self._viewer is None:
            self._viewer = _window(self._model, self._data)
        corner, large = mujoco.mjtGridPos.mjGRID_TOPLEFT, mujoco.mjtFontScale.mjFONTSCALE_150
        self._viewer.set_texts([(large, corner, "\n".join(_caption(signals)), "")])
        self._viewer.sync()

    def close(self) -> None:
        """See `Picture`."""
        if self._renderer is not None:
            self._renderer.close()
        if self._viewer is not None:
            self._viewer.close()
        self._renderer = self._viewer = None

    def _pose(self, signals: Signals) -> None:
        reference, link = float(signals["reference_angle"][0]), float(signals["link_angle"][0])
        rotor = link + float(signals["deflection"][0])
        self._data.joint("reference").qpos = reference
        self._data.joint("link").qpos = exaggerated(link, reference)
        self._data.joint("rotor").qpos = exaggerated(rotor, reference)
        mujoco.mj_forward(self._model, self._data)


def _window(model: mujoco.MjModel, data: mujoco.MjData) -> Any:
    try:
        import glfw  # only here: a machine that only computes may have neither GLFW nor a display
        import mujoco.viewer as viewers
    except (ImportError, RuntimeError) as error:
        raise ElasticError(f"no window can be opened here ({error}); {CURE}") from error
    if not glfw.init():  # the viewer itself would end the process
        raise ElasticError(f"no window can be opened here; make a video (--video FILE) or use rgb_array; {CURE}")
    viewer = viewers.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
    viewer.cam.fixedcamid = 0
    return viewer


def _renderer(model: mujoco.MjModel) -> Any:
    try:
        return mujoco.Renderer(model, _HEIGHT, _WIDTH)
    except Exception as error:  # MuJoCo's OpenGL backends raise errors of many types
        raise ElasticError(f"the renderer could not start ({error}); {CURE}") from error


def _caption(signals: Signals) -> list[str]:
    return [
        f"t = {float(signals['time_s'][0]):6.2f} s     deviations from the reference drawn x {EXAGGERATION:g}",
        f"deflection {1e3 * float(signals['deflection'][0]):+7.2f} mrad     "
        f"link error {1e3 * float(signals['link_error'][0]):+7.2f} mrad",
    ]


def _with_caption(image: npt.NDArray[np.uint8], lines: list[str]) -> npt.NDArray[np.uint8]:
    from PIL import Image, ImageDraw, ImageFont  # Pillow comes with Gymnasium's MuJoCo extra

    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(size=image.shape[0] // 28)
    for row, line in enumerate(lines):
        draw.text((12, 10 + row * image.shape[0] // 22), line, fill=(30, 34, 40), font=font)
    draw.text((12, image.shape[0] - 26), "rotor", fill=(38, 102, 217), font=font)
    draw.text((72, image.shape[0] - 26), "link", fill=(217, 115, 38), font=font)
    draw.text((120, image.shape[0] - 26), "reference", fill=(70, 140, 95), font=font)
    return np.asarray(picture)


def _display_spec(pendulum: Pendulum) -> mujoco.MjSpec:
    """A model for drawing only: three independent hinges, no dynamics."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.visual.global_.offwidth, spec.visual.global_.offheight = _WIDTH, _HEIGHT
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.15] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=_BACKGROUND, rgb2=_BACKGROUND, width=64, height=64,
    )  # fmt: skip
    reach = pendulum.com_distance
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    world = spec.worldbody
    world.add_light(
        pos=[0.3, -2.0, 2.0], dir=[-0.1, 0.8, -0.8], castshadow=False, diffuse=[0.45] * 3, specular=[0.1] * 3
    )
    world.add_camera(name="front", pos=[0.0, -2.25 * reach, -0.22 * reach], xyaxes=[1, 0, 0, 0, 0, 1], fovy=50)
    world.add_geom(name="housing", type=box, size=[0.07, 0.06, 0.09], pos=[0, 0.12, 0.02], rgba=_HOUSING_RGBA)
    world.add_geom(name="stand", type=box, size=[0.03, 0.03, 0.6], pos=[0, 0.2, -0.5], rgba=(0.72, 0.74, 0.77, 1))
    for name, y, rod, bob in (
        ("reference", 0.03, _REFERENCE_RGBA, _REFERENCE_RGBA),
        ("link", 0.0, _STEEL_RGBA, _LINK_RGBA),
    ):
        body = _hinged(world, name)
        body.add_geom(name=f"{name}_rod", type=box, size=[0.014, 0.008, reach / 2], pos=[0, y, -reach / 2], rgba=rod)
        body.add_geom(
            name=f"{name}_bob", type=cylinder, size=[0.09, 0.025, 0], pos=[0, y, -reach], zaxis=[0, 1, 0], rgba=bob
        )
    rotor = _hinged(world, "rotor")
    rotor.add_geom(name="rotor_disc", type=cylinder, size=[0.055, 0.01, 0], pos=[0, -0.03, 0], zaxis=[0, 1, 0],
                   rgba=_ROTOR_RGBA)  # fmt: skip
    rotor.add_geom(name="rotor_pointer", type=box, size=[0.005, 0.004, 0.36 * reach], pos=[0, -0.03, -0.36 * reach],
                   rgba=_ROTOR_RGBA)  # fmt: skip
    return spec


def _hinged(world: mujoco.MjsBody, name: str) -> mujoco.MjsBody:
    body = world.add_body(name=name, mass=1.0, inertia=[1.0] * 3, explicitinertial=True)
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, -1.0, 0.0])
    return body
