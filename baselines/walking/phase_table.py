r"""Phase table: a feedforward over the phase of a step, the same for all robots.

It is a simple alternative to learning. A table has the shift of the planned ZMP and the turn of the
hips. It does not depend on the robot at hand. It holds a few harmonics of the stride angle ψ, which
runs from 0 to π in a step that swings the right foot, and from π to 2π in the next one.

.. math::
    u_{x}(\psi) = \sum_k a_k \cos 2 k \psi + b_k \sin 2 k \psi, \qquad
    u_{y}(\psi) = \sum_k a_k \cos (2 k - 1) \psi + b_k \sin (2 k - 1) \psi

Forward shift and pitch are the same in left and right steps and have even harmonics. Shift to the
left and roll have odd ones, as the mirror changes their sign. There is no constant: integrals
remove constant errors. `train.learn.phase_table` finds the numbers in simulation.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from typing_extensions import override

from baselines.compensation.policy import PolicyInputs, Step
from baselines.compensation.policy_around import PassingMemory
from elastic_env.core.config import Model, Title, load_json, quantity
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array
from elastic_env.motion.gait import LEFT, Timing
from elastic_env.motion.trajectory import minimum_jerk
from elastic_env.world.robot_model import WalkerModel

MOST_HARMONICS = 8
"""Largest number of harmonics in a column of a table."""
CHANNELS = ("zmp_x", "zmp_y", "hip_roll", "hip_pitch")
"""Columns of a table: shift of the planned ZMP [m], turn of both hips [rad]."""
_IS_ODD = (False, True, True, False)
FOLDER = Path(__file__).parent / "phase_tables"
"""Tables that come with the package, a file per step period."""

_Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
_Harmonics = Annotated[list[_Pair], Field(min_length=1, max_length=MOST_HARMONICS)]


class PhaseTable(Model):
    """A table for one step period: cosine and sine a, b of every harmonic of a channel."""

    step_period_s: float = quantity("s", gt=0)
    """Duration of a step [s]."""
    found_on: Title
    """Policy and robots for which it was optimised."""
    zmp_x: _Harmonics
    """Shift of the planned ZMP forward [m]."""
    zmp_y: _Harmonics
    """The same to the left [m]."""
    hip_roll: _Harmonics
    """Offset of both hip rolls [rad]."""
    hip_pitch: _Harmonics
    """The same of both hip pitches [rad]."""

    def values(self, psi: Array) -> Array:
        """Inputs at stride angles, (n,) [rad] to (n, 4), columns as in `CHANNELS`."""
        columns = []
        for channel, is_odd in zip(CHANNELS, _IS_ODD, strict=True):
            factors = np.array(getattr(self, channel))
            columns.append(harmonics(psi, len(factors), is_odd) @ factors.ravel())
        return np.stack(columns, axis=1)


def harmonics(psi: Array, count: int, is_odd: bool) -> Array:
    """Cosine and sine of the first even or odd multiples of angles.

    Args:
        psi: Angles, (n,) [rad].
        count: Number of harmonics.
        is_odd: True for 1, 3, 5, ..., else 2, 4, 6, ...

    Returns:
        (n, 2 · count): a cosine and a sine per harmonic.
    """
    order = 2.0 * np.arange(1, count + 1) - is_odd
    angles = psi[:, None] * order
    return np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(psi), -1)


def stride_angle(timing: Timing, step_period_s: float) -> Array:
    """Stride angle ψ at the ends of all control periods, within the walk or not, (T,) [rad]."""
    begin = int(np.flatnonzero(timing.walking)[0])
    elapsed = timing.time - timing.time[begin - 1]
    first = 0.0 if timing.support[begin] == LEFT else np.pi
    return first + np.pi * elapsed / step_period_s


def shipped_tables() -> dict[float, Path]:
    """Files of the tables that come with the package, by step period [s]."""
    files = sorted(FOLDER.glob("*ms.json"))
    return {int(file.name.removesuffix("ms.json")) / 1000.0: file for file in files}


def load_phase_table(step_period_s: float, file: Path | None = None) -> PhaseTable:
    """Read the table for a gait, from a file or from the package.

    Raises:
        ConfigurationError: There is none for this step period, or it is not valid.
    """
    shipped = shipped_tables()
    if file is None:
        file = shipped.get(round(step_period_s, 3))
    if file is None:
        periods = ", ".join(f"{period:g}" for period in sorted(shipped))
        has = f"those for step periods of {periods} s" if periods else "none"
        raise ConfigurationError(
            "phase_table needs a table for the step period of the gait,"
            f" {step_period_s:g} s; the package has {has}; find one by"
            " `python -m train.learn.phase_table` and name its file in the option phase_table"
        )

    def missing(why: str) -> str:
        return f"no phase table at {file}: a file of `train.learn.phase_table` is needed ({why})"

    table = load_json(file, PhaseTable, "phase table", missing)
    if abs(table.step_period_s - step_period_s) > 1e-6:
        raise ConfigurationError(
            f"the table {file} is for a step period of {table.step_period_s:g} s, the gait has"
            f" {step_period_s:g} s; find one for it by `python -m train.learn.phase_table`"
        )
    return table


class PhaseFeedforward(PassingMemory):
    """A policy of a walker with a table added to its inputs `zmp` and `hip`, see the module.

    The table fades in with the first double support, and out with the last one.

    Args:
        policy: Commands the robot; it has the inputs `zmp` and `hip`.
        model: Assumed walker.
        table: For its step period.
    """

    def __init__(self, policy: Any, model: WalkerModel, table: PhaseTable) -> None:
        super().__init__(policy, model)
        plan = model.plan
        gait = plan.gait
        timing = plan.timing
        begin, *_, end = timing.time[timing.walking]
        fade_in = (timing.time - begin) / gait.double_support_s
        fade_out = (end - timing.time) / gait.last_double_support_s
        share = minimum_jerk(np.clip(np.minimum(fade_in, fade_out), 0.0, 1.0))
        psi = stride_angle(timing, gait.step_period_s)
        self._inputs = share[:, None] * table.values(psi)

    @override
    def act(self, rows: Array, memory: Any, inputs: PolicyInputs) -> Step:
        """Add the table to the inputs `zmp` and `hip`."""
        table = self._inputs.take(self.view.plan_row(rows), axis=0, mode="clip")
        zmp = table[:, :2] if inputs.zmp is None else inputs.zmp + table[:, :2]
        hip = table[:, 2:] if inputs.hip is None else inputs.hip + table[:, 2:]
        return self.policy.act(rows, memory, inputs._replace(zmp=zmp, hip=hip))
