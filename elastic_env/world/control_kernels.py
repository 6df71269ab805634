"""A control step but for the physics, compiled: command, read, measure, score, observe.

One pass over the worlds, between MuJoCo's state and the observation. A world's numbers depend on
its own row alone. Records have their fields by name, see `elastic_env.world.rows`. All robots share
the joints. What comes on top stands behind them: links on a fixed base, and a walker.

Numba keeps compiled code by the file of the function that was called. So everything that a kernel
calls stands in this file, and every size comes from a type or from an array. A kernel that Python
calls takes plain tuples and names their parts itself: Numba takes a microsecond more for a tuple
with names.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from elastic_env.core.compiled import compiled, within_compiled
from elastic_env.core.signals import Array, BoolArray, IntArray, Parameter

FIRST_HALF = 1
SECOND_HALF = 2
"""Of a swing; 0 is none."""


class Joints(NamedTuple):
    """Constants of the joints within an episode.

    Attributes:
        at: Where they stand in the physics, (n,).
        columns: Where they stand in the observation, (1,).
        plans: Angle, rate and acceleration of the reference at every step, (plans, steps, 3, n).
        plan: Which of the plans each world follows, (num_worlds,).
        rules: Records of `RULES`, (kinds,).
        kind: Which of the rules, and of all other constants, hold in each world, (num_worlds,).
    """

    at: Any
    columns: Any
    plans: Array
    plan: IntArray
    rules: Any
    kind: IntArray


class Noise(NamedTuple):
    """Standard normal samples ahead, (block, n), and how many of each world's are used, (n,)."""

    samples: Any
    used: IntArray


class Commanded(NamedTuple):
    """Commands of the control step that has gone by.

    Attributes:
        offset: Within their bounds, (num_worlds, n) [rad].
        is_clipped: Worlds whose action was beyond its bounds.
        diverged: Worlds that diverged, to which those too fast are added. They keep truth and
            measurements.
        periods: Control periods that have gone by, more than 1 where hardware has missed some.
    """

    offset: Array
    is_clipped: BoolArray
    diverged: BoolArray
    periods: float


class Steps(NamedTuple):
    """The control step before, and the present one, which is filled.

    Joints are (num_worlds, n), worlds (num_worlds,).
    """

    last_joints: Any
    joints: Any
    last_worlds: Any
    worlds: Any


class Results(NamedTuple):
    """Arrays that a step fills beside its records.

    Attributes:
        observed: Observation, (num_worlds, columns).
        reward: (num_worlds,).
        ends: Whether a world diverged, failed in other ways, is terminated, is truncated, (ways,
            num_worlds).
    """

    observed: Array
    reward: Array
    ends: BoolArray


@compiled
def command(
    joints: Any,
    last_joints: Any,
    last_worlds: Any,
    action: Array,
    bound: Array,
    is_clipped: BoolArray,
    inputs: Array,
) -> bool:
    """Servo inputs of the coming control period, q_ref + offset.

    Encoders are off by their homing error.

    Args:
        joints: `Joints`.
        last_joints: Records of the present step, (num_worlds, n).
        last_worlds: The same of the worlds, (num_worlds,).
        action: Offsets, (num_worlds, n) [rad], which are brought within their bounds.
        bound: Of every joint [rad].
        is_clipped: To be filled: worlds with an action beyond its bounds.
        inputs: To be filled [rad].

    Returns:
        Whether all offsets are finite; if not, no input is written.
    """
    joints = Joints(*joints)
    for world in range(len(action)):
        for i in range(len(bound)):
            if not np.isfinite(action[world, i]):
                return False
    for world in range(len(action)):
        is_clipped[world] = False
        plan = joints.plans[joints.plan[world]]
        coming = min(last_worlds[world].truth.step + 1, len(plan) - 1)
        for i in range(len(bound)):
            value = action[world, i]
            offset = min(max(value, -bound[i]), bound[i])
            if offset != value:
                is_clipped[world] = True
            action[world, i] = offset
            inputs[world, joints.at[i].servo] = (
                plan[coming, 0, i] + offset - last_joints[world, i].truth.homing
            )
    return True


@compiled
def begin_joints(qpos: Array, qvel: Array, joints: Joints, worlds: BoolArray, steps: Steps) -> None:
    """Truth and measurements of joints at the start of an episode in some worlds.

    The joints have been at rest.
    """
    for world in range(len(worlds)):
        if worlds[world]:
            course = steps.worlds[world].truth
            course.step = 0
            course.command_rate = 0.0
            course.clipped = False
            course.diverged = False
            rules = joints.rules[joints.kind[world]]
            plan = joints.plans[joints.plan[world]]
            for i in range(len(joints.at)):
                joint = steps.joints[world, i]
                joint.truth.q_ref = plan[0, 0, i]
                joint.truth.command = plan[0, 0, i]
                joint.truth.offset = 0.0
                joint.truth.command_rate = 0.0
                read_joint(qpos[world], qvel[world], joints.at[i], joint.truth)
                show_encoder(joint.truth, rules.count_rad, joint.shown)
                joint.shown.encoder_before = joint.shown.encoder


@compiled
def sense_joints(
    qpos: Array, qvel: Array, joints: Joints, commanded: Commanded, steps: Steps, observed: Array
) -> None:
    """Joints after the physics of a control step: keep the command, read, measure, observe."""
    offset = commanded.offset
    diverged = commanded.diverged
    n = len(joints.at)
    for world in range(len(offset)):
        rules = joints.rules[joints.kind[world]]
        plan = joints.plans[joints.plan[world]]
        steps.worlds[world] = steps.last_worlds[world]
        course = steps.worlds[world].truth
        course.step += 1
        course.clipped = commanded.is_clipped[world]
        total = 0.0
        for i in range(n):
            steps.joints[world, i] = steps.last_joints[world, i]
            truth = steps.joints[world, i].truth
            truth.q_ref = plan[min(course.step, len(plan) - 1), 0, i]
            change = offset[world, i] - truth.offset
            truth.offset = offset[world, i]
            truth.command = truth.q_ref + truth.offset
            truth.command_rate = change / rules.control_period_s
            total += change * change
            fastest = max(
                abs(qvel[world, joints.at[i].theta_dot]), abs(qvel[world, joints.at[i].q_dot])
            )
            diverged[world] = diverged[world] or fastest > rules.highest_rad_s
        course.command_rate = math.sqrt(total / n) / rules.control_period_s
        course.diverged = diverged[world]
        if not diverged[world]:
            for i in range(n):
                joint = steps.joints[world, i]
                read_joint(qpos[world], qvel[world], joints.at[i], joint.truth)
                joint.shown.encoder_before = joint.shown.encoder
                show_encoder(joint.truth, rules.count_rad, joint.shown)
        visible = steps.last_joints[world] if rules.is_delayed else steps.joints[world]
        period_s = rules.control_period_s * commanded.periods
        observe_joints(
            joints, plan, course.step, steps.joints[world], visible, period_s, observed[world]
        )


@compiled
def show_joints(joints: Any, steps: Any, observed: Array) -> None:
    """The joints' columns of observations of the present state."""
    joints = Joints(*joints)
    steps = Steps(*steps)
    for world in range(len(observed)):
        rules = joints.rules[joints.kind[world]]
        plan = joints.plans[joints.plan[world]]
        visible = steps.last_joints[world] if rules.is_delayed else steps.joints[world]
        step = steps.worlds[world].truth.step
        observe_joints(
            joints,
            plan,
            step,
            steps.joints[world],
            visible,
            rules.control_period_s,
            observed[world],
        )


@compiled
def read_joint(qpos: Array, qvel: Array, at: Any, truth: Any) -> None:
    """State of a joint as the physics has it."""
    truth.theta = qpos[at.theta]
    truth.theta_dot = qvel[at.theta_dot]
    truth.q = qpos[at.q]
    truth.q_dot = qvel[at.q_dot]


@compiled
def show_encoder(truth: Any, count_rad: float, shown: Any) -> None:
    """The motor's angle by its encoder."""
    angle = truth.theta + truth.homing
    shown.encoder = in_whole_counts(angle, count_rad) if count_rad > 0.0 else angle


@compiled
def observe_joints(
    joints: Joints,
    plan: Array,
    step: int,
    present: Any,
    visible: Any,
    period_s: float,
    observed: Array,
) -> None:
    """Fill the joints' columns of an observation, the coming reference among them."""
    columns = joints.columns[0]
    coming = min(step + 1, len(plan) - 1)
    for i in range(len(joints.at)):
        shown = visible[i].shown
        observed[columns.encoder_angle + i] = shown.encoder
        observed[columns.encoder_rate + i] = (shown.encoder - shown.encoder_before) / period_s
        observed[columns.reference_angle + i] = plan[coming, 0, i]
        observed[columns.reference_rate + i] = plan[coming, 1, i]
        observed[columns.reference_acceleration + i] = plan[coming, 2, i]
        observed[columns.last_command + i] = present[i].truth.command


# links on a fixed base


class Links(NamedTuple):
    """Constants of links on a fixed base.

    Attributes:
        schedule: What the reference says of every step, (steps,).
        constants: Weights of the reward and quality of the IMU, (1,).
        imu_bias: Offset of the IMU on the only link, (num_worlds,) [rad].
        imu_column: Where it is observed, −1 for nowhere.
        imu_angle: Angle of the link as an inertial IMU computes it, (num_worlds,) [rad]; None for
            one that shows the true angle with its errors.
    """

    schedule: Any
    constants: Any
    imu_bias: Array
    imu_column: int
    imu_angle: Any


@compiled
def begin_links(
    qpos: Array, qvel: Array, joints: Any, links: Any, noise: Any, worlds: BoolArray, steps: Any
) -> None:
    """Truth and measurements of links at the start of an episode in some worlds.

    The links have been at rest.
    """
    joints = Joints(*joints)
    links = Links(*links)
    noise = Noise(*noise)
    steps = Steps(*steps)
    begin_joints(qpos, qvel, joints, worlds, steps)
    for world in range(len(worlds)):
        if worlds[world]:
            truth = steps.worlds[world].truth
            shown = steps.worlds[world].shown
            truth.scored = links.schedule[0].scored
            truth.rest = links.schedule[0].rest
            constants = links.constants[0]
            q = steps.joints[world, 0].truth.q
            show_link(noise, world, q, links.imu_angle, links.imu_bias[world], constants, shown)
            shown.visible_imu = shown.imu


@compiled
def sense_links(
    qpos: Array,
    qvel: Array,
    joints: Any,
    links: Any,
    noise: Any,
    commanded: Any,
    steps: Any,
    results: Any,
) -> bool:
    """Everything after the physics where the base is fixed: read, measure, end, score, observe.

    Args:
        qpos: Positions of all worlds.
        qvel: And speeds.
        joints: `Joints`.
        links: `Links`.
        noise: Of the IMU, `Noise`.
        commanded: `Commanded`.
        steps: `Steps`.
        results: To be filled, `Results`.

    Returns:
        Whether an episode ends.
    """
    joints = Joints(*joints)
    links = Links(*links)
    noise = Noise(*noise)
    commanded = Commanded(*commanded)
    steps = Steps(*steps)
    results = Results(*results)
    sense_joints(qpos, qvel, joints, commanded, steps, results.observed)
    diverged = commanded.diverged
    is_over = False
    for world in range(len(diverged)):
        kind = joints.kind[world]
        constants = links.constants[0]
        truth = steps.worlds[world].truth
        shown = steps.worlds[world].shown
        scores = steps.worlds[world].scores
        last = len(links.schedule) - 1
        planned = links.schedule[min(truth.step, last)]
        truth.scored = planned.scored
        truth.rest = planned.rest
        if planned.imu_is_due and not diverged[world]:
            q = steps.joints[world, 0].truth.q
            show_link(noise, world, q, links.imu_angle, links.imu_bias[world], constants, shown)
        is_delayed = joints.rules[kind].is_delayed
        shown.visible_imu = steps.last_worlds[world].shown.imu if is_delayed else shown.imu
        if links.imu_column >= 0:
            results.observed[world, links.imu_column] = shown.visible_imu
        ends = results.ends[:, world]
        ends[0] = ends[1] = diverged[world]
        ends[2] = truth.step >= last and not diverged[world]
        is_over = is_over or ends[0] or ends[2]
        total = 0.0
        for i in range(len(joints.at)):
            error = steps.joints[world, i].truth.q_ref - steps.joints[world, i].truth.q
            total += error * error
        weights = constants.weights  # of penalties that grow without saturating
        scores.link_error = weights.link_error * -math.sqrt(total / len(joints.at))
        scores.command_rate = weights.command_rate * -truth.command_rate
        scores.divergence = weights.divergence * (-1.0 if diverged[world] else -0.0)
        results.reward[world] = scores.link_error + scores.command_rate + scores.divergence
    return is_over


@compiled
def show_link(
    noise: Noise, world: int, q: float, imu_angle: Any, imu_bias: float, constants: Any, shown: Any
) -> None:
    """The next sample of the IMU on the only link, see `Links`."""
    drawn = sample_of(noise, world)
    if imu_angle is None:
        angle = q
        added = constants.imu_noise_rad * drawn.imu
    else:
        angle = imu_angle[world]
        added = 0.0
    shown.imu = shown_angle(
        angle, imu_bias, added, constants.imu_bias_rad, constants.imu_sine_error_rad
    )


# walkers


class Physics(NamedTuple):
    """MuJoCo's arrays that a step of a walker reads, one row per world."""

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
        plan: One record per control step.
        bias: Errors of mounting, and of an inertial IMU, (num_worlds,).
        inertial: Records of `INERTIAL` beside the constants, or None where no robot has such an
            IMU: its filter is then not even compiled.
        columns: Where the observation has what they show, (1,).
    """

    constants: Any
    plan: Any
    bias: Any
    inertial: Any
    columns: Any


@compiled
def begin_walk(
    physics: Any, joints: Any, walker: Any, noise: Any, worlds: BoolArray, steps: Any
) -> None:
    """Truth and measurements of walkers at the start of an episode in some worlds.

    The walkers have been at rest.
    """
    physics = Physics(*physics)
    joints = Joints(*joints)
    walker = Walker(*walker)
    noise = Noise(*noise)
    steps = Steps(*steps)
    begin_joints(physics.qpos, physics.qvel, joints, worlds, steps)
    for world in range(len(worlds)):
        if worlds[world]:
            truth = steps.worlds[world].truth
            shown = steps.worlds[world].shown
            kind = joints.kind[world]
            constants = walker.constants[kind]
            truth.contact_since = -1
            read_body(physics, constants, world, truth)
            stand(physics, constants, world, truth)
            drawn = sample_of(noise, world)
            is_due = walker.plan[0].imu_is_due
            settle_imu(walker.inertial, walker, kind, world, truth, drawn, shown)
            measure(walker.inertial, walker, kind, world, truth, drawn, is_due, shown)


@compiled
def sense_walk(
    physics: Any, joints: Any, walker: Any, noise: Any, commanded: Any, steps: Any, results: Any
) -> bool:
    """Everything after the physics in a walker: read, measure, end, score, observe.

    Args:
        physics: State of all worlds, `Physics`.
        joints: `Joints`.
        walker: `Walker`.
        noise: Of the sensors, `Noise`.
        commanded: `Commanded`.
        steps: `Steps`.
        results: To be filled, `Results`.

    Returns:
        Whether an episode ends.
    """
    physics = Physics(*physics)
    joints = Joints(*joints)
    walker = Walker(*walker)
    noise = Noise(*noise)
    commanded = Commanded(*commanded)
    steps = Steps(*steps)
    results = Results(*results)
    sense_joints(physics.qpos, physics.qvel, joints, commanded, steps, results.observed)
    diverged = commanded.diverged
    is_over = False
    for world in range(len(diverged)):
        kind = joints.kind[world]
        last = steps.last_worlds[world]
        constants = walker.constants[kind]
        rules = constants.rules
        truth = steps.worlds[world].truth
        shown = steps.worlds[world].shown
        scores = steps.worlds[world].scores
        planned = row_of(walker.plan, truth.step)
        if not diverged[world]:
            read_body(physics, constants, world, truth)
            stand(physics, constants, world, truth)
            drawn = sample_of(noise, world)
            is_due = planned.imu_is_due
            period_s = joints.rules[kind].control_period_s
            before = last.truth
            advance_imu(walker.inertial, walker, kind, world, before, truth, drawn, period_s, shown)
            measure(walker.inertial, walker, kind, world, truth, drawn, is_due, shown)
        watch_swing_foot(truth, planned, rules.loaded_n)
        is_last = truth.step >= len(walker.plan) - 1
        is_over = end(truth, rules, diverged[world], is_last, results.ends[:, world]) or is_over
        results.reward[world] = score(
            truth, planned, rules.weights, results.ends[-2, world], scores
        )
        visible = last.shown if joints.rules[kind].is_delayed else shown
        observe_walk(
            visible, row_of(walker.plan, truth.step + 1), walker.columns[0], results.observed[world]
        )
    return is_over


@compiled
def show_walk(joints: Any, walker: Any, steps: Any, observed: Array) -> None:
    """The walker's columns of observations of the present state."""
    joints = Joints(*joints)
    walker = Walker(*walker)
    steps = Steps(*steps)
    for world in range(len(observed)):
        is_delayed = joints.rules[joints.kind[world]].is_delayed
        visible = steps.last_worlds[world].shown if is_delayed else steps.worlds[world].shown
        coming = row_of(walker.plan, steps.worlds[world].truth.step + 1)
        observe_walk(visible, coming, walker.columns[0], observed[world])


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
def read_body(physics: Physics, constants: Any, world: int, row: Any) -> None:
    """State of pelvis and feet as the physics has it.

    MuJoCo's wrench acts on the foot, ours on the leg.
    """
    qpos = physics.qpos[world]
    qvel = physics.qvel[world]
    at = constants.at
    row.servo_torque = rms(physics.actuator_force[world])
    for i in range(3):
        row.pelvis[i] = qpos[i]
        row.pelvis_velocity[i] = qvel[i]
        row.pelvis_rate[i] = qvel[3 + i]
    for i in range(4):
        row.quaternion[i] = qpos[3 + i]
    for foot in range(2):
        for i in range(3):
            row.ankles[foot, i] = physics.site_xpos[world, at.ankles[foot], i]
            row.wrench[foot, 0, i] = -physics.sensordata[world, 6 * foot + i]
            row.wrench[foot, 1, i] = -physics.sensordata[world, 6 * foot + 3 + i]
    w = row.quaternion[0]
    x = row.quaternion[1]
    y = row.quaternion[2]
    z = row.quaternion[3]
    up_x = 2.0 * (x * z - w * y)
    up_y = 2.0 * (y * z + w * x)
    row.roll, row.pitch, row.tilt = attitude_by(up_x, up_y, 1.0 - 2.0 * (x * x + y * y))


@compiled
def attitude_by(up_x: float, up_y: float, up_z: float) -> tuple[float, float, float]:
    """Roll and pitch (of yaw, pitch, roll), and the angle between z axis and vertical [rad].

    They follow from the vertical in the frame that is tilted, a unit vector [1].
    """
    pitch = math.asin(min(max(-up_x, -1.0), 1.0))
    return math.atan2(up_y, up_z), pitch, math.atan2(math.hypot(up_x, up_y), up_z)


@compiled
def stand(physics: Physics, constants: Any, world: int, row: Any) -> None:
    """Force of the ground on the feet, and the ZMP."""
    foot_R = np.empty((2, 3, 3))
    force = np.empty((2, 3))
    moment = np.empty((2, 3))
    for foot in range(2):
        for i in range(3):
            for j in range(3):
                foot_R[foot, i, j] = physics.site_xmat[world, constants.at.ankles[foot], 3 * i + j]
    ground_wrench(row.wrench, foot_R, constants.foot_com, constants.foot_weight, force, moment)
    moment_point(force, moment, row.ankles, constants.rules.zmp_n, row.zmp)
    row.force[0] = force[0, 2]
    row.force[1] = force[1, 2]


@compiled
def watch_swing_foot(row: Any, planned: Any, loaded_n: float) -> None:
    """Since when the swing foot has been on the ground in the second half of its swing."""
    if planned.half_of_swing == FIRST_HALF:
        row.contact_since = -1
    if (
        planned.half_of_swing == SECOND_HALF
        and row.contact_since < 0
        and row.force[planned.swing_foot] > loaded_n
    ):
        row.contact_since = row.step


@compiled
def measure(
    inertial: Any,
    walker: Walker,
    kind: int,
    world: int,
    row: Any,
    noise: Any,
    imu_is_due: bool,
    shown: Any,
) -> None:
    """Sample IMU and foot sensors; an IMU that is not due shows its last sample."""
    bias = walker.bias[world]
    quality = walker.constants[kind].quality
    for foot in range(2):
        for i in range(3):
            force = row.wrench[foot, 0, i]
            moment = row.wrench[foot, 1, i]
            shown.wrench[foot, 0, i] = (
                noise.wrench[foot, 0, i] * quality.noise.wrench[foot, 0, i] + force
            )
            shown.wrench[foot, 1, i] = (
                noise.wrench[foot, 1, i] * quality.noise.wrench[foot, 1, i] + moment
            )
    if imu_is_due:
        if show_inertial(inertial, kind, bias, quality, shown):
            return
        for i, angle in enumerate((row.roll, row.pitch)):
            drawn = quality.noise.imu_attitude[i] * noise.imu_attitude[i]
            shown.imu_attitude[i] = shown_angle(
                angle, bias.imu_attitude[i], drawn, quality.imu_bias_rad, quality.imu_sine_error_rad
            )
        for i in range(3):
            shown.imu_rate[i] = noise.imu_rate[i] * quality.noise.imu_rate[i] + row.pelvis_rate[i]


@compiled
def show_inertial(inertial: Any, kind: int, bias: Any, quality: Any, shown: Any) -> bool:
    """Show the state of an inertial IMU, where one is fitted; the result says so.

    Errors of the mounting come on top.
    """
    if inertial is None:
        return False
    if not inertial[kind].is_fitted:
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
def settle_imu(
    inertial: Any, walker: Walker, kind: int, world: int, row: Any, noise: Any, shown: Any
) -> None:
    """Settle an inertial IMU that has been at rest for long, a bias of its gyroscope included."""
    if inertial is None:
        return
    sensor = inertial[kind]
    bias = walker.bias[world]
    quality = walker.constants[kind].quality
    force = np.empty(3)
    if not sensor.is_fitted:
        return
    specific_force(row, row, 1.0, sensor.gravity_m_s2, force)
    for i in range(3):
        force[i] += bias.specific_force[i]
        shown.imu_gyro[i] = bias.gyro[i] + noise.imu_rate[i] * quality.noise.imu_rate[i]
    settled_vertical(shown.imu_up, force, bias.gyro, sensor.time_constant_s)


@compiled
def advance_imu(
    inertial: Any,
    walker: Walker,
    kind: int,
    world: int,
    before: Any,
    row: Any,
    noise: Any,
    period_s: float,
    shown: Any,
) -> None:
    """Advance an inertial IMU by a control period.

    Its gyroscope measures the mean rate, and its filter turns the vertical.

    Args:
        inertial: That of `walker`, as an argument of its own: Numba then leaves out all of this
            where it is None.
        walker: `Walker`.
        kind: Which of its constants hold.
        world: Number of the world.
        before: Truth at the beginning of the period.
        row: And at its end.
        noise: Sample of the sensors; that of the attitude is of the accelerometer, across the
            vertical.
        period_s: Control period [s].
        shown: Measurements, whose `imu_gyro` and `imu_up` are brought up to date.
    """
    if inertial is None:
        return
    sensor = inertial[kind]
    bias = walker.bias[world]
    quality = walker.constants[kind].quality
    if not sensor.is_fitted:
        return
    force = np.empty(3)
    turned = np.empty(3)
    specific_force(before, row, period_s, sensor.gravity_m_s2, force)
    rotation_between(before.quaternion, row.quaternion, turned)
    # a force to the left is a positive roll, one forward a negative pitch
    force[0] -= sensor.gravity_m_s2 * quality.noise.imu_attitude[1] * noise.imu_attitude[1]
    force[1] += sensor.gravity_m_s2 * quality.noise.imu_attitude[0] * noise.imu_attitude[0]
    for i in range(3):
        force[i] += bias.specific_force[i]
        rate = turned[i] / period_s + bias.gyro[i] + noise.imu_rate[i] * quality.noise.imu_rate[i]
        shown.imu_gyro[i] = rate
        turned[i] = rate * period_s
    complementary_filter(
        shown.imu_up, turned, force, 1.0 - math.exp(-period_s / sensor.time_constant_s)
    )


@compiled
def specific_force(
    before: Any, row: Any, period_s: float, gravity_m_s2: float, force: Array
) -> None:
    """Mean specific force over a period, in the frame at its end: into `force` [m/s²].

    It is acceleration minus gravity.
    """
    w = row.quaternion[0]
    x = row.quaternion[1]
    y = row.quaternion[2]
    z = row.quaternion[3]
    a = (row.pelvis_velocity[0] - before.pelvis_velocity[0]) / period_s
    b = (row.pelvis_velocity[1] - before.pelvis_velocity[1]) / period_s
    c = (row.pelvis_velocity[2] - before.pelvis_velocity[2]) / period_s + gravity_m_s2
    force[0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c
    force[1] = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c
    force[2] = 2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c


@compiled
def rotation_between(before: Array, after: Array, turned: Array) -> None:
    """Rotation vector from one unit quaternion to another: into `turned`, (3,) [rad].

    It stands in the frame that turns.
    """
    a = before
    b = after
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
    r"""One step of the explicit complementary filter of the vertical [Mahony2008].

    The bias is not estimated.

    .. math:: \dot u = u \times (\omega + \tfrac{1}{\tau} \, f / |f| \times u)

    Args:
        up: Vertical in the frame of the sensor, a unit vector, which is brought up to date, (3,)
            [1].
        turned: Rotation of the sensor by its gyroscope, as a vector in its frame, (3,) [rad].
        force: Specific force by its accelerometer in the frame after it, (3,) [m/s²].
        gain: 1 − exp(−period/τ) [1].
    """
    angle = math.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2)
    # what stands still in the world turns backwards in the frame of the sensor
    sine = math.sin(angle) / angle if angle > 0.0 else 1.0
    cosine = (1.0 - math.cos(angle)) / (angle * angle) if angle > 0.0 else 0.5
    x = up[0]
    y = up[1]
    z = up[2]
    p, q, r = cross(x, y, z, turned)
    s, t, u = cross(p, q, r, turned)
    x = x + sine * p + cosine * s
    y = y + sine * q + cosine * t
    z = z + sine * r + cosine * u
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if size > 0.0:
        a = force[0] / size
        b = force[1] / size
        c = force[2] / size
        along = a * x + b * y + c * z
        x = x + gain * (a - along * x)
        y = y + gain * (b - along * y)
        z = z + gain * (c - along * z)
    size = math.sqrt(x * x + y * y + z * z)
    up[0] = x / size
    up[1] = y / size
    up[2] = z / size


@compiled
def settled_vertical(up: Array, force: Array, gyro: Array, time_constant_s: float) -> None:
    """The vertical where the filter rests: into `up`, (3,).

    The force is constant, and the bias of the gyroscope is small.
    """
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    x = force[0] / size
    y = force[1] / size
    z = force[2] / size
    p, q, r = cross(x, y, z, gyro)
    x = x + time_constant_s * p
    y = y + time_constant_s * q
    z = z + time_constant_s * r
    size = math.sqrt(x * x + y * y + z * z)
    up[0] = x / size
    up[1] = y / size
    up[2] = z / size


@compiled
def cross(x: float, y: float, z: float, other: Array) -> tuple[float, float, float]:
    """Cross product of (x, y, z) with another vector."""
    return y * other[2] - z * other[1], z * other[0] - x * other[2], x * other[1] - y * other[0]


@within_compiled
def in_whole_counts(angle: Any, count_rad: Any) -> Any:
    """The nearest whole counts of an encoder, as an angle [rad]."""
    return np.rint(angle / count_rad) * count_rad


@within_compiled
def shown_angle(
    angle: Any, drawn_bias: Any, noise: Any, bias_rad: float, sine_error_rad: float
) -> Any:
    """An angle by the IMU, see `elastic_env.world.sensors.attitude` [rad]."""
    return angle + drawn_bias + noise + (bias_rad + sine_error_rad * np.sin(angle))


@compiled
def end(row: Any, rules: Any, has_diverged: bool, is_last: bool, ends: BoolArray) -> bool:
    """Say what ends the episode of a world, if anything does; what has diverged has not fallen."""
    is_down = row.pelvis[2] < rules.lowest_pelvis_m or row.tilt > rules.highest_tilt_rad
    has_fallen = is_down and not has_diverged
    is_terminated = has_diverged or has_fallen
    ends[0] = has_diverged
    ends[1] = has_fallen
    ends[2] = is_terminated
    ends[3] = is_last and not is_terminated
    return is_terminated or is_last


@compiled
def score(row: Any, planned: Any, weights: Any, is_terminated: bool, terms: Any) -> float:
    """Weighted terms of the reward, and their sum."""
    deviation = math.hypot(row.zmp[0] - planned.zmp[0], row.zmp[1] - planned.zmp[1])
    terms.tilt = weights.tilt * planned.weight * tilt_penalty(row.tilt)
    terms.zmp = weights.zmp * planned.weight * zmp_penalty(deviation)
    terms.effort = weights.effort * -row.servo_torque
    terms.smoothness = weights.smoothness * -row.command_rate
    terms.fall = weights.fall * (-1.0 if is_terminated else 0.0)
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
def observe_walk(shown: Any, coming: Any, columns: Any, observed: Array) -> None:
    """Fill the walker's columns of an observation, beside those of its joints."""
    observed[columns.load_share] = coming.share
    for i in range(2):
        observed[columns.imu_attitude + i] = shown.imu_attitude[i]
        observed[columns.zmp_reference + i] = coming.zmp[i]
    for i in range(3):
        observed[columns.imu_rate + i] = shown.imu_rate[i]
        observed[columns.clock + i] = coming.clock[i]
        for foot in range(2):
            observed[columns.wrench + 6 * foot + i] = shown.wrench[foot, 0, i]
            observed[columns.wrench + 6 * foot + 3 + i] = shown.wrench[foot, 1, i]


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
def ground_wrench(
    sensors: Array, foot_R: Array, com: Array, weight: Array, force: Array, moment: Array
) -> None:
    """Wrench of the ground on the feet of one robot: into `force` and `moment`, (L, 3).

    `FootSensors` has the equation.
    """
    c = np.empty(3)
    for foot in range(len(sensors)):
        R = foot_R[foot]
        f, n = sensors[foot]
        w = weight[foot]
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
        f = force[foot]
        n = moment[foot]
        p = ankle[foot]
        about_x += p[1] * f[2] - p[2] * f[1] + n[0]
        about_y += p[2] * f[0] - p[0] * f[2] + n[1]
        vertical += f[2]
    scale = vertical if vertical >= least_n else np.nan
    zmp[0] = -about_y / scale
    zmp[1] = about_x / scale


@compiled
def ground_wrenches(
    sensors: Array, foot_R: Array, com: Array, weight: Array, force: Array, moment: Array
) -> None:
    """`ground_wrench` of several robots."""
    for row in range(len(sensors)):
        ground_wrench(sensors[row], foot_R[row], com, weight, force[row], moment[row])


@compiled
def moment_points(force: Array, moment: Array, ankle: Array, least_n: float, zmp: Array) -> None:
    """`moment_point` of several robots."""
    for row in range(len(force)):
        moment_point(force[row], moment[row], ankle[row], least_n, zmp[row])
