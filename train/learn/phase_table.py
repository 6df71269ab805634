r"""`python -m train.learn.phase_table`: find the table of the policy `phase_table` in simulation.

The walk is periodic, so its mean error over robots is a sum of harmonics, as the table is. Near the
table that is played, the harmonics e of the errors follow those u of the table,

.. math:: e = e_0 + G u

with a complex matrix G for each harmonic and each of two planes: forward (ZMP, pitch) and sideways
(ZMP, roll). Two plays with a known u show it. Then u is corrected from play to play as in iterative
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
"""Errors that weigh the same, and unit of the inputs [m], [rad]."""
_PROBE = (0.2, 3.0)
"""Amplitude of the inputs that show the response, in that unit."""
_DIGITS = 5
"""Decimals that are kept: 0.01 mm, 0.01 mrad."""


class Search(Model):
    """Find a table over the phase of a step on robots of bank 1, and write it."""

    step_period: float = 3.0
    """Step period of the gait: 24, 3, 1.6 or 1.1 [s]."""
    scenario: str = "drawn"
    """Scenario that the robots come from."""
    robots: int = quantity("1", 24, ge=1, le=256)
    """Robots, whose seeds are 0, 1, ..."""
    strides: int = quantity("1", 2, ge=1, le=100)
    """Strides of two steps whose errors are averaged, after a first one that is not."""
    num_harmonics: int = quantity("1", 4, ge=1, le=MOST_HARMONICS)
    """Harmonics of each of the four inputs."""
    plays: int = quantity("1", 3, ge=1, le=100)
    """Corrections of the table; every one plays a walk."""
    gain: float = quantity("1", 0.8, gt=0, le=1)
    """Learning gain γ."""
    damping: float = quantity("1", 0.02, gt=0)
    """Damping λ of the inverse, where ZMP errors of 5 mm and tilts of 1 mrad are one."""
    output: Path | None = None
    """File for the table; default the package's own."""


class Harmonics(NamedTuple):
    """Harmonics of both planes, (planes, count, 2) complex in units of `_SCALE`.

    Real part less i times the sine's is what `PhaseTable` has.
    """

    planes: ComplexArray

    @classmethod
    def of(cls, columns: dict[str, Array]) -> Self:
        """Of cosines and sines, (2 · count,) by the name of the channel."""
        planes = []
        for names, _ in _PLANES:
            pairs = [columns[name].reshape(-1, 2) / _SCALE[name] for name in names]
            planes.append(np.stack([pair[:, 0] - 1j * pair[:, 1] for pair in pairs], axis=1))
        return cls(np.array(planes))

    def table(self, search: Search) -> PhaseTable:
        """As a table."""
        columns: dict[str, Any] = {}
        for (names, _), plane in zip(_PLANES, self.planes, strict=True):
            for i, name in enumerate(names):
                pairs = _SCALE[name] * np.stack([plane[:, i].real, -plane[:, i].imag], axis=1)
                columns[name] = np.round(pairs, _DIGITS).tolist()
        robots = f"{search.robots} robots of bank 1 in {search.scenario}"
        return PhaseTable(
            step_period_s=search.step_period, found_on=f"foothold, {robots}", **columns
        )


def probe(count: int, channel: int) -> Harmonics:
    """A known table: the same in every harmonic of the ZMP, 0, or of the hips, 1."""
    planes = np.zeros((2, count, 2), dtype=np.complex128)
    # phases that keep the sum low, as Schroeder's
    order = np.arange(count)
    planes[:, :, channel] = _PROBE[channel] * np.exp(-1j * np.pi * order * (order + 1) / count)
    return Harmonics(planes)


def next_table(
    now: Harmonics, error: Harmonics, response: ComplexArray, search: Search
) -> Harmonics:
    """The next table, see the module; the response is (planes, count, 2, 2)."""
    adjoint = response.conj().swapaxes(-1, -2)
    damped = adjoint @ response + search.damping * np.eye(2)
    step = np.linalg.solve(damped, adjoint @ error.planes[..., None])[..., 0]
    return Harmonics(now.planes - search.gain * step)


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
        """Harmonics of the mean error, and its rms by channel: of robots that did not fall."""
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
        return Harmonics.of(columns), rms


class Play(NamedTuple):
    """What a table left.

    Attributes:
        inputs: The table.
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


def find(search: Search) -> PhaseTable:
    """Find a table, and print the errors of every play; the best one counts."""
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
            known = probe(search.num_harmonics, channel)
            change = play(known, f"probe of {title}").errors.planes - before.errors.planes
            response.append(change / known.planes[:, :, channel, None])
        matrix = np.stack(response, axis=-1)
        plays = [before]
        for number in range(search.plays):
            last = plays[-1]
            now = next_table(last.inputs, last.errors, matrix, search)
            plays.append(play(now, f"table {number + 1}"))
    return best(plays).inputs.table(search)


def best(plays: Sequence[Play]) -> Play:
    """The play of the least cost: a correction may be one too many."""
    return min(plays, key=lambda own: own.cost)


def main(search: Search) -> None:
    """Find a table, and write it."""
    table = find(search)
    name = f"{round(1000.0 * search.step_period)}ms.json"
    file = search.output or FOLDER / name
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, table.model_dump_json(indent=2) + "\n")
    Console().print(f"wrote {file}")


if __name__ == "__main__":
    main(tyro.cli(Search))
