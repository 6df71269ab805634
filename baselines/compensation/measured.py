r"""Link angles by sensors, instead of an output compensator.

| sensor | deflection | source |
|---|---|---|
| joint torque sensors | :math:`\delta = K^{-1} \tau_J` with the assumed K, for any load | [7], [12] of the paper |
| link encoders | :math:`\delta = \theta - q`, for any K and load | [10] of the paper, at the hips alone |

A policy sees θ − δ at once. The command must not lead by the measured δ at once: where both feet
stand, the legs form a closed chain, and δ changes by as much as the command. So the command leads
by the model's deflection, which `baselines.adaptation` corrects slowly by the measurements.
"""  # noqa: E501

from typing import Any, Self

import numpy as np
from typing_extensions import override

from baselines.compensation.compensators import OutputMethod, shallow_copy
from baselines.compensation.dynamic_compensator import DriveMemory, DynamicCompensator
from baselines.compensation.gravity_torque import GravityMethod
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, SignalTable
from elastic_env.world.robot_model import RobotModel

TORQUE_SENSOR = "joint_torque"
LINK_ENCODER = "link_encoder"


def require_sensor(table: SignalTable, sensor: str, group: str | None = None) -> None:
    """Refuse an observation without a sensor.

    Args:
        table: The observation.
        sensor: Its name in `gymnasium.make(..., sensors=[...])`.
        group: Name of its columns; None for the same.

    Raises:
        ConfigurationError: The observation does not have the sensor.
    """
    if (group or sensor) not in {name.split(".")[0] for name in table.names}:
        raise ConfigurationError(
            f"this policy reads {sensor}, which the environment does not have; make it"
            f" with sensors=[{sensor!r}]"
        )


class DeflectionSensors:
    """Deflections of joints by their sensors, see the module.

    Args:
        model: Assumed robot, whose observation has the sensor.
        sensor: "joint_torque" or "link_encoder".
        joints: Parts of the names of joints that have it.

    Attributes:
        has: True for joints that have it, (n,).
        are_torques: True where it measures torques, not link angles.
        modelled: 1 where δ follows from the assumed K, 0 where it does not, (n,) [1].

    Raises:
        ConfigurationError: The observation does not have the sensor.
    """

    def __init__(self, model: RobotModel, sensor: str, joints: Any = ("",)) -> None:
        table = model.observation_table
        require_sensor(table, sensor)
        self._stiffness = model.stiffness
        self.are_torques = sensor == TORQUE_SENSOR
        self._columns = table.group(sensor)
        self._encoder = table.group("encoder_angle")
        self.has: BoolArray = np.array(
            [any(part in name for part in joints) for name in model.joint_names]
        )
        self.modelled: Array = np.where(self.has & (sensor == LINK_ENCODER), 0.0, 1.0)

    def deflection(self, rows: Array) -> Array:
        """δ = θ − q of observations, (num_worlds, n) [rad]; 0 where a joint has no sensor."""
        measured = rows[:, self._columns]
        if self.are_torques:
            return self.has * (measured / self._stiffness)
        return self.has * (rows[:, self._encoder] - measured)


class MeasuredCompensator(DynamicCompensator):
    """A compensator that takes link angles from sensors where there are any.

    Args:
        model: Assumed robot.
        sensors: Sensors of the joints; the model gives the links of other joints, and all rates.
        output: Argument of `DynamicCompensator`.
        method: Argument of `DynamicCompensator`.
    """

    def __init__(
        self,
        model: RobotModel,
        sensors: DeflectionSensors,
        output: OutputMethod,
        method: GravityMethod | None = None,
    ) -> None:
        super().__init__(model, output, method)
        self._sensors = sensors
        self.modelled = sensors.modelled
        self.weighs = self.weighs or sensors.are_torques
        self._measures_all = bool(sensors.has.all())
        self._deflection: Array = np.zeros(len(model.joint_names))

    @override
    def at(self, rows: Array) -> Self:
        compensator = shallow_copy(super().at(rows))
        compensator._deflection = self._sensors.deflection(rows)
        return compensator

    @override
    def link_angle(self, theta: Array, memory: DriveMemory) -> Array:
        measured = theta - self._deflection
        if self._measures_all:
            return measured
        return np.where(self._sensors.has, measured, super().link_angle(theta, memory))
