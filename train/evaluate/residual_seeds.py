"""Policies of a comparison with all training seeds of each residual, and their opponents.

A residual is compared with its base, and with the best policy without learning that reads the same
sensors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from baselines.policies import RESIDUAL, best_analytic
from baselines.policy_options import ASSUMED_OPTIONS
from baselines.residual.residual_folder import DESCRIPTION, read_description
from baselines.residual.settings import ResidualDescription
from elastic_env.core.errors import ConfigurationError, shorten
from train.evaluate.conditions import Member, PolicySpec
from train.evaluate.environments import ENVIRONMENTS
from train.evaluate.residual_folders import ResidualFolder, find_members

Options = dict[str, object]
"""Options of a policy by name."""


@dataclass(frozen=True)
class Entrant:
    """A policy that plays; for a residual one training seed of a family.

    Attributes:
        policy: The policy; all members of a family have its title.
        member: Training seed and base of a residual; None for another policy.
    """

    policy: PolicySpec
    member: Member | None = None


@dataclass(frozen=True)
class Origin:
    """Training of a family.

    Attributes:
        scenarios: Scenarios of the training; None if its files do not name them.
        reference: Motion of the training; None for the environment's default.
        missing_seeds: Training seeds of its configuration that the family does not have.
        folders: Its folders.
        commits: Commits that trained it.
        ranges: Intervals of drawn robots in its configuration.
    """

    scenarios: tuple[str, ...] | None
    reference: object
    missing_seeds: tuple[int, ...]
    folders: tuple[str, ...]
    commits: tuple[str, ...]
    ranges: Any = field(default_factory=dict)


def expand(policies: Sequence[PolicySpec], with_bases: bool = True) -> list[Entrant]:
    """All policies that play: a folder per residual, with bases and rivals that are not named.

    Args:
        policies: Policies as a configuration names them; `residual:PATH` may have * in its path.
        with_bases: True to add missing bases and rivals, each before its residual.

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
        members = find_members(policy.name.removeprefix(RESIDUAL))
        for member in members:
            _require_motion(member)
        base, rival = _opponents(members[0].description, policy, [*policies, *bases])
        add(base)
        if rival is not None:
            add(rival)
        entrants += [
            Entrant(
                policy.replace(name=f"{RESIDUAL}{member.folder}", label=policy.title),
                Member(
                    folder=str(member.folder),
                    training_seed=member.training_seed,
                    base=base.title,
                    rival=rival.title if rival in bases else None,
                ),
            )
            for member in members
        ]
    return entrants


def is_residual(policy: PolicySpec) -> bool:
    """True if a policy is a trained residual, or a family of them."""
    return policy.name.startswith(RESIDUAL)


def origin(members: Sequence[Member]) -> Origin:
    """Read the training of a family from its files."""
    descriptions = [read_description(Path(member.folder)) for member in members]
    config = descriptions[0].origin.config
    scenarios = config.scenarios
    missing = set(config.seeds) - {member.training_seed for member in members}
    commits = [description.origin.commit or "unknown" for description in descriptions]
    return Origin(
        scenarios=None if scenarios is None else tuple(scenarios),
        reference=config.reference,
        missing_seeds=tuple(sorted(missing)) if len(members) > 1 else (),
        folders=tuple(member.folder for member in members),
        commits=tuple(dict.fromkeys(commits)),
        ranges=descriptions[0].training.get("config", {}).get("ranges") or {},
    )


def _require_motion(member: ResidualFolder) -> None:
    """Refuse a residual trained on a motion that its environment cannot read."""
    environment = ENVIRONMENTS.get(member.description.robot)
    reference = member.description.origin.config.reference
    if environment is None or reference is None:
        return
    try:
        environment.label(environment.arguments(reference)[environment.motion])
    except ConfigurationError as error:
        file = shorten(member.folder / DESCRIPTION)
        problem = f"{file}: training.config.reference: {error}"
        raise ConfigurationError(problem) from None


def _opponents(
    description: ResidualDescription, residual: PolicySpec, policies: list[PolicySpec]
) -> tuple[PolicySpec, PolicySpec | None]:
    """Base and rival of a residual, among the policies that play or new ones.

    The base has the same options. The rival is the best policy without learning that has the same
    sensors; None if that is the base. A rival among the policies counts if it assumes the same
    stiffness; its other options do not count. If the base is the best policy with options, the
    residual is compared with that policy without options if it plays.

    Args:
        description: Description of the residual.
        residual: Its entry in the comparison; its options replace those of its base.
        policies: Policies that play.
    """
    options = _without_none({**description.base_options, **residual.options})
    assumed = _assumed_options(options)

    def policies_named(name: str) -> list[PolicySpec]:
        """Policies of a name in the environment of the residual."""
        key = (name, residual.env_options, residual.level)
        return [p for p in policies if (p.name, p.env_options, p.level) == key]

    def new_policy(name: str, role: str, options: Options) -> PolicySpec:
        """A new policy; its label has the role if another policy has the name as its title."""
        is_taken = name in {policy.title for policy in policies}
        label = f"{name} ({role})" if is_taken else None
        return residual.replace(name=name, label=label, options=options, track=None)

    bases = policies_named(description.base)
    same = [p for p in bases if _without_none(p.options) == options]
    role = f"base of {residual.title}"
    base = same[0] if same else new_policy(description.base, role, options)
    policies = [*policies, base]
    environment = ENVIRONMENTS.get(description.robot)
    best = best_analytic(environment is not None and environment.walks)
    is_base = best == description.base
    for rival in policies_named(best):
        rival_options = _without_none(rival.options)
        if (rival_options if is_base else _assumed_options(rival_options)) == assumed:
            return base, None if is_base and options == assumed else rival
    return base, None if is_base else new_policy(best, "best analytic", assumed)


def _assumed_options(options: Options) -> Options:
    return {name: value for name, value in options.items() if name in ASSUMED_OPTIONS}


def _without_none(options: Options) -> Options:
    return {name: value for name, value in options.items() if value is not None}
