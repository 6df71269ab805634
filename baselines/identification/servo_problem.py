"""Unknown parameters of a servo, their priors, and the residuals of replayed logs.

[Bock1983] H. G. Bock, "Recent Advances in Parameter Identification Techniques for O.D.E.".
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_replay import NAMES, STEP_S, Replay
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray

VISCOUS_SHARE = 0.2
"""Viscous friction over all damping where the torque is never off, by published models of small
servos: 22 % for the XL330 (Duclusaud et al., ICRA 2025)."""
USUAL_LOSS = (0.25, 0.15)
"""Mean and standard deviation of c before a log is used: gear trains pass 60 to 90 %."""
PRIORS = 2
"""Residuals that priors add: for c and for the no-load speed."""
INDEX = {name: i for i, name in enumerate(NAMES)}
"""Index of each parameter."""
FIRST_ROWS = 5
"""Rows that give angle and speed at the start."""
STEP = 1e-3
"""Step of difference quotients, in units of the scales."""
MOVING = 0.05
"""Speed above which a joint moves [rad/s]."""
_NO_LOAD_SPEED = 8.0
_NO_LOAD_DEVIATION = 0.5
"""No-load speed [rad/s] and the deviation of its logarithm: data sheets have 4 to 16 rad/s."""
_MOST_ROWS = 600
"""About the number of rows of a log that a thinned residual has."""
_COARSE_STEP_S = 3.4e-3
_LONGEST_DELAY_S = 0.06
_DELAY_SCALE_S = 0.01
_LEAD_SCALE_S = 0.01
_LONGEST_LEAD_S = 0.2
"""Bound of the lead where nothing is switched."""
_LEAST_TORQUE = 1e-9
"""Largest torque of the load below which the joint counts as unloaded [N·m]."""
_FEWEST_ROWS_OF_PART = 5
_FEWEST_ROWS_AT_LIMIT = 20
"""Rows with the largest PWM that show a torque limit."""
_LEAST_CORRELATION = 0.98
"""Correlation of PWM and error above which the PWM is proportional to the error."""
_FIRST_LIMIT_SHARE = 0.6
"""First torque limit over the largest torque of a servo without limit."""


@dataclass(frozen=True)
class ServoProblem:
    """Replays and unknown parameters, in units in which all parameters are about 1.

    Attributes:
        replays: Logs to replay.
        scale: Units of the parameters, (13,).
        lower, upper: Bounds of the parameters in these units, (13,).
        limit_per_gain: T/k [rad]; None if the logs do not determine it.
        split_damping: True if the logs separate viscous friction from the back-EMF.
        weight: Weight of a prior's deviation among the residuals; 0 for no priors.
    """

    replays: tuple[Replay, ...]
    scale: Array
    lower: Array
    upper: Array
    limit_per_gain: float | None
    split_damping: bool
    weight: float = 0.0

    @classmethod
    def from_logs(cls, logs: Sequence[ServoLog]) -> "ServoProblem":
        """Problem of the whole logs, without priors.

        Raises:
            ElasticError: Nothing loads the joint.
        """
        torque = max(float(np.abs(log.external_torque(log.position)).max()) for log in logs)
        if torque < _LEAST_TORQUE:
            raise ElasticError(
                "nothing loads the joint; hang a known mass on it, turn its axis out of the"
                " vertical, or log a column tau_known [N·m]"
            )
        highest = max(log.register for log in logs)
        inertia = max(log.load.inertia or torque / 100.0 for log in logs)
        span = max((np.ptp(log.goal) for log in logs if log.enabled.any()), default=1.0)
        scale = {
            "position_gain": torque / (0.3 * span * highest),
            "torque_limit": torque,
            "motor_damping": 0.1 * torque,
            "rotor_inertia": 0.5 * inertia,
            "link_inertia": inertia,
            "coulomb_friction": 0.1 * torque,
            "load_friction": 0.3,
            "viscous_friction": 0.02 * torque,
            "static_friction": 0.1 * torque,
            "stribeck_speed": 0.3,
            "zero_offset": 0.02,
            "delay": _DELAY_SCALE_S,
            "switch_lead": _LEAD_SCALE_S,
        }
        bounds = dict.fromkeys(NAMES, (0.0, 1e3)) | {
            "torque_limit": (0.0, 1e9),
            "load_friction": (0.0, 0.9 / 0.3),
            "stribeck_speed": (0.05, 10.0),
            "zero_offset": (-10.0, 10.0),
            "delay": (0.0, _LONGEST_DELAY_S / _DELAY_SCALE_S),
            "switch_lead": (0.0, _shortest_gap(logs) / _LEAD_SCALE_S),
        }
        lower, upper = np.transpose([bounds[name] for name in NAMES])
        return cls(
            replays=tuple(prepare(log) for log in logs),
            scale=np.array([scale[name] for name in NAMES]),
            lower=lower,
            upper=upper,
            limit_per_gain=find_limit_per_gain(logs),
            split_damping=any((~log.enabled).sum() > 0.1 * len(log) for log in logs),
        )

    @property
    def logs(self) -> list[ServoLog]:
        """Logs that are replayed."""
        return [replay.log for replay in self.replays]

    def without_priors(self) -> "ServoProblem":
        """Problem without the residuals of priors."""
        return replace(self, weight=0.0)

    def with_steps(self, longest_s: float = _COARSE_STEP_S) -> "ServoProblem":
        """Problem with steps of at most `longest_s` [s]."""
        return replace(self, replays=tuple(prepare(log, longest_s) for log in self.logs))

    def with_parts(self, seconds: float) -> "ServoProblem":
        """Problem of short parts, each replayed from measured angle and speed at its first row.

        A short replay deviates little with wrong parameters, so that its least squares have hardly
        any local minima [Bock1983]. A long replay then starts close to its own minimum.
        """
        parts = []
        for log in self.logs:
            speed, _ = log.derivatives()
            count = max(1, round((log.time[-1] - log.time[0]) / seconds))
            edges = np.searchsorted(log.time, np.linspace(log.time[0], log.time[-1], count + 1))
            for first, last in itertools.pairwise(edges):
                if last - first >= _FEWEST_ROWS_OF_PART:
                    part = log.part(slice(first, last + 1))
                    start = float(speed[first])
                    parts.append(Replay.from_log(part, start, longest_s=_COARSE_STEP_S))
        return replace(self, replays=tuple(parts))

    @property
    def basic_parameters(self) -> IntArray:
        """Indices of the parameters that every fit of these logs estimates."""
        names = ["rotor_inertia", "coulomb_friction", "load_friction"]
        if any(log.load.inertia is None for log in self.logs):
            names[0] = "link_inertia"
        if any(log.enabled.any() for log in self.logs):
            names += ["position_gain", "motor_damping", "delay"]
        if self.split_damping:
            names.append("viscous_friction")
        if any(len(_switches(log)) for log in self.logs):
            names.append("switch_lead")
        if any(log.load.torque > 0.0 for log in self.logs):
            names.append("zero_offset")
        return np.sort([INDEX[name] for name in names])

    def optional_effects(self, z: Array) -> list[dict[str, float]]:
        """Effects that are estimated only if they lower the error: first values of parameters.

        Args:
            z: The other parameters, in their scales, (13,).
        """
        effects = []
        if self.limit_per_gain is None and any(log.enabled.any() for log in self.logs):
            gain = self.expand(z)[INDEX["position_gain"]]
            torques = [
                gain * log.register * log.supply * np.abs(log.goal - log.position)[log.enabled]
                for log in self.logs
            ]
            # torque of a servo without limit
            largest = float(np.concatenate(torques).max())
            limit = largest / self.scale[INDEX["torque_limit"]]
            effects.append({"torque_limit": _FIRST_LIMIT_SHARE * limit})
        effects.append({"static_friction": 0.5, "stribeck_speed": 1.0})
        return effects

    def expand(self, z: Array) -> Array:
        """Parameters of the replay in their units, (13,)."""
        p = z * self.scale
        if self.limit_per_gain is not None:
            p[INDEX["torque_limit"]] = p[INDEX["position_gain"]] * self.limit_per_gain
        if not self.split_damping:
            damping = p[INDEX["motor_damping"]]
            p[INDEX["motor_damping"]] = (1.0 - VISCOUS_SHARE) * damping
            p[INDEX["viscous_friction"]] = VISCOUS_SHARE * damping
        return p

    def residual(self, z: Array, thinned: bool = True) -> Array:
        """Replayed less measured angles at some or all rows [rad], then the priors."""
        p = self.expand(z)
        parts = []
        for replay in self.replays:
            every = max(1, len(replay.log) // _MOST_ROWS) if thinned else 1
            parts.append((replay.play(p) - replay.log.position)[::every])
        if self.weight > 0.0:
            parts.append(self.weight * self._prior_deviations(p))
        return np.nan_to_num(np.concatenate(parts), nan=10.0, posinf=10.0, neginf=-10.0)

    def _prior_deviations(self, p: Array) -> Array:
        """Deviations of c and no-load speed from usual servos, in standard deviations, (2,)."""
        volts = max(log.supply for log in self.logs)
        limit = p[INDEX["torque_limit"]]
        damping = p[INDEX["motor_damping"]]
        speed = _NO_LOAD_SPEED
        if 0.0 < limit < 1e3 * self.scale[INDEX["torque_limit"]] and damping > 0.0:
            speed = np.clip(limit * volts / damping, 0.1, 1e3)
        loss = (p[INDEX["load_friction"]] - USUAL_LOSS[0]) / USUAL_LOSS[1]
        return np.array([loss, np.log(speed / _NO_LOAD_SPEED) / _NO_LOAD_DEVIATION])

    def solve(self, z: Array, free: IntArray, evaluations: int) -> tuple[Array, float]:
        """Minimise the squared residuals over some of the parameters.

        Args:
            z: First parameters, in their scales, (13,).
            free: Indices of the parameters to change.
            evaluations: Limit of the solver's evaluations.

        Returns:
            Parameters in their scales, (13,), and the sum of squares.
        """
        low = self.lower[free]
        high = self.upper[free]

        def merge(part: Array) -> Array:
            merged = z.copy()
            merged[free] = part
            return merged

        def jacobian(part: Array) -> Array:
            base = self.residual(merge(part))
            return np.stack(
                [
                    (self.residual(merge(part + STEP * unit)) - base) / STEP
                    for unit in np.eye(len(part))
                ],
                axis=-1,
            )

        solution = least_squares(
            lambda part: self.residual(merge(part)),
            np.clip(z[free], low + 1e-6, high - 1e-6),
            jac=jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            max_nfev=evaluations,
            x_scale="jac",
            xtol=1e-6,
            ftol=1e-7,
        )
        return merge(solution.x), 2.0 * float(solution.cost)


def prepare(log: ServoLog, longest_s: float = STEP_S) -> Replay:
    """Replay of a log that starts with angle and speed of the first rows."""
    speed, _ = log.derivatives()
    if np.abs(speed[:FIRST_ROWS]).max() > MOVING:
        return Replay.from_log(log, float(speed[0]), longest_s=longest_s)
    angle = float(np.mean(log.position[:FIRST_ROWS]))
    return Replay.from_log(log, 0.0, angle, longest_s)


def _switches(log: ServoLog) -> IntArray:
    """Rows before which the torque is switched."""
    return 1 + np.flatnonzero(np.diff(log.enabled))


def _shortest_gap(logs: Sequence[ServoLog]) -> float:
    """Shortest time between the rows before and after a switch of the torque [s]."""
    gaps = [np.diff(log.time)[_switches(log) - 1] for log in logs]
    return float(np.concatenate(gaps).min(initial=_LONGEST_LEAD_S))


def find_limit_per_gain(logs: Sequence[ServoLog]) -> float | None:
    """T/k, limit of the torque over the position gain, from logged PWM [rad]; None if unknown.

    The duty is proportional to g (goal − position) until it stays at its limit.
    """
    with_pwm = [(log, log.pwm) for log in logs if log.pwm is not None]
    highest = 0.0
    at_limit = 0
    for _, pwm in with_pwm:
        highest = max(highest, float(np.abs(pwm).max()))
        at_limit += int(np.sum(np.abs(pwm) > 0.999 * highest))
    if highest == 0.0 or at_limit < _FEWEST_ROWS_AT_LIMIT:
        return None
    errors = []
    duties = []
    for log, pwm in with_pwm:
        inner = log.enabled & (np.abs(pwm) < 0.98 * highest)
        errors.append(log.register * (log.goal - log.position)[inner])
        duties.append(pwm[inner])
    error = np.concatenate(errors)
    duty = np.concatenate(duties)
    slope = float(error @ duty) / float(error @ error)
    is_proportional = np.corrcoef(error, duty)[0, 1] > _LEAST_CORRELATION
    return highest / slope if slope > 0.0 and is_proportional else None
