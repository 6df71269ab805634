"""Feed-forward network of a residual, without torch."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from baselines.residual.settings import ResidualDescription
from elastic_env.core.compiled import compiled
from elastic_env.core.errors import ConfigurationError, quote
from elastic_env.core.signals import Array

Single = npt.NDArray[np.float32]
Tensors = Mapping[str, npt.NDArray[Any]]
"""`mean` and `std` of the features, `weight0`, `bias0`, `weight1`, ..."""
_ACTIVATIONS = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, np.float32(0.0))}
_MAX_LAYERS = 10
_LARGEST_WEIGHT = 1e6
_TYPES = ("float32", "float64")


def require_network(tensors: Tensors) -> int:
    """Check the tensors of a network, and return its number of layers.

    Raises:
        ConfigurationError: Tensors that are missing, have a wrong shape or type, or are not finite.
    """
    depth = sum(name.startswith("weight") for name in tensors)
    names = {f"{kind}{i}" for kind in ("weight", "bias") for i in range(depth)}
    if not 1 <= depth <= _MAX_LAYERS or set(tensors) != {"mean", "std", *names}:
        needed = f"mean, std, weight0, bias0, ... of at most {_MAX_LAYERS} layers"
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
        got = tensors[f"weight{i}"].shape
        if got != shape:
            raise ConfigurationError(f"weight{i} must have the shape {shape}, got {got}")
    std = tensors["std"]
    if std.shape != (widths[0],) or not (std > 0.0).all():
        raise ConfigurationError(f"std must be {widths[0]} positive values, one per feature")
    return depth


def _require_numbers(name: str, tensor: npt.NDArray[Any]) -> None:
    if tensor.dtype not in _TYPES:
        types = " or ".join(_TYPES)
        raise ConfigurationError(f"{name} must be of type {types}, got {tensor.dtype}")
    largest = np.inf if name in ("mean", "std") else _LARGEST_WEIGHT
    if not np.isfinite(tensor).all() or (np.abs(tensor) > largest).any():
        bound = f"weights and biases within ±{_LARGEST_WEIGHT:g}"
        raise ConfigurationError(f"{name} must be finite, {bound}")


class Network:
    """Feed-forward network in single precision: the mean action for normalised features.

    A row has the same bits alone and in a batch, which matrix products of BLAS do not guarantee.
    Their threads would also slow the physics down.

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
        self.num_features = len(self._mean)
        """Width of the input."""
        self.num_outputs = len(self._layers[-1][1])
        """Width of the output."""

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
    """Compute x W + b for every row x, in single precision, (n, k) to (n, m).

    The order of the sums is the same for all rows.
    """
    out = np.empty((len(rows), len(b)), dtype=np.float32)
    for row in range(len(rows)):
        for j in range(len(b)):
            out[row, j] = b[j]
        # outputs in the inner loop: their sums are independent, so that it is vectorised
        for i in range(W.shape[0]):
            x = rows[row, i]
            for j in range(len(b)):
                out[row, j] += x * W[i, j]
    return out
