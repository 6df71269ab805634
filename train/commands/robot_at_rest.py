"""A robot at rest, in closed form: shares of the joints in its error, and a picture of the sag."""

from typing import Any

import numpy as np
import pandas as pd
from rich import box
from rich.table import Table

from baselines import PositionCompensator
from elastic_env.core.signals import Array
from elastic_env.joint.friction import dry_friction
from elastic_env.rendering.picture import Image, with_text
from elastic_env.rendering.sag import ENLARGEMENT, SagViews
from elastic_env.robots.joint_robot import JointRobotConfig
from elastic_env.world.joint_plant import JointPlant
from train.runs.console import make_table

TABLE_STYLE: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0)}
"""Style of the tables of `elastic robot`."""
_PIXELS = 420
_MOST_POSES = 2
"""Poses in the picture."""


def rest_poses(plant: JointPlant) -> Array:
    """Static poses of a plant's reference, (poses, n) [rad]."""
    plan = plant.motion.plan(np.random.default_rng(0), plant.true.control_period_s)
    numbers, first = np.unique(plan.rest, return_index=True)
    return plan.q[first[numbers >= 0]]


def joint_shares(plant: JointPlant) -> pd.DataFrame:
    r"""Shares of the joints in the error of the end effector at rest, in closed form.

    No episode is played: a link rests where spring and weight balance, K(θ − q) = τ_g(q), with θ =
    q_ref. With column J_j of the end effector's Jacobian the error is, to first order, the sum over
    the joints

    .. math:: e = \sum_j J_j(q_{ref}) (q_j - q_{ref,j}), \quad s_j = \frac{\sum e \cdot e_j}{\sum e \cdot e}

    with e_j the term of joint j, and sums over the poses. The shares s_j add up to 1; a joint that
    reduces the error of others has a negative share.

    Args:
        plant: A robot with an end effector, and static poses as its reference.

    Returns:
        A row for each joint: K; the gain k_p of its servo, infinite where that holds its angle;
        and its share. Rms values over the poses: gravity torque; deflection from the command;
        displacement of the end effector by this deflection alone; the same by friction, F/K.
    """  # noqa: E501
    tool = plant.end_effector
    assert tool is not None
    q_ref = rest_poses(plant)
    q = plant.rest_angle(q_ref)
    parts = tool.parts(q_ref, q)
    error = parts.sum(axis=-1)
    total = max(float(np.sum(error**2)), np.finfo(np.float64).tiny)
    lever = np.linalg.norm(tool.jacobian(q_ref)[0], axis=1)
    joints = plant.true
    friction = dry_friction(
        speed=np.zeros_like(q),
        load=plant.static_torque(q),
        coulomb=joints.coulomb_friction,
        load_ratio=joints.load_friction,
        static=joints.static_friction,
        stribeck_speed=joints.stribeck_speed,
    )
    friction = lever * friction / joints.rest_stiffness("tendon")
    with np.errstate(divide="ignore"):
        position_gain = 1.0 / joints.servo_compliance
    return pd.DataFrame(
        {
            "joint": plant.joint_names,
            "stiffness_Nm_per_rad": joints.stiffness,
            "position_gain_Nm_per_rad": position_gain,
            "gravity_torque_rms_Nm": _rms(plant.static_torque(q)),
            "deflection_rms_rad": _rms(q - q_ref),
            "end_effector_rms_m": _rms(np.linalg.norm(parts, axis=1)),
            "share": np.einsum("pi,pij->j", error, parts) / total,
            "friction_leaves_m": _rms(friction),
        }
    )


def _rms(values: Array) -> Array:
    """Root mean square over the poses, the first axis."""
    return np.sqrt(np.mean(values**2, axis=0))


def picture(config: JointRobotConfig, plant: JointPlant) -> Image:
    """The poses with the largest sag, in rows: left without compensation, right with it.

    In closed form, as `joint_shares`. Deviations from the translucent reference are enlarged.

    Raises:
        ElasticError: The machine cannot draw.
    """
    tool = plant.end_effector
    assert tool is not None
    model = plant.assumed
    # spring and servo in series: the command leads both
    stiffness = model.rest_stiffness("tendon").tolist()
    compensator = PositionCompensator(model.rigid, stiffness, joints=model.joint_names)
    q_ref = rest_poses(plant)
    order = np.argsort(-tool.errors(q_ref, plant.rest_angle(q_ref))[0])[:_MOST_POSES]
    views = SagViews(config.robot.rigid(), plant.joint_names, _PIXELS)
    rows = []
    for pose in q_ref[order]:
        twice = np.array([pose, pose])
        links = plant.rest_angle(np.array([pose, compensator.command(pose)]))
        errors = 1e3 * tool.errors(twice, links)[0]
        caption = [
            f"end effector off by {errors[0]:.2f} mm without, {errors[1]:.3f} mm with compensation",
            "at rest without friction; deviations from the translucent reference drawn x"
            f" {ENLARGEMENT:g}",
        ]
        rows.append(with_text(views.draw(twice, links), caption))
    return np.concatenate(rows)


_COLUMNS = {
    "K\nNm/rad": ("stiffness_Nm_per_rad", 1.0, ".4g"),
    "k_p\nNm/rad": ("position_gain_Nm_per_rad", 1.0, ".4g"),
    "torque\nNm": ("gravity_torque_rms_Nm", 1.0, ".2f"),
    "deflection\nmrad": ("deflection_rms_rad", 1e3, ".2f"),
    "alone\nmm": ("end_effector_rms_m", 1e3, ".2f"),
    "share\n%": ("share", 100.0, ".1f"),
    "F/K\nmm": ("friction_leaves_m", 1e3, ".2f"),
}
"""Columns of the table of joints: name in `joint_shares`, factor and format."""


def shares_table(shares: pd.DataFrame) -> Table:
    """Result of `joint_shares` as a table."""
    columns = {"joint": list(shares["joint"])}
    for head, (name, factor, form) in _COLUMNS.items():
        columns[head] = [format(factor * value, form) for value in shares[name]]
    if not np.isfinite(shares["position_gain_Nm_per_rad"]).any():
        del columns["k_p\nNm/rad"]
    caption = (
        "closed form, uncompensated: springs and servos that give way; F/K is what friction can"
        " leave"
    )
    rows = zip(*columns.values(), strict=True)
    title = "where the error at rest comes from"
    table = make_table(title, list(columns), rows, caption=caption, **TABLE_STYLE)
    for column in table.columns[1:]:
        column.vertical = "bottom"
    return table
