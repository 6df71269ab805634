"""Desired joint angles that approach a target within limits of speed and acceleration."""

import numpy as np

from elastic_env.core.signals import Array

_ARRIVAL_RAD = 1e-9
"""Rounding error that may remain between the last step and the target [rad]."""


class Follower:
    """Desired angles that move to a target within a speed and an acceleration.

    Args:
        start: First desired angles, (n,) [rad].
        speed: Largest speed [rad/s].
        acceleration: Largest acceleration [rad/s²].

    Attributes:
        q, q_dot, q_ddot: Desired angles, their rates and accelerations, (n,) [rad], [rad/s],
            [rad/s²].
    """

    def __init__(self, start: Array, speed: float, acceleration: float) -> None:
        self.q = np.array(start, dtype=np.float64)
        self.q_dot = np.zeros_like(self.q)
        self.q_ddot = np.zeros_like(self.q)
        self._speed = speed
        self._acceleration = acceleration

    def step(self, target: Array, period_s: float) -> None:
        r"""Move towards a target, (n,) [rad], for one cycle.

        The speed is the highest from which the joint can still brake before the target:

        .. math:: v = \sqrt{(a T)^2 / 4 + 2 a |e|} - a T / 2

        Only the very last step brakes by up to twice the acceleration.
        """
        previous_q_dot = self.q_dot.copy()
        error = target - self.q
        step = self._acceleration * period_s
        braking = np.sqrt(0.25 * step**2 + 2.0 * self._acceleration * np.abs(error)) - 0.5 * step
        desired_q_dot = np.sign(error) * np.minimum(braking, self._speed)
        self.q_dot += np.clip(desired_q_dot - self.q_dot, -step, step)
        move = self.q_dot * period_s
        # the last step ends on the target
        is_last = np.abs(error) <= np.abs(move) + _ARRIVAL_RAD
        is_slow = np.abs(self.q_dot) <= 2.0 * step
        arrives = is_last & is_slow
        self.q = np.where(arrives, target, self.q + move)
        self.q_dot = np.where(arrives, 0.0, self.q_dot)
        self.q_ddot = (self.q_dot - previous_q_dot) / period_s
