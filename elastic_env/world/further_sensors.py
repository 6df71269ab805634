"""Sensors beyond the standard set of a robot, observed where `sensors=[...]` names them.

| name | columns | unit | measures | error in `nominal`, none in `ideal` |
|---|---|---|---|---|
| `link_encoder` | a joint each | rad | q in whole counts of the motor's encoder | homing error as of the encoders |
| `joint_torque` | a joint each | N·m | torque of spring and damper on the link | noise 0.2, offset up to 0.5 |
| `accelerometer` | x, y, z | m/s² | specific force at the IMU, acceleration minus gravity | noise 0.0112 |

`link_imu` of a fixed robot of one joint is declared in `elastic_env.world.link_signals`.

The accelerometer has the noise of the 3DM-GX4-25, 1.0e-3 m/s²/√Hz (thormang3_imu_3dm_gx4, calib),
at half the control rate of 250 Hz. Noise and offset of the torque sensor are assumed: 0.2 and 0.5 %
of 100 N·m. Noise is drawn every control step, the offset every episode.
"""  # noqa: E501

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from elastic_env.core.episode_random import EpisodeRandom
from elastic_env.core.errors import require_known
from elastic_env.core.signals import Array, BoolArray, SignalGroup, SignalTable
from elastic_env.world.joint_signals import Mirrors
from elastic_env.world.noise_stream import NoiseStream
from elastic_env.world.scenario import Scenario
from elastic_env.world.sensors import angle_of_count, quantise


@dataclass(frozen=True)
class SensorInputs:
    """True quantities that sensors measure, one row per world.

    Attributes:
        q: Link angles, (num_worlds, n) [rad].
        joint_torque: Torque of spring and damper on the links, (num_worlds, n) [N·m].
        specific_force: Acceleration of the IMU minus gravity, in its frame, (num_worlds, 3) [m/s²];
            nan where no sensor measures it.
    """

    q: Array
    joint_torque: Array
    specific_force: Array


@dataclass(frozen=True)
class Sensor:
    """Declaration of a sensor, which defines its columns, noise, offset, delay and mirror image.

    Attributes:
        unit, meaning: Unit and meaning of its columns.
        truth: Measurement without error, (num_worlds, columns).
        axes: Names of its columns, and the sign of each in the mirror image; None for one column
            per joint.
        noise: Standard deviation [unit].
        offset: Half-width of an offset that is drawn per episode [unit].
        is_encoder: True for a sensor with whole counts and the homing error of the encoders.
    """

    unit: str
    meaning: str
    truth: Callable[[SensorInputs], Array]
    axes: Mirrors | None = None
    noise: float = 0.0
    offset: float = 0.0
    is_encoder: bool = False

    def group(self, name: str, joints: Mirrors) -> SignalGroup:
        """Columns of the sensor on a robot with these joints."""
        parts = self.axes or joints
        return SignalGroup.of(name, self.unit, self.meaning, parts, "measured")


SENSORS: Mapping[str, Sensor] = {
    "link_encoder": Sensor(
        "rad", "encoder on the link, q in whole counts", lambda truth: truth.q, is_encoder=True
    ),
    "joint_torque": Sensor(
        "N·m",
        "torque sensor on the link side of the spring",
        lambda truth: truth.joint_torque,
        noise=0.2,
        offset=0.5,
    ),
    "accelerometer": Sensor(
        "m/s²",
        "specific force at the IMU, in its frame",
        lambda truth: truth.specific_force,
        axes={"x": "same", "y": "opposite", "z": "same"},
        noise=1.0e-3 * np.sqrt(125.0),
    ),
}
"""Sensors by their names in `sensors=[...]`."""

ACCELEROMETER = "accelerometer"


def add_accelerometer(spec: mujoco.MjSpec, site: str) -> None:
    """Add the sensor of `specific_force` to a model at a site."""
    spec.add_sensor(
        name=ACCELEROMETER,
        type=mujoco.mjtSensor.mjSENS_ACCELEROMETER,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname=site,
    )


class FurtherSensors:
    """Further sensors of all worlds.

    Args:
        names: Names in `SENSORS`.
        joints: The robot's joints in order, and the sign of each angle in the mirror image; None
            for a robot without one.
        scenarios: Scenario of every world: `sensor_noise` scales noise and offset, and it defines
            the encoders' errors.
        counts_per_turn: Counts per turn of the encoders; None for continuous encoders.

    Raises:
        ConfigurationError: There is no such sensor.
    """

    def __init__(
        self,
        names: Sequence[str],
        joints: Mirrors,
        scenarios: Sequence[Scenario],
        counts_per_turn: int | None,
    ) -> None:
        require_known("sensor", names, SENSORS)
        self._sensors = {name: SENSORS[name] for name in names}
        n = len(scenarios)
        self._homing_rad = [scenario.homing_width_rad for scenario in scenarios]
        self._scale = np.array([[scenario.sensor_noise] for scenario in scenarios])
        has_counts = np.array([[scenario.encoder_counts] for scenario in scenarios])
        self._count_rad = angle_of_count(counts_per_turn) * has_counts
        groups = [sensor.group(name, joints) for name, sensor in self._sensors.items()]
        self.signals = SignalTable.of(groups).signals
        """Columns of the sensors in the observation, in order."""
        fields = [(group.name, np.float64, group.shape) for group in groups]
        self._noise = NoiseStream(n, np.dtype(fields)) if names else None  # pyright: ignore[reportArgumentType]
        self._offset = {group.name: np.zeros((n, *group.shape)) for group in groups}
        self._values = self._last_values = np.zeros((n, len(self.signals)))

    def restart(
        self, worlds: BoolArray, random: Sequence[EpisodeRandom], truth: SensorInputs
    ) -> None:
        """Draw the offsets of new episodes, and measure."""
        if self._noise is None:
            return
        for world in np.flatnonzero(worlds).tolist():
            for name, sensor in self._sensors.items():
                offset = self._offset[name][world]
                width = self._homing_rad[world]
                if not sensor.is_encoder:
                    width = self._scale[world] * sensor.offset
                offset[:] = width * random[world].robot.uniform(-1.0, 1.0, len(offset))
            self._noise.restart(world, random[world].noise())
        self.measure(worlds, truth)
        self._last_values = np.where(worlds[:, None], self._values, self._last_values)

    def measure(self, worlds: BoolArray, truth: SensorInputs) -> None:
        """Measure new values in some worlds; the other worlds keep their values."""
        if self._noise is None:
            return
        noise = self._noise.next(worlds)
        columns = []
        for name, sensor in self._sensors.items():
            value = sensor.truth(truth) + self._offset[name]
            noisy = value + self._scale * sensor.noise * noise[name]
            counts = self._count_rad
            columns.append(quantise(value, counts) if sensor.is_encoder else noisy)
        self._last_values = self._values
        self._values = np.where(worlds[:, None], np.hstack(columns), self._values)

    def columns(self, is_delayed: BoolArray) -> Array:
        """Return the measurements, (num_worlds, columns), one control step old if delayed."""
        return np.where(is_delayed[:, None], self._last_values, self._values)
