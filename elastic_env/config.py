"""Validated, immutable parameter models, and YAML files that become them.

Every parameter of the project is a field of a `Model`: it carries its unit and its bounds, a wrong
value raises an error that names the field, the unit, the bound and what was given, and an unknown key
lists the keys that exist.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, get_args, get_origin

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from elastic_env.errors import ConfigurationError, unknown_name

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
            raise ConfigurationError(_explain(type(self), error)) from None

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


def _explain(model: type[BaseModel], error: ValidationError) -> str:
    """All problems of a validation, one per line, each with name, unit, bound and value."""
    return "\n".join(_explain_one(model, problem) for problem in error.errors())


def _explain_one(model: type[BaseModel], problem: Mapping[str, Any]) -> str:
    name = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return str(unknown_name(f"parameter of {model.__name__}", name, model.model_fields))
    if problem["type"] == "missing":
        field = model.model_fields.get(name)
        meaning = f": {field.description}" if field is not None and field.description else ""
        return f"{model.__name__} needs the parameter {name!r}{_unit(model, name)}{meaning}"
    if problem["type"] == "value_error":
        message = str(problem["ctx"]["error"])
        return f"{name}: {message}" if name else message
    if problem["type"] == "model_type":
        return f"{model.__name__}.{name} must be a mapping of parameters, got {problem['input']!r}"
    if problem["type"] == "too_short":
        return f"{model.__name__}.{name} needs at least {problem['ctx']['min_length']} entry, got {problem['input']!r}"
    requirement = _bounds(model, name) or problem["msg"].removeprefix("Input should be ")
    return f"{model.__name__}.{name} must be {requirement}{_unit(model, name)}, got {problem['input']!r}"


def _bounds(model: type[BaseModel], name: str) -> str:
    """Requirement of a parameter with bounds, such as "a finite number > 0"; empty for one without."""
    field = model.model_fields.get(name)
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    constraints = [
        f"{sign} {getattr(constraint, key):.6g}"
        for constraint in (field.metadata if field is not None else [])
        for key, sign in signs.items()
        if hasattr(constraint, key)
    ]
    whole = field is not None and "int" in str(field.annotation) and "float" not in str(field.annotation)
    kind = "a whole number" if whole else "a finite number"
    return f"{kind} {' and '.join(constraints)}" if constraints else ""


def _unit(model: type[BaseModel], name: str) -> str:
    field = model.model_fields.get(name)
    extra = field.json_schema_extra if field is not None else None
    return f" [{extra['unit']}]" if isinstance(extra, dict) and extra["unit"] != "1" else ""


class _Loader(yaml.SafeLoader):
    """PyYAML's, with the numbers of YAML 1.2 and JSON: 1e3 is one too, which YAML 1.1 takes for text."""


_EXPONENT = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+.0123456789"))


def parse_yaml(text: str) -> Any:
    """What a text in YAML holds.

    Raises:
        yaml.YAMLError: It is not YAML.
    """
    return yaml.load(text, _Loader)


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
    if file.is_dir():
        raise ConfigurationError(f"{file} is a folder, a YAML file is needed")
    if not file.is_file():
        known = sorted(str(p) for p in file.parent.glob("*.yaml")) if file.parent.is_dir() else []
        listing = f"; found beside it: {', '.join(known)}" if known else ""
        raise ConfigurationError(f"no configuration file at {file}{listing}")
    try:
        content = parse_yaml(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{file} is not valid YAML: {error}") from None
    if content is None and changes:
        content = {}
    if not isinstance(content, dict):
        got = "an empty file" if content is None else type(content).__name__
        raise ConfigurationError(f"{file} must hold a mapping of parameters, such as 'name: value', got {got}")
    try:
        for key in content:
            if not isinstance(key, str):
                raise unknown_name(f"parameter of {model.__name__}", key, model.model_fields)
        return model(**{**content, **(changes or {})})
    except ConfigurationError as error:
        raise ConfigurationError(f"in {file}: {error}") from None
