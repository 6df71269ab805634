"""Errors about the parameters of a model, which name each parameter as its user wrote it."""

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from elastic_env.core.errors import ConfigurationError, choices_listed, quote, readable

ParameterPath = tuple[str | int, ...]
"""Keys and numbers of entries that lead to a value."""
Spelling = Callable[[ParameterPath], str]
"""Function that writes a parameter as its user did."""


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a parameter.

    Attributes:
        path: The parameter.
        form: "must" for a wrong value, "rule" for parameters that contradict each other, "unknown"
            for one that does not exist, "missing" for one that has no default.
        text: The rest of the sentence.
    """

    path: ParameterPath
    form: Literal["must", "rule", "unknown", "missing"]
    text: str

    def sentence(self, root: str, spelling: Spelling) -> str:
        """Return the sentence.

        Args:
            root: Name of the outermost model, as a prefix; empty for none.
            spelling: Writes a parameter as its user did.
        """
        if self.form in ("must", "rule"):
            name = spelling(self.path)
            prefix = f"{root}." if root and name and self.form == "must" else ""
            between = ": " if self.form == "rule" and name else " " if name else ""
            return f"{prefix}{name}{between}{self.text}"
        owner = spelling(self.path[:-1]) or root
        name = quote(self.path[-1])
        if self.form == "unknown":
            of_owner = f"of {owner} " if owner else ""
            return f"unknown parameter {of_owner}{name}; {self.text}"
        return f"{owner or 'the configuration'} needs the parameter {name}{self.text}"


_MOST_SENTENCES = 20
_LONGEST_MESSAGE = 1900
"""Sentences and characters of an error; it counts the problems beyond them."""


def join_path(path: ParameterPath) -> str:
    """Write a parameter as the keys that lead to it, with dots."""
    is_short = [isinstance(part, str) and len(part) < 100 for part in path]
    parts = zip(path, is_short, strict=True)
    return ".".join(str(part) if short else quote(part) for part, short in parts)


class ModelError(ConfigurationError):
    """Parameters do not fit a model; the message lists all problems.

    Args:
        model: Name of the model.
        problems: The problems.
    """

    def __init__(self, model: str, problems: Sequence[Problem]) -> None:
        self.model = model
        self.problems = tuple(problems)
        super().__init__(self.describe(model))

    def __reduce__(self) -> Any:
        """Support pickling: another process makes the error from its arguments."""
        return type(self), (self.model, self.problems)

    def describe(self, root: str = "", spelling: Spelling = join_path) -> str:
        """List all problems, one per line, for the author of a file or options.

        Arguments as in `Problem.sentence`.
        """
        texts = [problem.sentence(root, spelling) for problem in self.problems]
        sentences = list(dict.fromkeys(map(readable, texts)))
        lengths = itertools.accumulate(len(sentence) + 1 for sentence in sentences)
        fitting = max(sum(length <= _LONGEST_MESSAGE for length in lengths), 1)
        fitting = min(fitting, _MOST_SENTENCES)
        lines = [sentence[:_LONGEST_MESSAGE] for sentence in sentences[:fitting]]
        if fitting < len(sentences):
            lines.append(f"and {len(sentences) - fitting} more")
        return "\n".join(lines)


def problems_of(
    model: type[BaseModel], error: ValidationError, values: Mapping[str, Any]
) -> list[Problem]:
    """Return the problems of a failed validation, with those of models within the model.

    Args:
        model: The model.
        error: The error of Pydantic.
        values: The given values.
    """
    problems: list[Problem] = []
    for problem in error.errors(include_url=False):
        path = _path(problem["loc"], values, is_missing=problem["type"] == "missing")
        cause = problem.get("ctx", {}).get("error")
        if isinstance(cause, ModelError):  # of a model within this one
            problems += [replace(p, path=(*path, *p.path)) for p in cause.problems]
        else:
            problems.append(_problem(model, path, problem))
    return problems


def _problem(model: type[BaseModel], path: ParameterPath, problem: Any) -> Problem:
    given = quote(problem["input"])
    field = model.model_fields.get(str(path[0])) if len(path) == 1 else None
    match problem["type"]:
        case "extra_forbidden":
            choices = choices_listed(path[-1], model.model_fields)
            return Problem(path, "unknown", choices)
        case "missing" if isinstance(path[-1], int):  # of a list of a fixed length
            return Problem(path[:-1], "must", f"must have an entry {path[-1] + 1}, got {given}")
        case "missing":
            meaning = f": {field.description}" if field and field.description else ""
            return Problem(path, "missing", f"{_unit(field)}{meaning}")
        case "value_error":
            return Problem(path, "rule", str(problem["ctx"]["error"]))
        case "string_pattern_mismatch":
            meaning = model.model_fields[str(path[0])].description
            return Problem(path, "must", f"must be as follows: {meaning} Got {given}")
    context = problem.get("ctx", {})
    requirement = f"be {problem['msg'].removeprefix('Input should be ')}"
    if kind := _REQUIREMENTS.get(problem["type"]):
        entries = "entry" if 1 in context.values() else "entries"
        requirement = kind.format(entries=entries, **context)
    if bounds := _bounds(field):
        requirement = f"be {bounds}"
    meaning = meaning_of(field) if field is not None else ""
    text = f"must {requirement}{_unit(field)}, got {given}"
    return Problem(path, "must", f"{text} ({meaning})" if meaning else text)


_REQUIREMENTS = {
    "model_type": "be a mapping of parameters",
    "dict_type": "be a mapping",
    "list_type": "be a list",
    "tuple_type": "be a list",
    "string_type": "be text",
    "path_type": "be a path",
    "greater_than": "be > {gt:.6g}",
    "greater_than_equal": "be >= {ge:.6g}",
    "less_than": "be < {lt:.6g}",
    "less_than_equal": "be <= {le:.6g}",
    "bool_type": "be true or false",
    "bool_parsing": "be true or false",
    "too_short": "have at least {min_length} {entries}",
    "too_long": "have at most {max_length} {entries}",
    "string_too_long": "have at most {max_length} characters",
}
"""Requirements in the words of a configuration; Pydantic's are in those of Python."""


def _path(location: ParameterPath, values: Any, is_missing: bool) -> ParameterPath:
    """Return a location without the member of a union, which Pydantic adds."""
    path: list[str | int] = []
    for number, part in enumerate(location):
        inside: Any = None
        if isinstance(values, Mapping) and isinstance(part, str):
            if part not in values and not (is_missing and number == len(location) - 1):
                continue
            inside = values.get(part)
        elif isinstance(values, list | tuple) and isinstance(part, int):
            inside = values[part] if part < len(values) else None
        elif number > 0 and not isinstance(values, Mapping | None):
            continue
        path.append(part)
        values = inside
    return tuple(path)


def _bounds(field: FieldInfo | None) -> str:
    """Return the requirement of bounds, such as "a finite number > 0", or an empty text."""
    if field is None:
        return ""
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    constraints = [
        f"{sign} {_number(getattr(constraint, key))}"
        for constraint in field.metadata
        for key, sign in signs.items()
        if hasattr(constraint, key)
    ]
    annotation = str(field.annotation)
    is_whole = "int" in annotation and "float" not in annotation
    kind = "a whole number" if is_whole else "a finite number"
    return f"{kind} {' and '.join(constraints)}" if constraints else ""


def _number(bound: float) -> str:
    """Write a bound, a whole one with all its digits."""
    return f"{bound:d}" if isinstance(bound, int) else f"{bound:.6g}"


def meaning_of(field: FieldInfo) -> str:
    """Return the first sentence of a quantity's description, without unit; else an empty text."""
    if not field.description or not isinstance(field.json_schema_extra, dict):
        return ""
    text = " ".join(field.description.split())
    sentence = re.split(r"\.(?: |$)", text, maxsplit=1)[0]
    if sentence[1:2].islower():  # no symbol and no abbreviation
        sentence = sentence[0].lower() + sentence[1:]
    return sentence.removesuffix(f" [{field.json_schema_extra['unit']}]")


def _unit(field: FieldInfo | None) -> str:
    extra = field.json_schema_extra if field is not None else None
    unit = extra["unit"] if isinstance(extra, dict) else "1"
    return f" [{unit}]" if unit != "1" else ""
