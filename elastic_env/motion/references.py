"""Reference trajectories of the testbed: static positions, sine, multisine, steps.

A reference is a validated model. Its method `plan` returns samples at the control rate, with rate
and acceleration in closed form. Every plan begins with a second of standing, in which policies ramp
in, and moves by quintic (minimum-jerk) polynomials, which start and end without acceleration.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.random import Generator
from pydantic import Field
from typing_extensions import override

from elastic_env.core.config import LARGEST_SEED, Model, quantity
from elastic_env.core.errors import ConfigurationError, unknown_name
from elastic_env.core.signals import Array, IntArray
from elastic_env.motion import trajectory
from elastic_env.motion.trajectory import STAND_S, Extent, Plan, quintic

_LONGEST_SUM_S = 36_000.0


class RepeatableReference(Model):
    """A reference whose plans repeat, unless it has a field `seed` that is None."""

    @property
    def is_random(self) -> bool:
        """True if every episode has a plan of its own."""
        return getattr(self, "seed", 0) is None

    def choose_generator(self, generator: Generator) -> Generator:
        """Return a generator of the reference's seed, or the given one without a seed."""
        seed: int | None = getattr(self, "seed", None)
        return generator if seed is None else np.random.default_rng(seed)


class _JointReference(RepeatableReference):
    """A motion of one joint."""

    def plan(self, generator: Generator, control_period_s: float) -> Plan:
        """Make a plan by the draws of a generator, or of the reference's own seed."""
        raise NotImplementedError

    def extent(self) -> Extent:
        """Return bounds over all its plans."""
        raise NotImplementedError

    def plan_about(self, home: Array, generator: Generator, period_s: float) -> Plan:
        """Make a plan of joints that all follow the reference about their home, (n,) [rad].

        If the reference is random, each joint has a plan of its own.
        """
        first = self.plan(generator, period_s)
        plans = [first] * len(home)
        if self.is_random:
            plans[1:] = [self.plan(generator, period_s) for _ in plans[1:]]
        motions = [(plan.q, plan.q_dot, plan.q_ddot) for plan in plans]
        q, q_dot, q_ddot = np.stack(motions, axis=-1)
        return Plan(q + home, q_dot, q_ddot, first.scored, first.rest)


class Hold(_JointReference):
    """The paper's static positions, evenly spaced in gravity torque.

    They are approached from below and then from above.

    Without compensation the link sags below its reference; the references lie so far beyond the
    positions that the uncompensated link rests at evenly spaced torques.

    The sweep starts below the first position and turns round beyond the last, so that every
    position is reached from both sides. Moves are slow: a link that overshoots would lose the
    friction's hysteresis, which the experiment shows.
    """

    kind: Literal["hold"] = "hold"
    positions: int = quantity("1", 20, ge=2, le=1000)
    """Number of static positions [1]."""
    lower: float = quantity("1", -0.875, gt=-1, lt=1)
    """First position, share of the torque at the horizontal [1]."""
    upper: float = quantity("1", 34.6 / 60, gt=-1, lt=1)
    """Last position, likewise [1]."""
    rate: float = quantity("rad/s", 0.06, gt=0)
    """Peak rate of the moves [rad/s]."""
    sag: float = quantity("rad", 60 / 1001, ge=0)
    """Deflection at the horizontal without compensation [rad]."""
    shortest_move_s: float = quantity("s", 4.0, gt=0, le=3600)
    """Shortest move; quick ones ring [s]."""
    settle_s: float = quantity("s", 1.5, ge=0, le=3600)
    """Time at rest before the measurement [s]."""
    measure_s: float = quantity("s", 0.5, gt=0, le=3600)
    """Time of the measurement [s]."""
    overrun: float = quantity("rad", 0.08, gt=0)
    """Distance outside the positions at which the sweep starts and turns [rad]."""

    def _check(self) -> None:
        if self.upper <= self.lower:
            got = f"got lower {self.lower} and upper {self.upper}"
            raise ValueError(f"upper must exceed lower, {got}")

    @property
    def angles(self) -> Array:
        """References of the static positions, (positions,) [rad], for τ_g proportional to sin q."""
        shares = np.linspace(self.lower, self.upper, self.positions)
        return np.arcsin(shares) + self.sag * shares

    @property
    def visits(self) -> tuple[Array, IntArray]:
        """Angle [rad] of each rest, and +1 if approached from below, else −1."""
        angles = self.angles
        directions = np.repeat(np.array([1, -1]), len(angles))
        return np.concatenate([angles, angles[::-1]]), directions

    @override
    def extent(self) -> Extent:
        angles = self.angles
        distances = np.append(np.diff(angles), self.overrun)
        durations = np.array([self._move_s(distance) for distance in distances])
        return Extent(
            float(angles[0]) - self.overrun,
            float(angles[-1]) + self.overrun,
            q_dot=trajectory.QUINTIC_PEAK_RATE * float((distances / durations).max()),
            q_ddot=trajectory.QUINTIC_PEAK_ACCELERATION * float((distances / durations**2).max()),
        )

    def _move_s(self, distance: float) -> float:
        """Return the duration of a move over a distance [rad]."""
        return max(trajectory.QUINTIC_PEAK_RATE * distance / self.rate, self.shortest_move_s)

    @override
    def plan(self, generator: Generator, control_period_s: float) -> Plan:
        angles, _ = self.visits
        start = angles[0] - self.overrun
        targets = np.insert(angles, self.positions, self.angles[-1] + self.overrun)
        moves = []
        windows = []
        time = STAND_S
        for number, distance in enumerate(np.abs(np.diff(targets, prepend=start))):
            duration = self._move_s(distance)
            moves.append((time, duration, targets[number]))
            time = time + duration
            if number != self.positions:  # the target of this number is the turn
                begin = time + self.settle_s
                time = begin + self.measure_s
                windows.append((begin, time))
        t = trajectory.control_times(time, control_period_s)
        q, q_dot, q_ddot = trajectory.quintic_moves(t, start, moves)
        rest = np.full(len(t), -1)
        for visit, (begin, end) in enumerate(windows):
            rest[(t > begin) & (t <= end + 1e-9)] = visit
        return Plan(q, q_dot, q_ddot, rest >= 0, rest)


class _Oscillation(_JointReference):
    """Amplitude, an envelope that starts smoothly, and a duration."""

    amplitude: float = quantity("rad", 0.5, gt=0, lt=np.pi)
    """Largest angle from the middle [rad]."""
    middle: float = quantity("rad", 0.0, gt=-np.pi, lt=np.pi)
    """Angle about which it oscillates [rad]."""
    duration_s: float = quantity("s", 12.0, gt=0, le=3600)
    """Scored time [s]."""
    onset_s: float = quantity("s", 2.0, gt=0, le=3600)
    """Time in which the amplitude grows; not scored [s]."""

    def _plan_with_onset(self, t: Array, x: Array, x_dot: Array, x_ddot: Array) -> Plan:
        w, w_dot, w_ddot = quintic((t - STAND_S) / self.onset_s)
        w_dot = w_dot / self.onset_s
        w_ddot = w_ddot / self.onset_s**2
        q_dot = w_dot * x + w * x_dot
        q_ddot = w_ddot * x + 2.0 * w_dot * x_dot + w * x_ddot
        q = self.middle + w * x
        return Plan(q, q_dot, q_ddot, t > STAND_S + self.onset_s, np.full(len(t), -1))

    def _extent(self, rate: float, acceleration: float) -> Extent:
        """Return bounds with the envelope, for any phase of the oscillation during its growth."""
        w, w_dot, w_ddot = quintic(np.linspace(0.0, 1.0, 1001))
        w_dot = w_dot / self.onset_s
        w_ddot = np.abs(w_ddot) / self.onset_s**2
        reach = self.amplitude
        q_dot = w_dot * reach + w * rate
        q_ddot = w_ddot * reach + 2.0 * w_dot * rate + w * acceleration
        ends = (self.middle - reach, self.middle + reach)
        return Extent(*ends, float(q_dot.max()), float(q_ddot.max()))

    def _time_base(self, control_period_s: float) -> Array:
        end_s = STAND_S + self.onset_s + self.duration_s
        return trajectory.control_times(end_s, control_period_s)


class Sine(_Oscillation):
    """One sine, the same in every episode."""

    kind: Literal["sine"] = "sine"
    frequency_hz: float = quantity("Hz", 0.25, gt=0)
    """Frequency [Hz]."""

    @override
    def extent(self) -> Extent:
        omega = 2.0 * np.pi * self.frequency_hz
        return self._extent(self.amplitude * omega, self.amplitude * omega**2)

    @override
    def plan(self, generator: Generator, control_period_s: float) -> Plan:
        t = self._time_base(control_period_s)
        omega = 2.0 * np.pi * self.frequency_hz
        phase = omega * (t - STAND_S)
        x = self.amplitude * np.sin(phase)
        x_dot = self.amplitude * omega * np.cos(phase)
        return self._plan_with_onset(t, x, x_dot, -(omega**2) * x)


class Multisine(_Oscillation):
    """Sines of evenly spaced frequencies and equal amplitude, with phases drawn per episode.

    Their sum stays inside the amplitude.
    """

    kind: Literal["multisine"] = "multisine"
    amplitude: float = quantity("rad", 0.4, gt=0, lt=np.pi)
    """Largest angle from the middle [rad]."""
    lowest_hz: float = quantity("Hz", 0.1, gt=0)
    """Lowest frequency [Hz]."""
    highest_hz: float = quantity("Hz", 1.0, gt=0)
    """Highest frequency [Hz]."""
    components: int = quantity("1", 5, ge=2, le=100)
    """Number of sines [1]."""
    seed: int | None = quantity("1", None, ge=0, le=LARGEST_SEED)
    """Seed of the phases; None draws new ones per episode [1]."""

    def _check(self) -> None:
        if self.highest_hz <= self.lowest_hz:
            got = f"got {self.lowest_hz} to {self.highest_hz} Hz"
            raise ValueError(f"highest_hz must exceed lowest_hz, {got}")
        if self.components * self.duration_s > _LONGEST_SUM_S:
            raise ValueError(
                f"components x duration_s must be at most {_LONGEST_SUM_S:g} s, got"
                f" {self.components} x {self.duration_s:g} s; take fewer sines or less time"
            )

    @property
    def _omega(self) -> Array:
        hertz = np.linspace(self.lowest_hz, self.highest_hz, self.components)
        return 2.0 * np.pi * hertz

    @override
    def extent(self) -> Extent:
        share = self.amplitude / self.components
        omega = self._omega
        return self._extent(share * float(omega.sum()), share * float((omega**2).sum()))

    @override
    def plan(self, generator: Generator, control_period_s: float) -> Plan:
        generator = self.choose_generator(generator)
        phases = generator.uniform(0.0, 2.0 * np.pi, self.components)
        t = self._time_base(control_period_s)
        omega = self._omega
        share = self.amplitude / self.components
        angle = omega * (t[:, None] - STAND_S) + phases
        x = share * np.sin(angle).sum(axis=1)
        x_dot = share * (omega * np.cos(angle)).sum(axis=1)
        x_ddot = -share * (omega**2 * np.sin(angle)).sum(axis=1)
        return self._plan_with_onset(t, x, x_dot, x_ddot)


class Steps(_JointReference):
    """Quick moves between random levels, each followed by a rest."""

    kind: Literal["steps"] = "steps"
    amplitude: float = quantity("rad", 0.5, gt=0, lt=np.pi)
    """Largest angle from the middle [rad]."""
    middle: float = quantity("rad", 0.0, gt=-np.pi, lt=np.pi)
    """Middle of the levels [rad]."""
    move_s: float = quantity("s", 1.0, gt=0, le=3600)
    """Duration of a move [s]."""
    rest_s: float = quantity("s", 1.0, ge=0, le=3600)
    """Rest after a move [s]."""
    moves: int = quantity("1", 5, ge=1, le=1000)
    """Number of moves [1]."""
    seed: int | None = quantity("1", None, ge=0, le=LARGEST_SEED)
    """Seed of the levels; None draws new ones per episode [1]."""

    @override
    def extent(self) -> Extent:
        span = 2.0 * self.amplitude
        ends = (self.middle - self.amplitude, self.middle + self.amplitude)
        q_ddot = trajectory.QUINTIC_PEAK_ACCELERATION * span / self.move_s**2
        return Extent(*ends, trajectory.QUINTIC_PEAK_RATE * span / self.move_s, q_ddot)

    @override
    def plan(self, generator: Generator, control_period_s: float) -> Plan:
        reach = self.amplitude
        offsets = self.choose_generator(generator).uniform(-reach, reach, self.moves)
        period = self.move_s + self.rest_s
        moves = [
            (STAND_S + i * period, self.move_s, float(self.middle + x))
            for i, x in enumerate(offsets)
        ]
        t = trajectory.control_times(STAND_S + self.moves * period, control_period_s)
        q, q_dot, q_ddot = trajectory.quintic_moves(t, self.middle, moves)
        return Plan(q, q_dot, q_ddot, scored=t > STAND_S, rest=np.full(len(t), -1))


AnyReference: TypeAlias = Hold | Sine | Multisine | Steps
Reference = Annotated[AnyReference, Field(discriminator="kind")]


def kinds_of(union: Any) -> dict[str, Any]:
    """Return the classes of a union of references by the names of their kinds."""
    return {model.model_fields["kind"].default: model for model in get_args(union)}


REFERENCES = kinds_of(AnyReference)


def make_reference(reference: Any, kinds: Mapping[str, Any] = REFERENCES) -> Any:
    """Make a reference from its name, or from a mapping with `kind` and parameters.

    Args:
        reference: Name, mapping, or a reference, which is returned.
        kinds: Classes of references by their names; default those that move every joint alike.

    Raises:
        ConfigurationError: The kind does not exist, or a parameter does not fit it.
    """
    if isinstance(reference, tuple(kinds.values())):
        return reference
    if isinstance(reference, str):
        reference = {"kind": reference}
    if not isinstance(reference, dict):
        raise ConfigurationError(
            f"a reference is a name, a mapping or a model, got {type(reference).__name__}"
        )
    kind = reference.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise unknown_name("reference", kind, kinds)
    return kinds[kind](**reference)
