"""Constants of the walker's control step, from its configuration and its walk plan."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from elastic_env.core.signals import BoolArray
from elastic_env.motion import walk_plan
from elastic_env.motion.gait import RIGHT
from elastic_env.motion.trajectory import STAND_S
from elastic_env.motion.walk_plan import WalkPlan
from elastic_env.robots.thormang import config as walk_config
from elastic_env.robots.thormang import records, walk_signals
from elastic_env.robots.thormang.config import WalkConfig
from elastic_env.robots.thormang.model import SIDES, biped
from elastic_env.world import walk_kernels as kernels
from elastic_env.world.foot_sensors import FootSensors
from elastic_env.world.records import Records, single_record
from elastic_env.world.robot_model import WalkerModel
from elastic_env.world.robot_ranges import DrawnRobot
from elastic_env.world.sensors import is_due

_STEPS_BEFORE_SKIP = 2
"""Steps after which the strides of a walk in place are all the same: the preview control has
forgotten the start, and does not see the end yet."""
_UNLOADED_SHARE = 0.05
"""Share of the weight below which a foot, or the sensors of both together, count as unloaded."""
TOUCHDOWN = -1
"""Row of the touch-downs in the masks by `phase_masks`."""


@dataclass(frozen=True, eq=False)
class RobotKind:
    """Robots of one scenario.

    Attributes:
        config: Configuration of their worlds, with no other scenario.
        bank: Robots that episodes draw from.
        model: Plant without drawn parameters.
        true_model: True joints and masses without drawn parameters.
    """

    config: WalkConfig
    bank: Sequence[DrawnRobot]
    model: mujoco.MjModel
    true_model: WalkerModel

    @staticmethod
    def of(config: WalkConfig, plan: WalkPlan) -> "RobotKind":
        """Make the robots of a configuration and a planned motion."""
        walk_config.require_stable_walker(config)  # pyright: ignore[reportArgumentType]  frozen models can be hashed
        bank = walk_config.robot_bank(config.scenario, config.bank)
        body = biped(config.true_robot)  # pyright: ignore[reportArgumentType]
        period_s = config.control_period_s
        if config.true_robot != config.robot:
            plan = walk_plan.with_torque(plan, body, period_s)
        joints = config.true_joints
        true_model = WalkerModel(joints, body.rigid, period_s, biped=body, plan=plan)
        plant = copy.copy(walk_config.undrawn_model(config))  # pyright: ignore[reportArgumentType]
        return RobotKind(config, bank, plant, true_model)

    @property
    def encoder_counts(self) -> int | None:
        """Counts per turn of the encoders; None for continuous ones."""
        has_counts = self.config.scenario.encoder_counts
        return self.true_model.encoder_counts_per_turn if has_counts else None

    @property
    def sensor_variants(self) -> list[tuple[bool, bool]]:
        """Pairs of its robots: True for delayed measurements, True for an inertial IMU."""
        pairs = [(robot.is_delayed, robot.is_inertial) for robot in self.bank]
        return list(dict.fromkeys(pairs))


def plan_rows(plan: WalkPlan, config: WalkConfig) -> Records:
    """Records of `PLAN_ROW`, one per control step."""
    timing = plan.timing
    steps = np.arange(plan.num_steps + 1)
    rows = np.zeros(len(steps), records.PLAN_ROW)
    halves = np.where(timing.swing > 0.5, kernels.SECOND_HALF, kernels.FIRST_HALF)
    imu_hz = config.scenario.pelvis_imu.rate_hz
    rows["clock"] = np.column_stack([timing.time, timing.swing, timing.support])
    rows["share"] = plan.share
    rows["zmp"] = plan.zmp
    rows["ankles"] = plan.ankles
    rows["half_of_swing"] = np.where(timing.single, halves, 0)
    rows["swing_foot"] = RIGHT - timing.support
    rows["imu_is_due"] = is_due(steps, imu_hz, config.control_period_s)
    rows["weight"] = np.where(timing.walking, 1.0, config.reward.standing)
    rows.flags.writeable = False
    return rows


def phase_masks(plan: WalkPlan) -> BoolArray:
    """Scored steps by control step: all, `PHASES`, `BLOCKS`, and planned touch-downs."""
    timing = plan.timing
    single = timing.single
    touchdown = np.zeros_like(single)
    touchdown[1:] = single[:-1] & ~single[1:]
    gait = plan.gait
    first = timing.step < gait.settling_steps + walk_signals.BLOCK_STEPS
    last = timing.step >= gait.num_steps - walk_signals.BLOCK_STEPS
    phases = (np.ones_like(single), ~single, single, timing.transition)
    masks = timing.scored & np.stack([*phases, first, last, touchdown])
    masks.flags.writeable = False
    return masks


def walk_constants(kind: RobotKind, is_inertial: bool) -> Records:
    """Constants of a kind of world, one record of `CONSTANTS`.

    Args:
        kind: Robots of its scenario.
        is_inertial: True if its IMU computes its attitude.
    """
    config = kind.config
    scenario = config.scenario
    noise = np.zeros(1, records.NOISE)
    for group, deviation in walk_signals.sensor_noise(scenario, is_inertial).items():
        noise[group] = deviation
    model = kind.model
    feet = [model.body(f"{side}_foot").id for side in SIDES]
    gravity = model.opt.gravity.copy()
    sensors = FootSensors(model.body_mass[feet], model.body_ipos[feet], gravity)
    g = biped(config.robot).gravity  # pyright: ignore[reportArgumentType]  frozen models can be hashed
    loaded_n = _UNLOADED_SHARE * float(model.body_mass.sum()) * g
    terms = records.SCORES.names or ()
    weights = {term: getattr(config.reward, term) for term in terms}
    before_skip_s = STAND_S + _STEPS_BEFORE_SKIP * config.gait.step_period_s
    return single_record(
        records.CONSTANTS,
        ankles=[model.site(f"{side}_ft").id for side in SIDES],
        foot_com=sensors.com,
        foot_weight=sensors.weight,
        noise=noise,
        imu_bias_rad=scenario.pelvis_imu.bias_rad,
        imu_sine_error_rad=scenario.pelvis_imu.sine_error_rad,
        lowest_pelvis_m=walk_config.FALL_HEIGHT_SHARE * config.gait.hip_height_m,
        highest_tilt_rad=walk_config.FALL_TILT_RAD,
        loaded_n=loaded_n,
        # sensors without load mean that the ground carries only the feet
        zmp_n=loaded_n + float(model.body_mass[feet].sum()) * g,
        weights=single_record(records.SCORES, **weights),
        skip_step=round(before_skip_s / config.control_period_s),
    )


def inertial_constants(
    variants: Sequence[tuple[RobotKind, bool, bool]], gravity_m_s2: float
) -> Records | None:
    """Records of `INERTIAL`, one per kind of world; None where no robot has such an IMU."""
    if not any(is_inertial for _, _, is_inertial in variants):
        return None
    rows = np.zeros(len(variants), records.INERTIAL)
    for row, (kind, _, is_inertial) in zip(rows, variants, strict=True):
        row["is_fitted"] = is_inertial
        row["time_constant_s"] = kind.config.scenario.inertial.time_constant_s
    rows["gravity_m_s2"] = gravity_m_s2
    return rows
