"""What is sought of a servo from its logs: parameters, priors, residuals, and a start.

The start solves the equation of motion, which is linear in the parameters where the joint moves.

[Bock1983] H. G. Bock, "Recent Advances in Parameter Identification Techniques for O.D.E.".
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_replay import NAMES, STEP_S, Replay
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array, IntArray

VISCOUS_SHARE = 0.2
"""Viscous friction over all damping where the torque is never off, as published models of small
servos have it: 22 % for the XL330 (Duclusaud et al., ICRA 2025)."""
USUAL_LOSS = (0.25, 0.15)
"""Mean and standard deviation of c before a log is seen: gear trains pass 60 to 90 %."""
PRIORS = 2
"""Residuals that priors add: of c and of the no-load speed."""
AT = {name: i for i, name in enumerate(NAMES)}
"""Places of the parameters."""
FIRST_ROWS = 5
"""Rows from which angle and speed at the start are taken."""
STEP = 1e-3
"""Step of difference quotients, in units of the scales."""
_NO_LOAD_SPEED = 8.0
_NO_LOAD_SPREAD = 0.5
"""No-load speed [rad/s] and the deviation of its logarithm: data sheets have 4 to 16 rad/s."""
_MOVING = 0.05
_MOST_ROWS = 600
_COARSE_S = 3.4e-3
_DELAY_S = 0.06
_LEAD_SCALE_S = 0.01
_LONGEST_LEAD_S = 0.2  # where nothing is switched
_LEAST_TORQUE = 1e-9
_FEWEST_IN_PART = 5
_FEWEST_AT_LIMIT = 20
_PROPORTIONAL = 0.98
_SATURATED = 0.6
_LEAST_START = 0.05
_NO_LIMIT = 1e6


@dataclass(frozen=True)
class ServoProblem:
    """Replays and what is sought of them, in units in which all parameters are about 1.

    Attributes:
        replays: Logs to replay.
        scale: Units of the parameters, (13,).
        lower, upper: Bounds of the parameters in these units, (13,).
        duty: T/k, where the logs tell it [rad].
        split_damping: Whether the logs tell viscous friction apart from the back-EMF.
        weight: Of a prior's deviation among the residuals; 0 for no priors.
    """

    replays: tuple[Replay, ...]
    scale: Array
    lower: Array
    upper: Array
    duty: float | None
    split_damping: bool
    weight: float = 0.0

    @classmethod
    def of(cls, logs: Sequence[ServoLog]) -> "ServoProblem":
        """The whole logs, without priors.

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
            "delay": 0.01,
            "switch_lead": _LEAD_SCALE_S,
        }
        bounds = dict.fromkeys(NAMES, (0.0, 1e3)) | {
            "torque_limit": (0.0, 1e9),
            "load_friction": (0.0, 0.9 / 0.3),
            "stribeck_speed": (0.05, 10.0),
            "zero_offset": (-10.0, 10.0),
            "delay": (0.0, _DELAY_S / 0.01),
            "switch_lead": (0.0, _shortest_gap(logs) / _LEAD_SCALE_S),
        }
        lower, upper = np.transpose([bounds[name] for name in NAMES])
        return cls(
            replays=tuple(prepare(log) for log in logs),
            scale=np.array([scale[name] for name in NAMES]),
            lower=lower,
            upper=upper,
            duty=duty_per_torque_gain(logs),
            split_damping=any((~log.enabled).sum() > 0.1 * len(log) for log in logs),
        )

    @property
    def logs(self) -> list[ServoLog]:
        """Logs that are replayed."""
        return [one.log for one in self.replays]

    def without_priors(self) -> "ServoProblem":
        """The residuals of the logs alone."""
        return replace(self, weight=0.0)

    def with_steps(self, longest_s: float = _COARSE_S) -> "ServoProblem":
        """The same with steps of at most so long [s]."""
        return replace(self, replays=tuple(prepare(log, longest_s) for log in self.logs))

    def in_parts(self, seconds: float) -> "ServoProblem":
        """Replays of short parts, each from the measured angle and speed at its first row.

        A short replay goes wrong little with wrong parameters, so that its least squares have
        hardly any local minima [Bock1983]; a long one then starts close to its own.
        """
        parts = []
        for log in self.logs:
            speed, _ = log.derivatives()
            count = max(1, round((log.time[-1] - log.time[0]) / seconds))
            edges = np.searchsorted(log.time, np.linspace(log.time[0], log.time[-1], count + 1))
            for first, last in itertools.pairwise(edges):
                if last - first >= _FEWEST_IN_PART:
                    own = log.part(slice(first, last + 1))
                    parts.append(Replay.of(own, float(speed[first]), longest_s=_COARSE_S))
        return replace(self, replays=tuple(parts))

    @property
    def always_sought(self) -> IntArray:
        """Parameters that every fit seeks."""
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
        return np.sort([AT[name] for name in names])

    def sought_where_shown(self, z: Array) -> list[dict[str, float]]:
        """Effects that are sought where they show, each with a start beside parameters z."""
        further = []
        if self.duty is None and any(log.enabled.any() for log in self.logs):
            gain = self.expand(z)[AT["position_gain"]]
            pulls = [
                gain * log.register * log.supply * np.abs(log.goal - log.position)[log.enabled]
                for log in self.logs
            ]
            # what the servo would give without a limit
            largest = float(np.concatenate(pulls).max()) / self.scale[AT["torque_limit"]]
            further.append({"torque_limit": _SATURATED * largest})
        further.append({"static_friction": 0.5, "stribeck_speed": 1.0})
        return further

    def expand(self, z: Array) -> Array:
        """Parameters of the replay."""
        p = z * self.scale
        if self.duty is not None:
            p[AT["torque_limit"]] = p[AT["position_gain"]] * self.duty
        if not self.split_damping:
            damping = p[AT["motor_damping"]]
            p[AT["motor_damping"]] = (1.0 - VISCOUS_SHARE) * damping
            p[AT["viscous_friction"]] = VISCOUS_SHARE * damping
        return p

    def residual(self, z: Array, thinned: bool = True) -> Array:
        """Deviations at some or all rows [rad]."""
        p = self.expand(z)
        parts = []
        for one in self.replays:
            every = max(1, len(one.log) // _MOST_ROWS) if thinned else 1
            parts.append((one.play(p) - one.log.position)[::every])
        if self.weight > 0.0:
            parts.append(self.weight * self._prior(p))
        return np.nan_to_num(np.concatenate(parts), nan=10.0, posinf=10.0, neginf=-10.0)

    def _prior(self, p: Array) -> Array:
        """Deviations from what servos usually have, in standard deviations, (2,)."""
        volts = max(log.supply for log in self.logs)
        limit = p[AT["torque_limit"]]
        damping = p[AT["motor_damping"]]
        speed = _NO_LOAD_SPEED
        if 0.0 < limit < 1e3 * self.scale[AT["torque_limit"]] and damping > 0.0:
            speed = np.clip(limit * volts / damping, 0.1, 1e3)
        loss = (p[AT["load_friction"]] - USUAL_LOSS[0]) / USUAL_LOSS[1]
        return np.array([loss, np.log(speed / _NO_LOAD_SPEED) / _NO_LOAD_SPREAD])

    def solve(self, z: Array, free: IntArray, evaluations: int) -> tuple[Array, float]:
        """Least squares over some of the parameters, from a start."""
        low = self.lower[free]
        high = self.upper[free]

        def full(part: Array) -> Array:
            whole = z.copy()
            whole[free] = part
            return whole

        def jacobian(part: Array) -> Array:
            base = self.residual(full(part))
            return np.stack(
                [
                    (self.residual(full(part + STEP * unit)) - base) / STEP
                    for unit in np.eye(len(part))
                ],
                axis=-1,
            )

        start = np.clip(z[free], low + 1e-6, high - 1e-6)
        found = least_squares(
            lambda part: self.residual(full(part)),
            start,
            jac=jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            max_nfev=evaluations,
            x_scale="jac",
            xtol=1e-6,
            ftol=1e-7,
        )
        return full(found.x), 2.0 * float(found.cost)


def prepare(log: ServoLog, longest_s: float = STEP_S) -> Replay:
    """A log ready for replays; its first speed from its first rows."""
    speed, _ = log.derivatives()
    if np.abs(speed[:FIRST_ROWS]).max() > _MOVING:
        return Replay.of(log, float(speed[0]), longest_s=longest_s)
    return Replay.of(log, 0.0, float(np.mean(log.position[:FIRST_ROWS])), longest_s)


def _switches(log: ServoLog) -> IntArray:
    """Rows before which the torque is switched."""
    return 1 + np.flatnonzero(np.diff(log.enabled))


def _shortest_gap(logs: Sequence[ServoLog]) -> float:
    """Time from the row before a switch of the torque to that after it, the shortest one [s]."""
    gaps = [np.diff(log.time)[_switches(log) - 1] for log in logs]
    return float(np.concatenate(gaps).min(initial=_LONGEST_LEAD_S))


def duty_per_torque_gain(logs: Sequence[ServoLog]) -> float | None:
    """T/k, limit of the torque over the position gain, from logged PWM [rad]; None if unknown.

    The duty is proportional to g (goal − position) until it stays at its limit.
    """
    rows = []
    duty = []
    highest = 0.0
    at_limit = 0
    for log in logs:
        if log.pwm is None:
            continue
        highest = max(highest, float(np.abs(log.pwm).max()))
        at_limit += int(np.sum(np.abs(log.pwm) > 0.999 * highest))
    if highest == 0.0 or at_limit < _FEWEST_AT_LIMIT:
        return None
    for log in logs:
        if log.pwm is not None:
            inner = log.enabled & (np.abs(log.pwm) < 0.98 * highest)
            rows.append(log.register * (log.goal - log.position)[inner])
            duty.append(log.pwm[inner])
    error = np.concatenate(rows)
    own = np.concatenate(duty)
    slope = float(error @ own) / float(error @ error)
    correlated = np.corrcoef(error, own)[0, 1] > _PROPORTIONAL
    return highest / slope if slope > 0.0 and correlated else None


def regress(problem: ServoProblem) -> Array:
    """Parameters that solve the equation of motion where the joint moves, in their scales, (13,).

    k g e − k c g e s σ − b w − B a − F s − d w − m g l o cos q = I a − τ(q), linear in k, k c, b,
    B, F, d and o, for the error e, the side s of motion and the side σ of the motor's torque.

    Raises:
        ElasticError: The joint hardly moves.
    """
    rows = []
    right = []
    for log in problem.logs:
        w, a = log.derivatives()
        error = drive(log, problem.duty)
        moving = np.abs(w) > _MOVING
        side = np.sign(w)
        lever = log.load.torque * np.cos(log.position - log.load.rest)
        columns = [
            error,
            -error * side * np.sign(error),
            -w * log.enabled,
            -a,
            -side,
            -w * ~log.enabled,
            lever,
        ]
        rows.append(np.stack(columns, axis=-1)[moving])
        inertial = (log.load.inertia or 0.0) * a
        right.append((inertial - log.external_torque(log.position))[moving])
    matrix = np.concatenate(rows)
    target = np.concatenate(right)
    if len(target) < 2 * matrix.shape[1]:
        raise ElasticError(
            f"the joint moves in {len(target)} rows only, {2 * matrix.shape[1]} are needed: it"
            " sticks or the goal hardly moves; command a motion of some tenths of a radian"
        )
    size = np.maximum(np.abs(matrix).max(axis=0), 1e-12)
    low = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -np.inf])
    solved = lsq_linear(matrix / size, target, (low, np.full(7, np.inf))).x / size
    k, kc, b, B, F, d, offset = solved
    has_inertia = all(log.load.inertia is not None for log in problem.logs)
    found = {
        "position_gain": k,
        "motor_damping": b,
        "rotor_inertia": B if has_inertia else 0.0,
        "link_inertia": 0.0 if has_inertia else B,
        "coulomb_friction": F,
        "load_friction": np.clip(kc / k if k > 0.0 else 0.0, 0.0, 0.7),
        "viscous_friction": d,
        "stribeck_speed": 0.3,
        "zero_offset": np.clip(offset, -0.1, 0.1),
    }
    z = np.array([found.get(name, 0.0) for name in NAMES]) / problem.scale
    z[AT["torque_limit"]] = _NO_LIMIT
    least = np.zeros(len(NAMES))
    least[problem.always_sought] = _LEAST_START
    least[AT["zero_offset"]] = -np.inf
    return np.maximum(z, least)


def drive(log: ServoLog, duty: float | None) -> Array:
    """Torque of the motor at standstill over k, as `Replay` has it, (N,) [V·rad].

    The register's error is limited before the supply's voltage scales it: the limit is T/k.
    """
    error = log.register * (log.goal - log.position)
    if duty is not None:
        error = np.clip(error, -duty, duty)
    return error * log.supply * log.enabled
