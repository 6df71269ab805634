"""Many worlds of one MuJoCo model, on a pool of threads.

Their results are those of single worlds bit for bit.
"""

import ctypes
import os
from typing import Any

import mujoco
from mujoco import MjModel, batch
from typing_extensions import override

from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.physics import Simulation
from elastic_env.world.worlds import SingleWorld, Worlds


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
