"""N worlds of one MuJoCo model on a GPU, by MuJoCo Warp.

The control step and its state stay on the CPU, in double precision. A step of the physics sends the
state to the device, and reads the bound fields back. The device computes in single precision: its
results agree with those of `elastic_env.world.worlds`, but not bit for bit.

No other module imports MuJoCo Warp, which the extra `gpu` installs.
"""

import copy
import dataclasses
import warnings
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from mujoco import MjModel
from typing_extensions import override

from elastic_env.core.errors import ConfigurationError, missing_extra, quote
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.worlds import Worlds

try:
    import mujoco_warp
    import warp
except ImportError as error:
    raise missing_extra(str(error.name), "gpu", 'the backend "warp"') from None

# do not print a line per kernel
warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)

_CONTACTS = 16
_CONSTRAINT_ROWS = 64
"""Memory of a world for contacts, and for rows of constraints; a walker has up to 8 and 44."""
_STATE = ("qpos", "qvel", "act", "qacc_warmstart")
"""Fields of `MjData` that a step reads and changes."""
_COMMANDS = ("ctrl", "xfrc_applied", "qfrc_applied")
"""Fields of `MjData` that a step only reads; all fields not listed here are results."""
_HOST_FIELDS = ("numeric_data",)
"""Fields of `MjModel` that the device does not need."""
_WORLD_FIELDS = {
    field.name
    for field in dataclasses.fields(mujoco_warp.Model)
    if getattr(field.type, "shape", ())[:1] == ("*",)
}
"""Fields of models that can have a row for every world on the device."""
_LARGEST_NUMBER = 1e10
"""MuJoCo counts larger numbers as bad."""
_OVERFLOW_BITS = int(
    mujoco_warp.OverflowType.NEFC
    | mujoco_warp.OverflowType.BROADPHASE
    | mujoco_warp.OverflowType.NARROWPHASE
)


def warp_model(model: MjModel) -> MjModel:
    """Return the same plant in elements that MuJoCo Warp supports.

    MuJoCo Warp refuses PID actuators. A DC motor with K = R = 1 and these gains is equivalent: its
    controller adds K ω to the voltage, and its back-EMF subtracts K ω. Both have the integral as
    their only state. MuJoCo Warp also refuses the flag against restarts of diverged worlds; it
    never restarts them.

    Raises:
        ConfigurationError: A PID actuator has a `slewmax`.
    """
    plant = copy.copy(model)
    plant.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    servos = np.flatnonzero(model.actuator_gaintype == mujoco.mjtGain.mjGAIN_PID)
    integral_limit, slew_limit = model.actuator_dynprm[servos, :2].T
    if slew_limit.any():
        needed = 'the backend "warp" needs PID actuators with slewmax = 0'
        got = f'got {slew_limit.max():g} rad/s; choose the backend "mujoco"'
        raise ConfigurationError(f"{needed}, {got}")
    _, position_gain, velocity_gain = -model.actuator_biasprm[servos, :3].T
    integral_gain = model.actuator_gainprm[servos, 0]
    plant.actuator_dyntype[servos] = mujoco.mjtDyn.mjDYN_DCMOTOR
    plant.actuator_gaintype[servos] = mujoco.mjtGain.mjGAIN_DCMOTOR
    plant.actuator_biastype[servos] = mujoco.mjtBias.mjBIAS_DCMOTOR
    plant.actuator_dynprm[servos] = 0.0
    plant.actuator_gainprm[servos] = 0.0
    plant.actuator_biasprm[servos] = 0.0
    plant.actuator_dynprm[servos, 8] = integral_limit
    plant.actuator_gainprm[servos, :2] = 1.0
    plant.actuator_gainprm[servos, 4] = position_gain
    plant.actuator_gainprm[servos, 5] = integral_gain
    plant.actuator_gainprm[servos, 6] = velocity_gain
    return plant


class WarpWorlds(Worlds):
    """Many worlds on a device of Warp.

    An array of `vary` is sent to the device once: call `vary` again before every change.

    Args:
        model: Model of every world.
        num_worlds: Number of worlds.
        device: "cuda:0", the default, another GPU, or "cpu" for tests.

    Raises:
        ConfigurationError: The device does not exist, or MuJoCo Warp does not support the model.
    """

    def __init__(self, model: MjModel, num_worlds: int, device: str | None = None) -> None:
        self.model = model
        self.num_worlds = num_worlds
        self._device = _find_device(device or "cuda:0")
        self._warned = set()
        self._views = {}
        warnings_known = int(mujoco.mjtWarning.mjNWARNING)
        self._counts = np.zeros((num_worlds, warnings_known), dtype=np.int64)
        self._plant = warp_model(model)
        self._host_data = mujoco.MjData(model)
        self._bound: dict[str, Array] = {}
        self._varied: dict[str, Array] = {}
        self._unsent_fields: set[str] = set()
        self._graph: Any = None
        with warp.ScopedDevice(self._device):
            try:
                self._model = mujoco_warp.put_model(self._plant)
            except (NotImplementedError, ValueError) as error:
                problem = f'the backend "warp" refuses the model: {error}'
                raise ConfigurationError(problem) from None
            memory = {"nconmax": _CONTACTS, "njmax": _CONSTRAINT_ROWS}
            self._data = mujoco_warp.make_data(self._plant, nworld=num_worlds, **memory)
        self._model.opt.warn_overflow = 0  # `_check_results` warns
        self.qpos, self.qvel, self.act, _ = self.views(_STATE)
        self.ctrl = self.bind("ctrl")
        self._find_friction()
        self.restart(np.ones(num_worlds, dtype=np.bool_))

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without arrays on the device, for copies and pickle."""
        return {
            "arguments": (self.model, self.num_worlds, self._device.alias),
            "varied": self._varied,
            "bound": self._bound,
            "counts": self._counts,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])
        for field, values in state["varied"].items():
            self.vary(field)[:] = values
        for field, values in state["bound"].items():
            self.bind(field)[:] = values
        self._counts[:] = state["counts"]

    @override
    def bind(self, field: str) -> Array:
        if field not in self._bound:
            shape = getattr(self._host_data, field).shape
            self._bound[field] = np.zeros((self.num_worlds, *shape))
        return self._bound[field]

    @override
    def vary(self, field: str) -> Array:
        is_sent = field not in _HOST_FIELDS
        if field not in self._varied:
            if is_sent:
                self._expand_field(field)
            shared = getattr(self._plant, field)
            self._varied[field] = np.repeat(shared[None], self.num_worlds, axis=0)
        if is_sent:
            self._unsent_fields.add(field)
        return self._varied[field]

    @override
    def set_model(self, world: int, model: MjModel) -> None:
        plant = warp_model(model)
        for name in {*_different_fields(model, self.model), *self._varied}:
            # fields such as names and sizes differ too, and do not exist on the device
            if name in _HOST_FIELDS or hasattr(self._model, name):
                self.vary(name)[world] = getattr(plant, name)

    @override
    def restart(self, worlds: BoolArray) -> None:
        for name in self._bound.keys() & {*_STATE, *_COMMANDS}:
            self._bound[name][worlds] = 0.0
        self.qpos[worlds] = self.model.qpos0
        self._counts[worlds] = 0

    @override
    def _forward(self, worlds: BoolArray) -> None:
        self._send()
        with warp.ScopedDevice(self._device):
            mujoco_warp.forward(self._model, self._data)
        for name in self._bound.keys() - {*_STATE, *_COMMANDS}:
            self._bound[name][worlds] = self._read_field(name)[worlds]

    @override
    def _field(self, name: str) -> Array:
        is_varied = name in self._varied
        return self._varied[name] if is_varied else getattr(self.model, name)[None]

    @override
    def _step(self, num_substeps: int) -> None:
        self._send()
        with warp.ScopedDevice(self._device):
            for _ in range(num_substeps):
                self._step_once()
        for name in self._bound.keys() - {*_COMMANDS}:
            self._bound[name][:] = self._read_field(name)
        self._check_results()

    def _step_once(self) -> None:
        """Take a physics step: the first one compiles, later ones launch its kernels as a graph."""
        if self._graph is not None:
            warp.capture_launch(self._graph)
            return
        mujoco_warp.step(self._model, self._data)
        with warp.ScopedCapture() as capture:
            mujoco_warp.step(self._model, self._data)
        self._graph = capture.graph

    def _check_results(self) -> None:
        """Count bad numbers, and warn once if the memory is too small."""
        state = np.concatenate([self.qpos, self.qvel], axis=1)
        is_good = np.abs(state) < _LARGEST_NUMBER  # false for nan
        self._counts[:, int(mujoco.mjtWarning.mjWARN_BADQPOS)] += ~is_good.all(axis=1)
        is_full = (self._data.overflow.numpy() & _OVERFLOW_BITS) != 0
        if "full" not in self._warned and is_full[is_good.all(axis=1)].any():
            self._warned.add("full")
            warnings.warn(
                f'the backend "warp" goes on, less exact: a world has more than {_CONTACTS}'
                f" contacts or {_CONSTRAINT_ROWS} rows of constraints; the backend"
                ' "mujoco" has no such limit',
                stacklevel=2,
            )

    def _expand_field(self, field: str) -> None:
        """Give every world a row of a field of the model on the device."""
        if field not in _WORLD_FIELDS:
            raise ConfigurationError(
                f'in the backend "warp" all worlds have the same {field}; choose the'
                ' backend "mujoco" for models that differ in it'
            )
        shared = getattr(self._model, field)
        shape = (self.num_worlds, *shared.shape[1:])
        rows = warp.empty(shape, shared.dtype, device=self._device)
        setattr(self._model, field, rows)
        self._graph = None  # the old graph reads the shared row

    def _send(self) -> None:
        """Send state, commands and changed fields of models to the device."""
        for name in self._bound.keys() & {*_STATE, *_COMMANDS}:
            getattr(self._data, name).assign(self._bound[name].astype(np.float32))
        for name in self._unsent_fields:
            getattr(self._model, name).assign(self._varied[name].astype(np.float32))
        self._unsent_fields.clear()

    def _read_field(self, field: str) -> Array:
        """Read a field from the device, in the shape that it has in MuJoCo."""
        return getattr(self._data, field).numpy().reshape(self._bound[field].shape)


@lru_cache(maxsize=1024)
def _different_fields(model: MjModel, other: MjModel) -> tuple[str, ...]:
    """Names of the arrays in which two models differ."""
    pairs = [(name, getattr(model, name), getattr(other, name)) for name in dir(model)]
    arrays = [pair for pair in pairs if isinstance(pair[1], np.ndarray)]
    return tuple(name for name, a, b in arrays if not np.array_equal(a, b))


def _find_device(name: str) -> Any:
    """Return a device of Warp by its name.

    Raises:
        ConfigurationError: The device does not exist.
    """
    try:
        return warp.get_device(name)
    except ValueError:
        choices = " or ".join(f'device="{each.alias}"' for each in warp.get_devices())
        raise ConfigurationError(
            f'the backend "warp" finds no device {quote(name)}, which needs CUDA, on this computer;'
            f' choose {choices}, or for speed without a GPU the backend "mujoco"'
        ) from None
