"""A compensator of live robots as a header in C99, its test vector, and an example.

The header loops over tables of constants. It computes what `PositionCompensator` does, by the
same formulas in the same order, so that both agree to rounding.
"""

import contextlib
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from string import Template
from typing import Any

import mujoco
import numpy as np

import elastic_env
from baselines import PositionCompensator
from baselines.compensation.dry_friction import PRESLIDING_RAD, FrictionCompensation
from baselines.compensation.position_compensator import CompensatorConstants
from elastic_env.core.errors import ConfigurationError, ElasticError, quote
from elastic_env.core.signals import Array

_FOLDER = Path(__file__).parent
_PREFIX = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*")
_LONGEST_PREFIX = 40
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


def require_prefix(prefix: str) -> str:
    """A prefix of names in C.

    Raises:
        ConfigurationError: It is none.
    """
    if len(prefix) > _LONGEST_PREFIX or not _PREFIX.fullmatch(prefix):
        raise ConfigurationError(
            "prefix must be a letter, then letters, digits or _, at most"
            f" {_LONGEST_PREFIX} characters, got {quote(prefix)}"
        )
    return prefix


def prefix_of(name: str) -> str:
    """A prefix from the name of a robot or file; `arm` where nothing of it fits."""
    return _identifier(name).lower().lstrip("_0123456789")[:_LONGEST_PREFIX] or "arm"


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
    require_prefix(prefix)
    names = compensator.joints
    constants = compensator.constants
    frames = payload_frames(constants)
    tables = _tables(constants, frames)
    digest = sha256("\n".join(tables.values()).encode()).hexdigest()
    capitals = prefix.upper()
    return _template("arm.h.in", prefix).substitute(
        tables,
        version=elastic_env.__version__,
        digest=digest,
        origin=_comment(_origin_lines(sources or {})),
        joints=_comment(_joint_lines(names, constants)),
        joint_names=_enumerated(_unique(f"{capitals}_JOINT_", names)),
        frame_names=_enumerated(f"{capitals}_{frame.name}" for frame in frames),
        test=_test_vector(compensator, prefix),
    )


def c_example(prefix: str, header: str) -> dict[str, str]:
    """Contents of a program that checks the header and times it, and of its CMakeLists, by name.

    Args:
        prefix: Of the header's names.
        header: Name of its file.
    """
    return {
        f"{prefix}_main.c": _template("arm_main.c.in", prefix).substitute(header=header),
        "CMakeLists.txt": _template("CMakeLists.txt.in", prefix).substitute(),
    }


def payload_frames(constants: CompensatorConstants) -> list[Frame]:
    """Bodies and sites with names that joints move; the body of the last joint first."""
    model = constants.model
    tree = constants.body.tree
    bodies = [b for b in range(model.nbody) if tree.carrier[b] > 0]
    named = [(b, model.body(b).name) for b in bodies if model.body(b).name]
    found = [("TIP", constants.tip, np.zeros(3), np.eye(3))]
    found += [(f"BODY_{_identifier(name)}", b, np.zeros(3), np.eye(3)) for b, name in named]
    taken = {name for _, name in named}
    for i in range(model.nsite):
        site = model.site(i)
        body = int(site.bodyid[0])
        if body in bodies and site.name and site.name not in taken:
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, site.quat)
            found.append((f"SITE_{_identifier(site.name)}", body, site.pos, R.reshape(3, 3)))
    names = _unique("", [name for name, *_ in found])
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
    rows = {
        "gravity": constants.model.opt.gravity,
        "compliance": constants.compliance,
        "of_command": constants.of_command,
        "lowest": constants.lowest,
        "highest": constants.highest,
        "spring": body.spring,
        "spring_rest": body.spring_rest,
        "viscous": constants.viscous,
        "lag_s": constants.lag_s,
        "coulomb": friction.coulomb,
        "load_ratio": friction.load_ratio,
        "static": friction.static,
        "stribeck_speed": friction.stribeck_speed,
        "dead_zone": friction.dead_zone,
    }
    return {
        "n": str(n),
        "num_frames": str(len(frames)),
        "ramp_steps": str(constants.ramp_steps),
        "has_friction": str(int(constants.friction is not None)),
        "limit_rad": _number(constants.limit_rad),
        "period_s": _number(constants.period_s),
        "presliding_rad": _number(PRESLIDING_RAD),
        "links": ",\n".join(_link(row) for row in body.tree.links[1:]),
        "frames": ",\n".join(
            f"    {{{one.body}, {one.link}, {_braced(one.place)}, {_braced(one.R)}}}"
            for one in frames
        ),
        **{name: ", ".join(map(_number, values)) for name, values in rows.items()},
    }


def _link(row: Any) -> str:
    masses = ", ".join(
        [
            _number(row["mass"]),
            _braced(row["mass_moment"]),
            _braced(row["inertia"]),
            _number(row["weight"]),
            _braced(row["weight_moment"]),
        ]
    )
    place = f"{row['parent']}, {row['column']}, {_number(row['zero'])}"
    return f"    {{{place}, {_braced(row['R'])}, {_braced(row['anchor'])},\n     {{{masses}}}}}"


def _origin_lines(sources: Mapping[str, bytes]) -> Iterator[str]:
    yield f"Generated by elastic-env {elastic_env.__version__}: generate it anew, do not edit it."
    for name, content in sources.items():
        yield f"  {_plain(name)}, SHA-256 {sha256(content).hexdigest()}"


def _joint_lines(names: Sequence[str], constants: CompensatorConstants) -> Iterator[str]:
    with np.errstate(divide="ignore"):
        K = 1.0 / constants.compliance
        gain = 1.0 / (constants.of_command - constants.compliance)
    for j, name in enumerate(names):
        ends = f"{constants.lowest[j]:.4g} to {constants.highest[j]:.4g} rad"
        servo = "" if np.isinf(gain[j]) else f", k_p {gain[j]:.6g} N*m/rad"
        yield f"  {j}  {_plain(name)}: K {K[j]:.6g} N*m/rad{servo}, {ends}"


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
    return _template("arm_test.h.in", prefix).substitute(
        steps=_TEST_STEPS,
        loaded=_LOADED_STEP,
        payload=", ".join(map(_number, (_PAYLOAD_KG, *_PAYLOAD_AT))),
        motion=_nested(motion),
        command=_nested(command),
        link_angle=_nested(link_angle),
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


def _nested(values: Array) -> str:
    """Rows of numbers in C, a row of the first axis on a line."""
    return ",\n".join(f"    {_braces(row)}" for row in values)


def _braces(values: Array) -> str:
    if values.ndim == 1:
        return _braced(values)
    return "{" + ", ".join(_braces(row) for row in values) + "}"


def _braced(values: Any) -> str:
    return "{" + ", ".join(map(_number, np.ravel(values))) + "}"


def _number(value: Any) -> str:
    """A double in C, read back bit for bit."""
    value = float(value)
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0.0 else "-INFINITY"
    return repr(value)


def _enumerated(names: Iterable[str]) -> str:
    return ",\n".join(f"    {name}" for name in names)


def _unique(start: str, names: Iterable[str]) -> list[str]:
    """Identifiers in capitals, numbered where two would be the same."""
    found: list[str] = []
    for name in names:
        whole = stem = start + _identifier(name).upper()
        number = 2
        while whole in found:
            whole = f"{stem}_{number}"
            number += 1
        found.append(whole)
    return found


def _identifier(name: str) -> str:
    return re.sub(r"[^a-zA-Z0-9_]", "_", name)


def _comment(lines: Iterable[str]) -> str:
    return "\n".join(f" * {line}" for line in lines)


def _plain(name: str) -> str:
    """A user's name for a comment: it cannot end the comment, and is in ASCII."""
    return re.sub(r"[^A-Za-z0-9 _.,:+=()-]", "_", name)


def _template(name: str, prefix: str) -> Template:
    """A template with the prefix in the place of `arm`."""
    text = (_FOLDER / name).read_text(encoding="utf-8")
    text = re.sub(r"\barm_(?=\w)", f"{prefix}_", text)
    return Template(re.sub(r"\bARM_(?=\w)", f"{prefix.upper()}_", text))
