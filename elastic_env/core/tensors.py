"""Files of arrays that others may have written: safetensors, of bounded size, with real numbers alone."""

from pathlib import Path
from typing import Any

import numpy.typing as npt
from safetensors import SafetensorError, safe_open

from elastic_env.core.errors import ConfigurationError, shortened, shown

_MOST_BYTES = 100_000_000
_FILE_TYPES = ("F32", "F64")


def read_tensors(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Tensors of a file of safetensors.

    Raises:
        ConfigurationError: It is missing, cut short, too large, something else, or holds other than real numbers.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigurationError(
                f"{shortened(path)} must have at most {_MOST_BYTES} bytes, it has {path.stat().st_size}"
            )
        with safe_open(path, framework="np") as file:
            for name in file.keys():  # noqa: SIM118  no mapping
                if (kind := file.get_slice(name).get_dtype()) not in _FILE_TYPES:
                    raise ConfigurationError(
                        f"{path}: the tensor {shown(name)} must be of type {' or '.join(_FILE_TYPES)}, got {kind}"
                    )
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read: it is missing, cut short or something else ({error}); copy it anew"
        ) from None
