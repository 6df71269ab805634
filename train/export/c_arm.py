"""A `PositionCompensator` as a header in C99, with its test vector and an example.

The header loops over tables of constants. It uses the formulas of `PositionCompensator` in the same
order, so that both agree up to rounding.
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
from elastic_env.core.quaternions import matrix_of
from elastic_env.core.signals import Array
from elastic_env.joint.model_joints import describe_home, held_positions
from train.export import c_text

_TEST_STEPS = 12
_LOADED_STEP = 6
"""First step of the test vector in which the tip carries a payload."""
_PAYLOAD_KG = 0.3
_PAYLOAD_AT = (0.01, -0.02, 0.05)
_TEST_RATE = 0.5
"""Largest rate [rad/s] and acceleration [rad/s²] of the test vector."""


@dataclass(frozen=True)
class Frame:
    """A body or site that can carry a payload.

    Attributes:
        name: Name in C, after the prefix.
        body: Number of the body in MuJoCo's model.
        link: Link that it moves with.
        place, R: Origin and axes in the frame of that link, (3,) [m], (3, 3).
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

    The compensator plays the test vector: it is reset before and after.

    Args:
        compensator: Compensator that the header computes.
        prefix: Prefix of all names in the header.
        sources: Contents of the files that define the compensator, by name, for their digests.

    Raises:
        ConfigurationError: The prefix is invalid.
    """
    names = compensator.joints
    constants = compensator.constants
    frames = payload_frames(constants)
    tables = _tables(constants, frames)
    digest = sha256("\n".join(tables.values()).encode()).hexdigest()
    capitals = prefix.upper()
    return c_text.fill_template(
        "arm.h.in",
        prefix,
        **tables,
        vectors=c_text.fill_template("common_vectors.h.in", prefix),
        digest=digest,
        origin=c_text.comment(_origin_lines(sources or {})),
        joints=c_text.comment(_joint_lines(names, constants)),
        joint_names=c_text.enum_lines(c_text.unique_names(f"{capitals}_JOINT_", names)),
        frame_names=c_text.enum_lines(f"{capitals}_{frame.name}" for frame in frames),
        test=_test_vector(compensator, prefix),
    )


def payload_frames(constants: CompensatorConstants) -> list[Frame]:
    """Bodies and sites with names that joints move, the body of the last joint first."""
    model = constants.model
    tree = constants.body.tree
    bodies = [b for b in range(model.nbody) if tree.carrier[b] > 0]
    body_names = {model.body(b).name: b for b in bodies if model.body(b).name}
    origin = (np.zeros(3), np.eye(3))
    candidates: list[tuple[str, int, Array, Array]] = [
        ("TIP", constants.tip, *origin),
        *((f"BODY_{c_text.identifier(n)}", b, *origin) for n, b in body_names.items()),
    ]
    for i in range(model.nsite):
        site = model.site(i)
        body = int(site.bodyid[0])
        if body in bodies and site.name and site.name not in body_names:
            name = f"SITE_{c_text.identifier(site.name)}"
            candidates.append((name, body, site.pos, matrix_of(site.quat)))
    names = c_text.unique_names("", [name for name, *_ in candidates])
    frames: list[Frame] = []
    for name, (_, body, place, R) in zip(names, candidates, strict=True):
        R_lb = tree.R[body]
        in_link = tree.place[body] + R_lb @ place
        frames.append(Frame(name, body, tree.carrier[body], in_link, R_lb @ R))
    return frames


def _tables(constants: CompensatorConstants, frames: Sequence[Frame]) -> dict[str, str]:
    """Constants of the compensator, as text in C."""
    body = constants.body
    n = len(constants.compliance)
    zeros = np.zeros(n)
    friction = constants.friction or FrictionCompensation(zeros, zeros, zeros, zeros)
    rows = {"gravity": constants.model.opt.gravity}
    for source, names in (
        (constants, "compliance of_command lowest highest"),
        (body, "spring spring_rest"),
        (constants, "viscous lag_s fastest rotor_s2"),
        (friction, "coulomb load_ratio static stribeck_speed dead_zone"),
    ):
        rows |= {name: getattr(source, name) for name in names.split()}
    return {
        "n": str(n),
        "num_frames": str(len(frames)),
        "ramp_steps": str(constants.ramp_steps),
        "has_friction": str(int(constants.friction is not None)),
        "limit_rad": c_text.number(constants.limit_rad),
        "period_s": c_text.number(constants.period_s),
        "presliding_rad": c_text.number(PRESLIDING_RAD),
        "links": ",\n".join(map(_link_text, body.tree.links[1:])),
        "frames": ",\n".join(
            f"    {{{f.body}, {f.link}, {c_text.number_list(f.place)}, {c_text.number_list(f.R)}}}"
            for f in frames
        ),
        **{name: c_text.numbers(values) for name, values in rows.items()},
    }


def _link_text(row: Any) -> str:
    masses = c_text.member_text(row, "mass mass_moment inertia weight weight_moment")
    place = f"{row['parent']}, {row['column']}, {c_text.member_text(row, 'zero R anchor')}"
    return f"    {{{place},\n     {{{masses}}}}}"


def _origin_lines(sources: Mapping[str, bytes]) -> Iterator[str]:
    yield c_text.GENERATED
    for name, content in sources.items():
        yield f"  {c_text.plain_text(name)}, SHA-256 {sha256(content).hexdigest()}"


def _joint_lines(names: Sequence[str], constants: CompensatorConstants) -> Iterator[str]:
    with np.errstate(divide="ignore"):
        K = 1.0 / constants.compliance
        gain = 1.0 / (constants.of_command - constants.compliance)
    for j, name in enumerate(names):
        bounds = f"{constants.lowest[j]:.4g} to {constants.highest[j]:.4g} rad"
        servo = "" if np.isinf(gain[j]) else f", k_p {gain[j]:.6g} N*m/rad"
        yield f"  {j}  {c_text.plain_text(name)}: K {K[j]:.6g} N*m/rad{servo}, {bounds}"
    if held := held_text(names, constants):
        yield f"  {c_text.plain_text(held)}"


def held_text(names: Sequence[str], constants: CompensatorConstants) -> str:
    """Say which joints of the model are held and where; empty if none is.

    Args:
        names: Joints that are commanded.
        constants: Constants of their compensator.
    """
    held = held_positions(constants.model, names)
    return f"not commanded, taken as held: {describe_home(constants.model, held)}" if held else ""


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
        warnings.simplefilter("ignore")  # no robot goes to these poses
        command, link_angle = _play(compensator, q, rates)
    motion = np.stack([q, *rates], axis=1)
    return c_text.fill_template(
        "arm_test.h.in",
        prefix,
        steps=_TEST_STEPS,
        loaded=_LOADED_STEP,
        payload=c_text.numbers((_PAYLOAD_KG, *_PAYLOAD_AT)),
        motion=c_text.row_lines(motion),
        command=c_text.row_lines(command),
        link_angle=c_text.row_lines(link_angle),
    )


def _play(compensator: PositionCompensator, q: Array, rates: Array) -> tuple[Array, Array]:
    """Play a motion; return commands, and link angles if the encoders were at the commands.

    Args:
        compensator: Compensator that plays it.
        q: Desired link angles, (T, n) [rad].
        rates: Their rates and accelerations, (2, T, n) [rad/s], [rad/s²].
    """
    command = np.empty(q.shape)
    link_angle = np.full(q.shape, np.nan)
    compensator.reset()
    for step in range(len(q)):
        if step == _LOADED_STEP:
            compensator.set_payload(_PAYLOAD_KG, _PAYLOAD_AT)
        command[step] = compensator.command(q[step], *rates[:, step])
        with contextlib.suppress(ElasticError):  # nan means that the call must fail
            link_angle[step] = compensator.link_angle(command[step])
    compensator.reset()
    return command, link_angle
