"""Policies `input_output` and `adaptive_posture` of a walker as headers in C99.

Each has its test vector and an example.

The plan stays outside: a planner hands the header a row of it in every control step. Without joint
torque sensors, `adaptive_posture` estimates from rolls alone: pitches are left out here.
"""

from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np

from baselines.adaptation.estimators import ASSUMED_LOADS, LegEstimator
from baselines.adaptation.online_stiffness import OnlineStiffness
from baselines.compensation.compensated import Compensated
from baselines.compensation.compensators import GravityCompensator
from baselines.compensation.contact_torque import ContactGravity
from baselines.compensation.policy import NO_INPUTS
from baselines.estimation.bending import (
    DISAGREEMENT_RAD,
    LOADED_SHARE,
    MODEL_ERROR,
    OFFSET_RAD,
)
from baselines.walking.controller import WalkingController
from baselines.walking.posture import PostureFeedback
from elastic_env.core.errors import ConfigurationError
from elastic_env.core.signals import Array, IntArray
from elastic_env.world.robot_model import WalkerModel
from train.export.c_text import (
    GENERATED,
    comment,
    fill,
    initialiser,
    members,
    number,
    number_list,
    numbers,
    plain,
    row_lines,
)

_TEST_STEPS = 12
_NOISE_RAD = 0.02
_NOISE_N = 30.0
_NOISE_M = 0.01
"""Spread of encoders, attitude, forces, moments [N·m], rates [rad/s] and ZMP of the test vector
about the plan."""
_OF_CONTROLLER = (
    "thigh shank weight weight_of_feet omega velocity_share zmp_share weight_share"
    " force_difference force_difference_decay_s force_difference_limit_m dcm zmp_limit_m"
    " friction_rate_rad_s"
)
_OF_POSTURE = "proportional integral derivative leak_s trim integral_limit filter_share swing_share"


class PlayedSteps(NamedTuple):
    """Control steps of a walker, a row each.

    Attributes:
        shown: Fields of the struct `shown`, in order.
        plan: Fields of the struct `plan`, in order.
        offset: What Python commands, in single precision, (T, 12) [rad].
        links: Link angles that its controller sees, (T, 12) [rad].
        memory: That of the policy after the last step.
    """

    shown: list[Array]
    plan: list[Array]
    offset: Array
    links: Array
    memory: Any


def c_walker(policy: Any, prefix: str) -> str:
    """The header of a policy, with a test vector behind the macro <PREFIX>_TEST.

    Args:
        policy: Of `baselines.make("input_output", env)`, or of `adaptive_posture`.
        prefix: Of all names in the header.

    Raises:
        ConfigurationError: Another policy, or the prefix is none.
    """
    layers = _layers(policy)
    model = layers.model
    tables = _tables(layers.compensated, model)
    of_layers = {} if layers.posture is None else _tables_of_layers(layers)
    tables |= of_layers
    digest = sha256("\n".join(tables.values()).encode()).hexdigest()
    names = model.joint_names
    joints = [
        f"  {j:2}  {plain(name)}: K {model.stiffness[j]:.6g} N*m/rad"
        for j, name in enumerate(names)
    ]
    return fill(
        "walker.h.in",
        prefix,
        **tables,
        policy="adaptive_posture" if of_layers else "input_output",
        is_adaptive=str(int(bool(of_layers))),
        adaptive=fill("walker_adaptive.h.in", prefix, **tables) if of_layers else "",
        vectors=fill("common_vectors.h.in", prefix),
        digest=digest,
        origin=comment([GENERATED]),
        joints=comment(joints),
        period_s=number(model.control_period_s),
        test=_test_vector(policy, prefix),
    )


def play_steps(policy: Any, count: int, seed: int = 0) -> PlayedSteps:
    """Random sensors about rows of the plan, and what a policy makes of them, from its begin.

    Args:
        policy: See `c_walker`.
        count: Rows of the plan, evenly over the walk.
        seed: Of the sensors.
    """
    model = _layers(policy).model
    row = np.linspace(1.0, model.plan.num_steps, count).astype(np.int64)
    return play_observations(policy, _observations(model, row, np.random.default_rng(seed)))


def play_observations(policy: Any, rows: Array) -> PlayedSteps:
    """What a policy makes of observations, from its begin.

    Args:
        policy: See `c_walker`.
        rows: One per control step, (T, m).
    """
    layers = _layers(policy)
    count = len(rows)
    offset = np.empty((count, 12))
    links = np.empty((count, 12))
    memory = policy.begin(rows[:1])
    for step in range(count):
        row = rows[step : step + 1]
        action, memory = policy.act(row, memory, NO_INPUTS)
        offset[step] = action[0]
        links[step] = policy.link_angles(row, memory)[0]
    planned = _planned(layers.model, policy.view.plan_row(rows))
    return PlayedSteps(_shown(layers, rows), planned, offset, links, memory)


class _Layers(NamedTuple):
    """What a policy is made of; `input_output` has neither posture feedback nor adaptation."""

    compensated: Compensated
    model: WalkerModel
    posture: PostureFeedback | None = None
    adaptive: OnlineStiffness | None = None


def _layers(policy: Any) -> _Layers:
    """Layers of a policy around the paper's compensator around its controller."""
    posture = policy if isinstance(policy, PostureFeedback) else None
    adaptive: Any = None if posture is None else posture.policy
    inner: Any = policy
    estimator = adaptive.estimator if isinstance(adaptive, OnlineStiffness) else None
    if isinstance(estimator, LegEstimator) and estimator.sensors is None:
        inner = adaptive.policy
        if not np.array_equal(policy.ramp, getattr(inner, "ramp", ())):
            raise ConfigurationError("in C, posture feedback and compensation have the same ramp")
    made = inner.compensator if isinstance(inner, Compensated) else None
    if isinstance(made, GravityCompensator) and isinstance(inner.policy, WalkingController):
        model = made.model
        assert isinstance(model, WalkerModel)  # as its controller needs one
        if made.output == "taylor" and made.gravity.chains is model.biped.chains:
            return _Layers(inner, model, posture, adaptive)
    raise ConfigurationError(
        "only input_output and adaptive_posture of a walker are there in C, with output: taylor and"
        " gravity: com or ankle"
    )


def _tables(policy: Compensated, model: WalkerModel) -> dict[str, str]:
    """All that is computed with, as text in C."""
    controller: Any = policy.policy
    compensator: Any = policy.compensator
    gravity: ContactGravity = compensator.gravity
    contact: Any = gravity.contact[0]
    constants: Any = controller.constants[0]
    links = gravity.chains.links
    feet = links[[int(np.flatnonzero(links["tip"] == foot)[0]) for foot in range(2)]]
    of_command = 1.0 / model.stiffness + compensator.servo_compliance
    return {
        **{name: number(constants[name]) for name in _OF_CONTROLLER.split()},
        "control_period_s": number(constants["period_s"]),
        "is_com_fed_back": str(int(constants["is_com_fed_back"])),
        "is_at_zmp": str(int(contact["is_at_zmp"])),
        "gravity": number(contact["gravity"]),
        "mass": number(contact["mass"]),
        "ankle_height": number(contact["ankle_height"]),
        "sole_depth": number(model.biped.ankle_height),
        "links": ",\n".join(_link(row) for row in links),
        "foot_R": ", ".join(number_list(row["tip_R"]) for row in feet),
        "foot_place": ", ".join(number_list(row["tip_place"]) for row in feet),
        "stiffness": numbers(model.stiffness),
        "of_command": numbers(of_command),
        "friction": numbers(constants["friction_deflection"]),
        "feedback_steps": str(len(controller.ramp)),
        "feedback_ramp": numbers(controller.ramp),
        "steps": str(len(policy.ramp)),
        "ramp": numbers(policy.ramp),
    }


def _tables_of_layers(layers: _Layers) -> dict[str, str]:
    """What posture feedback and adaptation compute with, as text in C."""
    adaptive: Any = layers.adaptive
    gains: Any = layers.posture.gains[0]  # type: ignore[union-attr]
    carried = adaptive.estimator.observer.carried
    mass, point = _below_sensors(layers.model)
    given = {
        **{name: gains[name] for name in _OF_POSTURE.split()},
        "turn_limit": gains["limit_rad"],
        "correction_limit": adaptive.limit,
        "correction_share": adaptive.share,
        "error_variance": MODEL_ERROR**2,
        "offset_variance": OFFSET_RAD**2,
        "measured_variance": DISAGREEMENT_RAD**2,
        "loaded_n": LOADED_SHARE * carried,
        "carried_n": carried,
        "assumed_loads": ASSUMED_LOADS,
    }
    return {
        **{name: number(value) for name, value in given.items()},
        "estimate_every": str(adaptive.every),
        "foot_mass": numbers(-mass),
        "foot_point": ", ".join(map(number_list, point)),
    }


def _below_sensors(model: WalkerModel) -> tuple[Array, Array]:
    """Masses below the foot sensors, (2,) [kg], and their centers from the ankles, (2, 3) [m]."""
    mass = np.empty(2)
    point = np.empty((2, 3))
    biped = model.biped
    for whole, above in zip(biped.chains.links, biped.chains_above_feet.links, strict=True):
        foot = whole["tip"]
        if foot >= 0:
            mass[foot] = whole["weight"] - above["weight"]
            moment = whole["weight_moment"] - above["weight_moment"]
            place = moment / mass[foot] - whole["tip_place"]
            point[foot] = whole["tip_R"].T @ place
    return mass, point


def _link(row: Any) -> str:
    place = f"{row['parent']}, {row['column']}, {row['tip']}"
    return f"    {{{place}, {members(row, 'zero R anchor weight weight_moment')}}}"


def _test_vector(policy: Any, prefix: str) -> str:
    played = play_steps(policy, _TEST_STEPS)
    return fill(
        "walker_test.h.in",
        prefix,
        count=_TEST_STEPS,
        shown=_structs(played.shown),
        plan=_structs(played.plan),
        offset=row_lines(played.offset),
        links=row_lines(played.links),
    )


def _structs(fields: list[Array]) -> str:
    """Rows of fields as initialisers of structs."""
    rows = [", ".join(map(initialiser, row)) for row in zip(*fields, strict=True)]
    return ",\n".join(f"    {{{row}}}" for row in rows)


def _observations(model: WalkerModel, row: IntArray, generator: np.random.Generator) -> Array:
    """Observations with the plan as their reference, and noise on what sensors show."""
    table = model.observation_table
    plan = model.plan
    rows = np.zeros((len(row), len(table)))
    planned = {
        "encoder_angle": plan.q[row] + generator.normal(0.0, _NOISE_RAD, (len(row), 12)),
        "imu_attitude": generator.normal(0.0, _NOISE_RAD, (len(row), 2)),
        "reference_angle": plan.q[row],
        "reference_rate": plan.q_dot[row],
        "load_share": plan.share[row, None],
        "zmp_reference": plan.zmp[row] + generator.normal(0.0, _NOISE_M, (len(row), 2)),
    }
    for name, values in planned.items():
        rows[:, table.group(name)] = values
    shares = np.column_stack([1.0 - plan.share[row], plan.share[row]])
    force = model.biped.weight * shares + generator.normal(0.0, _NOISE_N, shares.shape)
    rows[:, table.group("wrench")] = generator.normal(0.0, _NOISE_N, (len(row), 12))
    rows[:, table.group("imu_rate")] = generator.normal(0.0, _NOISE_RAD, (len(row), 3))
    rows[:, table.columns(*_FORCES)] = force
    rows[:, table.columns("clock.time")] = plan.timing.time[row, None]
    rows[:, table.columns("clock.support")] = plan.timing.support[row, None]
    return rows


_FORCES = ("wrench.l_fz", "wrench.r_fz")


def _shown(layers: _Layers, rows: Array) -> list[Array]:
    """Fields of the struct `shown` from observations."""
    table = layers.model.observation_table
    names = ("reference_angle", "reference_rate")
    sensors = [rows[:, table.group(name)] for name in ("encoder_angle", "imu_attitude")]
    if layers.posture is None:
        sensors.append(rows[:, table.columns(*_FORCES)])
    else:
        sensors.append(rows[:, table.group("imu_rate")][:, :2])
        sensors.append(rows[:, table.group("wrench")].reshape(len(rows), 2, 6))
    reference = [rows[:, table.group(name)] for name in names]
    share = rows[:, table.group("load_share")][:, 0]
    support: Any = rows[:, table.columns("clock.support")][:, 0].astype(np.int64)
    zmp = rows[:, table.group("zmp_reference")]
    return [*sensors, *reference, share, zmp, support]


def _planned(model: WalkerModel, row: IntArray) -> list[Array]:
    """Fields of the struct `plan` for control periods that end at rows of the plan."""
    plan = model.plan
    local = plan.local
    before = np.clip(row - 1, 0, plan.num_steps)
    row = np.minimum(before + 1, plan.num_steps)
    now = [plan.share[before], local.com[before], local.com_dot[before]]
    feet = [local.ankles[before][..., :2], local.foot_yaw[before]]
    return [*now, *feet, plan.ankles[row][..., :2], plan.foot_yaw[row]]
