"""Folder of a trained residual: `residual.json` and `weights.safetensors`.

`residual.json` has the base, the settings, the network and the training. Loading runs no code from
the folder and needs no torch.
"""

from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from baselines.residual.network import Network, Tensors
from baselines.residual.settings import ResidualDescription
from elastic_env.core.config import load_json
from elastic_env.core.errors import ConfigurationError, quote, shorten
from elastic_env.core.files import write_whole
from elastic_env.core.tensors import read_tensors

DESCRIPTION = "residual.json"
WEIGHTS = "weights.safetensors"
_SHIPPED = Path(__file__).parents[1] / "trained"


def save_residual(folder: Path, residual: Any, tensors: Tensors) -> None:
    """Write a residual that `load_residual` reads; the network must be valid.

    Raises:
        ConfigurationError: Tensors that do not fit.
    """
    Network(residual, tensors)
    folder.mkdir(parents=True, exist_ok=True)
    weights = save({k: np.ascontiguousarray(v) for k, v in tensors.items()})
    write_whole(folder / WEIGHTS, weights)
    residual = residual.replace(weights_sha256=sha256(weights).hexdigest())
    write_whole(folder / DESCRIPTION, residual.model_dump_json(indent=2) + "\n")


def shipped_names() -> list[str]:
    """Names of the residuals that come with the package, such as testbed/seed_0."""
    folders = [path.parent for path in _SHIPPED.glob(f"*/*/{DESCRIPTION}")]
    return sorted(folder.relative_to(_SHIPPED).as_posix() for folder in folders)


def find_folder(folder: Path) -> Path:
    """Folder of a residual: the path itself, or the folder of that name in the package."""
    shipped = _SHIPPED / folder
    try:
        return shipped if not folder.exists() and shipped.exists() else folder
    except OSError:  # too long for a path, or within a folder that cannot be read
        return folder


def read_description(folder: Path) -> ResidualDescription:
    """Read the description of a residual; `folder` is a path or the name of a shipped one.

    Raises:
        ConfigurationError: There is none, or it is not valid.
    """
    folder = find_folder(folder)
    file = folder / DESCRIPTION
    missing = partial(_missing_residual, folder)
    return load_json(file, ResidualDescription, "residual", missing, within=folder)


def _missing_residual(folder: Path, why: str) -> str:
    """Error message for a folder without a residual."""
    try:
        inside = [*folder.glob(f"*/{DESCRIPTION}"), *folder.glob(f"*/*/{DESCRIPTION}")]
    except OSError:  # a name that is too long, or a folder that cannot be read
        inside = []
    if inside:  # the last policy first: the score of the best one is biased
        folders = sorted((path.parent.name != "last", path.parent) for path in inside)
        listed = ", ".join(str(path) for _, path in folders)
        return f"{folder} is no residual but has some inside; give one of them: {listed}"
    families: dict[str, list[str]] = {}
    for name in shipped_names():
        family, _, seed = name.partition("/")
        families.setdefault(family, []).append(seed)
    names = ", ".join(f"{name}/{seeds[0]} to {seeds[-1]}" for name, seeds in families.items())
    return (
        f"no residual at {quote(str(folder))[1:-1]}: a folder with {DESCRIPTION} and {WEIGHTS} is"
        f" needed ({why}), or the name of one that comes with the package: {names}"
    )


def load_residual(folder: Path) -> tuple[ResidualDescription, Network]:
    """Read a residual from its folder.

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
    digest = sha256(content).hexdigest()
    if description.weights_sha256 not in (None, digest):
        raise ConfigurationError(
            f"{folder / WEIGHTS} was changed: {DESCRIPTION} names the SHA-256 digest"
            f" {description.weights_sha256}, it has {digest}; copy it again, or leave"
            " weights_sha256 out if you mean these weights"
        )
    return description, network
