"""Validated, immutable parameter models, and YAML files that become them.

Every parameter of the project is a field of a `Model`, with its unit and its bounds. A wrong value
raises an error that names the field, the unit, the bound and the given value. An unknown key raises
an error that lists the keys that exist.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import numpy as np
import pydantic
import yaml
from pydantic import AfterValidator, BaseModel, Field, ValidationError
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_before_validator_function

from elastic_env.core.config_problems import ModelError, problems_of
from elastic_env.core.errors import ConfigurationError, list_names, quote, shorten
from elastic_env.core.files import read_bounded
from elastic_env.core.json_text import LARGEST_JSON, parse_json
from elastic_env.core.yaml_text import LARGEST_TEXT, NO_TEXT, parse_yaml

ModelT = TypeVar("ModelT", bound="Model")


def quantity(unit: str, default: Any = ..., **bounds: Any) -> Any:
    """Declare a physical parameter of a `Model`; the docstring below the field is its meaning.

    Args:
        unit: SI unit as it appears in error messages and tables, "1" for a pure number.
        default: Default value; without one the parameter is required.
        **bounds: Any of gt, ge, lt, le.
    """
    return Field(default, json_schema_extra={"unit": unit}, **bounds)


def plain_numbers(value: Any) -> Any:
    """Convert NumPy's numbers and arrays to Python's numbers and lists, also within containers.

    A number of less than double precision becomes its shortest decimal: 1.6 and not
    1.600000023841858.
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


def _strict_schema(schema: Any) -> Any:
    """Return Pydantic's schema with strict numbers, also NumPy's; arrays count as lists."""
    if isinstance(schema, list | tuple):
        return type(schema)(_strict_schema(part) for part in schema)
    if not isinstance(schema, dict) or schema.get("strict"):
        return schema
    value_keys = "default", "expected", "metadata"
    strict: Any = {
        key: part if key in value_keys else _strict_schema(part) for key, part in schema.items()
    }
    kind = strict.get("type")
    if kind in ("float", "int"):
        strict["strict"] = True
    if kind not in ("float", "int", "list", "tuple"):
        return strict
    convert = _to_whole if kind == "int" else plain_numbers
    return no_info_before_validator_function(convert, strict)


def _to_whole(value: Any) -> Any:
    """Convert a whole number that is written as 1e3 to an integer."""
    number = plain_numbers(value)
    return int(number) if isinstance(number, float) and number.is_integer() else number


class Model(BaseModel):
    """Base of all parameter models: frozen, no unknown keys, no NaN, errors with unit and bound.

    A number is one of Python or NumPy, also in an array, but neither text nor a truth value.
    """

    model_config = pydantic.ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
        use_attribute_docstrings=True,
    )

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            problems = problems_of(type(self), error, values)
            raise ModelError(type(self).__name__, problems) from None

    def _check(self) -> None:
        """Refuse parameters that contradict each other, by a ValueError."""

    @pydantic.model_validator(mode="after")
    def _check_together(self) -> Self:
        self._check()
        return self

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Remove the line breaks of docstrings from descriptions."""
        super().__pydantic_init_subclass__(**kwargs)
        for field in cls.model_fields.values():
            if field.description is not None:
                parts = re.split(r"\n\s*\n", field.description)
                lines = [" ".join(part.split()) for part in parts]
                field.description = "\n\n".join(lines)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> CoreSchema:
        """Return Pydantic's schema with strict numbers."""
        return _strict_schema(handler(source))

    def replace(self, **changes: Any) -> Self:
        """Return a validated copy with some parameters changed."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**values, **changes})


def _require_text(value: str) -> str:
    if NO_TEXT.search(value):
        raise ValueError(
            f"a name must hold neither zero bytes nor halves of characters, got {quote(value)}"
        )
    return value


_Text = Annotated[str, AfterValidator(_require_text)]
Title = Annotated[_Text, Field(max_length=100)]
"""Text that names something in tables and files."""
Locator = Annotated[_Text, Field(max_length=1000)]
"""Text that may hold a path."""
MOST_ENTRIES = 1000
"""Entries of a list in a configuration."""


def _require_unique(values: list[Any]) -> list[Any]:
    for value in values:
        if values.count(value) > 1:
            raise ValueError(f"{quote(value)} stands twice; leave out one of them")
    return values


Once = AfterValidator(_require_unique)
"""Validator of a list without duplicates."""
_Entry = TypeVar("_Entry")
Entries = Annotated[list[_Entry], Field(min_length=1, max_length=MOST_ENTRIES)]
"""A list of a configuration that must not be empty."""
LARGEST_SEED = 2**63 - 1
"""Seeds of episodes are 64-bit integers."""
_UTF8_BYTES = 4
"""Most bytes of a character in UTF-8."""


def load_yaml(
    path: str | Path, model: type[ModelT], changes: Mapping[str, Any] | None = None
) -> ModelT:
    """Read a YAML file into a validated model.

    Args:
        path: The file.
        model: Class of the result.
        changes: Parameters that replace the file's or add to them.

    Raises:
        ConfigurationError: The file is missing, is not a YAML mapping, or does not fit the model.
    """
    file = Path(path)
    content = read_mapping(file, empty=bool(changes))
    try:
        return model(**{**content, **(changes or {})})
    except ConfigurationError as error:
        problem = error.describe() if isinstance(error, ModelError) else error
        raise ConfigurationError(f"in {shorten(file)}: {problem}") from None


def read_json(
    path: Path, most_bytes: int, missing: Callable[[str], str], within: Path | None = None
) -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        most_bytes: Largest size [bytes].
        missing: Makes the message for a file that cannot be read, from the reason.
        within: Folder that the file must lie in, after all links; None for anywhere.

    Raises:
        ConfigurationError: It cannot be read, or is not JSON.
    """
    try:
        return parse_json(read_bounded(path, most_bytes, within).decode("utf-8"))
    except ConfigurationError:
        raise
    except OSError as error:
        raise ConfigurationError(missing(str(error.strerror))) from None
    except ValueError as error:
        raise ConfigurationError(f"{shorten(path)} is not JSON: {error}") from None


def load_json(
    path: Path,
    model: type[ModelT],
    what: str,
    missing: Callable[[str], str],
    within: Path | None = None,
) -> ModelT:
    """Read a JSON file into a validated model.

    Args:
        path: The file.
        model: Class of the result.
        what: Word for the content, such as residual.
        missing: Makes the message for a file that cannot be read, from the reason.
        within: Folder that the file must lie in, after all links; None for anywhere.

    Raises:
        ConfigurationError: The file cannot be read, is not a JSON mapping, or does not fit the
            model.
    """
    content = read_json(path, _UTF8_BYTES * LARGEST_JSON, missing, within)
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise ConfigurationError(f"{shorten(path)} must be a mapping, got {kind}")
    try:
        return model(**content)
    except ModelError as error:
        problem = f"{shorten(path)} describes no {what}: {error.describe()}"
        raise ConfigurationError(problem) from None


def read_mapping(file: Path, empty: bool = False) -> dict[str, Any]:
    """Read the mapping in a YAML file.

    Args:
        file: The file.
        empty: True to read an empty file as an empty mapping.

    Raises:
        ConfigurationError: The file cannot be read, is no YAML, or holds something else.
    """
    try:
        content = parse_yaml(read_bounded(file, _UTF8_BYTES * LARGEST_TEXT).decode())
    except ConfigurationError:
        raise
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = str(error).replace('"<unicode string>"', shorten(file))
        problem = f"{shorten(file)} is not valid YAML: {reason}"
    except IsADirectoryError:
        problem = f"{shorten(file)} is a folder, a YAML file is needed"
    except (FileNotFoundError, NotADirectoryError, ValueError):
        problem = f"no configuration file at {shorten(file)}{_list_neighbours(file)}"
    except OSError as error:
        problem = f"{shorten(file)} cannot be read: {error.strerror}"
    else:
        if content is None and empty:
            return {}
        if isinstance(content, dict):
            return content
        got = "an empty file" if content is None else type(content).__name__
        needed = "must hold a mapping of parameters, such as 'name: value'"
        problem = f"{shorten(file)} {needed}, got {got}"
    raise ConfigurationError(problem) from None


def _list_neighbours(file: Path) -> str:
    """List the YAML files of the folder of a missing file."""
    known = sorted(map(str, file.parent.glob("*.yaml"))) if file.parent.is_dir() else []
    return f"; found beside it: {list_names(known)}" if known else ""
