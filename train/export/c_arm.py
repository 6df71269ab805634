"""A compensator of live robots as a header in C99, its test vector, and an example.

The header loops over tables of constants. It computes what `PositionCompensator` does, by the
same formulas in the same order, so that both agree to rounding.
"""

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from baselines import PositionCompensator
from baselines.compensation.dry_friction import PRESLIDING_RAD, FrictionCompensation
from baselines.compensation.position_compensator import CompensatorConstants
from elastic_env.core.errors import ElasticError
from elastic_env.core.rotations import matrix_of
from elastic_env.core.signals import Array
from train.export.c_text import (
    GENERATED,
    comment,
    enum_lines,
    fill,
    identifier,
    members,
    number,
    number_list,
    numbers,
    plain,
    row_lines,
    unique,
)

_TEST_STEPS = 12
_LOADED_STEP = 6
"""Step of the test vector from which on the tip carries a payload."""
_PAYLOAD_KG = 0.3
_PAYLOAD_AT = (0.01, -0.02, 0.05)
_TEST_RATE = 0.5
"""Largest rate [rad/s] and acceleration [rad/s²] of the test vector."""


@dataclass(frozen=True)
class Frame:
    """A body or site that can carry a payload.

    Attributes:
        name: In C, behind the prefix.
        body: Number of the body in MuJoCo's model.
        link: Link that it moves with.
        place, R: In the frame of that link, (3,) [m], (3, 3).
    """

    name: str
    body: int
    link: int
    place: Array
    R: Array


def c_header(
    compensator: PositionCompensator, prefix: str, sources: Mapping[str, bytes] | None = None
) -> str:
    """The header of a compensator, with a test vector behind the macro <PREFIX>_TEST.

    The compensator is played for the test vector: it begins anew, and ends so.

    Args:
        compensator: What the header computes.
        prefix: Of all names in the header.
        sources: Contents of the files that the compensator was made of, by name, for their digests.

    Raises:
        ConfigurationError: The prefix is none.
    """
    names = compensator.joints
    constants = compensator.constants
    frames = payload_frames(constants)
    tables = _tables(constants, frames)
    digest = sha256("\n".join(tables.values()).encode()).hexdigest()
    capitals = prefix.upper()
    return fill(
        "arm.h.in",
        prefix,
        **tables,
        vectors=fill("common_vectors.h.in", prefix),
        digest=digest,
        origin=comment(_origin_lines(sources or {})),
        joints=comment(_joint_lines(names, constants)),
        joint_names=enum_lines(unique(f"{capitals}_JOINT_", names)),
        frame_names=enum_lines(f"{capitals}_{frame.name}" for frame in frames),
        test=_test_vector(compensator, prefix),
    )


def payload_frames(constants: CompensatorConstants) -> list[Frame]:
    """Bodies and sites with names that joints move; the body of the last joint first."""
    model = constants.model
    tree = constants.body.tree
    bodies = [b for b in range(model.nbody) if tree.carrier[b] > 0]
    named = [(b, model.body(b).name) for b in bodies if model.body(b).name]
    found: list[tuple[str, int, Array, Array]] = [
        ("TIP", constants.tip, np.zeros(3), np.eye(3)),
    ]
    found += [(f"BODY_{identifier(name)}", b, np.zeros(3), np.eye(3)) for b, name in named]
    taken = {name for _, name in named}
    for i in range(model.nsite):
        site = model.site(i)
        body = int(site.bodyid[0])
        if body in bodies and site.name and site.name not in taken:
            found.append((f"SITE_{identifier(site.name)}", body, site.pos, matrix_of(site.quat)))
    names = unique("", [name for name, *_ in found])
    frames: list[Frame] = []
    for name, (_, body, place, R) in zip(names, found, strict=True):
        R_lb = tree.R[body]
        in_link = tree.place[body] + R_lb @ place
        frames.append(Frame(name, body, tree.carrier[body], in_link, R_lb @ R))
    return frames


def _tables(constants: CompensatorConstants, frames: Sequence[Frame]) -> dict[str, str]:
    """All that is computed with, as text in C."""
    body = constants.body
    n = len(constants.compliance)
    none = np.zeros(n)
    friction = constants.friction or FrictionCompensation(none, none, none, none)
    rows = {"gravity": constants.model.opt.gravity}
    for owner, names in (
        (constants, "compliance of_command lowest highest"),
        (body, "spring spring_rest"),
        (constants, "viscous lag_s fastest rotor_s2"),
        (friction, "coulomb load_ratio static stribeck_speed dead_zone"),
    ):
        rows |= {name: getattr(owner, name) for name in names.split()}
    return {
        "n": str(n),
        "num_frames": str(len(frames)),
        "ramp_steps": str(constants.ramp_steps),
        "has_friction": str(int(constants.friction is not None)),
        "limit_rad": number(constants.limit_rad),
        "period_s": number(constants.period_s),
        "presliding_rad": number(PRESLIDING_RAD),
        "links": ",\n".join(_link(row) for row in body.tree.links[1:]),
        "frames": ",\n".join(
            f"    {{{one.body}, {one.link}, {number_list(one.place)}, {number_list(one.R)}}}"
            for one in frames
        ),
        **{name: numbers(values) for name, values in rows.items()},
    }


def _link(row: Any) -> str:
    masses = members(row, "mass mass_moment inertia weight weight_moment")
    place = f"{row['parent']}, {row['column']}, {members(row, 'zero R anchor')}"
    return f"    {{{place},\n     {{{masses}}}}}"


def _origin_lines(sources: Mapping[str, bytes]) -> Iterator[str]:
    yield GENERATED
    for name, content in sources.items():
        yield f"  {plain(name)}, SHA-256 {sha256(content).hexdigest()}"


def _joint_lines(names: Sequence[str], constants: CompensatorConstants) -> Iterator[str]:
    with np.errstate(divide="ignore"):
        K = 1.0 / constants.compliance
        gain = 1.0 / (constants.of_command - constants.compliance)
    for j, name in enumerate(names):
        ends = f"{constants.lowest[j]:.4g} to {constants.highest[j]:.4g} rad"
        servo = "" if np.isinf(gain[j]) else f", k_p {gain[j]:.6g} N*m/rad"
        yield f"  {j}  {plain(name)}: K {K[j]:.6g} N*m/rad{servo}, {ends}"


def _test_vector(compensator: PositionCompensator, prefix: str) -> str:
    """A run of the compensator from its begin, and link angles for its commands."""
    constants = compensator.constants
    lowest = np.maximum(constants.lowest, -np.pi)
    highest = np.minimum(constants.highest, np.pi)
    generator = np.random.default_rng(0)
    shape = (_TEST_STEPS, len(lowest))
    q = generator.uniform(lowest, highest, shape)
    rates = generator.uniform(-_TEST_RATE, _TEST_RATE, (2, *shape))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nobody commands these poses
        command, link_angle = _play(compensator, q, rates)
    motion = np.stack([q, *rates], axis=1)
    return fill(
        "arm_test.h.in",
        prefix,
        steps=_TEST_STEPS,
        loaded=_LOADED_STEP,
        payload=numbers((_PAYLOAD_KG, *_PAYLOAD_AT)),
        motion=row_lines(motion),
        command=row_lines(command),
        link_angle=row_lines(link_angle),
    )


def _play(compensator: PositionCompensator, q: Array, rates: Array) -> tuple[Array, Array]:
    """Commands along a motion, (T, n) and (2, T, n), and link angles where encoders show them."""
    command = np.empty(q.shape)
    link_angle = np.full(q.shape, np.nan)
    compensator.reset()
    for step in range(len(q)):
        if step == _LOADED_STEP:
            compensator.set_payload(_PAYLOAD_KG, _PAYLOAD_AT)
        command[step] = compensator.command(q[step], *rates[:, step])
        with contextlib.suppress(ElasticError):  # NaN stands for a call that has to fail
            link_angle[step] = compensator.link_angle(command[step])
    compensator.reset()
    return command, link_angle
