"""Words, signs and limits of paired changes, for tables, charts and texts."""

import numpy as np

from train.evaluate.statistics import Estimate

CEILING = "ceiling on the training condition"
"""Mark: nothing is random in the scenario, so training and evaluation see the same."""
SAME_ROBOT = "trained robot"
"""Mark: the only robot is the one of the training, so evaluation differs by noise alone."""
HELD_OUT = "held out"
"""Mark: training never saw the scenario."""
PARTLY = "partly held out"
"""Mark: training saw some scenarios of the group."""
BEST_ANALYTIC = "best policy without learning"
"""Title of the policy that a residual is compared with, apart from its base."""
FEWEST_SEEDS = 5
"""Fewest training seeds for a verdict; without training, fewest robots and episodes.

Of 95 % intervals over two seeds every second one misses the truth, over five every eleventh.
"""
CLAIM_SEEDS = 10
"""Training seeds that a claim needs. With fewer, too many intervals exclude zero by chance."""
CLAIM_ROBOTS = 64
"""Drawn robots that a claim about `drawn` needs. With 8 of them means differ by 15 %."""

SIGNS = {"none": "*", "unclear": "?"}
"""Signs behind a change that is not shown, by its verdict."""
SIGNS_ARE = (
    "A star: the interval includes zero. A question mark: too few training seeds, robots or"
    " episodes to decide."
)

_SHOWN_WITH_DECIMAL = 0.0995
"""Shares below it are shown with a decimal."""
_SHOWN_AS_ZERO = 0.005
"""Bounds below it would look like zero without a decimal."""


def add_sign(text: str, verdict: str) -> str:
    """Return the text of a change, followed by the sign of its verdict if it has one."""
    return f"{text} {SIGNS[verdict]}" if verdict in SIGNS else text


def percent(value: float, signed: bool = True) -> str:
    """Return a share in per cent, with a decimal if it is small; - for nan."""
    if not np.isfinite(value):
        return "-"
    return f"{_percent_digits(value, signed, 0.0 < abs(value) < _SHOWN_WITH_DECIMAL)} %"


def percent_interval(estimate: Estimate, signed: bool = True) -> str:
    """Return a share with its interval, such as −40 % [−45, −33]."""
    if not estimate.has_interval:
        return percent(estimate.value, signed)
    shares = (estimate.value, *estimate.ends)
    sizes = [abs(share) for share in shares]
    has_tiny_bound = any(0.0 < size < _SHOWN_AS_ZERO for size in sizes)
    has_decimal = 0.0 < max(sizes) < _SHOWN_WITH_DECIMAL or has_tiny_bound
    value, low, high = (_percent_digits(share, signed, has_decimal) for share in shares)
    return f"{value} % [{low}, {high}]"


def _percent_digits(share: float, signed: bool, has_decimal: bool) -> str:
    return f"{100.0 * share:{'+' if signed else ''}.{int(has_decimal)}f}".replace("-", "−")


def signed_interval(estimate: Estimate, verdict: str) -> str:
    """Return a share with its interval and the sign of its verdict, such as +1 % [−2, +4] *."""
    text = percent_interval(estimate)
    return add_sign(text, verdict) if np.isfinite(estimate.value) else text
