"""N worlds of one MuJoCo model: a thread pool for many worlds, plain `mj_step` for one.

Both give the same results bit for bit.

Arrays are (num_worlds, ...) views of the live state. One call makes all sub-steps of a control
period.
"""

import copy
import ctypes
import os
import warnings
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco import MjData, MjModel, batch
from typing_extensions import override

from elastic_env.core.compiled import compile_now
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.joint.varying_friction import VaryingFriction


class Simulation(Protocol):
    """Physics of a task.

    The state arrays are live views; values written to `ctrl` command the next advance.
    """

    model: MjModel
    num_worlds: int
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    def bind(self, field: str) -> Array:
        """Return a live (num_worlds, ...) view of a field of `MjData`.

        Inputs such as `xfrc_applied` can be written. Derived fields and sensors lag one physics
        step behind the state, as after `mj_step`. Only calls after the first `bind` fill them, so
        bind them before `refresh`.
        """
        ...

    def views(self, fields: tuple[str, ...]) -> tuple[Array, ...]:
        """Bind several fields."""
        ...

    def vary(self, field: str) -> Array:
        """Return a live (num_worlds, ...) array of a field of `MjModel`, one row per world."""
        ...

    def set_model(self, world: int, model: MjModel) -> None:
        """Replace the model of a world, including its varied fields.

        The model must have the same numbers of bodies, joints and sensors. The state of the world
        stays.
        """
        ...

    def advance(self, num_substeps: int) -> None:
        """Step every world by `num_substeps` physics steps under its current `ctrl`."""
        ...

    def refresh(self, worlds: BoolArray) -> None:
        """Compute derived fields and sensors of some worlds, a (num_worlds,) mask."""
        ...

    def restart(self, worlds: BoolArray) -> None:
        """Reset some worlds, a (num_worlds,) mask, to the model's defaults.

        Write their state afterwards.
        """
        ...

    def divergence(self) -> BoolArray:
        """Mask of worlds with a bad number in state, acceleration or control since their restart.

        The mask has the shape (num_worlds,).
        """
        ...

    def close(self) -> None:
        """Release all resources; hardware switches its torque off."""
        ...


DIVERGED_RAD_S = 1e3
"""Speed of a joint that counts as divergence [rad/s]: two hundred times the no-load speed of the
servos.
"""

_BAD_NUMBERS = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{quantity}"))
    for quantity in ("QPOS", "QVEL", "QACC", "CTRL")
]
_MODEL_FAULTS = {
    "INERTIA": "a nearly singular inertia matrix: look at the inertias of its bodies",
    "CONTACTFULL": 'too many contacts for its memory: enlarge <size memory="..."/>',
    "CNSTRFULL": 'too many constraints for its memory: enlarge <size memory="..."/>',
}


class Worlds(Simulation):
    """Bound fields, warnings and varying friction of all simulations with MuJoCo."""

    _counts: IntArray
    """Numbers of all warnings, (num_worlds, kinds)."""
    _warned: set[str]
    """Warnings of MuJoCo that were already repeated to the user."""
    _views: dict[tuple[str, ...], tuple[Array, ...]]
    _friction: VaryingFriction | None
    """Friction that changes before every physics step; None for constant friction."""

    @override
    def advance(self, num_substeps: int) -> None:
        if self._friction is None:
            self._step(num_substeps)
            return
        for _ in range(num_substeps):
            self._set_friction(self._friction)
            self._step(1)

    @override
    def refresh(self, worlds: BoolArray) -> None:
        if worlds.any():
            if self._friction is not None:
                self._set_friction(self._friction)
            self._forward(worlds)

    def _step(self, num_substeps: int) -> None:
        raise NotImplementedError

    def _forward(self, worlds: BoolArray) -> None:
        raise NotImplementedError

    def _field(self, name: str) -> Array:
        """Return a field of the models, (num_worlds, ...) or (1, ...)."""
        raise NotImplementedError

    def _find_friction(self) -> None:
        """Find varying friction, and compile it before a first step that may be in real time."""
        self._friction = VaryingFriction.of(self.model)
        if self._friction is not None:
            compile_now(self._friction.limits, self._field, self.bind)

    def _set_friction(self, friction: VaryingFriction) -> None:
        """Set the friction of all worlds from their states."""
        limits = friction.limits(self._field, self.bind)
        self.vary("dof_frictionloss")[:, friction.links] = limits

    @override
    def views(self, fields: tuple[str, ...]) -> tuple[Array, ...]:
        if fields not in self._views:
            self._views[fields] = tuple(self.bind(field) for field in fields)
        return self._views[fields]

    @override
    def divergence(self) -> BoolArray:
        counts = self._counts
        if not np.count_nonzero(counts):
            return np.zeros(len(counts), dtype=np.bool_)
        is_bad = np.asarray(counts[:, _BAD_NUMBERS].any(axis=1))
        # a world that diverges has all other faults too
        others = np.asarray(counts[~is_bad].any(axis=0))
        for kind, meaning in _MODEL_FAULTS.items():
            number = int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}"))
            if others[number] and kind not in self._warned:
                self._warned.add(kind)
                problem = f"MuJoCo goes on, less exact; the model has {meaning}"
                warnings.warn(problem, stacklevel=2)
        return is_bad

    @override
    def close(self) -> None:
        pass


class SingleWorld(Worlds):
    """One world on `mj_step`."""

    num_worlds = 1

    def __init__(self, model: MjModel, state: MjData | None = None) -> None:
        data: MjData = state or MjData(model)
        self.model = model
        self._data = data
        self._warned = set()
        self._has_own_model = False
        self._counts = data.warning.number[None]
        self._views = {}
        self.qpos = data.qpos[None]
        self.qvel = data.qvel[None]
        self.act = data.act[None]
        self.ctrl = data.ctrl[None]
        self._find_friction()

    def __getstate__(self) -> dict[str, Any]:
        """Return everything except the live views, for `copy.deepcopy` and pickle."""
        attributes = {"_warned": self._warned, "_has_own_model": self._has_own_model}
        return {"arguments": (self.model, self._data), "attributes": attributes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])
        vars(self).update(state["attributes"])

    @override
    def bind(self, field: str) -> Array:
        return getattr(self._data, field)[None]

    @override
    def vary(self, field: str) -> Array:
        if not self._has_own_model:
            self.model = copy.copy(self.model)
            self._has_own_model = True
        return getattr(self.model, field)[None]

    @override
    def set_model(self, world: int, model: MjModel) -> None:
        self.model = model

    def model_of(self, world: int) -> MjModel:  # noqa: ARG002  there is one
        """Return the model of a world with its own parameters, for reading."""
        return self.model

    @override
    def _field(self, name: str) -> Array:
        return getattr(self.model, name)[None]

    @override
    def _step(self, num_substeps: int) -> None:
        mujoco.mj_step(self.model, self._data, num_substeps)

    @override
    def restart(self, worlds: BoolArray) -> None:
        if worlds[0]:
            mujoco.mj_resetData(self.model, self._data)

    @override
    def _forward(self, worlds: BoolArray) -> None:
        mujoco.mj_forward(self.model, self._data)


class ManyWorlds(Worlds):
    """Many worlds on `mujoco.batch`, stepped by a pool of threads."""

    def __init__(self, model: MjModel, num_worlds: int, num_threads: int = 0) -> None:
        self.model = model
        self.num_worlds = num_worlds
        self._warned = set()
        self._process = os.getpid()
        self._own_models: list[MjModel] | None = None
        self._has_new_models = False
        self._varied: set[str] = set()
        self._bound: set[str] = set()
        self._views = {}
        threads = min(num_threads or os.cpu_count() or 1, num_worlds)
        self._batch = batch.Batch(model, nsim=num_worlds, nthread=threads)
        self._counts = self._batch.warning[..., 1]
        self.qpos = self._batch.bind("qpos")
        self.qvel = self._batch.bind("qvel")
        self.act = self._batch.bind("act")
        self.ctrl = self._batch.bind("ctrl")
        self._find_friction()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without live views and threads: for copies, pickle, a forked process."""
        return {
            "arguments": (self.model, self.num_worlds, self._batch.nthread),
            "warned": self._warned,
            "models": self._own_models,
            "bound": self._bound,
            "varied": {field: self.vary(field).copy() for field in self._varied},
            "state": self._batch.state.copy(),
            "warning": self._batch.warning.copy(),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])
        self._warned = state["warned"]
        self._own_models = state["models"]
        self._has_new_models = state["models"] is not None
        for field, values in state["varied"].items():
            self.vary(field)[:] = values
        for field in state["bound"]:
            self.bind(field)
        self._batch.state[:] = state["state"]
        self._batch.warning[:] = state["warning"]

    def _ready_batch(self) -> batch.Batch:
        """Return the batch with the models of its worlds and with threads of this process.

        A forked process does not have the threads of its parent.
        """
        if self._process != os.getpid():
            inherited = self._batch
            # never free it: its destructor would wait for threads that do not exist
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(inherited))
            self.__setstate__(self.__getstate__())
        if self._has_new_models:
            self._batch.set_models(self._own_models)
            self._has_new_models = False
        return self._batch

    @override
    def bind(self, field: str) -> Array:
        self._bound.add(field)
        return self._batch.bind(field)

    @override
    def vary(self, field: str) -> Array:
        self._varied.add(field)
        return self._batch.expand(field)

    @override
    def set_model(self, world: int, model: MjModel) -> None:
        if self._own_models is None:
            self._own_models = [self.model] * self.num_worlds
        self._own_models[world] = model
        self._has_new_models = True

    def model_of(self, world: int) -> MjModel:
        """Return the model of a world with its own parameters, for reading."""
        return self._ready_batch().get_model(world)

    @override
    def _field(self, name: str) -> Array:
        is_varied = name in self._varied
        return self.vary(name) if is_varied else getattr(self.model, name)[None]

    @override
    def _step(self, num_substeps: int) -> None:
        self._ready_batch().step(nstep=num_substeps)

    @override
    def restart(self, worlds: BoolArray) -> None:
        if worlds.any():
            self._ready_batch().reset(worlds, stage=int(mujoco.mjtStage.mjSTAGE_NONE))

    @override
    def _forward(self, worlds: BoolArray) -> None:
        self._ready_batch().forward(worlds)


def simulate(model: MjModel, num_worlds: int, num_threads: int = 0) -> Simulation:
    """Make the fastest simulation for a number of worlds.

    Args:
        model: Model of every world.
        num_worlds: Number of worlds.
        num_threads: Threads for many worlds, 0 for all cores; the results do not depend on it.
    """
    if num_worlds == 1:
        return SingleWorld(model)
    return ManyWorlds(model, num_worlds, num_threads)


MOST_SUBSTEPS = 1000
"""Largest number of physics steps in a control period."""


def substeps(control_period_s: float, timestep_s: float) -> int:
    """Physics steps in a control period.

    Raises:
        ConfigurationError: The control period is no multiple of the physics step, or contains too
            many of them.
    """
    ratio = control_period_s / timestep_s
    if ratio > MOST_SUBSTEPS:
        raise ConfigurationError(
            f"timestep_s must be at least {control_period_s / MOST_SUBSTEPS:g} s, a"
            f" {MOST_SUBSTEPS}th of the control period, got {timestep_s:g} s"
        )
    if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
        needed = f"must divide the control period of {control_period_s:g} s"
        raise ConfigurationError(f"timestep_s {needed}, got {timestep_s:g} s")
    return round(ratio)
