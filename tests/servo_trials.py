"""How often intervals of a servo hold the truth: `python -m tests.servo_trials`.

Every trial is a servo of known parameters that plays three motions: two sweeps at two gains, and
a lift whose torque is taken off. The truth is played at a hundredth of the fit's step, and read by
an encoder of 4096 counts a turn with noise. Writes docs/results/servo_coverage.csv; some minutes.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from baselines.identification.servo_fit import ServoFit, fit_servo
from baselines.identification.servo_load import Load
from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_replay import NAMES, Replay
from elastic_env.core.signals import Array
from train.runs.escaping import write_records

SOUGHT = (
    "position_gain",
    "motor_damping",
    "rotor_inertia",
    "coulomb_friction",
    "load_friction",
    "viscous_friction",
    "zero_offset",
    "delay",
    "switch_lead",
)
"""Parameters that every trial has and that the logs tell."""
COUNT_RAD = 2.0 * np.pi / 4096
NOISE_RAD = 1e-3
STEP_S = 5e-3
"""Time between rows, within which the torque is switched [s]."""
SMALLEST = 1e-3
"""Value that a half-width is relative to at least, in the unit of the parameter."""


def draw_servo(rng: np.random.Generator) -> Array:
    """Parameters of a small servo, as in `NAMES`, (13,)."""
    values: dict[str, float] = dict.fromkeys(NAMES, 0.0)
    values |= {
        "position_gain": rng.uniform(1.5e-3, 4e-3),
        "torque_limit": np.inf,
        "motor_damping": rng.uniform(0.02, 0.06),
        "rotor_inertia": rng.uniform(1e-3, 4e-3),
        "coulomb_friction": rng.uniform(0.01, 0.05),
        "load_friction": rng.uniform(0.1, 0.5),
        "viscous_friction": rng.uniform(0.003, 0.012),
        "stribeck_speed": 0.3,
        "zero_offset": rng.uniform(-0.02, 0.02),
        "delay": rng.uniform(0.002, 0.02),
        "switch_lead": rng.uniform(0.0, STEP_S),
    }
    return np.array([values[name] for name in NAMES])


def make_logs(truth: Array, rng: np.random.Generator, step_s: float = STEP_S) -> list[ServoLog]:
    """Logs of three motions of a servo."""
    return [_record(log, truth, rng) for log in _motions(step_s)]


def _motions(step_s: float) -> Iterator[ServoLog]:
    time = step_s * np.arange(round(6.0 / step_s))
    on = np.ones(len(time), dtype=np.bool_)
    load = Load.pendulum(0.5, 0.1)
    sweep = 1.2 * np.sin(1.1 * time) + 0.5 * np.sin(4.3 * time)
    start = np.zeros(len(time))
    for gain in (200.0, 800.0):
        yield ServoLog(f"sweep {gain:g}", time, sweep, start, on, gain=gain, load=load)
    lift = 1.5 * np.sin(0.5 * np.pi * np.minimum(time / 1.5, 1.0))
    off = time < 2.0
    yield ServoLog("lift and drop", time, lift, start, off, gain=800.0, load=load)


def _record(log: ServoLog, truth: Array, rng: np.random.Generator) -> ServoLog:
    """The log as an encoder has it."""
    fine = np.arange(log.time[0], log.time[-1] + 1e-9, (log.time[1] - log.time[0]) / 100)
    dense = ServoLog(
        "fine",
        fine,
        np.interp(fine, log.time, log.goal),
        np.zeros(len(fine)),
        np.interp(fine, log.time, log.enabled.astype(float)) > 0.999,
        gain=log.gain,
        load=log.load,
    )
    told = fine + truth[NAMES.index("switch_lead")] + 1e-12
    at = np.minimum(np.searchsorted(log.time, told, side="right") - 1, len(log.time) - 1)
    dense = replace(dense, enabled=log.enabled[at])
    at_once = np.where(np.array(NAMES) == "switch_lead", 0.0, truth)
    q = Replay.from_log(dense).play(at_once)[::100][: len(log.time)]
    q = q + NOISE_RAD * rng.normal(size=len(q))
    return replace(log, position=np.round(q / COUNT_RAD) * COUNT_RAD)


def holds(fit: ServoFit, truth: Array) -> dict[str, bool]:
    """Of each parameter whether its interval holds the truth."""
    return {
        name: bool(abs(fit.value(name) - truth[NAMES.index(name)]) <= fit.half(name))
        for name in SOUGHT
    }


def records(trials: int) -> Iterator[dict[str, Any]]:
    """Rows of the table, one per parameter."""
    held: list[dict[str, bool]] = []
    widths: list[dict[str, float]] = []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        truth = draw_servo(rng)
        fit = fit_servo(make_logs(truth, rng))
        held.append(holds(fit, truth))
        sizes = np.maximum(np.abs(truth), SMALLEST)
        widths.append({name: fit.half(name) / sizes[NAMES.index(name)] for name in SOUGHT})
        if seed % 10 == 9:
            print(f"{seed + 1} servos", flush=True)
    for name in SOUGHT:
        yield {
            "parameter": name,
            "trials": trials,
            "holds": sum(own[name] for own in held),
            "half_width_median": f"{np.median([own[name] for own in widths]):.4g}",
        }


def main(trials: int = 100) -> None:
    """Write how many of the intervals hold the truth, and their median half-width.

    Args:
        trials: Servos.
    """
    folder = Path(__file__).parents[1] / "docs" / "results"
    print(f"wrote {write_records(list(records(trials)), folder / 'servo_coverage.csv')}")


if __name__ == "__main__":
    tyro.cli(main)
