"""Rows of a `leaderboard.csv`, read for the pages."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from elastic_env.core.errors import ConfigurationError, shorten
from train.evaluate.standings import Paired, Standing
from train.evaluate.statistics import Estimate
from train.report.leaderboard import COLUMNS, claims_table, paired_text
from train.report.table_formats import to_markdown


def claims_markdown(found: Sequence[Standing]) -> str:
    """The paired changes of residuals, as a table."""
    return f"{paired_text()}\n\n{to_markdown(claims_table(found))}\n"


def read_leaderboard(path: Path) -> list[Standing]:
    """The rows of a `leaderboard.csv`.

    Raises:
        ConfigurationError: It is none.
    """
    with path.open(newline="", encoding="utf-8") as file:
        try:
            found = [_standing(row) for row in csv.DictReader(file)]
        except ValidationError as error:
            said = error.errors()[0]["msg"]
            raise ConfigurationError(f"{shorten(path)} is no leaderboard.csv: {said}") from None
        except (KeyError, TypeError, ValueError) as error:
            problem = f"{shorten(path)} is no leaderboard.csv: {error!r}"
            raise ConfigurationError(problem) from None
    if not found:
        raise ConfigurationError(f"{shorten(path)} has no rows")
    return found


def _standing(row: Mapping[str, str]) -> Standing:
    fields = {}
    for name in Standing.__dataclass_fields__:
        if name == "interval_over" and name not in row:
            continue  # of a leaderboard that was written before there was one
        cells = [row[column] for column in COLUMNS.get(name, (name,))]
        fields[name] = _FIELDS[len(cells)](*cells)
    return _STANDING.validate_python(fields)


def _estimate(value: str, low: str, high: str) -> Estimate:
    if not low:
        return Estimate(float(value))
    return Estimate(float(value), float(low), float(high))


def _paired(to: str, value: str, low: str, high: str, verdict: str) -> Paired | None:
    return Paired(to, _estimate(value, low, high), verdict) if to else None


_FIELDS: Mapping[int, Callable[..., Any]] = {1: str, 3: _estimate, 5: _paired}
"""Fields from so many columns."""
_STANDING = TypeAdapter(Standing)
