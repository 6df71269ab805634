r"""TODO law"""

from collections.abc import Sequence

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array

_ORDER = 2  # of the filter, which acts twice


class ChannelGains(Model):
    """How one error, in its own unit, corrects its offset."""

    gain: float = quantity("offset/error", ge=0)
    """Learning gain γ [offset/error]."""
    lead_s: float = quantity("s", ge=0, le=1)
    """Lead ℓ: delay from an offset to its effect [s]."""
    cutoff_hz: float = quantity("Hz", gt=0, le=100)
    """Frequency at which Q halves the amplitude [Hz]."""
    surprise: float = quantity("error", gt=0)
    """By how much an error can grow from trial to trial [error]."""
    limit: float = quantity("offset", gt=0)
    """Largest offset [offset]."""
    forgetting: float = quantity("1", 0.0, ge=0, lt=1)
    """Share λ of the offset that is forgotten [1]."""
    halved_after: float | None = quantity("trials", None, gt=0)
    """Trials n that halve γ; None keeps it [trials]."""

    def gain_of(self, trial: int) -> float:
        """Learning gain of a trial, 0 for the first."""
        if self.halved_after is None:
            return self.gain
        return self.gain / (1.0 + trial / self.halved_after)


def zero_phase(table: Array, cutoff_hz: float, period_s: float) -> Array:
    """Q: a low-pass filter that runs forwards and backwards in time, so that it shifts no phase.

    Args:
        table: Values over time, (T, ...).
        cutoff_hz: Where the amplitude is halved [Hz].
        period_s: Time between rows [s].
    """
    # here: most programs need none of it, and it loads for half a second
    from scipy import signal

    sections = signal.butter(_ORDER, cutoff_hz, fs=1.0 / period_s, output="sos")
    longest = round(1.0 / (cutoff_hz * period_s))  # a period of the cutoff at both ends
    length = min(longest, len(table) - 1)
    return signal.sosfiltfilt(sections, table, axis=0, padlen=length)


def lead_error(error: Array, steps: int) -> Array:
    """Error that comes some steps later, at every step, (T, ...); its last value behind the end."""
    return error[np.minimum(np.arange(len(error)) + steps, len(error) - 1)]


def limit_surprise(error: Array, before: Array, surprise: float | Array) -> Array:
    """An error as far as that of the trial before makes it credible, elementwise.

    Args:
        error: Of this trial, nan where it was not measured, which counts as none.
        before: What was credible in the trial before.
        surprise: By how much an error can grow, in its unit.
    """
    low = np.minimum(before, 0.0) - surprise
    high = np.maximum(before, 0.0) + surprise
    return np.clip(np.nan_to_num(error), low, high)


def update(
    table: Array, error: Array, gains: Sequence[ChannelGains], dt: float, trial: int = 0
) -> Array:
    """Offsets of the next trial, see the module.

    Args:
        table: Offsets of this trial, (T, k), a column for each of the gains.
        error: What is to be corrected, at the same times, (T, k).
        gains: Of the columns.
        dt: Time between rows [s].
        trial: Number of this trial, 0 for the first.
    """
    following = np.empty_like(table)
    for column, own in enumerate(gains):
        leading = lead_error(error[:, column], round(own.lead_s / dt))
        kept = (1.0 - own.forgetting) * table[:, column]
        wanted = kept + own.gain_of(trial) * leading
        smooth = zero_phase(wanted, own.cutoff_hz, dt)
        following[:, column] = np.clip(smooth, -own.limit, own.limit)
    return following
