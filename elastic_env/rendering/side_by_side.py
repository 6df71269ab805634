"""Scene of a robot three times side by side: reference, motor side and link side.

Deviations from the reference are enlarged: a joint is drawn at q_ref + factor · (x − q_ref), where
x is the angle of the motor or of the link. A floating base deviates from its planned pose by factor
times its true deviation. The motor side has the planned base, as an encoder does not measure where
the robot is.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import mujoco
import numpy as np

from elastic_env.core.signals import Array
from elastic_env.rendering.picture import paint, set_stage

REFERENCE, MOTOR, LINK = COPIES = ("reference_", "motor_", "link_")
"""Prefixes of the names of the three robots, from left to right."""

_REFERENCE_RGBA = (0.40, 0.72, 0.50, 1.0)
_MOTOR_RGBA = (0.30, 0.50, 0.85, 1.0)
_SIZE = 720
_ELEVATION_DEG = -15.0


@dataclass(frozen=True)
class DisplayRobot:
    """Display model of one robot.

    Attributes:
        spec: Its bodies, without floor and light.
        joints: Names of its joints, in the order of `Sides`.
        right: Place of the next robot, from this one [m], (3,).
        base: Name of its free joint; None for a robot on a fixed base.
        dress: Adds floor and light to the scene.
    """

    spec: mujoco.MjSpec
    joints: Sequence[str]
    right: tuple[float, float, float]
    base: str | None = None
    dress: Callable[[mujoco.MjSpec], None] = field(default=lambda _: None)


@dataclass(frozen=True)
class Sides:
    """Angles and base of a robot at one time.

    Attributes:
        q_ref, theta, q: Reference, motor side and link side, (n,) [rad].
        base_ref, base: Planned and true pose of a floating base, position [m] and quaternion, (7,);
            empty without one.
    """

    q_ref: Array
    theta: Array
    q: Array
    base_ref: Array = field(default_factory=lambda: np.empty(0))
    base: Array = field(default_factory=lambda: np.empty(0))


class HasSides(Protocol):
    """A picture whose robot can be drawn side by side."""

    def display_robot(self) -> DisplayRobot:
        """Return the robot's display model."""
        ...

    def sides(self, now: Mapping[str, float], world: int = 0) -> Sides:
        """Return its angles and base, from the present signals of a world."""
        ...


def enlarged_pose(planned: Array, true: Array, factor: float) -> Array:
    """Return a pose that deviates from the planned one by a factor times the true deviation, (7,).

    Args:
        planned: Position [m] and quaternion, (7,).
        true: True position and quaternion, (7,).
        factor: 0 gives the planned pose, 1 the true one.
    """
    turn = np.empty(3)
    quaternion = planned[3:].copy()
    mujoco.mju_subQuat(turn, true[3:], planned[3:])
    mujoco.mju_quatIntegrate(quaternion, turn, factor)
    return np.concatenate([planned[:3] + factor * (true[:3] - planned[:3]), quaternion])


class SideBySide:
    """The model of three robots, and their sides.

    Args:
        robot: Robot that is drawn three times.

    Attributes:
        model: Compiled for drawing, never stepped.
    """

    def __init__(self, robot: DisplayRobot) -> None:
        spec = mujoco.MjSpec()
        set_stage(spec, _SIZE, _SIZE)
        for name in ("cone", "impratio", "integrator"):  # attaching needs equal options
            setattr(spec.option, name, getattr(robot.spec.option, name))
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        robot.dress(spec)
        # the camera sees the robots from left to right
        forward = np.cross([0.0, 0.0, 1.0], robot.right)
        azimuth = np.degrees(np.arctan2(forward[1], forward[0]))
        spec.visual.global_.azimuth = float(azimuth)
        spec.visual.global_.elevation = _ELEVATION_DEG
        right = np.array(robot.right)
        self._offsets = {REFERENCE: -right, MOTOR: 0.0 * right, LINK: right}
        colours = {REFERENCE: _REFERENCE_RGBA, MOTOR: _MOTOR_RGBA, LINK: None}
        for copy, rgba in colours.items():
            spec_copy = robot.spec.copy()
            if rgba is not None:
                paint(spec_copy, rgba)
            frame = spec.worldbody.add_frame(pos=self._offsets[copy])
            spec.attach(spec_copy, prefix=copy, frame=frame)
        self.model = spec.compile()
        self._robot = robot

    def pose(self, data: mujoco.MjData, sides: Sides, factor: float) -> None:
        """Bring the three robots into their postures.

        Args:
            data: State of `model`; only positions are written.
            sides: Angles and base of the robot.
            factor: Factor by which deviations from the reference are enlarged.
        """
        bases = {REFERENCE: sides.base_ref, MOTOR: sides.base_ref, LINK: sides.base}
        angles_of = {REFERENCE: sides.q_ref, MOTOR: sides.theta, LINK: sides.q}
        for copy, angles in angles_of.items():
            drawn = sides.q_ref + factor * (angles - sides.q_ref)
            for name, angle in zip(self._robot.joints, drawn, strict=True):
                data.joint(copy + name).qpos = angle
            if self._robot.base is not None:
                pose = enlarged_pose(sides.base_ref, bases[copy], factor)
                pose[:3] += self._offsets[copy]
                data.joint(copy + self._robot.base).qpos = pose
