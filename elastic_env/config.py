"""Validated, immutable parameter models, and YAML files that become them.

Every parameter of the project is a field of a `Model`: it carries its unit and its bounds, a wrong
value raises an error that names the field, the unit, the bound and what was given, and an unknown key
lists the keys that exist.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

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
    """Base of all parameter models: frozen, no unknown keys, no NaN, errors with unit and bound."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True, use_attribute_docstrings=True
    )

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ConfigurationError(_explain(type(self), error)) from None

    def replace(self, **changes: Any) -> Self:
        """A validated copy with some parameters changed."""
        return type(self)(**{**{name: getattr(self, name) for name in type(self).model_fields}, **changes})


def _explain(model: type[BaseModel], error: ValidationError) -> str:
    """All problems of a validation, one per line, each with name, unit, bound and value."""
    return "\n".join(_explain_one(model, problem) for problem in error.errors())


def _explain_one(model: type[BaseModel], problem: Mapping[str, Any]) -> str:
    name = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return str(unknown_name(f"parameter of {model.__name__}", name, model.model_fields))
    if problem["type"] == "missing":
        return f"{model.__name__} needs the parameter {name!r}{_unit(model, name)}"
    if problem["type"] == "value_error":
        message = str(problem["ctx"]["error"])
        return f"{name}: {message}" if name else message
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


def load_yaml(path: str | Path, model: type[ModelT]) -> ModelT:
    """Read a YAML file into a validated model.

    Raises:
        ConfigurationError: The file is missing, is not a YAML mapping, or does not fit the model.
    """
    file = Path(path)
    if not file.is_file():
        known = sorted(str(p) for p in file.parent.glob("*.yaml")) if file.parent.is_dir() else []
        listing = f"; found beside it: {', '.join(known)}" if known else ""
        raise ConfigurationError(f"no configuration file at {file}{listing}")
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{file} is not valid YAML: {error}") from None
    if not isinstance(content, dict):
        raise ConfigurationError(f"{file} must hold a mapping of parameters, got {type(content).__name__}")
    try:
        for key in content:
            if not isinstance(key, str):
                raise unknown_name(f"parameter of {model.__name__}", key, model.model_fields)
        return model(**content)
    except ConfigurationError as error:
        raise ConfigurationError(f"in {file}: {error}") from None
