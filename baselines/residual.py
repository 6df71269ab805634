"""Trained residuals as policies: a NumPy forward pass of weights from a folder, on top of the base they belong to.

A folder holds `residual.json` (base, settings, network, how it was trained) and `weights.safetensors`. Loading it runs
no code from it and needs no torch. The observation is normalised in here; the base policy sees it as it is.
"""

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import field_validator
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from baselines.correction import Corrected, ResidualSettings
from baselines.evidence import caution
from baselines.features import Features
from baselines.policy import Action, ObservationView, Policy, resume
from elastic_env.config import Model
from elastic_env.errors import ConfigurationError
from elastic_env.signals import Array

RESIDUAL = "residual:"
"""Before the folder of a trained residual, where policies are named."""
DESCRIPTION, WEIGHTS = "residual.json", "weights.safetensors"
_SHIPPED = Path(__file__).parent / "trained"

_BLOCK = 32
"""Rows that are multiplied at once: a larger product would be shared out to threads, which then wait busily for more
work in the way of the physics."""
_ACTIVATIONS = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, np.float32(0.0))}


class ResidualDescription(Model):
    """What `residual.json` says of the weights beside it."""

    robot: str
    """Task of the environment, walker or testbed."""
    base: str
    """Name of the base policy."""
    base_options: dict[str, Any] = {}
    settings: ResidualSettings = ResidualSettings()
    activation: Literal["tanh", "relu"] = "tanh"
    """Between the layers."""
    output: Literal["clip", "tanh"] = "clip"
    """How the last layer comes to [−1, 1]: clipped (PPO), or by tanh (SAC)."""
    clip: float = 10.0
    """Bound of normalised features, in standard deviations."""
    training: dict[str, Any] = {}
    """How it was trained: configuration, seed, versions, commit."""

    @field_validator("base")
    @classmethod
    def _base_is_no_residual(cls, value: str) -> str:
        return require_plain_base(value)


def require_plain_base(name: str) -> str:
    """The name of a base policy.

    Raises:
        ValueError: It is itself a residual, which could name another, or itself.
    """
    if name.startswith(RESIDUAL):
        raise ValueError(f"the base of a residual must be no residual itself, got {name!r}; name a baseline")
    return name


class Network:
    """Feed-forward network in single precision, as it was trained: the mean action of normalised features.

    Rows of a batch agree with single rows to rounding only (10⁻⁶): a matrix product may add in another order.

    Args:
        description: Activation, output and clipping.
        tensors: `mean` and `std` of the features, `weight0`, `bias0`, `weight1`, ...

    Raises:
        ConfigurationError: Tensors that are missing, not finite, or do not fit one another.
    """

    def __init__(self, description: ResidualDescription, tensors: dict[str, npt.NDArray[Any]]) -> None:
        depth = sum(name.startswith("weight") for name in tensors)
        names = {"mean", "std", *(f"{kind}{i}" for i in range(depth) for kind in ("weight", "bias"))}
        if depth == 0 or set(tensors) != names:
            raise ConfigurationError(f"weights must be mean, std, weight0, bias0, ...; got {sorted(tensors)}")
        self._mean, self._std = tensors["mean"].astype(np.float64), tensors["std"].astype(np.float64)
        layers = [(tensors[f"weight{i}"], tensors[f"bias{i}"]) for i in range(depth)]
        self._layers = [(W.astype(np.float32).T, b.astype(np.float32)) for W, b in layers]
        widths = [len(self._mean), *(len(bias) for _, bias in layers)]
        for (W, _), shape in zip(layers, zip(widths[1:], widths, strict=False), strict=True):
            if W.shape != shape:
                raise ConfigurationError(f"a layer must have the shape {shape}, got {W.shape}")
        if self._std.shape != self._mean.shape or not (self._std > 0.0).all():
            raise ConfigurationError("std must have one positive value per feature")
        if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
            raise ConfigurationError("weights must be finite")
        self._activation, self._output = _ACTIVATIONS[description.activation], description.output
        self._clip = description.clip

    @property
    def num_features(self) -> int:
        """Width of the input."""
        return len(self._mean)

    @property
    def num_outputs(self) -> int:
        """Width of the output."""
        return len(self._layers[-1][1])

    def __call__(self, features: Array) -> Array:
        """Residual in [−1, 1], (num_worlds, features) to (num_worlds, k)."""
        blocks = [self._forward(features[i : i + _BLOCK]) for i in range(0, len(features), _BLOCK)]
        return np.concatenate(blocks) if blocks else np.zeros((0, self.num_outputs))

    def _forward(self, features: Array) -> Array:
        x = np.clip((features - self._mean) / self._std, -self._clip, self._clip).astype(np.float32)
        for number, (W, b) in enumerate(self._layers):
            x = x @ W + b
            if number < len(self._layers) - 1:
                x = self._activation(x)
        x = np.tanh(x) if self._output == "tanh" else np.clip(x, -1.0, 1.0)
        return x.astype(np.float64)


class ResidualPolicy:
    """A base policy with a network that corrects it.

    Memory per world: control steps since the last decision, the residual that was decided, that of the features, and
    that of caution.

    Args:
        corrected: The base and its correction.
        network: What decides.

    Raises:
        ConfigurationError: The network does not fit the settings, or they do not fit the robot.
    """

    def __init__(self, corrected: Corrected, network: Network) -> None:
        self.corrected, self._network = corrected, network
        self._features, self._period = Features(corrected), corrected.settings.decision_period
        expected = self._features.width, corrected.num_residuals
        if (network.num_features, network.num_outputs) != expected:
            raise ConfigurationError(
                f"the network must take {expected[0]} features and give {expected[1]} residuals for these settings, "
                f"it has {network.num_features} and {network.num_outputs}"
            )
        model = corrected.model
        self._caution = caution(corrected)
        self._ends = np.cumsum([1, corrected.num_residuals, self._features.memory_width])
        self._view = ObservationView(model.observation_table, model.control_period_s)

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,  # noqa: ARG002  the interface's
    ) -> tuple[Action, Any]:
        """Corrected action and new state."""
        rows = self._view.rows(observation)
        memory, inner = resume(state, episode_start, rows, self._view, lambda: self._undecided(len(rows)))
        due = np.flatnonzero((memory[:, 0] == 0.0) | (memory[:, 0] == _UNDECIDED))
        if len(due) > 0:
            memory = memory.copy()
            fresh = memory[:, 0] == _UNDECIDED
            _, _, past, known = np.split(memory, self._ends, axis=1)
            features, past = self._features.at(rows, past, fresh, inner, episode_start)
            trust, known = self._caution.observe(rows, np.where(fresh[:, None], self._caution.begin(len(rows)), known))
            decided = self._network(features[due]) * trust[due]
            memory[due] = np.hstack([np.zeros((len(due), 1)), decided, past[due], known[due]])
        residual = memory[:, self._ends[0] : self._ends[1]]
        action, inner = self.corrected.act(observation, residual, inner, episode_start)
        counted = memory.copy()
        counted[:, 0] = (memory[:, 0] + 1.0) % self._period
        return action, (counted, inner)

    def link_estimate(self, observation: Array, state: Any) -> Array:
        """See `Corrected`."""
        return self.corrected.link_estimate(observation, state[1])

    def _undecided(self, num_worlds: int) -> Array:
        memory = np.zeros((num_worlds, self._ends[-1] + self._caution.memory_width))
        memory[:, 0] = _UNDECIDED
        return memory


_UNDECIDED = -1.0


def save_residual(folder: Path, description: ResidualDescription, tensors: dict[str, npt.NDArray[Any]]) -> None:
    """Write a residual that `load_residual` reads; the network must be valid.

    Raises:
        ConfigurationError: Tensors that do not fit.
    """
    Network(description, tensors)
    folder.mkdir(parents=True, exist_ok=True)
    save_file({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}, folder / WEIGHTS)
    (folder / DESCRIPTION).write_text(description.model_dump_json(indent=2) + "\n", encoding="utf-8")


def shipped() -> list[str]:
    """Names of the residuals that come with the package, such as testbed/seed_0."""
    return sorted(path.parent.relative_to(_SHIPPED).as_posix() for path in _SHIPPED.glob(f"*/*/{DESCRIPTION}"))


def located(folder: Path) -> Path:
    """A residual's folder: the path itself, or where nothing lies there, the one of that name in the package."""
    own = _SHIPPED / folder
    return own if not folder.exists() and own.exists() else folder


def read_description(folder: Path) -> ResidualDescription:
    """What a residual says of itself; `folder` is a path or the name of a shipped one.

    Raises:
        ConfigurationError: There is none, or it is not valid.
    """
    folder = located(folder)
    try:
        content = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(
            f"no residual at {folder}: a folder with {DESCRIPTION} and {WEIGHTS} is needed ({error.strerror}), or the "
            f"name of one that comes with the package: {', '.join(shipped())}"
        ) from None
    except ValueError as error:
        raise ConfigurationError(f"{folder / DESCRIPTION} is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise ConfigurationError(f"{folder / DESCRIPTION} must be a mapping, got {type(content).__name__}")
    try:
        return ResidualDescription(**content)
    except ConfigurationError as error:
        raise ConfigurationError(f"{folder / DESCRIPTION} describes no residual: {error}") from None


def load_residual(folder: Path) -> tuple[ResidualDescription, Network]:
    """A residual from its folder.

    Raises:
        ConfigurationError: There is none, or it is damaged.
    """
    folder = located(folder)
    description = read_description(folder)
    try:
        tensors = load_file(folder / WEIGHTS)
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(
            f"{folder / WEIGHTS} cannot be read: it is missing, cut short or something else ({error}); copy it anew"
        ) from None
    return description, Network(description, tensors)


def residual_policy(folder: Path, base: Policy, model: Any) -> ResidualPolicy:
    """The policy of a residual's folder around its base."""
    description, network = load_residual(folder)
    return ResidualPolicy(Corrected(base, model, description.settings), network)
