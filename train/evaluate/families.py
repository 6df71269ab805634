"""Policies of a comparison with all training seeds of a residual, and with whom each residual is
compared.

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
from baselines.residual.residual import DESCRIPTION, ResidualDescription, read_description, shipped
from elastic_env.core.errors import ConfigurationError, quote, shorten
from train.evaluate.conditions import Member, PolicySpec
from train.evaluate.environments import ENVIRONMENTS

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
    """All who play: a residual's pattern as one entrant per folder, and bases and rivals that
    nobody named.

    Args:
        policies: Policies as a configuration names them; `residual:PATH` may have * in its path.
        with_bases: Whether a base or a rival that is not among them is added, before its residual.

    Raises:
        ConfigurationError: A pattern that matches no folder, a folder without residual, or folders
            that do not belong together.
    """
    entrants: list[Entrant] = []
    bases = [policy for policy in policies if not is_residual(policy)]
    for policy in policies:
        if not is_residual(policy):
            entrants.append(Entrant(policy))
            continue
        members = _members(policy.name.removeprefix(RESIDUAL))
        for folder, _, said in members:
            _require_motion(folder, said)
        description = members[0][2]
        base = next((known for known in bases if _plays(known, description, policy)), None)
        if base is None:
            base = _base(description, policy, [*policies, *bases])
            if with_bases:
                bases.append(base)
                entrants.append(Entrant(base))
        rival = _rival(description, policy, [*policies, *bases])
        if rival is not None and with_bases and rival not in bases:
            bases.append(rival)
            entrants.append(Entrant(rival))
        others = None if rival is None or rival not in bases else rival.title
        entrants += [
            Entrant(
                policy.replace(name=f"{RESIDUAL}{folder}", label=policy.title),
                Member(folder=str(folder), training_seed=seed, base=base.title, rival=others),
            )
            for folder, seed, _ in members
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
    return Origin(
        scenarios=None if scenarios is None else tuple(scenarios),
        reference=config.reference,
        missing_seeds=tuple(sorted(wanted - had)) if len(members) > 1 else (),
        folders=tuple(member.folder for member in members),
        commits=tuple(dict.fromkeys(d.origin.commit or "unknown" for d in descriptions)),
        ranges=descriptions[0].training.get("config", {}).get("ranges") or {},
    )


def _members(pattern: str) -> list[tuple[Path, int | None, ResidualDescription]]:
    """Folders of a pattern in natural order, with training seed and description; shipped ones
    where none lie there.
    """
    is_family = bool(_WILD.search(pattern))
    folders = [Path(pattern)]
    if is_family:
        folders = sorted(
            _matching(pattern) or map(Path, fnmatch.filter(shipped(), pattern)), key=_natural
        )
        if not folders:
            raise ConfigurationError(
                f"no folder matches {quote(pattern)}; {_nearest(Path(pattern))}"
            )
    descriptions = [read_description(folder) for folder in folders]
    members = [
        (f, _training_seed(f, said), said) for f, said in zip(folders, descriptions, strict=True)
    ]
    if is_family:
        _require_one_family(pattern, members)
    return members


def _matching(pattern: str) -> list[Path]:
    """Folders whose paths match a pattern.

    Raises:
        ConfigurationError: The pattern stands for folders of any depth, which may be all of the
            disk.
    """
    if "**" in pattern:
        raise ConfigurationError(
            f"* stands for one part of a path, got {quote(pattern)}; leave ** out"
        )
    anchor = Path(pattern).anchor
    try:
        return [
            path
            for path in Path(anchor).glob(str(Path(pattern).relative_to(anchor)))
            if path.is_dir()
        ]
    except OSError:  # a name that is too long
        return []


def _require_motion(folder: Path, description: ResidualDescription) -> None:
    """Refuse a residual whose training names a motion that its environment cannot read: the
    report would need it.
    """
    known = ENVIRONMENTS.get(description.robot)
    reference = description.origin.config.reference
    if known is None or reference is None:
        return
    try:
        known.label(known.arguments(reference)[known.motion])
    except ConfigurationError as error:
        raise ConfigurationError(
            f"{shorten(folder / DESCRIPTION)}: training.config.reference: {error}"
        ) from None


def _nearest(pattern: Path) -> str:
    """The folders beside a pattern that matches none, the most similar names first, and those
    that are shipped.
    """
    there = next(
        path
        for path in pattern.parents
        if os.path.isdir(path) and not _WILD.search(str(path))  # noqa: PTH112
    )
    names = [
        path.name for path in there.iterdir() if path.is_dir() and not path.name.startswith(".")
    ]
    near = difflib.get_close_matches(
        pattern.relative_to(there).parts[0], names, n=_NEAREST, cutoff=0.0
    )
    families = dict.fromkeys(f"{name.split('/')[0]}/seed_*" for name in shipped())
    where = "this folder" if there == Path() else str(there)
    return (
        f"{where} has {', '.join(near) or 'no folders'}; with the package come"
        f" {', '.join(families)}"
    )


def _training_seed(folder: Path, description: ResidualDescription) -> int | None:
    """As the residual says it, or the name of its folder; None where neither does."""
    if description.origin.seed is not None:
        return description.origin.seed
    found = _SEED.findall(str(folder))
    return int(found[-1]) if found else None


def _require_one_family(
    pattern: str, members: Sequence[tuple[Path, int | None, ResidualDescription]]
) -> None:
    """Refuse folders that are no training seeds of one configuration."""
    first, _, expected = members[0]
    seen: dict[int, Path] = {}
    for folder, seed, description in members:
        mine = _kin(description)
        theirs = _kin(expected)
        for what in {**mine, **theirs}:
            if mine.get(what) != theirs.get(what):
                raise ConfigurationError(
                    f"{pattern!r} must match training seeds of one configuration, but {what} of"
                    f" {shorten(folder)} is {mine.get(what)!r} and of {first}"
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
    trained = {f"the trained {name}": value for name, value in config.items() if name not in _OWN}
    return trained | {
        name: getattr(description, name) for name in ("robot", "base", "base_options", "settings")
    }


def _plays(known: PolicySpec, description: ResidualDescription, residual: PolicySpec) -> bool:
    """True if a policy is the base of a residual, with the same options, in the same
    environment.
    """
    return (
        known.name == description.base
        and _set_options(known.options) == _base_options(description, residual)
        and known.env_options == residual.env_options
        and known.level == residual.level
    )


def _base(
    description: ResidualDescription, residual: PolicySpec, taken: Sequence[PolicySpec]
) -> PolicySpec:
    """The base of a residual as a policy of its own, under a title that nobody has."""
    options = _base_options(description, residual)
    return _beside(residual, taken, description.base, f"base of {residual.title}", options)


def _beside(
    residual: PolicySpec,
    taken: Sequence[PolicySpec],
    name: str,
    role: str,
    options: dict[str, object],
) -> PolicySpec:
    """Whom a residual is compared with, under its name, or where a policy is called so under one
    that says its role.
    """
    label = f"{name} ({role})" if name in {policy.title for policy in taken} else None
    return PolicySpec(
        name=name,
        label=label,
        options=options,
        env_options=residual.env_options,
        level=residual.level,
    )


def _rival(
    description: ResidualDescription, residual: PolicySpec, taken: Sequence[PolicySpec]
) -> PolicySpec | None:
    """The best policy without learning, with the same sensors, in the same environment; None where
    that is the base.

    One that is among the policies counts if it assumes the same stiffness, whatever its other
    options. Where the base is that policy with options, it is compared with the plain one if that
    is among the policies.
    """
    known = ENVIRONMENTS.get(description.robot)
    name = best_analytic(known is not None and known.walks)
    if name is None:
        return None
    options = _base_options(description, residual)
    is_base = name == description.base
    assumed = {option: value for option, value in options.items() if option in ASSUMED_OPTIONS}
    for policy in taken:
        given = _set_options(policy.options)
        mine = (
            given
            if is_base
            else {option: v for option, v in given.items() if option in ASSUMED_OPTIONS}
        )
        same = policy.env_options == residual.env_options and policy.level == residual.level
        if policy.name == name and mine == assumed and same:
            return policy if not is_base or options != assumed else None
    return None if is_base else _beside(residual, taken, name, "best analytic", assumed)


def _base_options(description: ResidualDescription, residual: PolicySpec) -> dict[str, object]:
    """Options of the base: its own, and over them those that the comparison gives the residual."""
    return _set_options({**description.base_options, **residual.options})


def _set_options(options: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in options.items() if value is not None}


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Key that sorts seed_2 before seed_10."""
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part)
        for part in re.split(r"(\d+)", str(path))
    ]
