"""N worlds of one MuJoCo model: a thread pool for many, plain `mj_step` for one, the same results
bit for bit.

Arrays are (num_worlds, ...) views of the live state. All sub-steps of a control period are one
call.
"""

import copy
import ctypes
import os
import warnings
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco import batch

from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, IntArray


class Simulation(Protocol):
    """What a task needs of the physics.

    The state arrays are live views; writing `ctrl` commands the next advance.
    """

    model: mujoco.MjModel
    num_worlds: int
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    def bind(self, field: str) -> Array:
        """A live (num_worlds, ...) view of a field of `MjData`.

        Inputs such as `xfrc_applied` can be written. Derived fields and sensors lag one physics
        step behind the state, as after `mj_step`; they are filled by the calls after they were
        first bound, so bind them before `refresh`.
        """
        ...

    def views(self, fields: tuple[str, ...]) -> tuple[Array, ...]:
        """Several fields bound."""
        ...

    def vary(self, field: str) -> Array:
        """A live (num_worlds, ...) array of a field of `MjModel`, of each world its own from now
        on.
        """
        ...

    def take(self, world: int, model: mujoco.MjModel) -> None:
        """Give a world a model of its own, with as many bodies, joints and sensors, instead of
        varied fields.

        The state of the world stays.
        """
        ...

    def advance(self, num_substeps: int) -> None:
        """Step every world by `num_substeps` physics steps under its current `ctrl`."""
        ...

    def refresh(self, worlds: BoolArray) -> None:
        """Compute derived fields and sensors of the present state in some worlds, a
        (num_worlds,) mask.
        """
        ...

    def restart(self, worlds: BoolArray) -> None:
        """Set some worlds, a (num_worlds,) mask, to the model's defaults; write their state
        afterwards.
        """
        ...

    def diverged(self) -> BoolArray:
        """Worlds whose state, acceleration or control has been a bad number since their restart,
        (num_worlds,).
        """
        ...

    def close(self) -> None:
        """Give back what it holds; hardware loses its torque."""
        ...


DIVERGED_RAD_S = 1e3
"""Speed of a joint beyond anything physical [rad/s]: two hundred times the no-load speed of the
servos.
"""

_BAD = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}"))
    for what in ("QPOS", "QVEL", "QACC", "CTRL")
]
_OTHERS = {
    int(
        mujoco.mjtWarning.mjWARN_INERTIA
    ): "a nearly singular inertia matrix: look at the inertias of its bodies",
    int(
        mujoco.mjtWarning.mjWARN_CONTACTFULL
    ): 'too many contacts for its memory: enlarge <size memory="..."/>',
    int(
        mujoco.mjtWarning.mjWARN_CNSTRFULL
    ): 'too many constraints for its memory: enlarge <size memory="..."/>',
}


class _Warnings:
    """What MuJoCo warns of: bad numbers, which end an episode, and anything else, which is said
    once.
    """

    def __init__(self) -> None:
        self._said: set[int] = set()

    def diverged(self, counts: IntArray) -> BoolArray:
        """Worlds with a bad number, from the counts of all warnings, (num_worlds, kinds)."""
        if not np.count_nonzero(counts):
            return np.zeros(len(counts), dtype=np.bool_)
        is_bad = np.asarray(counts[:, _BAD].any(axis=1))
        for kind in np.flatnonzero(
            counts[~is_bad].any(axis=0)
        ).tolist():  # what explodes has every fault
            if kind in _OTHERS and kind not in self._said:
                self._said.add(kind)
                warnings.warn(
                    f"MuJoCo goes on, less exact; the model has {_OTHERS[kind]}", stacklevel=2
                )
        return is_bad


class SingleWorld:
    """One world on `mj_step`."""

    num_worlds = 1

    def __init__(self, model: mujoco.MjModel) -> None:
        self.__setstate__(
            {"model": model, "varied": set(), "data": mujoco.MjData(model), "warnings": _Warnings()}
        )

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the live views, for `copy.deepcopy` and pickle."""
        return {
            "model": self.model,
            "varied": self._varied,
            "data": self._data,
            "warnings": self._warnings,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.model: mujoco.MjModel = state["model"]
        self._varied: set[str] = state["varied"]
        self._data = state["data"]
        self._warnings = state["warnings"]
        self._counts = self._data.warning.number[None]
        self._views = dict[tuple[str, ...], tuple[Array, ...]]()
        self.qpos = self._data.qpos[None]
        self.qvel = self._data.qvel[None]
        self.act = self._data.act[None]
        self.ctrl = self._data.ctrl[None]

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
        if not self._varied:
            self.model = copy.copy(self.model)
        self._varied.add(field)
        return getattr(self.model, field)[None]

    def take(self, world: int, model: mujoco.MjModel) -> None:  # noqa: ARG002  there is one
        """See `Simulation`."""
        self.model = model

    def model_of(self, world: int) -> mujoco.MjModel:  # noqa: ARG002  there is one
        """The model of a world with all that is its own, for reading."""
        return self.model

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
        return self._warnings.diverged(self._counts)

    def close(self) -> None:
        """See `Simulation`; there is nothing to give back."""


class ManyWorlds:
    """Many worlds on `mujoco.batch`, stepped by a pool of threads."""

    def __init__(self, model: mujoco.MjModel, num_worlds: int, num_threads: int = 0) -> None:
        threads = min(num_threads or os.cpu_count() or 1, num_worlds)
        self._start(model, num_worlds, threads, _Warnings())

    def _start(
        self,
        model: mujoco.MjModel,
        num_worlds: int,
        num_threads: int,
        said: _Warnings,
        own: list[mujoco.MjModel] | None = None,
    ) -> None:
        """Begin with worlds in the model's default state, and threads of this process."""
        self.model = model
        self.num_worlds = num_worlds
        self._warnings = said
        self._process = os.getpid()
        self._own_models = own
        self._are_given = own is None
        self._varied: set[str] = set()
        self._bound: set[str] = set()
        self._views: dict[tuple[str, ...], tuple[Array, ...]] = {}
        self._batch = batch.Batch(model, nsim=num_worlds, nthread=num_threads)
        self.qpos = self._batch.bind("qpos")
        self.qvel = self._batch.bind("qvel")
        self.act = self._batch.bind("act")
        self.ctrl = self._batch.bind("ctrl")

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the live views and the threads, for `copy.deepcopy`, pickle, and a
        process that was forked.
        """
        return {
            "made": (
                self.model,
                self.num_worlds,
                self._batch.nthread,
                self._warnings,
                self._own_models,
            ),
            "bound": self._bound,
            "varied": {field: self.vary(field).copy() for field in self._varied},
            "state": self._batch.state.copy(),
            "warning": self._batch.warning.copy(),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._start(*state["made"])
        for field, values in state["varied"].items():
            self.vary(field)[:] = values
        for field in state["bound"]:
            self.bind(field)
        self._batch.state[:] = state["state"]
        self._batch.warning[:] = state["warning"]

    def _ready(self) -> batch.Batch:
        """The batch with the models of its worlds, and threads of this process: a fork leaves
        those of the parent.
        """
        if self._process != os.getpid():
            inherited = self._batch
            # its end would wait for threads that are not there: it is never freed
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(inherited))
            self.__setstate__(self.__getstate__())
        if not self._are_given:
            self._batch.set_models(self._own_models)
            self._are_given = True
        return self._batch

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

    def take(self, world: int, model: mujoco.MjModel) -> None:
        """See `Simulation`."""
        if self._own_models is None:
            self._own_models = [self.model] * self.num_worlds
        self._own_models[world] = model
        self._are_given = False

    def model_of(self, world: int) -> mujoco.MjModel:
        """The model of a world with all that is its own, for reading."""
        return self._ready().get_model(world)

    def advance(self, num_substeps: int) -> None:
        """See `Simulation`."""
        self._ready().step(nstep=num_substeps)

    def restart(self, worlds: BoolArray) -> None:
        """See `Simulation`."""
        if worlds.any():
            self._ready().reset(worlds, stage=int(mujoco.mjtStage.mjSTAGE_NONE))

    def refresh(self, worlds: BoolArray) -> None:
        """See `Simulation`."""
        if worlds.any():
            self._ready().forward(worlds)

    def diverged(self) -> BoolArray:
        """See `Simulation`."""
        return self._warnings.diverged(self._batch.warning[..., 1])

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


MOST_SUBSTEPS = 1000


def substeps(control_period_s: float, timestep_s: float) -> int:
    """Physics steps in a control period.

    Raises:
        ConfigurationError: The control period is no multiple of the physics step, or holds too many
            of them.
    """
    ratio = control_period_s / timestep_s
    if ratio > MOST_SUBSTEPS:
        raise ConfigurationError(
            f"timestep_s must be at least {control_period_s / MOST_SUBSTEPS:g} s, a"
            f" {MOST_SUBSTEPS}th of the control period, got {timestep_s:g} s"
        )
    if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
        raise ConfigurationError(
            f"timestep_s must divide the control period of {control_period_s:g} s, got"
            f" {timestep_s:g} s"
        )
    return round(ratio)
