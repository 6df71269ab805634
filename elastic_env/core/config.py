"""Validated, immutable parameter models, and YAML files that become them.

Every parameter of the project is a field of a `Model`: it carries its unit and its bounds, a wrong
value raises an error that names the field, the unit, the bound and what was given, and an unknown key
lists the keys that exist.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, get_args, get_origin

import numpy as np
import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from elastic_env.core.config_problems import ModelError, problems_of
from elastic_env.core.errors import ConfigurationError, shown
from elastic_env.core.yaml_text import LARGEST_TEXT, NO_TEXT, parse_yaml

ModelT = TypeVar("ModelT", bound="Model")


def quantity(unit: str, default: Any = ..., *, description: str, **bounds: Any) -> Any:
    """A physical parameter of a `Model`.

    Args:
        unit: SI unit as it appears in error messages and tables, "1" for a pure number.
        default: Default value; without one the parameter is required.
        description: One line for `--help` and documentation.
        **bounds: Any of gt, ge, lt, le.
    """
    return Field(default, description=f"{description} [{unit}]", json_schema_extra={"unit": unit}, **bounds)


class Model(BaseModel):
    """Base of all parameter models: frozen, no unknown keys, no NaN, errors with unit and bound.

    Numbers are numbers: Python's or NumPy's, and arrays of them, but neither text nor truth values.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True, use_attribute_docstrings=True
    )

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ModelError(type(self).__name__, problems_of(type(self), error, values)) from None

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_numbers(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        fields = cls.model_fields
        return {
            name: _only_numbers(plain_numbers(value))
            if name in fields and _is_numeric(fields[name].annotation)
            else value
            for name, value in values.items()
        }

    def replace(self, **changes: Any) -> Self:
        """A validated copy with some parameters changed."""
        return type(self)(**{**{name: getattr(self, name) for name in type(self).model_fields}, **changes})


def _is_text(value: str) -> str:
    if NO_TEXT.search(value):
        raise ValueError(f"a name must hold neither zero bytes nor halves of characters, got {shown(value)}")
    return value


_Text = Annotated[str, AfterValidator(_is_text)]
Title = Annotated[_Text, Field(max_length=100)]
"""Text that names something in tables and files."""
Locator = Annotated[_Text, Field(max_length=1000)]
"""Text that may hold a path."""
MOST_ENTRIES = 1000
"""Entries of a list in a configuration."""
LARGEST_SEED = 2**63 - 1
"""Seeds of episodes are 64-bit integers."""


def plain_numbers(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's numbers and lists, also within lists, tuples and mappings.

    A number of less than double precision becomes what it is written as: 1.6 and not 1.600000023841858.
    """
    match value:
        case np.ndarray():
            return plain_numbers(list(value) if value.ndim else value[()])
        case np.floating() if not isinstance(value, float):
            return float(str(value))
        case np.generic():
            return value.item()
        case list():
            return [plain_numbers(item) for item in value]
        case tuple():
            return tuple(plain_numbers(item) for item in value)
        case dict():
            return {key: plain_numbers(item) for key, item in value.items()}
        case _:
            return value


@dataclass(frozen=True)
class _NoNumber:
    """Text or a truth value in a number's place, which Pydantic would convert; shown as it was given."""

    given: Any

    def __repr__(self) -> str:
        return repr(self.given)


def _only_numbers(value: Any) -> Any:
    """The same with text and truth values, also within lists, tuples and mappings, made what no number field takes."""
    if isinstance(value, list | tuple):
        return [_only_numbers(item) for item in value]
    if isinstance(value, dict):
        return {key: _only_numbers(item) for key, item in value.items()}
    return _NoNumber(value) if isinstance(value, str | bytes | bool) else value


def _is_numeric(annotation: Any) -> bool:
    """Whether an annotation is of numbers, or of lists, tuples and mappings of them, and allows nothing else."""
    if annotation in (int, float):
        return True
    arguments = [part for part in get_args(annotation) if part not in (type(None), Ellipsis)]
    if get_origin(annotation) is Annotated:
        arguments = arguments[:1]
    if get_origin(annotation) is dict:
        arguments = arguments[1:]
    return bool(arguments) and all(map(_is_numeric, arguments))


def load_yaml(path: str | Path, model: type[ModelT], changes: Mapping[str, Any] | None = None) -> ModelT:
    """Read a YAML file into a validated model.

    Args:
        path: The file.
        model: What it becomes.
        changes: Parameters in place of the file's, or beside them.

    Raises:
        ConfigurationError: The file is missing, is not a YAML mapping, or does not fit the model.
    """
    file = Path(path)
    try:
        content = parse_yaml(_text_of(file))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{file} is not valid YAML: {error}") from None
    if content is None and changes:
        content = {}
    if not isinstance(content, dict):
        got = "an empty file" if content is None else type(content).__name__
        raise ConfigurationError(f"{file} must hold a mapping of parameters, such as 'name: value', got {got}")
    try:
        return model(**{**content, **(changes or {})})
    except ModelError as error:
        raise ConfigurationError(f"in {file}: {error.named()}") from None
    except ConfigurationError as error:
        raise ConfigurationError(f"in {file}: {error}") from None


def _text_of(file: Path) -> str:
    """Text of a file that is one, and no longer than a configuration is.

    Raises:
        ConfigurationError: It is missing, a folder or too long, or cannot be read.
    """
    try:
        if file.is_dir():
            raise ConfigurationError(f"{file} is a folder, a YAML file is needed")
        if not file.is_file():
            known = sorted(str(p) for p in file.parent.glob("*.yaml")) if file.parent.is_dir() else []
            listing = f"; found beside it: {', '.join(known)}" if known else ""
            raise ConfigurationError(f"no configuration file at {shown(str(file))[1:-1]}{listing}")
        if file.stat().st_size > 4 * LARGEST_TEXT:  # bytes of a character in UTF-8
            raise ConfigurationError(f"{file} is too long for a configuration: more than {LARGEST_TEXT} characters")
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{shown(str(file))} cannot be read: {error.strerror}") from None
