"""The testbed task on hardware: the rules of `elastic_env/Testbed-v0`, with measurements in the place of the truth.

What differs, because a real joint does not tell it:

| signal | here |
|---|---|
| `link_angle`, `link_error`, `deflection` | from the IMU, with its offset and noise; nan without one |
| `joint_torque` | from the motor current by a measured line: rough, and in motion the motor's, not the spring's |
| reward | its term `link_error` is by the IMU; nan without one |
| `truth()`, and with it the policy `oracle` | an error |

Beside the signals of the simulation stand `jitter` [s], `period` [s], `overruns`, `missed_replies` and `limited`, see
`elastic_env.hardware.live.plant.CycleTiming`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from elastic_env.core.draws import Draws
from elastic_env.core.signals import Array, BoolArray, IntArray, Signals
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live.plant import ServoPlant
from elastic_env.hardware.settings import HardwareSettings
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.task import TestbedTask
from elastic_env.runtime.joint_task import METRICS_OF_ONE, JointSample, JointTruth, Measurement
from elastic_env.runtime.metrics import Metric
from elastic_env.runtime.physics import Simulation
from elastic_env.runtime.task import Outcome

TIMING_METRICS = (
    Metric("jitter_rms_s", "jitter", "rms", over="all"),
    Metric("jitter_peak_s", "jitter", "peak", over="all"),
    Metric("overruns", "overruns", "max", over="all"),
    Metric("missed_replies", "missed_replies", "max", over="all"),
    Metric("limited", "limited", "max", over="all"),
)


@dataclass(frozen=True, slots=True)
class HardwareSample(JointSample):
    """What a step is scored by, and how well its period was kept, (1,) each."""

    motor_torque: Array
    jitter_s: Array
    period_s: Array
    overruns: IntArray
    missed_replies: IntArray
    limited: IntArray


class HardwareTestbedTask(TestbedTask):
    """Rules of `elastic_env/HardwareTestbed-v0`.

    Args:
        config: Reference, assumed joint and pendulum; its scenario says nothing here.
        settings: Wiring, mounting and limits.
    """

    def __init__(self, config: TestbedConfig, settings: HardwareSettings) -> None:
        super().__init__(config, num_worlds=1)
        self.metrics: Sequence[Metric] = (*METRICS_OF_ONE, *TIMING_METRICS)
        self.plant = ServoPlant(self.model, self._at, settings, config.control_period_s, config.pendulum.gravity_torque)
        self._read_plant()
        extent, limits = config.reference.extent(), settings.limits
        if extent.lowest < limits.lowest_rad or extent.highest > limits.highest_rad:
            raise HardwareError(
                f"the reference {config.reference.kind!r} can reach {extent.lowest:.3f} to {extent.highest:.3f} rad, "
                f"the limits allow {limits.lowest_rad:g} to {limits.highest_rad:g} rad; lower its amplitude or widen "
                "the limits"
            )

    def restart(self, simulation: Simulation, worlds: BoolArray, draws: Sequence[Draws]) -> None:
        """Drive the testbed to its start and let it settle under zero offset."""
        self._reference.draw(0, draws[0].robot)
        self._step = np.zeros(1, dtype=np.int64)
        self._offset, self._offset_before = np.zeros((2, 1, 1))
        self._follow()
        self._command = self._present.q.copy()
        self.plant.begin(float(self._command[0, 0]))
        self._read(simulation, worlds)
        self._read_plant()
        theta, q = self._state.theta, self._state.q
        at_rest = Measurement(theta, theta, q)
        self._measured = self._shown = at_rest

    def sense(self, simulation: Simulation, diverged: BoolArray) -> Outcome:
        """Take the new measurements; behind the last step the pendulum is brought to rest."""
        self._read_plant()  # before the way back to rest, which measures too
        outcome = super().sense(simulation, diverged)
        if outcome.is_over:
            self.plant.finish()
        return outcome

    def sample(self) -> HardwareSample:
        """See `TestbedTask`."""
        measured = super().sample()
        return HardwareSample(
            *(getattr(measured, field.name) for field in fields(JointSample)),
            motor_torque=self._motor_torque.copy(),
            **{name: np.array([value]) for name, value in vars(self._timing).items()},
        )

    def signals(self, sample: JointSample) -> Signals:
        """See `TestbedTask`, and the table of the module."""
        assert isinstance(sample, HardwareSample)
        return {
            **super().signals(sample),
            "joint_torque": sample.motor_torque.copy(),
            "jitter": sample.jitter_s.copy(),
            "period": sample.period_s.copy(),
            "overruns": sample.overruns.copy(),
            "missed_replies": sample.missed_replies.copy(),
            "limited": sample.limited.copy(),
        }

    def truth(self) -> JointTruth:
        """There is none on hardware.

        Raises:
            HardwareError: Always.
        """
        raise HardwareError("hardware has no truth: the policy 'oracle' and scores by the true link need a simulation")

    def _read_plant(self) -> None:
        self._motor_torque, self._timing = self.plant.motor_torque.copy(), self.plant.timing

    def _measure(self, worlds: BoolArray) -> Measurement:  # noqa: ARG002  there is one
        """The encoder's change is that of a control period also where a cycle had to be repeated."""
        theta, q = self._state.theta, self._state.q
        change = theta - self._measured.encoder
        periods = max(self.plant.timing.period_s / self.config.control_period_s, 1.0)
        return Measurement(theta, theta - change / np.rint(periods), q)
