"""Safetensors that others may have written: of bounded size, with real numbers alone."""

from pathlib import Path
from typing import Any

import numpy.typing as npt
from safetensors import SafetensorError, deserialize
from safetensors.numpy import load

from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.files import read_bounded

_MOST_BYTES = 100_000_000
_FILE_TYPES = ("F32", "F64")


def read_tensors(path: Path) -> tuple[dict[str, npt.NDArray[Any]], bytes]:
    """Tensors of a file of safetensors, and the content of the file that they were read from.

    Raises:
        ConfigurationError: It is missing, cut short, too large, something else, holds other than
            real numbers, or is a link that leads out of its folder.
    """
    try:
        content = read_bounded(path, _MOST_BYTES, within=path.parent)
        for name, tensor in deserialize(content):
            kind = quote(tensor["dtype"])[1:-1]
            if kind not in _FILE_TYPES:
                raise ConfigurationError(
                    f"{path}: the tensor {quote(name)} must be of type {' or '.join(_FILE_TYPES)},"
                    f" got {kind}"
                )
        return load(content), content
    except (OSError, SafetensorError) as error:
        problem = "cannot be read: it is missing, cut short or something else"
        raise ConfigurationError(f"{shorten(path)} {problem} ({error}); copy it anew") from None
