r"""Published compensation of flexible hips of TALOS: hip rolls lead by their torque.

The measured torque of each hip roll passes a first-order low-pass, is divided by K, bounded,
limited in its rate, and added to the command:

.. math:: \Delta = \mathrm{rate}\big(\mathrm{clip}(\bar\tau_J / K, \pm\Delta_{max}), \pm\dot\Delta_{max}\big), \quad
          \bar\tau_k = \alpha \bar\tau_{k-1} + (1 - \alpha) \tau_k, \quad \alpha = e^{-2 \pi f T}

In double support the value before the rate limit is zero, as in the published entity with its phase
input connected. The joint torque is positive along q, so the motor leads by the deflection that
belongs to it.

The published entity reads the joint torque sensors of TALOS, and divides by 973.2 N·m/rad, the
flexibility that was measured on that robot. Ours reads the sensor `joint_torque`, and divides by
the K that is assumed of this robot.

Source: loco-3d/sot-talos-balance, src/hip-flexibility-compensation.cpp (method);
src/dynamic_graph/sot_talos_balance/ talos/hip_flexibility_compensation_conf.py (1 Hz, 0.01 rad,
0.003 rad/s); create_entities_utils.py (torque sensors).
"""  # noqa: E501

from typing import Any, NamedTuple

import numpy as np
from typing_extensions import override

from baselines.compensation.measured import TORQUE_SENSOR, require_sensor
from baselines.compensation.policy import PolicyInputs, Step
from baselines.compensation.policy_around import PolicyAround
from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import WalkerModel

_HIP_ROLLS = [1, 7]  # of twelve joints, left and right


class HipTorqueGains(Model):
    """Hip roll by its measured torque; the defaults are the published values."""

    cutoff_hz: float = quantity("Hz", 1.0, gt=0)
    """Cut-off frequency of the torque's low-pass [Hz]."""
    limit_rad: float = quantity("rad", 0.01, gt=0)
    """Largest offset [rad]."""
    rate_rad_s: float = quantity("rad/s", 0.003, gt=0)
    """Largest rate of the offset [rad/s]."""
    in_double_support: bool = False
    """True to act also in double support, as the published entity does without its phase input."""


def low_pass(before: Array, value: Array, cutoff_hz: float, period_s: float) -> Array:
    """Output of a first-order low-pass after one more sample, elementwise."""
    decay = np.exp(-2.0 * np.pi * cutoff_hz * period_s)
    return decay * before + (1.0 - decay) * value


def limit_rate(before: Array, value: Array, rate: float, period_s: float) -> Array:
    """Value, or as near to it as a rate [1/s] allows after one period, elementwise."""
    return before + np.clip(value - before, -rate * period_s, rate * period_s)


class HipTorqueMemory(NamedTuple):
    """Memory of `HipTorque`.

    Attributes:
        torque: Filtered torques of both hip rolls, (num_worlds, 2) [N·m].
        offset: Their offsets, (num_worlds, 2) [rad].
        inner: Memory of the policy.
    """

    torque: Array
    offset: Array
    inner: Any


class HipTorque(PolicyAround):
    """Any policy of a walker whose hip rolls lead by their measured torque, see the module.

    Args:
        policy: Commands the robot.
        model: Assumed walker, whose observation has the joint torque sensors.
        gains: Filter, bound and rate limit.

    Raises:
        ConfigurationError: The observation does not have the sensors.
    """

    def __init__(self, policy: Any, model: WalkerModel, gains: HipTorqueGains) -> None:
        super().__init__(policy, model)
        table = model.observation_table
        require_sensor(table, TORQUE_SENSOR)
        self._gains = gains
        self._dt = model.control_period_s
        self._clock = table.group("clock")
        self._torque = table.group(TORQUE_SENSOR)
        self._stiffness = model.stiffness[_HIP_ROLLS]

    @override
    def begin(self, rows: Array) -> HipTorqueMemory:
        torque = rows[:, self._torque][:, _HIP_ROLLS]
        return HipTorqueMemory(torque, np.zeros_like(torque), self.policy.begin(rows))

    @override
    def act(self, rows: Array, memory: HipTorqueMemory, inputs: PolicyInputs) -> Step:
        gains = self._gains
        action, inner = self.policy.act(rows, memory.inner, inputs)
        measured = rows[:, self._torque][:, _HIP_ROLLS]
        torque = low_pass(memory.torque, measured, gains.cutoff_hz, self._dt)
        wanted = np.clip(torque / self._stiffness, -gains.limit_rad, gains.limit_rad)
        if not gains.in_double_support:
            swing = rows[:, self._clock][:, [1]]
            wanted = np.where((swing > 0.0) & (swing < 1.0), wanted, 0.0)
        offset = limit_rate(memory.offset, wanted, gains.rate_rad_s, self._dt)
        total = action.astype(np.float64)
        total[:, _HIP_ROLLS] += offset
        return total.astype(np.float32), HipTorqueMemory(torque, offset, inner)
