"""Torque of a servo's motor in units of its position gain k, and the limit of it."""

from collections.abc import Sequence

import numpy as np

from baselines.identification.servo_log import ServoLog
from elastic_env.core.signals import Array

_FEWEST_ROWS_AT_LIMIT = 20
"""Rows with the largest PWM that show a limit."""
_LEAST_CORRELATION = 0.98
"""Correlation of PWM and error above which the PWM is proportional to the error."""


def torque_per_gain(log: ServoLog, limit: float | None) -> Array:
    """Torque of the motor at standstill over k, as `Replay` has it, (N,) [V·rad].

    The register's error is limited before the supply's voltage scales it.

    Args:
        log: The log.
        limit: T/k [rad]; None for no limit.
    """
    error = log.register * (log.goal - log.position)
    if limit is not None:
        error = np.clip(error, -limit, limit)
    return error * log.supply * log.enabled


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
