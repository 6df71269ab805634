"""N worlds of one MuJoCo model: a thread pool for many, plain `mj_step` for one, the same results bit for bit.

Arrays are (num_worlds, ...) views of the live state. All sub-steps of a control period are one call.
"""

import copy
import os
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco import batch

from elastic_env.errors import ConfigurationError
from elastic_env.signals import Array, BoolArray


class Simulation(Protocol):
    """What a task needs of the physics. The state arrays are live views; writing `ctrl` commands the next advance."""

    model: mujoco.MjModel
    num_worlds: int
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    def bind(self, field: str) -> Array:
        """A live (num_worlds, ...) view of a field of `MjData`.

        Inputs such as `xfrc_applied` can be written. Derived fields and sensors lag one physics step behind the state,
        as after `mj_step`; they are filled by the calls after they were first bound, so bind them before `refresh`.
        """
        ...

    def views(self, fields: tuple[str, ...]) -> tuple[Array, ...]:
        """Several fields bound."""
        ...

    def vary(self, field: str) -> Array:
        """A live (num_worlds, ...) array of a field of `MjModel`, of each world its own from now on."""
        ...

    def advance(self, num_substeps: int) -> None:
        """Step every world by `num_substeps` physics steps under its current `ctrl`."""
        ...

    def refresh(self, worlds: BoolArray) -> None:
        """Compute derived fields and sensors of the present state in some worlds, a (num_worlds,) mask."""
        ...

    def restart(self, worlds: BoolArray) -> None:
        """Set some worlds, a (num_worlds,) mask, to the model's defaults; write their state afterwards."""
        ...

    def diverged(self) -> BoolArray:
        """Worlds in which MuJoCo warned of a bad number since their restart, (num_worlds,)."""
        ...

    def close(self) -> None:
        """Give back what it holds; hardware loses its torque."""
        ...


class SingleWorld:
    """One world on `mj_step`."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.num_worlds = 1
        self._varies = False
        self._data = mujoco.MjData(model)
        self._warnings, self._views = self._data.warning.number, dict[tuple[str, ...], tuple[Array, ...]]()
        self.qpos, self.qvel = self._data.qpos[None], self._data.qvel[None]
        self.act, self.ctrl = self._data.act[None], self._data.ctrl[None]

    def __deepcopy__(self, memo: dict[int, Any]) -> "SingleWorld":
        copied = SingleWorld(copy.copy(self.model) if self._varies else self.model)
        copied._varies = self._varies
        mujoco.mj_copyData(copied._data, self.model, self._data)
        return copied

    def bind(self, field: str) -> Array:
        """See `Simulation`."""
        return getattr(self._data, field)[None]

    def views(self, fields: tuple[str, ...]) -> tuple[Array, ...]:
        """See `Simulation`."""
        if fields not in self._views:
            self._views[fields] = tuple(self.bind(field) for field in fields)
        return self._views[fields]

    def vary(self, field: str) -> Array:
        """See `Simulation`."""
        if not self._varies:
            self.model, self._varies = copy.copy(self.model), True
        return getattr(self.model, field)[None]

    def advance(self, num_substeps: int) -> None:
        """See `Simulation`."""
        mujoco.mj_step(self.model, self._data, num_substeps)

    def restart(self, worlds: BoolArray) -> None:
        """See `Simulation`."""
        if worlds[0]:
            mujoco.mj_resetData(self.model, self._data)

    def refresh(self, worlds: BoolArray) -> None:
        """See `Simulation`."""
        if worlds[0]:
            mujoco.mj_forward(self.model, self._data)

    def diverged(self) -> BoolArray:
        """See `Simulation`."""
        return np.array([np.count_nonzero(self._warnings) > 0])

    def close(self) -> None:
        """See `Simulation`; there is nothing to give back."""


class ManyWorlds:
    """Many worlds on `mujoco.batch`, stepped by a pool of threads."""

    def __init__(self, model: mujoco.MjModel, num_worlds: int, num_threads: int = 0) -> None:
        self.model = model
        self.num_worlds = num_worlds
        self._varied: set[str] = set()
        self._bound: set[str] = set()
        self._views: dict[tuple[str, ...], tuple[Array, ...]] = {}
        self._batch = batch.Batch(model, nsim=num_worlds, nthread=min(num_threads or os.cpu_count() or 1, num_worlds))
        self.qpos, self.qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self.act, self.ctrl = self._batch.bind("act"), self._batch.bind("ctrl")

    def __deepcopy__(self, memo: dict[int, Any]) -> "ManyWorlds":
        copied = ManyWorlds(self.model, self.num_worlds, self._batch.nthread)
        for field in self._varied:
            copied.vary(field)[:] = self.vary(field)
        for field in self._bound:
            copied.bind(field)
        copied._batch.state[:] = self._batch.state
        copied._batch.warning[:] = self._batch.warning
        return copied

    def get_state(self) -> dict[str, Any]:
        """Everything that goes on from here: integration states, outputs, warnings, varied fields of the model."""
        outputs = {field: self.bind(field).copy() for field in sorted(self._bound)}
        varied = {field: self.vary(field).copy() for field in sorted(self._varied)}
        state, warning = self._batch.state.copy(), self._batch.warning.copy()
        return {"state": state, "warning": warning, "outputs": outputs, "varied": varied}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that `get_state` returned; outputs are filled again by the next step."""
        for field, values in state["varied"].items():
            self.vary(field)[:] = values
        for field in state["outputs"]:
            self.bind(field)
        self._batch.state[:] = state["state"]
        self._batch.warning[:] = state["warning"]

    def bind(self, field: str) -> Array:
        """See `Simulation`."""
        self._bound.add(field)
        return self._batch.bind(field)

    def views(self, fields: tuple[str, ...]) -> tuple[Array, ...]:
        """See `Simulation`."""
        if fields not in self._views:
            self._views[fields] = tuple(self.bind(field) for field in fields)
        return self._views[fields]

    def vary(self, field: str) -> Array:
        """See `Simulation`."""
        self._varied.add(field)
        return self._batch.expand(field)

    def advance(self, num_substeps: int) -> None:
        """See `Simulation`."""
        self._batch.step(nstep=num_substeps)

    def restart(self, worlds: BoolArray) -> None:
        """See `Simulation`."""
        if worlds.any():
            self._batch.reset(worlds, stage=int(mujoco.mjtStage.mjSTAGE_NONE))

    def refresh(self, worlds: BoolArray) -> None:
        """See `Simulation`."""
        if worlds.any():
            self._batch.forward(worlds)

    def diverged(self) -> BoolArray:
        """See `Simulation`."""
        return self._batch.warning[..., 1].any(axis=1)

    def close(self) -> None:
        """See `Simulation`; there is nothing to give back."""


def simulate(model: mujoco.MjModel, num_worlds: int, num_threads: int = 0) -> Simulation:
    """The fastest simulation for a number of worlds.

    Args:
        model: The model of every world.
        num_worlds: How many.
        num_threads: Threads for many worlds, 0 for all cores; the results do not depend on it.
    """
    return SingleWorld(model) if num_worlds == 1 else ManyWorlds(model, num_worlds, num_threads)


_MOST_SUBSTEPS = 1000


def substeps(control_period_s: float, timestep_s: float) -> int:
    """Physics steps in a control period.

    Raises:
        ConfigurationError: The control period is no multiple of the physics step, or holds too many of them.
    """
    ratio = control_period_s / timestep_s
    if ratio > _MOST_SUBSTEPS:
        raise ConfigurationError(
            f"timestep_s must be at least {control_period_s / _MOST_SUBSTEPS:g} s, a {_MOST_SUBSTEPS}th of the control "
            f"period, got {timestep_s:g} s"
        )
    if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
        raise ConfigurationError(
            f"timestep_s must divide the control period of {control_period_s:g} s, got {timestep_s:g} s"
        )
    return round(ratio)
