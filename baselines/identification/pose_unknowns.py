"""Unknowns of an arm in static poses, as slices of one vector."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from baselines.identification.pose_log import PoseLog
from elastic_env.core.signals import IntArray

Frame = Literal["known", "offset", "pose"]
"""Knowledge of the measurement's frame: all, its directions, or nothing."""


@dataclass(frozen=True)
class PoseUnknowns:
    """Order of the unknowns in one vector: c, o, F of the elastic joints, m, then the frame.

    Attributes:
        elastic: Indices of the joints whose stiffness is estimated, (k,).
        friction: True if F is unknown.
        payload: True if m is unknown.
        translation: True if the frame's origin is unknown.
        rotation: True if the frame's directions are unknown.
    """

    elastic: IntArray
    friction: bool
    payload: bool
    translation: bool
    rotation: bool

    @classmethod
    def from_log(
        cls, log: PoseLog, elastic: Sequence[str], frame: Frame, payload: bool
    ) -> "PoseUnknowns":
        """The unknowns that a log needs."""
        return cls(
            elastic=np.array([log.joints.index(joint) for joint in elastic], dtype=np.int64),
            friction=log.direction is not None,
            payload=payload,
            translation=log.kind == "end_effector" and frame != "known",
            rotation=(log.kind == "end_effector" and frame == "pose")
            or (log.kind == "imu" and frame != "known"),
        )

    def frame_alone(self) -> "PoseUnknowns":
        """The unknowns of the frame, which a rigid arm has too."""
        none = np.empty(0, dtype=np.int64)
        return replace(self, elastic=none, friction=False, payload=False)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Part of the vector for each kind of unknown."""
        k = len(self.elastic)
        sizes = {
            "compliance": k,
            "offset": k,
            "friction": k * self.friction,
            "payload": int(self.payload),
            "translation": 3 * self.translation,
            "rotation": 3 * self.rotation,
        }
        ends = np.cumsum(list(sizes.values()))
        return {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.slices["rotation"].stop
