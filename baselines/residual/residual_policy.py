r"""Trained residuals as policies: a network from a folder corrects the base it belongs to.

A folder holds `residual.json` (base, settings, network, how it was trained) and
`weights.safetensors`. Loading it runs no code from it and needs no torch. The observation is
normalised in here; the base policy sees it as it is.
"""

from collections.abc import Mapping
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from safetensors.numpy import save
from typing_extensions import override

from baselines.compensation import policy as policies
from baselines.residual.correction import Corrected, CorrectedMemory
from baselines.residual.features import Features, FeaturesMemory
from baselines.residual.settings import ResidualDescription
from elastic_env.core.compiled import compiled
from elastic_env.core.config import load_json
from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.files import write_whole
from elastic_env.core.signals import Array, BoolArray, IntArray
from elastic_env.core.tensors import read_tensors

Single = npt.NDArray[np.float32]
Tensors = Mapping[str, npt.NDArray[Any]]
"""`mean` and `std` of the features, `weight0`, `bias0`, `weight1`, ..."""

_ACTIVATIONS = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, np.float32(0.0))}
_MOST_LAYERS = 10
_LARGEST = 1e6
_TYPES = ("float32", "float64")


def require_network(tensors: Tensors) -> int:
    """The number of layers of tensors that make a network.

    Raises:
        ConfigurationError: Tensors that are missing, have a wrong shape or type, or are not finite.
    """
    depth = sum(name.startswith("weight") for name in tensors)
    names = {f"{kind}{i}" for kind in ("weight", "bias") for i in range(depth)}
    if not 1 <= depth <= _MOST_LAYERS or set(tensors) != {"mean", "std", *names}:
        needed = f"mean, std, weight0, bias0, ... of at most {_MOST_LAYERS} layers"
        raise ConfigurationError(f"weights must be {needed}; got {quote(sorted(tensors))}")
    for name, tensor in tensors.items():
        _require_numbers(name, tensor)
    vectors = ["mean", *(f"bias{i}" for i in range(depth))]
    for name in vectors:
        if tensors[name].ndim != 1 or len(tensors[name]) == 0:
            raise ConfigurationError(
                f"{name} must have the shape (n,) with n >= 1, got {tensors[name].shape}"
            )
    widths = [len(tensors[name]) for name in vectors]
    for i in range(depth):
        shape = (widths[i + 1], widths[i])
        found = tensors[f"weight{i}"].shape
        if found != shape:
            shapes = f"the shape {shape}, got {found}"
            raise ConfigurationError(f"weight{i} must have {shapes}")
    std = tensors["std"]
    if std.shape != (widths[0],) or not (std > 0.0).all():
        raise ConfigurationError(f"std must be {widths[0]} positive values, one per action")
    return depth


def _require_numbers(name: str, tensor: npt.NDArray[Any]) -> None:
    if tensor.dtype not in _TYPES:
        types = " or ".join(_TYPES)
        raise ConfigurationError(f"{name} must be of type {types}, got {tensor.dtype}")
    largest = np.inf if name in ("mean", "std") else _LARGEST
    if not np.isfinite(tensor).all() or (np.abs(tensor) > largest).any():
        bound = f"weights and biases within ±{_LARGEST:g}"
        raise ConfigurationError(f"{name} must be finite, {bound}")


class Network:
    """Feed-forward network in single precision: the mean action of normalised features.

    A row of a batch is what it is alone, bit for bit, which matrix products of BLAS do not grant.
    They would also keep threads in the way of the physics.

    Args:
        settings: Description of the residual, with activation, output and clipping.
        tensors: `mean` and `std` of the features, `weight0`, `bias0`, `weight1`, ...

    Raises:
        ConfigurationError: Tensors that are missing, not finite, or do not fit one another.
    """

    def __init__(self, settings: ResidualDescription, tensors: Tensors) -> None:
        depth = require_network(tensors)
        self._mean = tensors["mean"].astype(np.float64)
        self._std = tensors["std"].astype(np.float64)
        self._layers: list[tuple[Single, Single]] = []
        for i in range(depth):
            W = np.ascontiguousarray(tensors[f"weight{i}"].astype(np.float32).T)
            self._layers.append((W, tensors[f"bias{i}"].astype(np.float32)))
        self._activation = _ACTIVATIONS[settings.activation]
        self._output = settings.output
        self._clip = settings.clip

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
        normalised = (features - self._mean) / self._std
        x = np.clip(normalised, -self._clip, self._clip).astype(np.float32)
        for number, (W, b) in enumerate(self._layers):
            x = affine(x, W, b)
            if number < len(self._layers) - 1:
                x = self._activation(x)
        x = np.tanh(x) if self._output == "tanh" else np.clip(x, -1.0, 1.0)
        return x.astype(np.float64)


@compiled
def affine(rows: Single, W: Single, b: Single) -> Single:
    """Give x W + b of every row x, in single precision, (n, k) to (n, m).

    All rows are added up in the same order.
    """
    out = np.empty((len(rows), len(b)), dtype=np.float32)
    for row in range(len(rows)):
        for j in range(len(b)):
            out[row, j] = b[j]
        # along the outputs, whose sums are apart, the processor works on several at once
        for i in range(W.shape[0]):
            x = rows[row, i]
            for j in range(len(b)):
                out[row, j] += x * W[i, j]
    return out


DESCRIPTION = "residual.json"
WEIGHTS = "weights.safetensors"
_SHIPPED = Path(__file__).parents[1] / "trained"


class ResidualMemory(NamedTuple):
    """Memory of a residual policy.

    Attributes:
        wait: Control steps until the next decision, (num_worlds,); -1 before the first.
        residual: What was decided, (num_worlds, k).
        features: Memory of the features.
        inner: Memory of the corrected base.
    """

    wait: IntArray
    residual: Array
    features: FeaturesMemory
    inner: CorrectedMemory


class ResidualPolicy(policies.BatchPolicy):
    """A base policy with a network that corrects it.

    Args:
        corrected: The base and its correction.
        network: What decides.

    Attributes:
        features: What the network sees.

    Raises:
        ConfigurationError: The network does not fit the settings, or they do not fit the robot.
    """

    def __init__(self, corrected: Corrected, network: Network) -> None:
        super().__init__(corrected.model)
        self.corrected = corrected
        self._network = network
        self.features = Features(corrected)
        self._period = corrected.settings.decision_period
        expected = (self.features.width, corrected.num_residuals)
        if (network.num_features, network.num_outputs) != expected:
            raise ConfigurationError(
                f"the network must take {expected[0]} features and give {expected[1]} residuals for"
                f" these settings, it has {network.num_features} and {network.num_outputs}"
            )

    @override
    def begin(self, rows: Array) -> ResidualMemory:
        n = len(rows)
        wait = np.full(n, _UNDECIDED)
        residual = np.zeros((n, self.corrected.num_residuals))
        seen = self.features.begin(n)
        return ResidualMemory(wait, residual, seen, self.corrected.begin(rows))

    @override
    def act(self, rows: Array, memory: ResidualMemory, inputs: Any) -> policies.Step:
        due = memory.wait <= 0
        if np.count_nonzero(due) > 0:
            decided = policies.select_rows(self._decide(rows, memory, due), due)
            memory = policies.put_rows(memory, due, decided)
        residual = memory.residual
        action, inner = self.corrected.correct(rows, residual, memory.inner, inputs)
        return action, memory._replace(wait=memory.wait - 1, inner=inner)

    @override
    def link_angles(self, rows: Array, memory: ResidualMemory) -> Array:
        return self.corrected.base.link_angles(rows, memory.inner.inner)

    def _decide(self, rows: Array, memory: ResidualMemory, due: BoolArray) -> Any:
        """Memory after a decision, of the worlds that are due."""
        inner = memory.inner
        fresh = memory.wait == _UNDECIDED
        seen, features = self.features.at(rows, memory.features, fresh, inner, None)
        residual = memory.residual.copy()
        residual[due] = self.features.turn_back(rows[due], self._network(seen[due]))
        wait = np.full_like(memory.wait, self._period)
        return ResidualMemory(wait, residual, features, inner)


_UNDECIDED = -1


def save_residual(folder: Path, residual: Any, tensors: Tensors) -> None:
    """Write a residual that `load_residual` reads; the network must be valid.

    Raises:
        ConfigurationError: Tensors that do not fit.
    """
    Network(residual, tensors)
    folder.mkdir(parents=True, exist_ok=True)
    weights = save({name: np.ascontiguousarray(own) for name, own in tensors.items()})
    write_whole(folder / WEIGHTS, weights)
    residual = residual.replace(weights_sha256=sha256(weights).hexdigest())
    write_whole(folder / DESCRIPTION, residual.model_dump_json(indent=2) + "\n")


def shipped_names() -> list[str]:
    """Names of the residuals that come with the package, such as testbed/seed_0."""
    folders = [path.parent for path in _SHIPPED.glob(f"*/*/{DESCRIPTION}")]
    return sorted(folder.relative_to(_SHIPPED).as_posix() for folder in folders)


def find_folder(folder: Path) -> Path:
    """A residual's folder: the path itself, or the one of that name in the package."""
    own = _SHIPPED / folder
    try:
        return own if not folder.exists() and own.exists() else folder
    except OSError:  # too long for a path, or within a folder that cannot be read
        return folder


def read_description(folder: Path) -> ResidualDescription:
    """Description of a residual; `folder` is a path or the name of a shipped one.

    Raises:
        ConfigurationError: There is none, or it is not valid.
    """
    folder = find_folder(folder)
    file = folder / DESCRIPTION
    missing = partial(_none_at, folder)
    return load_json(file, ResidualDescription, "residual", missing, within=folder)


def _none_at(folder: Path, why: str) -> str:
    """Sentence that says what to do where no residual is."""
    try:
        inside = [*folder.glob(f"*/{DESCRIPTION}"), *folder.glob(f"*/*/{DESCRIPTION}")]
    except OSError:  # a name that is too long, or a folder that cannot be read
        inside = []
    if inside:  # the last policy first: the best one flatters itself
        folders = sorted((path.parent.name != "last", path.parent) for path in inside)
        listed = ", ".join(str(path) for _, path in folders)
        cure = f"give one of them: {listed}"
        return f"{folder} is no residual but has some inside; {cure}"
    families: dict[str, list[str]] = {}
    for name in shipped_names():
        family, _, seed = name.partition("/")
        families.setdefault(family, []).append(seed)
    names = ", ".join(f"{name}/{own[0]} to {own[-1]}" for name, own in families.items())
    return (
        f"no residual at {quote(str(folder))[1:-1]}: a folder with {DESCRIPTION} and {WEIGHTS} is"
        f" needed ({why}), or the name of one that comes with the package: {names}"
    )


def load_residual(folder: Path) -> tuple[ResidualDescription, Network]:
    """A residual from its folder.

    Raises:
        ConfigurationError: There is none, or it is damaged.
    """
    folder = find_folder(folder)
    description = read_description(folder)
    tensors, content = read_tensors(folder / WEIGHTS)
    try:
        network = Network(description, tensors)
    except ConfigurationError as error:
        file = shorten(folder / WEIGHTS)
        raise ConfigurationError(f"{file} holds no network: {error}") from None
    found = sha256(content).hexdigest()
    if description.weights_sha256 not in (None, found):
        raise ConfigurationError(
            f"{folder / WEIGHTS} was changed: {DESCRIPTION} names the SHA-256 digest"
            f" {description.weights_sha256}, it has {found}; copy it anew, or leave weights_sha256"
            " out if you mean these weights"
        )
    return description, network
