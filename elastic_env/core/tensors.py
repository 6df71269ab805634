"""Reader of safetensors from any source: of bounded size, with real numbers only."""

from pathlib import Path
from typing import Any

import numpy.typing as npt
from safetensors import SafetensorError, deserialize
from safetensors.numpy import load

from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.files import read_bounded

_LARGEST_BYTES = 100_000_000
_TYPES = ("F32", "F64")


def read_tensors(path: Path) -> tuple[dict[str, npt.NDArray[Any]], bytes]:
    """Return the tensors of a file of safetensors, and the content of the file.

    Raises:
        ConfigurationError: The file is missing, cut short, too large or no safetensors; a tensor
            is not of real numbers; or the file is a link out of its folder.
    """
    try:
        content = read_bounded(path, _LARGEST_BYTES, within=path.parent)
        for name, tensor in deserialize(content):
            kind = quote(tensor["dtype"])[1:-1]
            if kind not in _TYPES:
                raise ConfigurationError(
                    f"{path}: the tensor {quote(name)} must be of type"
                    f" {' or '.join(_TYPES)}, got {kind}"
                )
        return load(content), content
    except (OSError, SafetensorError) as error:
        reason = f"cannot be read: it is missing, cut short or something else ({error})"
        raise ConfigurationError(f"{shorten(path)} {reason}; copy it again") from None
