"""Policies of a comparison with all training seeds of each residual, and their opponents.

A residual is compared with its base, and with the best policy without learning that reads the same
sensors.
"""

import difflib
import fnmatch
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from baselines.catalogue import ASSUMED_OPTIONS
from baselines.policies import RESIDUAL, best_analytic
from baselines.residual.residual_folder import DESCRIPTION, read_description, shipped_names
from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import ConfigurationError, quote, shorten
from train.evaluate.conditions import Member, PolicySpec
from train.evaluate.environments import ENVIRONMENTS

Options = dict[str, object]
"""Options of a policy by name."""

_WILD = re.compile(r"[*?\[]")
_NEAREST = 5
"""Names that the error for a pattern without folders lists."""
_SEED = re.compile(r"seed[_-]?(\d+)")


@dataclass(frozen=True)
class Entrant:
    """Who plays: a policy, and of a residual which training seed of which family.

    Attributes:
        policy: The policy; all members of a family have its title.
        member: Training seed and base; None for what is no residual.
    """

    policy: PolicySpec
    member: Member | None = None


@dataclass(frozen=True)
class Origin:
    """How a family was trained.

    Attributes:
        scenarios: That it was trained on; None where its files do not say.
        reference: Motion that it was trained on; None for the environment's default.
        missing_seeds: Training seeds of its configuration that the family does not have.
        folders: Its folders.
        commits: Commits that trained it.
        ranges: Intervals of drawn robots that its configuration names.
    """

    scenarios: tuple[str, ...] | None
    reference: object
    missing_seeds: tuple[int, ...]
    folders: tuple[str, ...]
    commits: tuple[str, ...]
    ranges: Any = field(default_factory=dict)


def expand(policies: Sequence[PolicySpec], with_bases: bool = True) -> list[Entrant]:
    """All who play: residuals with a folder each, and bases and rivals that nobody named.

    Args:
        policies: Policies as a configuration names them; `residual:PATH` may have * in its path.
        with_bases: Whether a base or a rival that is not among them is added, before its residual.

    Raises:
        ConfigurationError: A pattern that matches no folder, a folder without residual, or folders
            that do not belong together.
    """
    entrants: list[Entrant] = []
    bases = [policy for policy in policies if not is_residual(policy)]

    def add(other: PolicySpec) -> None:
        if with_bases and other not in bases:
            bases.append(other)
            entrants.append(Entrant(other))

    for policy in policies:
        if not is_residual(policy):
            entrants.append(Entrant(policy))
            continue
        members = _members(policy.name.removeprefix(RESIDUAL))
        for member in members:
            _require_motion(member)
        taken = [*policies, *bases]
        base, rival = _opponents(members[0].description, policy, taken)
        add(base)
        if rival is not None:
            add(rival)
        entrants += [
            Entrant(
                policy.replace(name=f"{RESIDUAL}{own.folder}", label=policy.title),
                Member(
                    folder=str(own.folder),
                    training_seed=own.training_seed,
                    base=base.title,
                    rival=rival.title if rival in bases else None,
                ),
            )
            for own in members
        ]
    return entrants


def is_residual(policy: PolicySpec) -> bool:
    """True if a policy is a trained residual, or a family of them."""
    return policy.name.startswith(RESIDUAL)


def origin(members: Sequence[Member]) -> Origin:
    """How a family was trained, from its files."""
    descriptions = [read_description(Path(member.folder)) for member in members]
    config = descriptions[0].origin.config
    scenarios = config.scenarios
    wanted = set(config.seeds)
    had = {member.training_seed for member in members}
    commits = [description.origin.commit or "unknown" for description in descriptions]
    return Origin(
        scenarios=None if scenarios is None else tuple(scenarios),
        reference=config.reference,
        missing_seeds=tuple(sorted(wanted - had)) if len(members) > 1 else (),
        folders=tuple(member.folder for member in members),
        commits=tuple(dict.fromkeys(commits)),
        ranges=descriptions[0].training.get("config", {}).get("ranges") or {},
    )


@dataclass(frozen=True)
class _Folder:
    """A residual's folder with its description and training seed; None where nothing says it."""

    folder: Path
    description: ResidualDescription

    @property
    def training_seed(self) -> int | None:
        """As the residual says it, or the name of its folder."""
        if self.description.origin.seed is not None:
            return self.description.origin.seed
        found = _SEED.findall(str(self.folder))
        return int(found[-1]) if found else None


def _members(pattern: str) -> list[_Folder]:
    """Folders of a pattern in natural order; shipped ones where none lie there."""
    if not _WILD.search(pattern):
        return [_Folder(Path(pattern), read_description(Path(pattern)))]
    local = _matching(pattern)
    folders = local or map(Path, fnmatch.filter(shipped_names(), pattern))
    folders = sorted(folders, key=_natural)
    members = [_Folder(own, read_description(own)) for own in folders]
    if not members:
        near = _nearest(Path(pattern))
        raise ConfigurationError(f"no folder matches {quote(pattern)}; {near}")
    _require_one_family(pattern, members)
    return members


def _matching(pattern: str) -> list[Path]:
    """Folders whose paths match a pattern.

    Raises:
        ConfigurationError: The pattern stands for folders of any depth, which may be all of the
            disk.
    """
    if "**" in pattern:
        problem = f"* stands for one part of a path, got {quote(pattern)}; leave ** out"
        raise ConfigurationError(problem)
    anchor = Path(pattern).anchor
    try:
        found = Path(anchor).glob(str(Path(pattern).relative_to(anchor)))
        return [path for path in found if path.is_dir()]
    except OSError:  # a name that is too long
        return []


def _require_motion(member: _Folder) -> None:
    """Refuse a residual trained on a motion that its environment cannot read."""
    known = ENVIRONMENTS.get(member.description.robot)
    reference = member.description.origin.config.reference
    if known is None or reference is None:
        return
    try:
        known.label(known.arguments(reference)[known.motion])
    except ConfigurationError as error:
        file = shorten(member.folder / DESCRIPTION)
        problem = f"{file}: training.config.reference: {error}"
        raise ConfigurationError(problem) from None


def _nearest(pattern: Path) -> str:
    """The folders beside a pattern that matches none, the most similar first, and shipped ones."""
    there = next(
        path
        for path in pattern.parents
        if os.path.isdir(path) and not _WILD.search(str(path))  # noqa: PTH112
    )
    folders = (path.name for path in there.iterdir() if path.is_dir())
    names = [name for name in folders if not name.startswith(".")]
    wanted = pattern.relative_to(there).parts[0]
    near = difflib.get_close_matches(wanted, names, n=_NEAREST, cutoff=0.0)
    families = dict.fromkeys(f"{name.split('/')[0]}/seed_*" for name in shipped_names())
    where = "this folder" if there == Path() else str(there)
    return (
        f"{where} has {', '.join(near) or 'no folders'}; with the package come"
        f" {', '.join(families)}"
    )


def _require_one_family(pattern: str, members: Sequence[_Folder]) -> None:
    """Refuse folders that are no training seeds of one configuration."""
    theirs = _kin(members[0].description)
    seen: dict[int, Path] = {}
    for member in members:
        mine = _kin(member.description)
        folder = member.folder
        seed = member.training_seed
        for what in {**mine, **theirs}:
            if mine.get(what) != theirs.get(what):
                raise ConfigurationError(
                    f"{pattern!r} must match training seeds of one configuration, but {what} of"
                    f" {shorten(folder)} is {mine.get(what)!r} and of {members[0].folder}"
                    f" {theirs.get(what)!r}; give each an entry of its own"
                )
        if seed is None:
            raise ConfigurationError(
                f"{folder} does not say its training seed: residual.json has no training.seed and"
                " the path no seed_N"
            )
        if seed in seen:
            raise ConfigurationError(
                f"{pattern!r} matches training seed {seed} twice: {seen[seed]} and"
                f" {shorten(folder)}"
            )
        seen[seed] = folder


_OWN = ("name", "seeds", "evaluate_every", "evaluation_episodes", "checkpoint_every")
"""Keys of a training configuration in which the seeds of a family may differ."""


def _kin(description: ResidualDescription) -> dict[str, object]:
    """Settings that the members of a family share."""
    config = description.training.get("config", {})
    trained = {f"the trained {key}": config[key] for key in config if key not in _OWN}
    names = ("robot", "base", "base_options", "settings")
    return trained | {name: getattr(description, name) for name in names}


def _opponents(
    description: ResidualDescription, residual: PolicySpec, taken: Sequence[PolicySpec]
) -> tuple[PolicySpec, PolicySpec | None]:
    """The policies that a residual is compared with, of those that play or new ones.

    The base is one with the same options. The other is the best policy without learning that has
    the same sensors; None where that is the base. One that is among the policies counts if it
    assumes the same stiffness, whatever its other options. Where the base is that policy with
    options, the residual is compared with the plain one if that is among the policies.

    Args:
        description: Of the residual.
        residual: Its entry in the comparison, whose options go over those of its base.
        taken: Policies that play.
    """
    options = _set_options({**description.base_options, **residual.options})
    assumed = _assumed(options)

    def beside(name: str) -> list[PolicySpec]:
        """Policies of a name in the environment of the residual."""
        mine = (name, residual.env_options, residual.level)
        return [own for own in taken if (own.name, own.env_options, own.level) == mine]

    def new(name: str, role: str, options: Options) -> PolicySpec:
        """A policy under its name or, where one is called so, under one with its role."""
        is_taken = name in {policy.title for policy in taken}
        label = f"{name} ({role})" if is_taken else None
        own = {"name": name, "label": label, "options": options, "track": None}
        return residual.replace(**own)

    same = [own for own in beside(description.base) if _set_options(own.options) == options]
    base = same[0] if same else new(description.base, f"base of {residual.title}", options)
    taken = [*taken, base]
    environment = ENVIRONMENTS.get(description.robot)
    best = best_analytic(environment is not None and environment.walks)
    if best is None:
        return base, None
    is_base = best == description.base
    for known in beside(best):
        own = _set_options(known.options)
        if (own if is_base else _assumed(own)) == assumed:
            return base, None if is_base and options == assumed else known
    return base, None if is_base else new(best, "best analytic", assumed)


def _assumed(options: Options) -> Options:
    return {name: value for name, value in options.items() if name in ASSUMED_OPTIONS}


def _set_options(options: Options) -> Options:
    return {name: value for name, value in options.items() if value is not None}


def _natural(path: Path) -> list[int | str]:
    """Key that sorts seed_2 before seed_10: texts and numbers in turn."""
    parts = re.split(r"(\d+)", str(path))
    return [int(part) if part.isdecimal() else part for part in parts]
