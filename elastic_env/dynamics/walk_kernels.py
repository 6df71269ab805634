"""A control step of a walker after the physics, compiled: follow, read, stand, measure, score, observe.

One pass over the worlds, from MuJoCo's state to the observation. A world's numbers depend on its own row alone. Rows
have their fields by name, see `elastic_env.robots.thormang.rows`.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel calls stands in this
file, and every size comes from a type. A kernel that Python calls takes plain tuples and names their parts itself:
Numba takes a microsecond more for a tuple with names.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from elastic_env.core.compiled import compiled, within_compiled
from elastic_env.core.signals import Array, BoolArray, IntArray, Parameter

FIRST_HALF, SECOND_HALF = 1, 2
"""Of a swing; 0 is none."""


class Physics(NamedTuple):
    """MuJoCo's arrays that a step reads, one row per world."""

    qpos: Array
    qvel: Array
    sensordata: Array
    actuator_force: Array
    site_xpos: Array
    site_xmat: Array


class Walker(NamedTuple):
    """What does not change within an episode.

    Attributes:
        constants: Addresses, feet, sensors and rules: rows of `CONSTANTS`, one for every kind of sensors.
        plan: One row per control step.
        bias: Errors of homing and mounting, and which row of the constants holds, (n,).
        inertial: Rows of `INERTIAL` beside the constants, or None where no robot has such an IMU: its filter is then
            not even compiled.
    """

    constants: Any
    plan: Any
    bias: Any
    inertial: Any


class Noise(NamedTuple):
    """Standard normal samples ahead, (block, n), and how many of each world's are used, (n,), which is counted here."""

    samples: Any
    used: IntArray


class Outcome(NamedTuple):
    """What a step fills beside the rows; `ends` is (4, n): diverged, fell, terminated, truncated."""

    observed: Any
    reward: Array
    ends: BoolArray


@compiled
def command(rows: Any, offset: Array, walker: Any, inputs: Array) -> None:
    """Servo inputs of the coming control period, q_ref + offset, by encoders that are off by a bias, (n, 12) [rad]."""
    walker = Walker(*walker)
    for world in range(len(offset)):
        coming, bias = row_of(walker.plan, rows[world].truth.step + 1), walker.bias[world]
        for i in range(offset.shape[1]):
            inputs[world, i] = coming.q[i] + offset[world, i] - bias.encoder[i]


@compiled
def begin(physics: Any, walker: Any, noise: Any, worlds: BoolArray, rows: Any) -> None:
    """Truth and measurements at the start of an episode in some worlds, whose encoders have been at rest."""
    physics, walker, noise = Physics(*physics), Walker(*walker), Noise(*noise)
    feet = feet_to_be_filled()
    for world in range(len(rows)):
        if worlds[world]:
            truth, shown, bias = rows[world].truth, rows[world].measured, walker.bias[world]
            constants = walker.constants[bias.fit]
            read(physics, constants.at, world, truth)
            stand(physics, constants, world, truth, feet)
            drawn = sample_of(noise, world)
            settle_imu(walker.inertial, truth, drawn, bias, constants.quality, shown)
            imu_is_due = row_of(walker.plan, truth.step).imu_is_due  # as always at first
            measure(walker.inertial, truth, drawn, bias, constants.quality, imu_is_due, shown)
            for i in range(len(shown.encoder)):
                shown.encoder_before[i] = shown.encoder[i]


@compiled
def control_step(
    physics: Any, walker: Any, noise: Any, commanded: tuple[Array, BoolArray], last: Any, now: Any, outcome: Any
) -> bool:
    """Everything after the physics.

    Args:
        physics: State of all worlds, `Physics`.
        walker: What does not change, `Walker`.
        noise: Of the sensors, `Noise`.
        commanded: Offsets of this control period, (n, 12) [rad], and the worlds that diverged under them, (n,). These
            keep truth and measurements.
        last: Rows of the step before, (n,).
        now: To be filled, (n,).
        outcome: To be filled, `Outcome`.

    Returns:
        Whether an episode ends.
    """
    physics, walker, noise, outcome = Physics(*physics), Walker(*walker), Noise(*noise), Outcome(*outcome)
    offset, diverged = commanded
    is_over, feet = False, feet_to_be_filled()
    for world in range(len(offset)):
        bias = walker.bias[world]
        constants = walker.constants[bias.fit]
        rules = constants.rules
        now[world] = last[world]
        truth, shown, scores = now[world].truth, now[world].measured, now[world].scores
        truth.step += 1
        planned = row_of(walker.plan, truth.step)
        follow(truth, planned, offset[world], rules.control_period_s)
        if not diverged[world]:
            read(physics, constants.at, world, truth)
            stand(physics, constants, world, truth, feet)
            drawn = sample_of(noise, world)
            advance_imu(walker.inertial, last[world].truth, truth, drawn, bias, constants, shown)
            measure(walker.inertial, truth, drawn, bias, constants.quality, planned.imu_is_due, shown)
        watch_swing_foot(truth, planned, rules.loaded_n)
        is_last = truth.step >= len(walker.plan) - 1
        is_over = end(truth, rules, diverged[world], is_last, outcome.ends[:, world]) or is_over
        outcome.reward[world] = score(truth, planned, rules.weights, outcome.ends[-2, world], scores)
        visible = last[world].measured if rules.is_delayed else shown
        coming = row_of(walker.plan, truth.step + 1)
        observe(truth, visible, coming, rules.control_period_s, outcome.observed[world])
    return is_over


@compiled
def show(rows: Any, before: Any, walker: Any, observed: Any) -> None:
    """Observations of the present state; `before` are the rows of the step before."""
    walker = Walker(*walker)
    for world in range(len(rows)):
        rules = walker.constants[walker.bias[world].fit].rules
        visible = before[world].measured if rules.is_delayed else rows[world].measured
        coming = row_of(walker.plan, rows[world].truth.step + 1)
        observe(rows[world].truth, visible, coming, rules.control_period_s, observed[world])


@compiled
def row_of(plan: Any, step: int) -> Any:
    """The plan's row of a step; its last one from the end on."""
    return plan[min(step, len(plan) - 1)]


@compiled
def sample_of(noise: Noise, world: int) -> Any:
    """The next sample of a world."""
    used = noise.used[world]
    noise.used[world] += 1
    return noise.samples[min(used, len(noise.samples) - 1), world]


@compiled
def follow(row: Any, planned: Any, offset: Array, period_s: float) -> None:
    """Keep what was commanded, and how fast it changed."""
    total = 0.0
    for i in range(len(offset)):
        change = offset[i] - row.offset[i]
        total += change * change
        row.offset[i], row.command[i] = offset[i], planned.q[i] + offset[i]
    row.command_rate = math.sqrt(total / len(offset)) / period_s


@compiled
def read(physics: Physics, at: Any, world: int, row: Any) -> None:
    """State of a world as the physics has it; MuJoCo's wrench acts on the foot, ours on the leg."""
    qpos, qvel = physics.qpos[world], physics.qvel[world]
    for i in range(len(row.theta)):
        row.theta[i], row.theta_dot[i] = qpos[at.theta[i]], qvel[at.theta_dot[i]]
        row.q[i], row.q_dot[i] = qpos[at.q[i]], qvel[at.q_dot[i]]
        row.servo_torque[i] = physics.actuator_force[world, i]
    for i in range(3):
        row.pelvis[i], row.pelvis_velocity[i], row.pelvis_rate[i] = qpos[i], qvel[i], qvel[3 + i]
    for i in range(4):
        row.quaternion[i] = qpos[3 + i]
    for foot in range(2):
        for i in range(3):
            row.ankles[foot, i] = physics.site_xpos[world, at.ankles[foot], i]
            row.wrench[foot, 0, i] = -physics.sensordata[world, 6 * foot + i]
            row.wrench[foot, 1, i] = -physics.sensordata[world, 6 * foot + 3 + i]
    row.roll, row.pitch, row.tilt = attitude_of(row.quaternion)


@compiled
def attitude_of(quaternion: Array) -> tuple[float, float, float]:
    """Roll and pitch (of yaw, pitch, roll), and the angle between z axis and vertical [rad]."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    # the vertical in the frame of the pelvis
    return attitude_by(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


@compiled
def attitude_by(up_x: float, up_y: float, up_z: float) -> tuple[float, float, float]:
    """As `attitude_of`, by the vertical in the frame that is tilted, a unit vector [1]."""
    pitch = math.asin(min(max(-up_x, -1.0), 1.0))
    return math.atan2(up_y, up_z), pitch, math.atan2(math.hypot(up_x, up_y), up_z)


@compiled
def feet_to_be_filled() -> tuple[Array, Array, Array]:
    """Orientation of two feet, (2, 3, 3), force and moment of the ground on them, (2, 3) each, for `stand`."""
    return np.empty((2, 3, 3)), np.empty((2, 3)), np.empty((2, 3))


@compiled
def stand(physics: Physics, constants: Any, world: int, row: Any, feet: tuple[Array, Array, Array]) -> None:
    """Force of the ground on the feet, and the ZMP."""
    foot_R, force, moment = feet
    for foot in range(2):
        for i in range(3):
            for j in range(3):
                foot_R[foot, i, j] = physics.site_xmat[world, constants.at.ankles[foot], 3 * i + j]
    ground_wrench(row.wrench, foot_R, constants.foot_com, constants.foot_weight, force, moment)
    moment_point(force, moment, row.ankles, constants.rules.zmp_n, row.zmp)
    row.force[0], row.force[1] = force[0, 2], force[1, 2]


@compiled
def watch_swing_foot(row: Any, planned: Any, loaded_n: float) -> None:
    """Since when the swing foot has been on the ground in the second half of its swing."""
    if planned.half_of_swing == FIRST_HALF:
        row.contact_since = -1
    if planned.half_of_swing == SECOND_HALF and row.contact_since < 0 and row.force[planned.swing_foot] > loaded_n:
        row.contact_since = row.step


@compiled
def measure(inertial: Any, row: Any, noise: Any, bias: Any, quality: Any, imu_is_due: bool, shown: Any) -> None:
    """What encoders, IMU and foot sensors show; an IMU that is not due shows its last sample."""
    for i in range(len(shown.encoder)):
        shown.encoder_before[i] = shown.encoder[i]
        angle = row.theta[i] + bias.encoder[i]
        shown.encoder[i] = in_whole_counts(angle, quality.count_rad) if quality.count_rad > 0.0 else angle
    for foot in range(2):
        for i in range(3):
            force, moment = row.wrench[foot, 0, i], row.wrench[foot, 1, i]
            shown.wrench[foot, 0, i] = noise.wrench[foot, 0, i] * quality.noise.wrench[foot, 0, i] + force
            shown.wrench[foot, 1, i] = noise.wrench[foot, 1, i] * quality.noise.wrench[foot, 1, i] + moment
    if imu_is_due:
        if show_inertial(inertial, bias, quality, shown):
            return
        for i, angle in enumerate((row.roll, row.pitch)):
            drawn = quality.noise.imu_attitude[i] * noise.imu_attitude[i]
            shown.imu_attitude[i] = shown_angle(
                angle, bias.imu_attitude[i], drawn, quality.imu_bias_rad, quality.imu_sine_error_rad
            )
        for i in range(3):
            shown.imu_rate[i] = noise.imu_rate[i] * quality.noise.imu_rate[i] + row.pelvis_rate[i]


@compiled
def show_inertial(inertial: Any, bias: Any, quality: Any, shown: Any) -> bool:
    """What an inertial IMU shows of its own state, and whether one is fitted: errors of the mounting come on top."""
    if inertial is None:
        return False
    if not inertial[bias.fit].is_fitted:
        return False
    roll, pitch, _ = attitude_by(shown.imu_up[0], shown.imu_up[1], shown.imu_up[2])
    for i, angle in enumerate((roll, pitch)):
        shown.imu_attitude[i] = shown_angle(
            angle, bias.imu_attitude[i], 0.0, quality.imu_bias_rad, quality.imu_sine_error_rad
        )
    for i in range(3):
        shown.imu_rate[i] = shown.imu_gyro[i]
    return True


@compiled
def settle_imu(inertial: Any, row: Any, noise: Any, bias: Any, quality: Any, shown: Any) -> None:
    """An inertial IMU that has been at rest for long: its filter has settled, a bias of the gyroscope included."""
    if inertial is None:
        return
    sensor, force = inertial[bias.fit], np.empty(3)
    if not sensor.is_fitted:
        return
    specific_force(row, row, 1.0, sensor.gravity_m_s2, force)
    for i in range(3):
        force[i] += bias.specific_force[i]
        shown.imu_gyro[i] = bias.gyro[i] + noise.imu_rate[i] * quality.noise.imu_rate[i]
    settled_vertical(shown.imu_up, force, bias.gyro, sensor.time_constant_s)


@compiled
def advance_imu(inertial: Any, before: Any, row: Any, noise: Any, bias: Any, constants: Any, shown: Any) -> None:
    """What an inertial IMU makes of a control period: its gyroscope's mean rate, and the vertical by its filter.

    Args:
        inertial: Rows of `INERTIAL`, or None.
        before: Truth at the beginning of the period.
        row: And at its end.
        noise: Sample of the sensors; that of the attitude is of the accelerometer, across the vertical.
        bias: Of the world.
        constants: One row of `CONSTANTS`.
        shown: Measurements, whose `imu_gyro` and `imu_up` are brought up to date.
    """
    if inertial is None:
        return
    sensor, quality, period_s = inertial[bias.fit], constants.quality, constants.rules.control_period_s
    if not sensor.is_fitted:
        return
    force, turned = np.empty(3), np.empty(3)
    specific_force(before, row, period_s, sensor.gravity_m_s2, force)
    rotation_between(before.quaternion, row.quaternion, turned)
    # a force to the left is a positive roll, one forward a negative pitch
    force[0] -= sensor.gravity_m_s2 * quality.noise.imu_attitude[1] * noise.imu_attitude[1]
    force[1] += sensor.gravity_m_s2 * quality.noise.imu_attitude[0] * noise.imu_attitude[0]
    for i in range(3):
        force[i] += bias.specific_force[i]
        rate = turned[i] / period_s + bias.gyro[i] + noise.imu_rate[i] * quality.noise.imu_rate[i]
        shown.imu_gyro[i], turned[i] = rate, rate * period_s
    complementary_filter(shown.imu_up, turned, force, 1.0 - math.exp(-period_s / sensor.time_constant_s))


@compiled
def specific_force(before: Any, row: Any, period_s: float, gravity_m_s2: float, force: Array) -> None:
    """Mean specific force over a period, acceleration minus gravity, in the frame at its end: into `force` [m/s²]."""
    w, x, y, z = row.quaternion[0], row.quaternion[1], row.quaternion[2], row.quaternion[3]
    a = (row.pelvis_velocity[0] - before.pelvis_velocity[0]) / period_s
    b = (row.pelvis_velocity[1] - before.pelvis_velocity[1]) / period_s
    c = (row.pelvis_velocity[2] - before.pelvis_velocity[2]) / period_s + gravity_m_s2
    force[0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c
    force[1] = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c
    force[2] = 2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c


@compiled
def rotation_between(before: Array, after: Array, turned: Array) -> None:
    """Rotation vector from one unit quaternion to another, in the frame that turns: into `turned`, (3,) [rad]."""
    a, b = before, after
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    turned[0] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    turned[1] = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
    turned[2] = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
    sine = math.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2)
    # q and −q are one rotation: the shorter way
    scale = 2.0 * math.atan2(sine, abs(w)) / sine if sine > 0.0 else 2.0
    for i in range(3):
        turned[i] *= math.copysign(scale, w)


@compiled
def complementary_filter(up: Array, turned: Array, force: Array, gain: float) -> None:
    r"""One step of a complementary filter of the vertical, the explicit one of [Mahony2008] without bias estimation.

    .. math:: \dot u = u \times (\omega + \tfrac{1}{\tau} \, f / |f| \times u)

    Args:
        up: Vertical in the frame of the sensor, a unit vector, which is brought up to date, (3,) [1].
        turned: Rotation of the sensor by its gyroscope, as a vector in its frame, (3,) [rad].
        force: Specific force by its accelerometer in the frame after it, (3,) [m/s²].
        gain: 1 − exp(−period/τ) [1].
    """
    angle = math.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2)
    # what stands still in the world turns backwards in the frame of the sensor
    sine = math.sin(angle) / angle if angle > 0.0 else 1.0
    cosine = (1.0 - math.cos(angle)) / (angle * angle) if angle > 0.0 else 0.5
    x, y, z = up[0], up[1], up[2]
    p, q, r = cross(x, y, z, turned)
    s, t, u = cross(p, q, r, turned)
    x, y, z = x + sine * p + cosine * s, y + sine * q + cosine * t, z + sine * r + cosine * u
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if size > 0.0:
        a, b, c = force[0] / size, force[1] / size, force[2] / size
        along = a * x + b * y + c * z
        x, y, z = x + gain * (a - along * x), y + gain * (b - along * y), z + gain * (c - along * z)
    size = math.sqrt(x * x + y * y + z * z)
    up[0], up[1], up[2] = x / size, y / size, z / size


@compiled
def settled_vertical(up: Array, force: Array, gyro: Array, time_constant_s: float) -> None:
    """The vertical where the filter rests, for a constant force and a small bias of the gyroscope: into `up`, (3,)."""
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    x, y, z = force[0] / size, force[1] / size, force[2] / size
    p, q, r = cross(x, y, z, gyro)
    x, y, z = x + time_constant_s * p, y + time_constant_s * q, z + time_constant_s * r
    size = math.sqrt(x * x + y * y + z * z)
    up[0], up[1], up[2] = x / size, y / size, z / size


@compiled
def cross(x: float, y: float, z: float, other: Array) -> tuple[float, float, float]:
    """Cross product of (x, y, z) with another vector."""
    return y * other[2] - z * other[1], z * other[0] - x * other[2], x * other[1] - y * other[0]


@within_compiled
def in_whole_counts(angle: Any, count_rad: Any) -> Any:
    """The nearest whole counts of an encoder, as an angle [rad]."""
    return np.rint(angle / count_rad) * count_rad


@within_compiled
def shown_angle(angle: Any, drawn_bias: Any, noise: Any, bias_rad: float, sine_error_rad: float) -> Any:
    """An angle by the IMU, see `elastic_env.runtime.sensors.attitude` [rad]."""
    return angle + drawn_bias + noise + (bias_rad + sine_error_rad * np.sin(angle))


@compiled
def end(row: Any, rules: Any, has_diverged: bool, is_last: bool, ends: BoolArray) -> bool:
    """Say what ends the episode of a world, if anything does; speeds beyond all physics are no fall."""
    for i in range(len(row.theta_dot)):
        fastest = max(abs(row.theta_dot[i]), abs(row.q_dot[i]))
        has_diverged = has_diverged or fastest > rules.highest_rad_s
    is_down = row.pelvis[2] < rules.lowest_pelvis_m or row.tilt > rules.highest_tilt_rad
    has_fallen = is_down and not has_diverged
    is_terminated = has_diverged or has_fallen
    ends[0], ends[1], ends[2], ends[3] = has_diverged, has_fallen, is_terminated, is_last and not is_terminated
    return is_terminated or is_last


@compiled
def score(row: Any, planned: Any, weights: Any, is_terminated: bool, terms: Any) -> float:
    """Weighted terms of the reward, and their sum."""
    deviation = math.hypot(row.zmp[0] - planned.zmp[0], row.zmp[1] - planned.zmp[1])
    terms.tilt = weights.tilt * planned.weight * tilt_penalty(row.tilt)
    terms.zmp = weights.zmp * planned.weight * zmp_penalty(deviation)
    terms.effort = weights.effort * effort_penalty(row.servo_torque)
    terms.smoothness = weights.smoothness * smoothness_penalty(row.command_rate)
    terms.fall = weights.fall * fall_penalty(is_terminated)
    return terms.tilt + terms.zmp + terms.effort + terms.smoothness + terms.fall


@compiled
def tilt_penalty(tilt: Parameter) -> Any:
    """−|tilt| [rad]: linear, so that a large error never stops to matter."""
    return -np.abs(tilt)


@compiled
def zmp_penalty(zmp_deviation: Parameter) -> Any:
    """−ZMP deviation [m], a distance; none where the feet are not loaded and it is nan."""
    return -np.fmax(zmp_deviation, 0.0)


@compiled
def effort_penalty(servo_torque: Array) -> float:
    """−rms of the servos' torques over the joints [N·m]."""
    return -rms(servo_torque)


@compiled
def smoothness_penalty(command_rate: float) -> float:
    """−rms over the joints of the change of the offsets [rad/s]."""
    return -command_rate


@compiled
def fall_penalty(is_terminated: bool) -> float:
    """−1 in the step in which the robot falls or the simulation diverges."""
    return -1.0 if is_terminated else 0.0


@compiled
def observe(row: Any, shown: Any, coming: Any, period_s: float, observed: Any) -> None:
    """What a policy sees, see the table of `elastic_env.robots.thormang.task`."""
    for i in range(len(observed.encoder_angle)):
        observed.encoder_angle[i] = shown.encoder[i]
        observed.encoder_rate[i] = (shown.encoder[i] - shown.encoder_before[i]) / period_s
        observed.reference_angle[i], observed.reference_rate[i] = coming.q[i], coming.q_dot[i]
        observed.reference_acceleration[i], observed.last_command[i] = coming.q_ddot[i], row.command[i]
    observed.load_share = coming.share
    for i in range(2):
        observed.imu_attitude[i], observed.zmp_reference[i] = shown.imu_attitude[i], coming.zmp[i]
    for i in range(3):
        observed.imu_rate[i], observed.clock[i] = shown.imu_rate[i], coming.clock[i]
        for foot in range(2):
            observed.wrench[foot, 0, i], observed.wrench[foot, 1, i] = (
                shown.wrench[foot, 0, i],
                shown.wrench[foot, 1, i],
            )


@compiled
def rms(values: Array) -> float:
    """Root of the mean square, added in order."""
    total = 0.0
    for value in values:
        total += value * value
    return math.sqrt(total / len(values))


@compiled
def rms_of_rows(values: Array) -> Array:
    """`rms` of every row of (n, m)."""
    found = np.empty(len(values))
    for row in range(len(values)):
        found[row] = rms(values[row])
    return found


@compiled
def ground_wrench(sensors: Array, foot_R: Array, com: Array, weight: Array, force: Array, moment: Array) -> None:
    """Wrench of the ground on the feet of one robot, see `FootSensors`: into `force` and `moment`, (L, 3)."""
    c = np.empty(3)
    for foot in range(len(sensors)):
        R, (f, n), w = foot_R[foot], sensors[foot], weight[foot]
        for i in range(3):
            c[i] = R[i, 0] * com[foot, 0] + R[i, 1] * com[foot, 1] + R[i, 2] * com[foot, 2]
            force[foot, i] = R[i, 0] * f[0] + R[i, 1] * f[1] + R[i, 2] * f[2] - w[i]
            moment[foot, i] = R[i, 0] * n[0] + R[i, 1] * n[1] + R[i, 2] * n[2]
        moment[foot, 0] -= c[1] * w[2] - c[2] * w[1]
        moment[foot, 1] -= c[2] * w[0] - c[0] * w[2]
        moment[foot, 2] -= c[0] * w[1] - c[1] * w[0]


@compiled
def moment_point(force: Array, moment: Array, ankle: Array, least_n: float, zmp: Array) -> None:
    """ZMP of one robot, see `zero_moment_point`: into `zmp`, (2,)."""
    about_x = about_y = vertical = 0.0
    for foot in range(len(force)):
        f, n, p = force[foot], moment[foot], ankle[foot]
        about_x += p[1] * f[2] - p[2] * f[1] + n[0]
        about_y += p[2] * f[0] - p[0] * f[2] + n[1]
        vertical += f[2]
    scale = vertical if vertical >= least_n else np.nan
    zmp[0], zmp[1] = -about_y / scale, about_x / scale


@compiled
def ground_wrenches(sensors: Array, foot_R: Array, com: Array, weight: Array, force: Array, moment: Array) -> None:
    """`ground_wrench` of several robots."""
    for row in range(len(sensors)):
        ground_wrench(sensors[row], foot_R[row], com, weight, force[row], moment[row])


@compiled
def moment_points(force: Array, moment: Array, ankle: Array, least_n: float, zmp: Array) -> None:
    """`moment_point` of several robots."""
    for row in range(len(force)):
        moment_point(force[row], moment[row], ankle[row], least_n, zmp[row])
