r"""Iterative learning control: the errors of a trial correct the offsets of the next one.

.. math:: u_{j+1}(t) = Q \, [\, (1 - \lambda) \, u_j(t) + \gamma \, e_j(t + \ell) \,]

u is a table of offsets over the time of a trial, and e the error that the sensors measured in trial
j. γ is the learning gain. It may fall as 1 / (1 + j/n), which averages the noise of later trials
[Saab2001]. A share λ is forgotten, so that noise does not add up where the plant hardly responds.
The lead ℓ compensates the delay from an offset to its effect. Q is a low-pass filter without phase
shift, which stops learning where the delay is not known well enough [Longman2000, Elci2002]. With a
plant e = d − P u the error shrinks from trial to trial where, at all frequencies,

.. math:: | Q \, (1 - \lambda - \gamma \, e^{i \omega \ell} P) | < 1

[Bristow2006]; the wrong sign of γ diverges. With Q = 1, λ = 0 and P = p it is e_j = (1 − γ p)^j
e_0.

A push in one trial is no error of the robot. So an error may shrink by any amount from one trial to
the next. Growth, also beyond a change of sign, counts up to the surprise.

[Bristow2006] D. A. Bristow, M. Tharayil, A. G. Alleyne, "A Survey of Iterative Learning Control",
IEEE Control Systems Magazine 26(3). [Longman2000] R. W. Longman, "Iterative Learning Control and
Repetitive Control for Engineering Practice", International Journal of Control 73(10). [Saab2001] S.
S. Saab, "A Discrete-Time Stochastic Learning Control Algorithm", IEEE Trans. Automatic Control
46(6). [Elci2002] H. Elci, R. W. Longman, M. Q. Phan, J.-N. Juang, R. Ugoletti, "Simple Learning
Control Made Practical by Zero-Phase Filtering: Applications to Robotics", IEEE Trans. Circuits and
Systems I 49(6).
"""

from collections.abc import Sequence

import numpy as np

from elastic_env.core.config import Model, quantity
from elastic_env.core.signals import Array

_FILTER_ORDER = 2  # the filter acts twice


class ChannelGains(Model):
    """Gains with which one error, in its own unit, corrects its offset."""

    gain: float = quantity("offset/error", ge=0)
    """Learning gain γ [offset/error]."""
    lead_s: float = quantity("s", ge=0, le=1)
    """Lead ℓ: delay from an offset to its effect [s]."""
    cutoff_hz: float = quantity("Hz", gt=0, le=100)
    """Frequency at which Q halves the amplitude [Hz]."""
    surprise: float = quantity("error", gt=0)
    """Largest growth of an error from trial to trial [error]."""
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
        cutoff_hz: Frequency at which the amplitude is halved [Hz].
        period_s: Time between rows [s].
    """
    # imported here: most programs do not need it, and it loads for half a second
    from scipy import signal

    sections = signal.butter(_FILTER_ORDER, cutoff_hz, fs=1.0 / period_s, output="sos")
    # a period of the cutoff at both ends
    padding = min(round(1.0 / (cutoff_hz * period_s)), len(table) - 1)
    return signal.sosfiltfilt(sections, table, axis=0, padlen=padding)


def lead_error(error: Array, steps: int) -> Array:
    """Error some steps later, at every step, (T, ...); beyond the end its last value."""
    return error[np.minimum(np.arange(len(error)) + steps, len(error) - 1)]


def limit_surprise(error: Array, before: Array, surprise: float | Array) -> Array:
    """Limit the growth of an error since the last trial, elementwise.

    Args:
        error: Error of this trial; nan where it was not measured, which counts as zero.
        before: Limited error of the last trial.
        surprise: Largest growth of an error, in its unit.
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
        error: Errors to be corrected, at the same times, (T, k).
        gains: Gains of the columns.
        dt: Time between rows [s].
        trial: Number of this trial, 0 for the first.
    """
    next_table = np.empty_like(table)
    for column, channel in enumerate(gains):
        later_error = lead_error(error[:, column], round(channel.lead_s / dt))
        remaining = (1.0 - channel.forgetting) * table[:, column]
        corrected = remaining + channel.gain_of(trial) * later_error
        smooth = zero_phase(corrected, channel.cutoff_hz, dt)
        next_table[:, column] = np.clip(smooth, -channel.limit, channel.limit)
    return next_table
