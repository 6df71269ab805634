"""Charts of signals over time."""

from collections.abc import Mapping, Sequence
from itertools import chain, product

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.motion.trajectory import STAND_S
from train.evaluate.environments import TracedSignal
from train.figures.chart import Chart, Colours, Curve, Evaluations, Mark, Panel
from train.figures.colours import RAMP, REFERENCE, SCORED, dash_of


def time_chart(
    policies: Mapping[str, Evaluations],
    signals: Sequence[TracedSignal],
    colours: Colours,
    most_points: int | None = None,
    most_lines: int | None = None,
) -> Chart:
    """Chart of signals of the first episodes over time; median and band over training seeds.

    The scale fits walks that go on: a signal may leave the chart during the ramp-in, or shortly
    before a fall. Strips mark the times in which policies ramp in, and those that are scored.

    Args:
        policies: Evaluations with a trace, by title of the policy.
        signals: Signals, a panel for each.
        colours: Colours of the policies.
        most_points: Approximate number of points of a curve; None for all.
        most_lines: Largest number of lines of a panel, with the reference; None for all. Policies
            with similar errors share a panel.
    """
    longest = _longest_trace(list(chain(*policies.values())))
    time_s = longest["time_s"]
    stride = 1 if most_points is None else max(1, -(-len(time_s) // most_points))
    most = len(policies)
    if most_lines is not None:
        most = most_lines - any(signal.reference is not None for signal in signals)
    parts = _split_policies(policies, signals, most)
    panels = []
    for signal, titles in product(signals, parts):
        curves = [_curve(t, colours[t], policies[t], signal, stride) for t in titles]
        if signal.reference is not None:
            y = signal.scale * longest[signal.reference][::stride]
            look = (REFERENCE, time_s[::stride], y, "dash")
            curves.append(Curve("reference", *look, width=1.1))
        limits = _axis_limits([*chain(*(policies[title] for title in titles))], signal)
        own_legend = titles if len(parts) > 1 else ()
        panels.append(Panel(signal.label, curves, limits, own_legend=own_legend))
    single = longest.get("single_support", np.zeros(len(time_s)))
    marks = _time_marks(longest)
    return Chart("", "time [s]", panels, shaded=intervals(single, time_s), marks=marks)


def _split_policies(
    policies: Mapping[str, Evaluations], signals: Sequence[TracedSignal], most: int
) -> list[list[str]]:
    """Split policies into parts of similar size, at most `most` each, the greatest errors first.

    A single part keeps the order of the policies.
    """
    number = -(-len(policies) // most)
    if number == 1:
        return [list(policies)]
    errors = np.array([[_rms(runs, s) for s in signals] for runs in policies.values()])
    sizes = np.nansum(errors / np.maximum(np.nanmax(errors, axis=0), 1e-12), axis=1)
    titles = list(policies)
    order = [titles[index] for index in np.argsort(-sizes, kind="stable")]
    return [list(part) for part in np.array_split(order, number)]


def _rms(evaluations: Evaluations, signal: TracedSignal) -> float:
    """RMS of a signal minus its reference, without the time shortly before a fall."""
    parts = []
    for e in evaluations:
        reference = 0.0 if signal.reference is None else e.trace[signal.reference]
        parts.append((e.trace[signal.name] - reference)[e.is_steady])
    values = np.concatenate(parts)
    if not np.isfinite(values).any():
        return float("nan")
    return float(np.sqrt(np.nanmean(values**2)))


def _time_marks(trace: Mapping[str, Array]) -> list[Mark]:
    """Marks of the time in which policies ramp in, and of the times that are scored."""
    time_s = trace["time_s"]
    ramp = (float(time_s[0]), min(STAND_S, float(time_s[-1])))
    scored = intervals(trace["scored"], time_s)
    return [Mark("ramp-in, may leave the axes", RAMP, [ramp]), Mark("scored", SCORED, scored)]


def _longest_trace(evaluations: Evaluations) -> Mapping[str, Array]:
    return max((e.trace for e in evaluations), key=lambda trace: len(trace["time_s"]))


def _curve(title: str, colour: str, seeds: Evaluations, signal: TracedSignal, stride: int) -> Curve:
    """Curve of a signal under a policy, from an evaluation per training seed."""
    time_s = _longest_trace(seeds)["time_s"]
    values = np.full((len(seeds), len(time_s)), np.nan)
    for row, e in zip(values, seeds, strict=True):
        row[: len(e.trace[signal.name])] = signal.scale * e.trace[signal.name]
    look = {"dash": dash_of(title), "fails": len(seeds) == 1 and seeds[0].first_failed}
    return Curve.median(title, colour, time_s[::stride], values[:, ::stride], **look)


def _axis_limits(evaluations: Evaluations, signal: TracedSignal) -> tuple[float, float]:
    """Range of a signal and its reference with a margin, without the ramp-in and a fall."""
    names = [name for name in (signal.name, signal.reference) if name is not None]
    masks = [e.is_steady & (e.trace["time_s"] > STAND_S) for e in evaluations]
    if not any(mask.any() for mask in masks):
        masks = [e.is_steady for e in evaluations]
    pairs = zip(evaluations, masks, strict=True)
    values = np.concatenate([e.trace[n][mask] for e, mask in pairs for n in names])
    values = signal.scale * values[np.isfinite(values)]
    if len(values) == 0:
        return -1.0, 1.0
    margin = 0.06 * float(np.ptp(values)) + 1e-6
    return float(values.min()) - margin, float(values.max()) + margin


def intervals(mask: Array, time: Array) -> list[tuple[float, float]]:
    """Beginnings and ends of the times at which a mask is true; mask and time are (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0.0], mask > 0.5, [0.0]])))
    pairs = edges.reshape(-1, 2)
    return [(float(time[begin]), float(time[end - 1])) for begin, end in pairs]
