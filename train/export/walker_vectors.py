"""Test vectors of a walker's policy: sensors and plan, and the offsets that Python commands."""

from typing import Any, NamedTuple

import numpy as np

from baselines.compensation.policy import NO_INPUTS
from elastic_env.core.signals import Array, IntArray
from elastic_env.world.robot_model import WalkerModel
from train.export.walker_layers import WalkerLayers, find_layers

_NOISE_RAD = 0.02
"""Standard deviation of encoders, attitude [rad] and rates [rad/s] about the plan."""
_NOISE_N = 30.0
"""Standard deviation of forces [N] and moments [N·m]."""
_NOISE_M = 0.01
"""Standard deviation of the ZMP [m]."""
_FORCES = ("wrench.l_fz", "wrench.r_fz")


class PlayedSteps(NamedTuple):
    """Control steps of a walker, a row each.

    Attributes:
        shown: Fields of the struct `shown`, in order.
        plan: Fields of the struct `plan`, in order.
        offset: Offsets that Python commands, in single precision, (T, 12) [rad].
        links: Link angles that its controller estimates, (T, 12) [rad].
        memory: Memory of the policy after the last step.
    """

    shown: list[Array]
    plan: list[Array]
    offset: Array
    links: Array
    memory: Any


def play_steps(policy: Any, count: int, seed: int = 0) -> PlayedSteps:
    """Play a policy from its begin on random sensors about rows of the plan.

    Args:
        policy: See `c_walker`.
        count: Number of rows of the plan, evenly over the walk.
        seed: Seed of the sensors.
    """
    model = find_layers(policy).model
    row = np.linspace(1.0, model.plan.num_steps, count).astype(np.int64)
    rows = _random_observations(model, row, np.random.default_rng(seed))
    return play_observations(policy, rows)


def play_observations(policy: Any, rows: Array) -> PlayedSteps:
    """Play a policy from its begin on observations.

    Args:
        policy: See `c_walker`.
        rows: Observations, one per control step, (T, m).
    """
    layers = find_layers(policy)
    count = len(rows)
    offset = np.empty((count, 12))
    links = np.empty((count, 12))
    memory = policy.begin(rows[:1])
    for step in range(count):
        row = rows[step : step + 1]
        action, memory = policy.act(row, memory, NO_INPUTS)
        offset[step] = action[0]
        links[step] = policy.link_angles(row, memory)[0]
    plan = _plan_fields(layers.model, policy.view.plan_row(rows))
    return PlayedSteps(_sensor_fields(layers, rows), plan, offset, links, memory)


def _random_observations(
    model: WalkerModel, row: IntArray, generator: np.random.Generator
) -> Array:
    """Observations with the plan as their reference, and noise on the sensors."""
    table = model.observation_table
    plan = model.plan
    rows = np.zeros((len(row), len(table)))
    noisy = {
        "encoder_angle": plan.q[row] + generator.normal(0.0, _NOISE_RAD, (len(row), 12)),
        "imu_attitude": generator.normal(0.0, _NOISE_RAD, (len(row), 2)),
        "reference_angle": plan.q[row],
        "reference_rate": plan.q_dot[row],
        "load_share": plan.share[row, None],
        "zmp_reference": plan.zmp[row] + generator.normal(0.0, _NOISE_M, (len(row), 2)),
    }
    for name, values in noisy.items():
        rows[:, table.group(name)] = values
    shares = np.column_stack([1.0 - plan.share[row], plan.share[row]])
    force = model.biped.weight * shares + generator.normal(0.0, _NOISE_N, shares.shape)
    rows[:, table.group("wrench")] = generator.normal(0.0, _NOISE_N, (len(row), 12))
    rows[:, table.group("imu_rate")] = generator.normal(0.0, _NOISE_RAD, (len(row), 3))
    rows[:, table.columns(*_FORCES)] = force
    rows[:, table.columns("clock.time")] = plan.timing.time[row, None]
    rows[:, table.columns("clock.support")] = plan.timing.support[row, None]
    return rows


def _sensor_fields(layers: WalkerLayers, rows: Array) -> list[Array]:
    """Fields of the struct `shown` from observations."""
    table = layers.model.observation_table
    sensors = [rows[:, table.group(name)] for name in ("encoder_angle", "imu_attitude")]
    if layers.posture is None:
        sensors.append(rows[:, table.columns(*_FORCES)])
    else:
        sensors.append(rows[:, table.group("imu_rate")][:, :2])
        sensors.append(rows[:, table.group("wrench")].reshape(len(rows), 2, 6))
    reference = [rows[:, table.group(name)] for name in ("reference_angle", "reference_rate")]
    share = rows[:, table.group("load_share")][:, 0]
    support: Any = rows[:, table.columns("clock.support")][:, 0].astype(np.int64)
    return [*sensors, *reference, share, rows[:, table.group("zmp_reference")], support]


def _plan_fields(model: WalkerModel, row: IntArray) -> list[Array]:
    """Fields of the struct `plan` for control periods that end at rows of the plan."""
    plan = model.plan
    local = plan.local
    before = np.clip(row - 1, 0, plan.num_steps)
    row = np.minimum(before + 1, plan.num_steps)
    com = [plan.share[before], local.com[before], local.com_dot[before]]
    feet = [local.ankles[before][..., :2], local.foot_yaw[before]]
    return [*com, *feet, plan.ankles[row][..., :2], plan.foot_yaw[row]]
