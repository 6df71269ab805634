"""Errors of a replay at logs that were not fitted, compared with rivals that need no physics."""

from collections.abc import Sequence

import numpy as np

from baselines.identification.servo_fit import ServoFit
from baselines.identification.servo_log import FEWEST_ROWS, ServoLog, slow_rows
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array

PREDICTIONS = ("the goal itself", "a constant offset", "a line in the goal", "identified")
_FEWEST_HELD_OUT = 20
"""Rows that are held out of a single log, at least."""


class ServoError(Model):
    """Error of a prediction of the angle at logs that were not fitted."""

    name: str
    rms_mrad: float
    """Root mean square over all rows with torque on; all logs have equal weights."""
    slow_mrad: float | None
    """Root mean square over all rows of slow motion; None where nothing moves slowly."""


class LogErrors(Model):
    """Errors at one log."""

    log: str
    gain: float
    rms_mrad: tuple[float, ...]
    """Error of each prediction."""
    slow_mrad: tuple[float, ...] | None
    slow_rows: int
    replay_mrad: float
    """Error of the replay over all rows, also those with the torque off."""
    off_rows: int = 0
    """Rows with the torque off, which `rms_mrad` leaves out."""


class ServoHoldout(Model):
    """Errors at logs that were not fitted; a part of `identification.json`."""

    fitted: tuple[str, ...]
    replay_mrad: float
    """Root mean square of the replay over all rows of the logs, also those with the torque off."""
    errors: tuple[ServoError, ...]
    """Errors of the rivals, and of the identification last."""
    logs: tuple[LogErrors, ...]

    @property
    def has_torque_off(self) -> bool:
        """True if `errors` leave out rows with the torque off."""
        return any(log.off_rows for log in self.logs)

    @property
    def best_rival(self) -> ServoError:
        """The best prediction except the identification."""
        return min(self.errors[:-1], key=lambda error: error.rms_mrad)


def judge_servo(fit: ServoFit, held_out: Sequence[ServoLog]) -> ServoHoldout:
    """Errors of a fit and of rivals that learn from the same logs.

    Args:
        fit: A fit to other logs.
        held_out: Logs that were not fitted.
    """
    logs = []
    slow = []
    for log in held_out:
        replay = fit.replay(log)
        errors = np.vstack([rivals(fit.logs, log), replay]) - log.position
        slow_fit = np.vstack([rivals(fit.logs, log, slow=True), replay]) - log.position
        slow.append(slow_fit[:, slow_rows(log)])
        logs.append(_log_errors(log, errors, slow[-1]))
    slow_errors = np.concatenate(slow, axis=1)
    total = np.array([log.rms_mrad for log in logs])
    return ServoHoldout(
        fitted=tuple(log.name for log in fit.logs),
        replay_mrad=float(np.sqrt(np.mean([log.replay_mrad**2 for log in logs]))),
        errors=tuple(
            ServoError(
                name=name,
                rms_mrad=float(np.sqrt(np.mean(total[:, i] ** 2))),
                slow_mrad=_rms_mrad(slow_errors[i]) if slow_errors.shape[1] else None,
            )
            for i, name in enumerate(PREDICTIONS)
        ),
        logs=tuple(logs),
    )


def rivals(fitted: Sequence[ServoLog], log: ServoLog, *, slow: bool = False) -> Array:
    """Angles of a log by predictions without physics, (3, N) [rad].

    They learn from the fitted logs with the same gain, or from all if there are none.

    Args:
        fitted: Logs to learn from.
        log: Log to predict.
        slow: Learn from rows of slow motion only, where there are any.
    """
    powered = [other for other in fitted if other.enabled.any()]
    alike = [other for other in powered if other.gain == log.gain] or powered
    if not alike:
        return np.stack([log.goal] * 3)
    rows = [slow_rows(other) if slow else other.enabled for other in alike]
    if not any(part.any() for part in rows):
        rows = [other.enabled for other in alike]
    chosen = list(zip(alike, rows, strict=True))
    goal = np.concatenate([other.goal[part] for other, part in chosen])
    position = np.concatenate([other.position[part] for other, part in chosen])
    offset = float(np.mean(position - goal))
    design = np.column_stack([np.ones(len(goal)), goal])
    constant, slope = np.linalg.lstsq(design, position, rcond=None)[0]
    return np.stack([log.goal, log.goal + offset, constant + slope * log.goal])


def split_logs(
    logs: Sequence[ServoLog], share: float, seed: int
) -> tuple[list[ServoLog], list[ServoLog]]:
    """Logs to fit and logs to hold out; a single log is cut, and its last part is held out.

    Args:
        logs: All logs.
        share: Share that is held out; at least one log is fitted and one held out.
        seed: Seed of the draw.

    Raises:
        ConfigurationError: A part of a single log has too few rows.
    """
    if len(logs) == 1:
        cut = round((1.0 - share) * len(logs[0]))
        if cut < FEWEST_ROWS or len(logs[0]) - cut < _FEWEST_HELD_OUT:
            raise ConfigurationError(
                f"--holdout {share:g} fits {cut} rows of {logs[0].name} and holds out"
                f" {len(logs[0]) - cut}, at least {FEWEST_ROWS} and {_FEWEST_HELD_OUT} are needed;"
                " choose another share, 0 for none, or give more logs"
            )
        return [logs[0].part(slice(0, cut))], [logs[0].part(slice(cut, None))]
    count = min(max(1, round(share * len(logs))), len(logs) - 1)
    order = np.random.default_rng(seed).permutation(len(logs))
    chosen = set(order[:count].tolist())
    return (
        [log for i, log in enumerate(logs) if i not in chosen],
        [log for i, log in enumerate(logs) if i in chosen],
    )


def _log_errors(log: ServoLog, errors: Array, slow: Array) -> LogErrors:
    on = log.enabled if log.enabled.any() else np.ones(len(log), dtype=np.bool_)
    return LogErrors(
        log=log.name,
        gain=log.register,
        rms_mrad=tuple(_rms_mrad(error[on]) for error in errors),
        slow_mrad=tuple(map(_rms_mrad, slow)) if slow.size else None,
        slow_rows=slow.shape[1],
        replay_mrad=_rms_mrad(errors[-1]),
        off_rows=int((~on).sum()),
    )


def _rms_mrad(errors: Array) -> float:
    return 1e3 * float(np.sqrt(np.mean(errors**2)))
