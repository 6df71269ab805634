"""Files that describe a robot on a fixed base, for `--env ROBOT.yaml`."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from elastic_env.core.config import Locator, Model, load_yaml, quantity
from elastic_env.core.errors import ConfigurationError, quote

ENDINGS = (".yaml", ".yml")
"""Endings of the names of robot files."""


class RobotFile(Model):
    """A robot on a fixed base; keys as of `gymnasium.make("elastic_env/Robot-v0", ...)`."""

    model: Locator
    """Rigid model, a file of MJCF (.xml) or URDF (.urdf)."""
    joints: Locator | dict[str, Any]
    """Elastic joints: a YAML file, or a mapping from names or patterns."""
    end_effector: Locator | None = None
    """Site or body whose place and tilt are scored; None for the outermost body."""
    home: dict[str, float] | list[float] | None = None
    """Angles about which the joints follow a reference, by name or in order [rad]."""
    load_kg: float | None = quantity("kg", None, gt=0)
    """The scenario `payload` adds a fifth of it at the end effector [kg]."""
    imu: Locator | None = None
    """Site of the accelerometer."""

    def arguments(self, folder: Path) -> dict[str, Any]:
        """Arguments of the environment; paths of files are relative to the folder."""
        arguments = self.model_dump(exclude_none=True)
        files = {name: str(folder / path) for name, path in _file_arguments(arguments)}
        return {**arguments, **files}


def read_robot_file(name: str) -> dict[str, Any]:
    """Arguments of `elastic_env/Robot-v0` from a file, which `--env arm.robot.yaml` names.

        model: arm.xml
        joints: arm.yaml
        end_effector: tool

    Paths in the file are relative to its folder.

    Raises:
        ConfigurationError: The file is missing or does not describe a robot.
    """
    try:
        return load_yaml(name, RobotFile).arguments(Path(name).parent)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"--env {quote(name)[1:-1]} must be a file of a robot, with the keys model and joints:"
            f" {error}"
        ) from None


def files_of_robot(name: str) -> Iterator[Path]:
    """Yield the files that a robot file names; none if the file is not a robot file."""
    if name.endswith(ENDINGS) and Path(name).is_file():
        try:
            arguments = read_robot_file(name)
        except ConfigurationError:
            return
        yield from (Path(path) for _, path in _file_arguments(arguments))


def _file_arguments(arguments: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Arguments that name a file, with its path."""
    values = [(name, arguments[name]) for name in ("model", "joints")]
    return [(name, value) for name, value in values if isinstance(value, str)]
