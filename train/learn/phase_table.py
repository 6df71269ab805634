r"""`python -m train.learn.phase_table`: find the table of the policy `phase_table` in simulation.

The walk is periodic, so its mean error over robots is a sum of harmonics, as the table is. Near a
table, the harmonics e of the errors depend on those u of the table,

.. math:: e = e_0 + G u

with a complex matrix G for each harmonic and each of two planes: forward (ZMP, pitch) and sideways
(ZMP, roll). Two plays with a known u identify G. Then every play corrects u as in iterative
learning control, with a damped inverse of G as the learning gain [Bristow2006],

.. math:: u \leftarrow u - \gamma (G^* G + \lambda)^{-1} G^* e

[Bristow2006]: see `baselines.adaptation.learning_law`.
"""

from collections.abc import Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
import tyro
from rich.console import Console

import baselines
from baselines.walking.phase_table import (
    CHANNELS,
    FOLDER,
    MOST_HARMONICS,
    PhaseFeedforward,
    PhaseTable,
    harmonics,
    stride_angle,
)
from elastic_env.core.config import Model, quantity
from elastic_env.core.files import write_whole
from elastic_env.core.signals import Array
from train.evaluate.rollout import control_steps

ComplexArray: TypeAlias = npt.NDArray[np.complex128]
_PLANES = ((("zmp_x", "hip_pitch"), False), (("zmp_y", "hip_roll"), True))
_ERRORS = {
    "zmp_x": "zmp_deviation_x",
    "hip_pitch": "pelvis_pitch",
    "zmp_y": "zmp_deviation_y",
    "hip_roll": "pelvis_roll",
}
_SCALE = {"zmp_x": 5e-3, "zmp_y": 5e-3, "hip_pitch": 1e-3, "hip_roll": 1e-3}
"""Errors of equal weight, which are the units of errors and inputs [m], [rad]."""
_PROBE_AMPLITUDES = (0.2, 3.0)
"""Amplitudes of the inputs that identify the response, in units of `_SCALE`."""
_DECIMALS = 5
"""Decimals of a table: 0.01 mm, 0.01 mrad."""


class Search(Model):
    """Find a table over the phase of a step on robots of bank 1, and write it."""

    step_period: float = 3.0
    """Step period of the gait: 24, 3, 1.6 or 1.1 [s]."""
    scenario: str = "drawn"
    """Scenario that the robots come from."""
    robots: int = quantity("1", 24, ge=1, le=256)
    """Robots, whose seeds are 0, 1, ..."""
    strides: int = quantity("1", 2, ge=1, le=100)
    """Strides of two steps whose errors are averaged; one more stride comes first."""
    num_harmonics: int = quantity("1", 4, ge=1, le=MOST_HARMONICS)
    """Harmonics of each of the four inputs."""
    plays: int = quantity("1", 3, ge=1, le=100)
    """Corrections of the table; each plays a walk."""
    gain: float = quantity("1", 0.8, gt=0, le=1)
    """Learning gain γ."""
    damping: float = quantity("1", 0.02, gt=0)
    """Damping λ of the inverse, where ZMP errors of 5 mm and tilts of 1 mrad are one."""
    output: Path | None = None
    """File for the table; default the file of the package."""


class Harmonics(NamedTuple):
    """Harmonics of both planes, (planes, count, 2) complex in units of `_SCALE`.

    The real part is the factor of the cosine in `PhaseTable`, the imaginary part minus that of the
    sine.
    """

    planes: ComplexArray

    @classmethod
    def from_columns(cls, columns: dict[str, Array]) -> Self:
        """Convert factors of cosines and sines, (2 · count,) by the name of the channel."""
        planes = []
        for names, _ in _PLANES:
            pairs = [columns[name].reshape(-1, 2) / _SCALE[name] for name in names]
            planes.append(np.stack([p[:, 0] - 1j * p[:, 1] for p in pairs], axis=1))
        return cls(np.array(planes))

    def table(self, search: Search) -> PhaseTable:
        """Return the table with these harmonics."""
        columns: dict[str, Any] = {}
        for (names, _), plane in zip(_PLANES, self.planes, strict=True):
            for i, name in enumerate(names):
                parts = [plane[:, i].real, -plane[:, i].imag]
                pairs = _SCALE[name] * np.stack(parts, axis=1)
                columns[name] = np.round(pairs, _DECIMALS).tolist()
        robots = f"{search.robots} robots of bank 1 in {search.scenario}"
        return PhaseTable(
            step_period_s=search.step_period, found_on=f"foothold, {robots}", **columns
        )


def probe_inputs(count: int, channel: int) -> Harmonics:
    """Inputs of equal amplitude in every harmonic of the ZMP (channel 0) or of the hips (1)."""
    planes = np.zeros((2, count, 2), dtype=np.complex128)
    order = np.arange(count)
    # Schroeder phases keep the sum low
    phases = np.exp(-1j * np.pi * order * (order + 1) / count)
    planes[:, :, channel] = _PROBE_AMPLITUDES[channel] * phases
    return Harmonics(planes)


def correct_inputs(
    inputs: Harmonics, errors: Harmonics, response: ComplexArray, search: Search
) -> Harmonics:
    """Return the corrected inputs u, see the module; the response G is (planes, count, 2, 2)."""
    adjoint = response.conj().swapaxes(-1, -2)
    damped = adjoint @ response + search.damping * np.eye(2)
    step = np.linalg.solve(damped, adjoint @ errors.planes[..., None])[..., 0]
    return Harmonics(inputs.planes - search.gain * step)


class Walks:
    """Walks of the same robots with other tables.

    Args:
        search: Gait and robots.
    """

    def __init__(self, search: Search) -> None:
        self._search = search
        self.env: Any = gymnasium.make_vec(
            "elastic_env/WalkInPlace-v0",
            num_envs=search.robots,
            vectorization_mode="vector_entry_point",
            step_period=search.step_period,
            num_steps=2 * search.strides + 2,
            gait={"settling_steps": 2},
            scenario=search.scenario,
            bank=1,
        )
        plan = self.env.unwrapped.task.plan
        self._rows = np.flatnonzero(plan.timing.scored)
        psi = stride_angle(plan.timing, search.step_period)[self._rows]
        self._fits = {}
        for names, is_odd in _PLANES:
            fit = np.linalg.pinv(harmonics(psi, search.num_harmonics, is_odd))
            self._fits.update(dict.fromkeys(names, fit))

    def errors(self, table: PhaseTable) -> tuple[Harmonics, dict[str, float]]:
        """Play a table; return harmonics and rms of the mean error of robots that do not fall."""
        model = self.env.unwrapped.assumed_model
        policy = PhaseFeedforward(baselines.make("foothold", self.env), model, table)
        stands = np.ones(self._search.robots, dtype=np.bool_)
        logs: dict[str, list[Array]] = {name: [] for name in CHANNELS}
        steps = control_steps(self.env, policy, list(range(self._search.robots)))
        for step in islice(steps, int(self._rows[-1])):
            stands &= ~step.terminated
            for name, log in logs.items():
                log.append(np.nan_to_num(step.info[_ERRORS[name]]))
        columns = {}
        rms = {}
        for name, log in logs.items():
            errors = np.array(log)[self._rows - 1][:, stands]
            columns[name] = self._fits[name] @ errors.mean(axis=1)
            rms[name] = float(np.sqrt((errors**2).mean()))
        rms["fell"] = float((~stands).sum())
        return Harmonics.from_columns(columns), rms


class Play(NamedTuple):
    """Errors that remain with a table.

    Attributes:
        inputs: Harmonics of the table.
        errors: Harmonics of the mean errors.
        rms: Errors by channel [m], [rad], and the number of robots that `fell`.
    """

    inputs: Harmonics
    errors: Harmonics
    rms: dict[str, float]

    @property
    def cost(self) -> float:
        """Sum of squares of all errors in units of `_SCALE`; infinite where a robot fell."""
        if self.rms["fell"] > 0.0:
            return np.inf
        return sum((self.rms[name] / _SCALE[name]) ** 2 for name in CHANNELS)


def find_table(search: Search) -> PhaseTable:
    """Find the best table of all plays, and print the errors of every play."""
    none = Harmonics(np.zeros((2, search.num_harmonics, 2), dtype=np.complex128))
    walks = Walks(search)
    with closing(walks.env):

        def play(inputs: Harmonics, title: str) -> Play:
            errors, rms = walks.errors(inputs.table(search))
            shares = [f"{name} {1e3 * rms[name]:.2f}" for name in CHANNELS]
            Console().print(f"{title}: {', '.join(shares)} mm, mrad rms, {rms['fell']:g} falls")
            return Play(inputs, errors, rms)

        before = play(none, "without")
        response = []
        for channel, title in enumerate(("ZMP", "hips")):
            inputs = probe_inputs(search.num_harmonics, channel)
            errors = play(inputs, f"probe of {title}").errors
            change = errors.planes - before.errors.planes
            response.append(change / inputs.planes[:, :, channel, None])
        matrix = np.stack(response, axis=-1)
        plays = [before]
        for number in range(search.plays):
            last = plays[-1]
            inputs = correct_inputs(last.inputs, last.errors, matrix, search)
            plays.append(play(inputs, f"table {number + 1}"))
    return best_play(plays).inputs.table(search)


def best_play(plays: Sequence[Play]) -> Play:
    """The play with the lowest cost, since a correction may increase the errors."""
    return min(plays, key=lambda play: play.cost)


def main(search: Search) -> None:
    """Find a table, and write it."""
    table = find_table(search)
    file = search.output or FOLDER / f"{round(1000.0 * search.step_period)}ms.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, table.model_dump_json(indent=2) + "\n")
    Console().print(f"wrote {file}")


if __name__ == "__main__":
    main(tyro.cli(Search))
