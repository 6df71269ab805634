"""Replay of logs that were not fitted, beside predictions that need no physics."""

from collections.abc import Sequence

import numpy as np

from baselines.identification.servo_fit import ServoFit
from baselines.identification.servo_log import FEWEST_ROWS, ServoLog, slow_rows
from elastic_env.core.config import Model
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array

PREDICTIONS = ("the goal itself", "a constant offset", "a line in the goal", "identified")
_FEWEST_HELD_OUT = 20


class ServoError(Model):
    """Error of a prediction of the angle at logs that were not fitted."""

    name: str
    rms_mrad: float
    """Root mean square over all rows with torque on, logs weighted alike."""
    slow_mrad: float | None
    """The same over rows of slow motion, each alike; None where nothing moves slowly."""


class LogErrors(Model):
    """Errors at one log."""

    log: str
    gain: float
    rms_mrad: tuple[float, ...]
    """One for each prediction."""
    slow_mrad: tuple[float, ...] | None
    slow_rows: int
    replay_mrad: float
    """Of the replay over all rows, those with the torque off included."""
    off_rows: int = 0
    """Rows with the torque off, which `rms_mrad` leaves out."""


class ServoHoldout(Model):
    """Errors at logs that were not fitted; a part of `identification.json`."""

    fitted: tuple[str, ...]
    replay_mrad: float
    """Root mean square of the replay over all rows of the logs, torque off included."""
    errors: tuple[ServoError, ...]
    """Of the rivals, and the identification last."""
    logs: tuple[LogErrors, ...]

    @property
    def has_torque_off(self) -> bool:
        """True if `errors` leave out rows with the torque off."""
        return any(log.off_rows for log in self.logs)

    @property
    def best_rival(self) -> ServoError:
        """The best prediction but the identification."""
        return min(self.errors[:-1], key=lambda error: error.rms_mrad)


def judge_servo(fit: ServoFit, held_out: Sequence[ServoLog]) -> ServoHoldout:
    """Errors of a fit and of rivals that learn from the same logs.

    Args:
        fit: A fit to other logs.
        held_out: Logs that it did not see.
    """
    logs = []
    slow = []
    for log in held_out:
        played = fit.replay(log)
        errors = np.vstack([rivals(fit.logs, log), played]) - log.position
        slowly = np.vstack([rivals(fit.logs, log, slow=True), played]) - log.position
        slow.append(slowly[:, slow_rows(log)])
        logs.append(_of_log(log, errors, slow[-1]))
    slowly = np.concatenate(slow, axis=1)
    total = np.array([log.rms_mrad for log in logs])
    return ServoHoldout(
        fitted=tuple(log.name for log in fit.logs),
        replay_mrad=float(np.sqrt(np.mean([log.replay_mrad**2 for log in logs]))),
        errors=tuple(
            ServoError(
                name=name,
                rms_mrad=float(np.sqrt(np.mean(total[:, i] ** 2))),
                slow_mrad=_mrad(slowly[i]) if slowly.shape[1] else None,
            )
            for i, name in enumerate(PREDICTIONS)
        ),
        logs=tuple(logs),
    )


def rivals(fitted: Sequence[ServoLog], log: ServoLog, *, slow: bool = False) -> Array:
    """Angles of a log by predictions without physics, (3, N) [rad].

    Offset and line are those of the fitted logs with the same gain, or of all if there are none.

    Args:
        fitted: Logs to learn from.
        log: Log to predict.
        slow: Learn from rows of slow motion only, where there are any.
    """
    own = [one for one in fitted if one.gain == log.gain and one.enabled.any()]
    own = own or [one for one in fitted if one.enabled.any()]
    offset = 0.0
    line = np.array([0.0, 1.0])
    if own:
        rows = [slow_rows(one) if slow else one.enabled for one in own]
        if not any(part.any() for part in rows):
            rows = [one.enabled for one in own]
        goal = np.concatenate([one.goal[part] for one, part in zip(own, rows, strict=True)])
        position = np.concatenate([one.position[part] for one, part in zip(own, rows, strict=True)])
        offset = float(np.mean(position - goal))
        line = fit_line(goal, position)
    return np.stack([log.goal, log.goal + offset, line[0] + line[1] * log.goal])


def fit_line(goal: Array, position: Array) -> Array:
    """Constant and slope of the least-squares line, (2,)."""
    rows = np.column_stack([np.ones(len(goal)), goal])
    return np.linalg.lstsq(rows, position, rcond=None)[0]


def split_logs(
    logs: Sequence[ServoLog], share: float, seed: int
) -> tuple[list[ServoLog], list[ServoLog]]:
    """Logs to fit and logs to hold out; of a single log its last part.

    Args:
        logs: All logs.
        share: Share that is held out; at least one log is fitted and one held out.
        seed: Seed of the draw.

    Raises:
        ConfigurationError: A part of a single log has too few rows.
    """
    if len(logs) == 1:
        at = round((1.0 - share) * len(logs[0]))
        if at < FEWEST_ROWS or len(logs[0]) - at < _FEWEST_HELD_OUT:
            raise ConfigurationError(
                f"--holdout {share:g} fits {at} rows of {logs[0].name} and holds out"
                f" {len(logs[0]) - at}, at least {FEWEST_ROWS} and {_FEWEST_HELD_OUT} are needed;"
                " choose another share, 0 for none, or give more logs"
            )
        return [logs[0].part(slice(0, at))], [logs[0].part(slice(at, None))]
    count = min(max(1, round(share * len(logs))), len(logs) - 1)
    order = np.random.default_rng(seed).permutation(len(logs))
    chosen = set(order[:count].tolist())
    return (
        [log for i, log in enumerate(logs) if i not in chosen],
        [log for i, log in enumerate(logs) if i in chosen],
    )


def _of_log(log: ServoLog, errors: Array, slow: Array) -> LogErrors:
    on = log.enabled if log.enabled.any() else np.ones(len(log), dtype=np.bool_)
    return LogErrors(
        log=log.name,
        gain=log.register,
        rms_mrad=tuple(_mrad(error[on]) for error in errors),
        slow_mrad=tuple(map(_mrad, slow)) if slow.size else None,
        slow_rows=slow.shape[1],
        replay_mrad=_mrad(errors[-1]),
        off_rows=int((~on).sum()),
    )


def _mrad(errors: Array) -> float:
    return 1e3 * float(np.sqrt(np.mean(errors**2)))
