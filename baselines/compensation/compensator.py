"""Protocol of a compensator: offsets of commands, and estimates of link angles."""

from abc import abstractmethod
from typing import Any, Protocol

from baselines.compensation.policy import Motion
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import RobotModel


class Compensator(Protocol):
    """An input offset for a motion, and a link angle for an encoder angle, for `Compensated`.

    `memory` has one row per world: an array, or a named tuple of arrays.
    """

    model: RobotModel
    modelled: float | Array = 1.0
    """1 where its link angles follow from the model, 0 where sensors measure them; a number, or
    (n,) [1].
    """
    weighs: bool = False
    """True where its link angles show a load that the model does not have."""

    @abstractmethod
    def at(self, rows: Array) -> "Compensator":
        """Compensator for the loads at the control steps of observations, (num_worlds, m)."""

    @abstractmethod
    def begin(self, motion: Motion) -> Any:
        """Memory at rest at the start of an episode."""

    @abstractmethod
    def offset(self, motion: Motion, memory: Any) -> tuple[Array, Any]:
        """Command offset for the coming control period, (num_worlds, n) [rad], and new memory."""

    @abstractmethod
    def deflection(self, offset: Array, memory: Any) -> Array:
        """Deflection δ within an offset that `offset` returned, (num_worlds, n) [rad]."""

    @abstractmethod
    def link_angle(self, theta: Array, memory: Any) -> Array:
        """Estimate of q from the encoders, (num_worlds, n) [rad]."""

    @abstractmethod
    def link_rate(self, theta: Array, theta_dot: Array) -> Array:
        """Estimate of q̇ from the encoders, (num_worlds, n) [rad/s]."""
