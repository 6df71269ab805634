r"""Motion of one joint with a position servo, replayed from the goals of a log.

The motor turns the link through a stiff gear, B and I are the inertias of rotor and link:

.. math:: \tau_J = \tau_m - B \ddot q, \qquad
    I \ddot q = \tau_J + \tau(q) - d\,\dot q - \operatorname{sign}(\dot q)\,F

with the dry friction F of `elastic_env.joint.friction.dry_friction`, that is
F = F₀ + c |τ_J| + F_s exp(−(ω/ω_s)²). A DC motor under a voltage that the servo sets gives

.. math:: \tau_m = \operatorname{clip}(k\,g\,(q_\mathrm{goal} - q), \pm T) - b\,\dot q

where V is the supply's voltage, k the position gain for one volt and one unit of the register g, T
the torque at standstill for one volt, and b = k_t k_e / R the back-EMF's damping. Without torque
enabled τ_m is zero, and the rotor's inertia remains. A program that switches the torque, then reads
the angle, logs the switch up to a row late: the torque changes a lead before the row.

At rest friction balances any torque up to F. So a joint at rest determines a band of torques, and
motion determines the torque.
"""

from dataclasses import dataclass

import numpy as np

from baselines.identification.servo_log import ServoLog
from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array, BoolArray

PARAMETERS = {
    "position_gain": "N·m/rad",
    "torque_limit": "N·m",
    "motor_damping": "N·m·s/rad",
    "rotor_inertia": "kg·m²",
    "link_inertia": "kg·m²",
    "coulomb_friction": "N·m",
    "load_friction": "1",
    "viscous_friction": "N·m·s/rad",
    "static_friction": "N·m",
    "stribeck_speed": "rad/s",
    "zero_offset": "rad",
    "delay": "s",
    "switch_lead": "s",
}
"""Parameters of a servo with their units.

Position gain and torque limit are for one volt, where voltages are known. The gain is for one unit
of the servo's register.
"""
NAMES = tuple(PARAMETERS)
"""Order of the parameters in arrays."""

STEP_S = 1.7e-3
"""Longest step of a replay [s]."""


@dataclass(frozen=True)
class Replay:
    """A log on the grid of the simulation, computed once for many replays.

    Attributes:
        log: The log.
        start: Angle and speed at the first row [rad], [rad/s].
        middle: Times of the middles of the steps, (N − 1, s) [s].
        known_torque: Known torque at these times, (N − 1, s) [N·m].
    """

    log: ServoLog
    start: tuple[float, float]
    middle: Array
    known_torque: Array

    @staticmethod
    def from_log(
        log: ServoLog, speed: float = 0.0, angle: float | None = None, longest_s: float = STEP_S
    ) -> "Replay":
        """Prepare a log.

        Args:
            log: The log.
            speed: Speed at the first row [rad/s].
            angle: Angle at the first row [rad]; None for the logged one.
            longest_s: Longest step [s].
        """
        step = np.diff(log.time)
        count = max(1, int(np.ceil(np.median(step) / longest_s)))
        middle = log.time[:-1, None] + step[:, None] * (np.arange(count) + 0.5) / count
        known = np.zeros_like(middle)
        if log.known_torque is not None:
            known = np.interp(middle, log.time, log.known_torque)
        angle = float(log.position[0]) if angle is None else angle
        return Replay(log, (angle, speed), middle, known)

    def play(self, parameters: Array) -> Array:
        """Angles at the rows of the log, (N,) [rad]; parameters as in `NAMES`, (13,)."""
        log = self.log
        goal = np.interp(self.middle - parameters[11], log.time, log.goal)
        load = log.load
        inertia = parameters[4] if load.inertia is None else load.inertia
        out = np.empty(len(log.time))
        _play(
            np.diff(log.time),
            goal,
            self.known_torque,
            log.enabled,
            self._switched_shares(parameters[12]),
            np.array([*self.start, log.register, log.supply, load.torque, load.rest, inertia]),
            np.ascontiguousarray(parameters, dtype=np.float64),
            out,
        )
        return out

    def _switched_shares(self, lead: float) -> Array:
        """Share of each step after the torque is switched, (N − 1, s); 0 where it is not.

        Args:
            lead: Time from the switch to the first row that contains it, at most one row [s].
        """
        step = np.diff(self.log.time)[:, None]
        count = self.middle.shape[1]
        share = np.clip(np.arange(1, count + 1) - count * (1.0 - lead / step), 0.0, 1.0)
        return np.where(np.diff(self.log.enabled)[:, None], share, 0.0)


@compiled
def _play(
    steps: Array,
    goal: Array,
    known: Array,
    enabled: BoolArray,
    switched: Array,
    setting: Array,
    p: Array,
    out: Array,
) -> None:
    """Angles of the link at the rows, into `out`; second order in the step.

    A link whose speed passes zero within a step stops there. For the rest of the step it stays at
    rest, or is driven the other way.
    """
    q = setting[0]
    w = setting[1]
    gain = setting[2] * setting[3] * p[0]
    limit = setting[3] * p[1]
    M = p[3] + setting[6]
    at_rest = p[5] + p[8]
    out[0] = q
    substeps = goal.shape[1]
    for k in range(len(steps)):
        for part in range(2 * substeps):  # each step before and after the torque is switched
            j = part // 2
            share = switched[k, j] if part % 2 else 1.0 - switched[k, j]
            if share == 0.0:
                continue
            h = share * (steps[k] / substeps)
            on = enabled[k + part % 2]
            b = p[2] if on else 0.0
            left = h
            if w != 0.0:
                middle = q + 0.5 * h * w
                pull = 0.0
                if on:
                    pull = min(max(gain * (goal[k, j] - middle), -limit), limit)
                other = known[k, j] - setting[4] * np.sin(middle - setting[5] - p[10])
                F = p[5]
                if p[8] > 0.0:
                    F += p[8] * np.exp(-((w / p[9]) ** 2))
                side = 1.0 if w > 0.0 else -1.0
                slope = _acceleration(side, pull, b, w, h, other, F, p[6], p[7], M, p[3])
                faster = w + h * slope
                if faster * w > 0.0:
                    q = middle + 0.5 * h * faster
                    w = faster
                    continue
                stop = -w / slope
                q += 0.5 * w * stop
                w = 0.0
                left = h - stop
            pull = 0.0
            if on:
                pull = min(max(gain * (goal[k, j] - q), -limit), limit)
            other = known[k, j] - setting[4] * np.sin(q - setting[5] - p[10])
            needed = pull + other
            if abs(needed) > at_rest + p[6] * abs(pull):
                side = 1.0 if needed > 0.0 else -1.0
                slope = _acceleration(side, pull, b, 0.0, left, other, at_rest, p[6], p[7], M, p[3])
                w = left * slope
                q += 0.5 * left * w
        out[k + 1] = q


@compiled_part
def _acceleration(
    side: float,
    pull: float,
    b: float,
    w: float,
    h: float,
    other: float,
    F: float,
    c: float,
    d: float,
    M: float,
    B: float,
) -> float:
    """Mean acceleration of a link over a step in which it moves to one side [rad/s²].

    M a = pull − b w̄ + other − d w̄ − s (F + c |pull − b w̄ − B a|), with w̄ = w + a h / 2, solved for
    the sign of the load that it then has.
    """
    turn = 1.0 if pull - b * w > 0.0 else -1.0
    slope = 0.0
    for _ in range(2):
        s = side * c * turn
        damping = d + b * (1.0 - s)
        slope = (pull * (1.0 - s) + other - side * F - damping * w) / (
            M - s * B + 0.5 * h * damping
        )
        if (pull - b * (w + 0.5 * h * slope) - B * slope) * turn >= 0.0:
            break
        turn = -turn
    return slope
