"""What a robot measures: motor encoders with counts, an attitude sensor with noise, bias and a rate of its own."""

from typing import Any

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.core.state import Stateful


class AttitudeSensor(Model):
    """IMU attitude of one axis: bias, white noise, and a sample rate below or at the control rate."""

    noise_rad: float = quantity("rad", 0.0, ge=0, description="standard deviation of the white noise")
    bias_rad: float = quantity("rad", 0.0, description="constant offset")
    bias_spread_rad: float = quantity("rad", 0.0, ge=0, description="half-width of a further offset, drawn per episode")
    sine_error_rad: float = quantity("rad", 0.0, description="amplitude of an error proportional to sin(angle)")
    rate_hz: float = quantity("Hz", 100.0, gt=0, description="sample rate; the value is held in between")

    @property
    def is_random(self) -> bool:
        """Whether it measures the same motion differently from episode to episode."""
        return self.noise_rad > 0.0 or self.bias_spread_rad > 0.0


def quantise(angle: Array, counts_per_turn: int | None) -> Array:
    """Angle of an encoder with whole counts [rad]; None leaves the angle as it is."""
    return in_whole_counts(angle, angle_of_count(counts_per_turn))


def angle_of_count(counts_per_turn: int | None) -> float:
    """One count of an encoder [rad]; 0 for one without counts."""
    return 0.0 if counts_per_turn is None else 2.0 * np.pi / counts_per_turn


def in_whole_counts(angle: Array, count_rad: float) -> Array:
    """The nearest whole counts of an encoder, as an angle [rad]; counts of 0 leave it as it is."""
    return np.rint(angle / count_rad) * count_rad if count_rad > 0.0 else angle


def attitude(sensor: AttitudeSensor, angle: Array, drawn_bias: Array, noise: Array) -> Array:
    """Measured angle of the attitude sensor.

    Args:
        sensor: Its parameters.
        angle: True angle, (...) [rad].
        drawn_bias: Further offset of this episode, (...) [rad].
        noise: Standard normal samples, (...) [1].

    Returns:
        (...) [rad].
    """
    return shown_angle(angle, drawn_bias, noise, sensor.noise_rad, sensor.bias_rad, sensor.sine_error_rad)


def shown_angle(
    angle: Array, drawn_bias: Array, noise: Array, noise_rad: float, bias_rad: float, sine_error_rad: float
) -> Array:
    """What an attitude sensor shows of an angle, with the parameters of `AttitudeSensor` [rad]."""
    return angle + drawn_bias + noise_rad * noise + (bias_rad + sine_error_rad * np.sin(angle))


def is_due(step: IntArray, rate_hz: float, control_period_s: float) -> BoolArray:
    """Whether a sensor of its own rate delivers a new sample at a control step, (n,).

    Step 0, the start of an episode, always does; a sensor faster than the control loop does at every step.
    """
    samples_per_step = rate_hz * control_period_s
    # the small shift keeps a rate that divides the control rate exact in floating point
    return (step == 0) | (np.floor(step * samples_per_step + 1e-9) > np.floor((step - 1) * samples_per_step + 1e-9))


class NoiseStream(Stateful):
    """Standard normal samples, one independent stream per world, drawn in blocks.

    World i's samples depend on its generator and on how many it has used, never on the other worlds.

    Args:
        num_worlds: How many.
        kind: Structured type of a sample, of real numbers alone.
        block: Samples that are drawn at once.
    """

    STATE = ("_samples", "_used", "_most_used", "_generators")

    def __init__(self, num_worlds: int, kind: np.dtype[Any], block: int = 250) -> None:
        # samples of a time are neighbours in memory: worlds mostly use theirs together
        self._samples = np.zeros((block, num_worlds), kind)
        self._used, self._world = np.zeros(num_worlds, dtype=np.int64), np.arange(num_worlds)
        self._most_used = 0
        self._generators: list[np.random.Generator] = [np.random.default_rng(0) for _ in range(num_worlds)]

    def restart(self, world: int, generator: np.random.Generator) -> None:
        """Begin a new stream for one world."""
        self._generators[world] = generator
        self._refill(world)

    def next(self, worlds: BoolArray) -> Any:
        """The next sample of some worlds, (num_worlds,); the rows of the others are not to be used."""
        samples, used = self.ready()
        sample = samples[np.minimum(used, len(samples) - 1), self._world]
        used += worlds
        return sample

    def ready(self) -> tuple[Any, IntArray]:
        """Samples ahead, at least one of each world, for one step.

        Returns:
            (block, num_worlds), and how many of each world's are used, (num_worlds,): its next one has that number, and
            counting it is for the caller.
        """
        block = len(self._samples)
        if self._most_used >= block:
            for world in np.flatnonzero(self._used == block):
                self._refill(int(world))
            self._most_used = int(self._used.max())
        self._most_used += 1
        return self._samples, self._used

    def _refill(self, world: int) -> None:
        kind = self._samples.dtype
        drawn = self._generators[world].standard_normal((len(self._samples), kind.itemsize // 8))
        self._samples[:, world] = drawn.view(kind)[:, 0]
        self._used[world] = 0
