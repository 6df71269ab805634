"""Policies `input_output` and `adaptive_posture` of a walker as headers in C99.

Each has its test vector and an example.

The header does not contain the plan: in every control step a planner gives it one row. Without
joint torque sensors `adaptive_posture` estimates from rolls alone, so the header has no pitches.
"""

from hashlib import sha256
from typing import Any

import numpy as np

from baselines.adaptation.estimators import ASSUMED_LOADS
from baselines.compensation.compensators import Compensated
from baselines.compensation.contact_torque import ContactGravity
from baselines.estimation import model_error
from elastic_env.core.signals import Array
from elastic_env.world.robot_model import WalkerModel
from train.export import c_text
from train.export.walker_layers import WalkerLayers, find_layers
from train.export.walker_vectors import play_steps

_TEST_STEPS = 12
_CONTROLLER_CONSTANTS = (
    "thigh shank weight weight_of_feet omega velocity_share zmp_share weight_share"
    " force_difference force_difference_decay_s force_difference_limit_m dcm"
    " zmp_limit_m friction_rate_rad_s"
)
_GAINS = "proportional integral derivative leak_s trim integral_limit filter_share swing_share"


def c_walker(policy: Any, prefix: str) -> str:
    """The header of a policy, with a test vector behind the macro <PREFIX>_TEST.

    Args:
        policy: Policy of `baselines.make("input_output", env)`, or of `adaptive_posture`.
        prefix: Prefix of all names in the header.

    Raises:
        ConfigurationError: Another policy, or an invalid prefix.
    """
    layers = find_layers(policy)
    model = layers.model
    tables = _tables(layers.compensated, model)
    is_adaptive = layers.posture is not None
    if is_adaptive:
        tables |= _adaptive_tables(layers)
    digest = sha256("\n".join(tables.values()).encode()).hexdigest()
    joints = [
        f"  {j:2}  {c_text.plain_text(name)}: K {model.stiffness[j]:.6g} N*m/rad"
        for j, name in enumerate(model.joint_names)
    ]
    return c_text.fill_template(
        "walker.h.in",
        prefix,
        **tables,
        policy="adaptive_posture" if is_adaptive else "input_output",
        is_adaptive=str(int(is_adaptive)),
        adaptive=c_text.fill_template("walker_adaptive.h.in", prefix, **tables)
        if is_adaptive
        else "",
        vectors=c_text.fill_template("common_vectors.h.in", prefix),
        digest=digest,
        origin=c_text.comment([c_text.GENERATED]),
        joints=c_text.comment(joints),
        period_s=c_text.number(model.control_period_s),
        test=_test_vector(policy, prefix),
    )


def _tables(policy: Compensated, model: WalkerModel) -> dict[str, str]:
    """Constants of controller and compensator, as text in C."""
    controller: Any = policy.policy
    compensator: Any = policy.compensator
    gravity: ContactGravity = compensator.gravity
    contact: Any = gravity.contact[0]
    constants: Any = controller.constants[0]
    links = gravity.chains.links
    feet = links[[int(np.flatnonzero(links["tip"] == foot)[0]) for foot in range(2)]]
    command_compliance = 1.0 / model.stiffness + compensator.servo_compliance
    return {
        **{name: c_text.number(constants[name]) for name in _CONTROLLER_CONSTANTS.split()},
        "control_period_s": c_text.number(constants["period_s"]),
        "is_com_fed_back": str(int(constants["is_com_fed_back"])),
        "is_at_zmp": str(int(contact["is_at_zmp"])),
        "gravity": c_text.number(contact["gravity"]),
        "mass": c_text.number(contact["mass"]),
        "ankle_height": c_text.number(contact["ankle_height"]),
        "sole_depth": c_text.number(model.biped.ankle_height),
        "links": ",\n".join(map(_link_text, links)),
        "foot_R": ", ".join(c_text.number_list(row["tip_R"]) for row in feet),
        "foot_place": ", ".join(c_text.number_list(row["tip_place"]) for row in feet),
        "stiffness": c_text.numbers(model.stiffness),
        "of_command": c_text.numbers(command_compliance),
        "friction": c_text.numbers(constants["friction_deflection"]),
        "feedback_steps": str(len(controller.ramp)),
        "feedback_ramp": c_text.numbers(controller.ramp),
        "steps": str(len(policy.ramp)),
        "ramp": c_text.numbers(policy.ramp),
    }


def _adaptive_tables(layers: WalkerLayers) -> dict[str, str]:
    """Constants of posture feedback and adaptation, as text in C."""
    adaptive: Any = layers.adaptive
    gains: Any = layers.posture.gains[0]  # type: ignore[union-attr]
    carried = adaptive.estimator.observer.carried
    mass, point = _masses_below_sensors(layers.model)
    constants = {
        **{name: gains[name] for name in _GAINS.split()},
        "turn_limit": gains["limit_rad"],
        "correction_limit": adaptive.limit,
        "correction_share": adaptive.share,
        "error_variance": model_error.MODEL_ERROR**2,
        "offset_variance": model_error.OFFSET_RAD**2,
        "measured_variance": model_error.DISAGREEMENT_RAD**2,
        "loaded_n": model_error.LOADED_SHARE * carried,
        "carried_n": carried,
        "assumed_loads": ASSUMED_LOADS,
    }
    return {
        **{name: c_text.number(value) for name, value in constants.items()},
        "estimate_every": str(adaptive.every),
        "foot_mass": c_text.numbers(-mass),
        "foot_point": ", ".join(map(c_text.number_list, point)),
    }


def _masses_below_sensors(model: WalkerModel) -> tuple[Array, Array]:
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


def _link_text(row: Any) -> str:
    place = f"{row['parent']}, {row['column']}, {row['tip']}"
    return f"    {{{place}, {c_text.member_text(row, 'zero R anchor weight weight_moment')}}}"


def _test_vector(policy: Any, prefix: str) -> str:
    steps = play_steps(policy, _TEST_STEPS)
    return c_text.fill_template(
        "walker_test.h.in",
        prefix,
        count=_TEST_STEPS,
        shown=_struct_lines(steps.shown),
        plan=_struct_lines(steps.plan),
        offset=c_text.row_lines(steps.offset),
        links=c_text.row_lines(steps.links),
    )


def _struct_lines(fields: list[Array]) -> str:
    """Rows of fields as initialisers of structs, a row on a line."""
    rows = [", ".join(map(c_text.initialiser, row)) for row in zip(*fields, strict=True)]
    return ",\n".join(f"    {{{row}}}" for row in rows)
