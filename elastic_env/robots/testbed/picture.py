"""Picture of the testbed, with enlarged deviations: x is drawn at q_ref + factor · (x − q_ref).

The translucent pendulum is the reference, the solid one the link, the blue pointer the rotor.
"""

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from elastic_env.rendering import deviation_picture
from elastic_env.rendering.deviation_picture import DeviationPicture, enlarge_deviation
from elastic_env.rendering.picture import set_stage
from elastic_env.rendering.side_by_side import DisplayRobot, Sides
from elastic_env.robots.testbed.model import Pendulum

_SHAPES = Path(__file__).with_suffix(".xml").read_text(encoding="utf-8")
_LEGEND_GEOMS = {"rotor": "rotor_disc", "link": "link_bob"}
"""Words of the legend, and the shapes with their colours."""


class TestbedPicture(DeviationPicture):
    """The testbed of Fig. 4: housing, rotor pointer, pendulum, and a translucent reference."""

    __test__ = False

    def __init__(self, pendulum: Pendulum) -> None:
        spec = _display_spec(pendulum)
        _add_light(spec)
        set_stage(spec, deviation_picture.WIDTH, deviation_picture.HEIGHT)
        colours = {word: spec.geom(name).rgba for word, name in _LEGEND_GEOMS.items()}
        colours["reference"] = deviation_picture.REFERENCE_WORD_RGBA
        super().__init__(spec, [*colours.items()])
        self._pendulum = pendulum

    def display_robot(self) -> DisplayRobot:
        """Return the robot of a side-by-side picture."""
        spec = _display_spec(self._pendulum)
        for element in (spec.body("reference"), spec.body("rotor"), *spec.cameras):
            spec.delete(element)
        right = (1.6 * self._pendulum.com_distance, 0.0, 0.0)
        return DisplayRobot(spec, ["link"], right, dress=_add_light)

    def sides(self, now: Mapping[str, float], world: int = 0) -> Sides:  # noqa: ARG002
        """Return reference, motor side and link side of a world."""
        link = now["link_angle"]
        angles = (now["reference_angle"], link + now["deflection"], link)
        return Sides(*(np.array([angle]) for angle in angles))

    def _pose(self, now: dict[str, float], world: int) -> None:  # noqa: ARG002
        reference = now["reference_angle"]
        link = now["link_angle"]
        rotor = link + now["deflection"]
        self._data.joint("reference").qpos = reference
        self._data.joint("link").qpos = enlarge_deviation(link, reference)
        self._data.joint("rotor").qpos = enlarge_deviation(rotor, reference)


def _display_spec(pendulum: Pendulum) -> mujoco.MjSpec:
    """Make a model for pictures only: three independent hinges, no dynamics."""
    reach = pendulum.com_distance
    half = 0.36 * reach
    lengths = {"half_rod": reach / 2, "rod": -reach / 2, "bob": -reach}
    lengths |= {"eye_y": -2.25 * reach, "eye_z": -0.22 * reach}
    lengths |= {"pointer": half, "pointer_place": -half}
    return mujoco.MjSpec.from_string(_SHAPES.format(**lengths))


def _add_light(spec: mujoco.MjSpec) -> None:
    light = spec.worldbody.add_light(pos=[0.3, -2.0, 2.0], dir=[-0.1, 0.8, -0.8])
    light.castshadow = False
    light.diffuse = [0.45] * 3
    light.specular = [0.1] * 3
