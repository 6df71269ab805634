"""Folders of the training seeds of a residual: `residual:PATH`, where * may be in the path."""

import difflib
import fnmatch
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from baselines.residual.residual_folder import read_description, shipped_names
from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import ConfigurationError, quote, shorten

_WILDCARD = re.compile(r"[*?\[]")
_LISTED_NAMES = 5
"""Names that the error for a pattern without folders lists."""
_SEED = re.compile(r"seed[_-]?(\d+)")
_SEED_KEYS = ("name", "seeds", "evaluate_every", "evaluation_episodes", "checkpoint_every")
"""Keys of a training configuration in which the seeds of a family may differ."""


@dataclass(frozen=True)
class ResidualFolder:
    """A residual's folder with its description."""

    folder: Path
    description: ResidualDescription

    @property
    def training_seed(self) -> int | None:
        """Seed in the description, or else in the path; None if neither has one."""
        if self.description.origin.seed is not None:
            return self.description.origin.seed
        numbers = _SEED.findall(str(self.folder))
        return int(numbers[-1]) if numbers else None


def find_members(pattern: str) -> list[ResidualFolder]:
    """Find the residuals of a path or pattern, in natural order.

    A pattern that matches no folder stands for residuals of the package.

    Raises:
        ConfigurationError: A pattern that matches no folder, a folder without residual, or folders
            that do not belong together.
    """
    if not _WILDCARD.search(pattern):
        return [ResidualFolder(Path(pattern), read_description(Path(pattern)))]
    shipped = map(Path, fnmatch.filter(shipped_names(), pattern))
    folders = sorted(_matching_folders(pattern) or shipped, key=_natural_order)
    members = [ResidualFolder(folder, read_description(folder)) for folder in folders]
    if not members:
        choices = _similar_folders(Path(pattern))
        raise ConfigurationError(f"no folder matches {quote(pattern)}; {choices}")
    _require_one_family(pattern, members)
    return members


def _matching_folders(pattern: str) -> list[Path]:
    """Folders whose paths match a pattern.

    Raises:
        ConfigurationError: The pattern matches folders of any depth, perhaps of the whole disk.
    """
    if "**" in pattern:
        problem = f"* stands for one part of a path, got {quote(pattern)}; leave ** out"
        raise ConfigurationError(problem)
    anchor = Path(pattern).anchor
    try:
        paths = Path(anchor).glob(str(Path(pattern).relative_to(anchor)))
        return [path for path in paths if path.is_dir()]
    except OSError:  # a name that is too long
        return []


def _similar_folders(pattern: Path) -> str:
    """List the folders next to a pattern, the most similar first, and those of the package."""
    parent = next(
        path
        for path in pattern.parents
        if os.path.isdir(path) and not _WILDCARD.search(str(path))  # noqa: PTH112
    )
    folders = (path.name for path in parent.iterdir() if path.is_dir())
    names = [name for name in folders if not name.startswith(".")]
    wanted = pattern.relative_to(parent).parts[0]
    similar = difflib.get_close_matches(wanted, names, n=_LISTED_NAMES, cutoff=0.0)
    families = dict.fromkeys(f"{name.split('/')[0]}/seed_*" for name in shipped_names())
    place = "this folder" if parent == Path() else str(parent)
    return (
        f"{place} has {', '.join(similar) or 'no folders'}; with the package come"
        f" {', '.join(families)}"
    )


def _require_one_family(pattern: str, members: Sequence[ResidualFolder]) -> None:
    """Refuse folders that are not training seeds of one configuration."""
    expected = _family_settings(members[0].description)
    seen: dict[int, Path] = {}
    for member in members:
        settings = _family_settings(member.description)
        folder = member.folder
        seed = member.training_seed
        for name in {**settings, **expected}:
            if settings.get(name) != expected.get(name):
                raise ConfigurationError(
                    f"{pattern!r} must match training seeds of one configuration, but {name} of"
                    f" {shorten(folder)} is {settings.get(name)!r} and of {members[0].folder}"
                    f" {expected.get(name)!r}; give each an entry of its own"
                )
        if seed is None:
            raise ConfigurationError(
                f"{folder} has no training seed: residual.json has no training.seed and the path no"
                " seed_N"
            )
        if seed in seen:
            raise ConfigurationError(
                f"{pattern!r} matches training seed {seed} twice: {seen[seed]} and"
                f" {shorten(folder)}"
            )
        seen[seed] = folder


def _family_settings(description: ResidualDescription) -> dict[str, object]:
    """Settings that the members of a family share."""
    config = description.training.get("config", {})
    trained = {f"the trained {k}": v for k, v in config.items() if k not in _SEED_KEYS}
    names = ("robot", "base", "base_options", "settings")
    return trained | {name: getattr(description, name) for name in names}


def _natural_order(path: Path) -> list[int | str]:
    """Sort key for seed_2 before seed_10: texts and numbers in turn."""
    parts = re.split(r"(\d+)", str(path))
    return [int(part) if part.isdecimal() else part for part in parts]
