"""MuJoCo's physics of one world, by plain `mj_step`, and what many worlds share with it."""

import copy
import warnings
from typing import Any

import mujoco
import numpy as np
from mujoco import MjData, MjModel
from typing_extensions import override

from elastic_env.core.compiled import compile_now
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.joint.mujoco_friction import VaryingFriction
from elastic_env.world.physics import Simulation

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
