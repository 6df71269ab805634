"""The registered environment on hardware: measurements replace the truth.

The rules are those of `elastic_env/Testbed-v0`. These signals differ, because a real joint gives
only measurements:

| signal | here |
|---|---|
| `link_angle`, `link_error`, `deflection` | from the IMU, with its offset and noise; nan without one |
| `joint_torque` | from the motor current by a measured line: rough, and in motion the motor's, not the spring's |
| reward | its term `link_error` is by the IMU; nan without one |
| `truth()`, and with it the policy `oracle` | an error |

There are further signals: `jitter` [s], `period` [s], `overruns`, `missed_replies` and `limited`,
see `elastic_env.hardware.live.plant.CycleRecord`.
"""  # noqa: E501

import inspect
from functools import partial
from typing import Any, get_type_hints

import numpy as np
from gymnasium.vector import AutoresetMode

from elastic_env.core.errors import ConfigurationError, quote, require_known
from elastic_env.core.signals import BoolArray, Signals
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.live import ID
from elastic_env.hardware.live.plant import CycleRecord, ServoPlant
from elastic_env.hardware.settings import HardwareSettings
from elastic_env.joint.joint_names import JointAddresses
from elastic_env.robots.testbed.config import TestbedConfig
from elastic_env.robots.testbed.environment import configure_testbed
from elastic_env.robots.testbed.picture import TestbedPicture
from elastic_env.world.env import ElasticEnv
from elastic_env.world.joint_plant import JointTruth
from elastic_env.world.joint_task import JointTask
from elastic_env.world.link_signals import METRICS_OF_ONE
from elastic_env.world.metrics import Metric
from elastic_env.world.records import REAL, WHOLE, Records, record_type
from elastic_env.world.sensors import AttitudeSensor
from elastic_env.world.vector_env import ElasticVectorEnv

TIMING_METRICS = (
    Metric("jitter_rms_s", "jitter", "rms", over="all"),
    Metric("jitter_peak_s", "jitter", "peak", over="all"),
    Metric("overruns", "overruns", "max", over="all"),
    Metric("missed_replies", "missed_replies", "max", over="all"),
    Metric("limited", "limited", "max", over="all"),
)
_KINDS = {float: REAL, int: WHOLE}
_FIELDS = get_type_hints(CycleRecord).items()
_CYCLE = record_type(*((name, _KINDS[kind]) for name, kind in _FIELDS))
_LINK = JointTask.world_type
_OF_LINK = [(name, _LINK[name]) for name in _LINK.names or ()]


class HardwareTestbedTask(JointTask):
    """Rules of `elastic_env/HardwareTestbed-v0`.

    Args:
        config: Reference, assumed joint and pendulum; its scenario has no effect here.
        settings: Wiring, mounting and limits.
    """

    config: TestbedConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    world_type = record_type(*_OF_LINK, ("cycle", _CYCLE))

    def __init__(self, config: TestbedConfig, settings: HardwareSettings) -> None:
        # the IMU is read in every cycle
        period_s = config.control_period_s
        scenario = config.scenario.replace(imu=AttitudeSensor(rate_hz=1.0 / period_s))
        super().__init__(config.replace(scenario=scenario), num_worlds=1)
        self.metrics = (*METRICS_OF_ONE, *TIMING_METRICS)
        at = JointAddresses.of(self.model, self.assumed_model.joint_names)
        load_nm = config.pendulum.gravity_torque
        self.plant = ServoPlant(self.model, at, settings, period_s, load_nm)
        extent = config.reference.extent()
        limits = settings.limits
        if extent.lowest < limits.lowest_rad or extent.highest > limits.highest_rad:
            raise HardwareError(
                f"the reference {config.reference.kind!r} can reach {extent.lowest:.3f} to"
                f" {extent.highest:.3f} rad, the limits allow {limits.lowest_rad:g} to"
                f" {limits.highest_rad:g} rad; lower its amplitude or widen the limits"
            )

    def truth(self) -> JointTruth:
        """Refuse: there is no truth on hardware.

        Raises:
            HardwareError: Always.
        """
        raise HardwareError(
            "hardware has no truth: 'oracle' and scores by the true link need a simulation"
        )

    def _place(self, worlds: BoolArray) -> None:  # noqa: ARG002  there is one
        """Move the testbed to its start and let it settle under zero offset."""
        self.plant.begin(float(self._reference.motion[0, 0, 0, 0]))

    def _begin_worlds(self, worlds: BoolArray) -> None:
        super()._begin_worlds(worlds)
        self._keep_cycle()

    def _sense_worlds(self, control: tuple[Any, ...]) -> bool:
        """Sense as in simulation; after the last step, bring the pendulum to rest."""
        is_over = super()._sense_worlds(control)
        self._keep_cycle()  # before the way back to rest, which measures too
        if is_over:
            self.plant.finish()
        return is_over

    def _signals(self, joints: Records, worlds: Records) -> Signals:
        """Signals of a step, with those of its cycle."""
        timing = {name: worlds["cycle"][name].copy() for name in _CYCLE.names or ()}
        return {**super()._signals(joints, worlds), **timing}

    @property
    def _periods(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Control periods in the last step; several if a cycle was repeated."""
        periods = self.plant.record.period / self.config.control_period_s
        return float(np.rint(max(periods, 1.0)))

    def _keep_cycle(self) -> None:
        self._worlds[self._row]["cycle"] = tuple(self.plant.record)


SCENARIO = "hardware"
"""Name that tables of results have instead of a scenario."""
_SIMULATION_ONLY = ("form", "timestep_s")


def configure_hardware(port: Any = None, **arguments: Any) -> HardwareTestbedTask:
    """Task of `gymnasium.make("elastic_env/HardwareTestbed-v0", port=..., ...)`.

    Args:
        port: Port of the servo.
        **arguments: Arguments of `HardwareSettings`, and of `configure_testbed` of
            `elastic_env.robots.testbed.environment` except `form` and `timestep_s`; `scenario` can
            only be "hardware" or "nominal", and changes nothing.

    Raises:
        ConfigurationError: An argument is unknown, or a value or a combination is invalid.
    """
    if port is None:
        cure = "such as /dev/ttyUSB0; see: elastic hardware scan PORT"
        raise ConfigurationError(f"{ID} needs port, {cure}")
    fields = list(HardwareSettings.model_fields)
    parameters = inspect.signature(configure_testbed).parameters
    testbed_names = [name for name in parameters if name not in _SIMULATION_ONLY]
    require_known(f"argument of {ID}", arguments, [*fields, *testbed_names])
    scenario = arguments.pop("scenario", SCENARIO)
    if scenario not in (SCENARIO, "nominal"):
        raise HardwareError(
            f"scenarios are for simulations; hardware has none, got {quote(scenario)}"
        )
    settings = {name: arguments.pop(name) for name in fields if name in arguments}
    config = configure_testbed(scenario="ideal", **arguments)
    return HardwareTestbedTask(config, HardwareSettings(port=port, **settings))


def make(render_mode: str | None = None, **arguments: Any) -> ElasticEnv:
    """Make the environment; arguments as in `configure_hardware`."""
    task = configure_hardware(**arguments)
    picture = partial(TestbedPicture, task.config.pendulum)
    return ElasticEnv(task, render_mode, picture, task.plant)


def make_vector(
    num_envs: int = 1,
    num_threads: int = 0,  # noqa: ARG001  the same arguments as the other environments
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    **arguments: Any,
) -> ElasticVectorEnv:
    """Make the vector environment, of one world, so that the same programs run on hardware.

    Raises:
        ConfigurationError: More than one world.
    """
    if num_envs != 1:
        raise ConfigurationError(
            f"there is one testbed at a port: num_envs must be 1, got {quote(num_envs)}"
        )
    task = configure_hardware(**arguments)
    picture = partial(TestbedPicture, task.config.pendulum)
    return ElasticVectorEnv(task, 1, autoreset_mode, task.plant, render_mode, picture)
