"""Compiled control step of walkers without the physics: their joints, then pelvis, feet and IMU.

The rules of `elastic_env.world.joint_kernels` hold here too.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from elastic_env.core.compiled import compiled, compiled_part
from elastic_env.core.signals import Array, BoolArray
from elastic_env.world.attitude_kernels import (
    attitude_from_vertical,
    complementary_filter,
    rotation_between,
    rotation_of,
    settled_vertical,
)
from elastic_env.world.joint_kernels import (
    Control,
    Step,
    begin_joints,
    measured_angle,
    next_noise,
    sense_joints,
    step_at,
)
from elastic_env.world.walk_reward import score_walk

FIRST_HALF = 1
SECOND_HALF = 2
"""Halves of a swing; 0 means that no foot swings."""


class Physics(NamedTuple):
    """Arrays of MuJoCo that a walker's step reads, one row per world."""

    qpos: Array
    qvel: Array
    sensordata: Array
    actuator_force: Array
    site_xpos: Array
    site_xmat: Array


class Walker(NamedTuple):
    """Constants of walkers within an episode.

    Attributes:
        constants: Addresses, feet, sensors and rules: records of `CONSTANTS`, (kinds,).
        plan: Records of `PLAN_ROW`, (steps,).
        bias: Records of `BIAS`, drawn per episode, (num_worlds,).
        inertial: Records of `INERTIAL`, (kinds,); None where no robot has such an IMU. Its filter
            is then not compiled, which needs `inertial` as a separate argument of the functions.
        columns: First column of each group of the observation, (1,).
    """

    constants: Any
    plan: Any
    bias: Any
    inertial: Any
    columns: Any


@compiled
def begin_walk(physics: Any, step: Any, walker: Any, worlds: BoolArray) -> None:
    """Fill truth and measurements of resting walkers at the start of an episode in some worlds."""
    physics = Physics(*physics)
    step = step_at(*step)
    walker = Walker(*walker)
    for world in range(len(worlds)):
        if worlds[world]:
            begin_joints(physics.qpos, physics.qvel, step, world)
            step.worlds[world].truth.contact_since = -1
            read_body(physics, walker, step, world)
            update_foot_drift(step.worlds[world].truth, walker.plan[0])
            noise = next_noise(step, world)
            settle_imu(walker.inertial, walker, step, world, noise)
            is_due = walker.plan[0].imu_is_due
            measure_walk(walker.inertial, walker, step, world, noise, is_due)


@compiled
def sense_walk(physics: Any, step: Any, walker: Any, control: Any, first: int, stride: int) -> bool:
    """Process walkers after the physics: read, measure, end, score, observe.

    Args:
        physics: State of all worlds, `Physics`.
        step: `Step`.
        walker: `Walker`.
        control: `Control`.
        first: First world.
        stride: Distance to the next world, see `EVERY_WORLD`.

    Returns:
        True if an episode ends.
    """
    physics = Physics(*physics)
    step = step_at(*step)
    walker = Walker(*walker)
    control = Control(*control)
    sense_joints(physics.qpos, physics.qvel, step, control, first, stride)
    diverged = control.diverged
    is_over = False
    for world in range(first, len(diverged), stride):
        rules = walker.constants[step.kind[world]]
        truth = step.worlds[world].truth
        if truth.step == rules.skip_step:
            truth.step += walker.bias[world].skipped
        planned = plan_row(walker.plan, truth.step)
        if not diverged[world]:
            read_body(physics, walker, step, world)
            update_foot_drift(truth, planned)
            noise = next_noise(step, world)
            advance_imu(walker.inertial, walker, step, world, noise)
            is_due = planned.imu_is_due
            measure_walk(walker.inertial, walker, step, world, noise, is_due)
        watch_swing_foot(truth, planned, rules.loaded_n)
        ends = control.ends[:, world]
        is_last = truth.step >= len(walker.plan) - 1
        is_over = end_walk(truth, rules, diverged[world], is_last, ends) or is_over
        scores = step.worlds[world].scores
        weights = rules.weights
        control.reward[world] = score_walk(truth, planned, weights, ends[2], scores)
        observe_walk(step, walker, world, control.observation[world])
    return is_over


@compiled
def observe_all_walkers(step: Any, walker: Any, observation: Array) -> None:
    """Fill the walkers' columns of all observations from the present state."""
    step = step_at(*step)
    walker = Walker(*walker)
    for world in range(len(observation)):
        observe_walk(step, walker, world, observation[world])


@compiled_part
def observe_walk(step: Step, walker: Walker, world: int, observation: Array) -> None:
    """Fill the columns of an observation that are not the joints'."""
    is_delayed = step.rules[step.kind[world]].is_delayed
    visible = step.last_worlds if is_delayed else step.worlds
    measured = visible[world].measured
    coming = plan_row(walker.plan, step.worlds[world].truth.step + 1)
    columns = walker.columns[0]
    observation[columns.load_share] = coming.share
    for i in range(2):
        observation[columns.imu_attitude + i] = measured.imu_attitude[i]
        observation[columns.zmp_reference + i] = coming.zmp[i]
    for i in range(3):
        observation[columns.imu_rate + i] = measured.imu_rate[i]
        observation[columns.clock + i] = coming.clock[i]
        for foot in range(2):
            for part in range(2):
                column = columns.wrench + 6 * foot + 3 * part + i
                observation[column] = measured.wrench[foot, part, i]


@compiled_part
def plan_row(plan: Any, step: int) -> Any:
    """Row of the plan at a control step; its last row after the end."""
    return plan[min(step, len(plan) - 1)]


# end of the episode and reward


@compiled_part
def end_walk(row: Any, rules: Any, diverged: bool, is_last: bool, ends: BoolArray) -> bool:
    """Fill the ends of a world, see `Control`; a world that diverged has not fallen.

    Returns:
        True if its episode ends.
    """
    is_down = row.pelvis[2] < rules.lowest_pelvis_m or row.tilt > rules.highest_tilt_rad
    has_fallen = is_down and not diverged
    is_terminated = diverged or has_fallen
    ends[0] = diverged
    ends[1] = has_fallen
    ends[2] = is_terminated
    ends[3] = is_last and not is_terminated
    return is_terminated or is_last


# state of pelvis and feet


@compiled_part
def read_body(physics: Physics, walker: Walker, step: Step, world: int) -> None:
    """Copy the state of pelvis and feet from the physics, and compute ground force and ZMP.

    MuJoCo's wrench acts on the foot, ours on the leg: hence the sign.
    """
    constants = walker.constants[step.kind[world]]
    row = step.worlds[world].truth
    qpos = physics.qpos[world]
    qvel = physics.qvel[world]
    frames = np.empty((3, 3, 3))  # orientation of both feet and of the pelvis
    ground = np.empty((2, 2, 3))  # its forces on the feet, and its moments
    row.servo_torque = rms(physics.actuator_force[world])
    for i in range(3):
        row.pelvis[i] = qpos[i]
        row.pelvis_velocity[i] = qvel[i]
        row.pelvis_rate[i] = qvel[3 + i]
    for i in range(4):
        row.quaternion[i] = qpos[3 + i]
    for foot in range(2):
        ankle = constants.ankles[foot]
        for i in range(3):
            row.ankles[foot, i] = physics.site_xpos[world, ankle, i]
            row.wrench[foot, 0, i] = -physics.sensordata[world, 6 * foot + i]
            row.wrench[foot, 1, i] = -physics.sensordata[world, 6 * foot + 3 + i]
            for j in range(3):
                frames[foot, i, j] = physics.site_xmat[world, ankle, 3 * i + j]
    rotation_of(row.quaternion, frames[2])
    up = frames[2, 2]
    row.roll, row.pitch, row.tilt = attitude_from_vertical(up[0], up[1], up[2])
    weight = constants.foot_weight
    force = ground[0]
    moment = ground[1]
    compute_ground_wrench(row.wrench, frames, constants.foot_com, weight, force, moment)
    compute_zmp(force, moment, row.ankles, constants.zmp_n, row.zmp)
    row.force[0] = force[0, 2]
    row.force[1] = force[1, 2]


@compiled_part
def compute_ground_wrench(
    sensors: Array, foot_R: Array, com: Array, weight: Array, force: Array, moment: Array
) -> None:
    """Compute the wrench of the ground on the feet of one robot.

    Args:
        sensors: Force and moment on the legs, in the frames of the feet, (L, 2, 3) [N], [N·m].
        foot_R: Orientations of the feet, (L, 3, 3).
        com: Center of mass of the feet, as in `FootSensors`, (L, 3) [m].
        weight: Weight of the feet, as in `FootSensors`, (L, 3) [N].
        force: Output: force in the world frame, (L, 3) [N].
        moment: Output: moment about the ankles in the world frame, (L, 3) [N·m].
    """
    c = np.empty(3)
    for foot in range(len(sensors)):
        R = foot_R[foot]
        f, n = sensors[foot]
        w = weight[foot]
        p = com[foot]
        for i in range(3):
            c[i] = R[i, 0] * p[0] + R[i, 1] * p[1] + R[i, 2] * p[2]
            force[foot, i] = R[i, 0] * f[0] + R[i, 1] * f[1] + R[i, 2] * f[2] - w[i]
            moment[foot, i] = R[i, 0] * n[0] + R[i, 1] * n[1] + R[i, 2] * n[2]
        moment[foot, 0] -= c[1] * w[2] - c[2] * w[1]
        moment[foot, 1] -= c[2] * w[0] - c[0] * w[2]
        moment[foot, 2] -= c[0] * w[1] - c[1] * w[0]


@compiled_part
def compute_zmp(force: Array, moment: Array, ankle: Array, least_n: float, zmp: Array) -> None:
    r"""Compute the ZMP of both feet of one robot on the ground plane z = 0: into `zmp`, (2,) [m].

    The ZMP is nan where the feet carry less than `least_n`. M and F are the moment and the force of
    the ground on the feet about the origin:

    .. math:: x = -M_y / F_z, \quad y = M_x / F_z
    """
    about_x = about_y = vertical = 0.0
    for foot in range(len(force)):
        f = force[foot]
        n = moment[foot]
        p = ankle[foot]
        about_x += p[1] * f[2] - p[2] * f[1] + n[0]
        about_y += p[2] * f[0] - p[0] * f[2] + n[1]
        vertical += f[2]
    scale = vertical if vertical >= least_n else np.nan
    zmp[0] = -about_y / scale
    zmp[1] = about_x / scale


@compiled_part
def update_foot_drift(row: Any, planned: Any) -> None:
    """Compute the drift of the feet against the plan; nan where there is no ZMP."""
    compute_foot_drift(row.force, row.ankles, planned.ankles, row.drift)
    if np.isnan(row.zmp[0]):
        row.drift[0] = row.drift[1] = np.nan


@compiled_part
def compute_foot_drift(force: Array, ankle: Array, plan: Array, drift: Array) -> None:
    r"""Compute the displacement of standing feet against the plan: into `drift`, (2,) [m].

    .. math:: d = \sum_i w_i \, (p_i - p_{i, plan}), \quad w_i = F_{z, i} / \sum_j F_{z, j}

    The displacement is in the ground plane. It is continuous, as the weights are, and nan where the
    feet carry nothing. The ZMP minus d is the ZMP of the same wrenches on feet at their planned
    places.
    """
    carried = 0.0
    for foot in range(len(force)):
        carried += force[foot]
    for i in range(2):
        total = 0.0 if carried > 0.0 else np.nan
        for foot in range(len(force)):
            total += force[foot] / carried * (ankle[foot, i] - plan[foot, i])
        drift[i] = total


@compiled_part
def watch_swing_foot(row: Any, planned: Any, loaded_n: float) -> None:
    """Record the step in which the swing foot first touches down in the second half of a swing."""
    if planned.half_of_swing == FIRST_HALF:
        row.contact_since = -1
    is_landing = planned.half_of_swing == SECOND_HALF and row.contact_since < 0
    if is_landing and row.force[planned.swing_foot] > loaded_n:
        row.contact_since = row.step


# measurements


@compiled_part
def measure_walk(
    inertial: Any, walker: Walker, step: Step, world: int, noise: Any, imu_is_due: bool
) -> None:
    """Sample IMU and foot sensors; an IMU that is not due keeps its last sample."""
    quality = walker.constants[step.kind[world]]
    sigma = quality.noise
    row = step.worlds[world].truth
    measured = step.worlds[world].measured
    for foot in range(2):
        for part in range(2):
            for i in range(3):
                error = noise.wrench[foot, part, i] * sigma.wrench[foot, part, i]
                measured.wrench[foot, part, i] = error + row.wrench[foot, part, i]
    if walker.bias[world].has_foot_errors:
        seconds = row.step * step.rules[step.kind[world]].control_period_s
        add_foot_errors(walker.bias[world], row.wrench, seconds, measured.wrench)
    if not imu_is_due or read_inertial_imu(inertial, walker, step, world):
        return
    bias = walker.bias[world].imu_attitude
    for i, angle in enumerate((row.roll, row.pitch)):
        error = sigma.imu_attitude[i] * noise.imu_attitude[i]
        measured.imu_attitude[i] = measured_angle(
            angle, bias[i], error, quality.imu_bias_rad, quality.imu_sine_error_rad
        )
    for i in range(3):
        error = noise.imu_rate[i] * sigma.imu_rate[i]
        measured.imu_rate[i] = error + row.pelvis_rate[i]


@compiled_part
def add_foot_errors(bias: Any, wrench: Array, seconds: float, measured: Array) -> None:
    """Add bias, drift and cross-talk of the feet's sensors, see `elastic_env.world.foot_sensors`.

    Args:
        bias: Record of `BIAS` of the world.
        wrench: True wrench, (2, 2, 3) [N], [N·m].
        seconds: Time since the start of the episode [s].
        measured: Measured wrench, to which the errors are added, as `wrench`.
    """
    for foot in range(2):
        for row in range(6):
            part = row // 3
            i = row % 3
            rate = bias.wrench_rate[foot, part, i]
            error = bias.wrench[foot, part, i] + seconds * rate
            for column in range(6):
                share = bias.cross_talk[foot, row, column]
                error += share * wrench[foot, column // 3, column % 3]
            measured[foot, part, i] += error


@compiled_part
def read_inertial_imu(inertial: Any, walker: Walker, step: Step, world: int) -> bool:
    """Read the state of an inertial IMU, and add the errors of its mounting.

    Returns:
        True if the world has an inertial IMU.
    """
    if inertial is None:
        return False
    if not inertial[step.kind[world]].is_fitted:
        return False
    quality = walker.constants[step.kind[world]]
    bias = walker.bias[world].imu_attitude
    measured = step.worlds[world].measured
    up = measured.imu_up
    roll, pitch, _ = attitude_from_vertical(up[0], up[1], up[2])
    for i, angle in enumerate((roll, pitch)):
        measured.imu_attitude[i] = measured_angle(
            angle, bias[i], 0.0, quality.imu_bias_rad, quality.imu_sine_error_rad
        )
    for i in range(3):
        measured.imu_rate[i] = measured.imu_gyro[i]
    return True


@compiled_part
def settle_imu(inertial: Any, walker: Any, step: Step, world: int, noise: Any) -> None:
    """Set an inertial IMU to the state that it reaches at rest, including the gyroscope's bias."""
    if inertial is None:
        return
    sensor = inertial[step.kind[world]]
    bias = walker.bias[world]
    sigma = walker.constants[step.kind[world]].noise
    row = step.worlds[world].truth
    measured = step.worlds[world].measured
    force = np.empty(3)
    if not sensor.is_fitted:
        return
    specific_force(row, row, 1.0, sensor.gravity_m_s2, force)
    for i in range(3):
        force[i] += bias.specific_force[i]
        measured.imu_gyro[i] = bias.gyro[i] + noise.imu_rate[i] * sigma.imu_rate[i]
    settled_vertical(measured.imu_up, force, bias.gyro, sensor.time_constant_s)


@compiled_part
def advance_imu(inertial: Any, walker: Any, step: Step, world: int, noise: Any) -> None:
    """Advance an inertial IMU by a control period.

    Its gyroscope measures the mean rate, and its filter turns the vertical.

    Args:
        inertial: `inertial` of `walker`.
        walker: `Walker`.
        step: `Step`, whose measurements `imu_gyro` and `imu_up` are updated.
        world: Index of the world.
        noise: Sample of the sensors' noise; `imu_attitude` is the accelerometer's, across the
            vertical.
    """
    if inertial is None:
        return
    sensor = inertial[step.kind[world]]
    bias = walker.bias[world]
    sigma = walker.constants[step.kind[world]].noise
    if not sensor.is_fitted:
        return
    gravity = sensor.gravity_m_s2
    period_s = step.rules[step.kind[world]].control_period_s
    before = step.last_worlds[world].truth
    row = step.worlds[world].truth
    measured = step.worlds[world].measured
    force = np.empty(3)
    turned = np.empty(3)
    specific_force(before, row, period_s, gravity, force)
    rotation_between(before.quaternion, row.quaternion, turned)
    # a force to the left is a positive roll, one forward a negative pitch
    force[0] -= gravity * sigma.imu_attitude[1] * noise.imu_attitude[1]
    force[1] += gravity * sigma.imu_attitude[0] * noise.imu_attitude[0]
    for i in range(3):
        force[i] += bias.specific_force[i]
        rate_noise = noise.imu_rate[i] * sigma.imu_rate[i]
        rate = turned[i] / period_s + bias.gyro[i] + rate_noise
        measured.imu_gyro[i] = rate
        turned[i] = rate * period_s
    gain = 1.0 - math.exp(-period_s / sensor.time_constant_s)
    complementary_filter(measured.imu_up, turned, force, gain)


@compiled_part
def specific_force(
    before: Any, row: Any, period_s: float, gravity_m_s2: float, force: Array
) -> None:
    """Compute the mean specific force over a period, in the frame at its end: into `force` [m/s²].

    Specific force is acceleration minus gravity.
    """
    R = np.empty((3, 3))
    rotation_of(row.quaternion, R)
    v = row.pelvis_velocity
    u = before.pelvis_velocity
    a = (v[0] - u[0]) / period_s
    b = (v[1] - u[1]) / period_s
    c = (v[2] - u[2]) / period_s + gravity_m_s2
    for i in range(3):
        force[i] = R[0, i] * a + R[1, i] * b + R[2, i] * c


# means


@compiled_part
def rms(values: Array) -> float:
    """Root mean square, summed in order."""
    total = 0.0
    for value in values:
        total += value * value
    return math.sqrt(total / len(values))


@compiled
def rms_of_rows(values: Array) -> Array:
    """`rms` of every row of (n, m)."""
    result = np.empty(len(values))
    for row in range(len(values)):
        result[row] = rms(values[row])
    return result
