"""Compiled control step of joints without the physics: command, read, measure, observe, score.

One pass over the worlds, between MuJoCo's state and the observation. A world's numbers depend only
on its own row. Records have named fields, see `elastic_env.world.records`. First the joints of
every robot, then links on a fixed base; walkers have `elastic_env.world.walk_kernels`.

Sizes come from types and arrays, so that one kernel serves any robot. A kernel that Python calls
takes `Step`, `Links` and `Control` as plain tuples and names their parts itself: a named tuple
costs Numba a microsecond more. The control step compiles for a GPU too, see `tests.ptx`. So its
functions allocate only arrays of constant shapes.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from elastic_env.core.compiled import compiled, compiled_part, within_compiled
from elastic_env.core.signals import Array, BoolArray, IntArray

EVERY_WORLD = (0, 1)
"""Arguments `first` and `stride` of a kernel that visits all worlds; a GPU's thread has others."""


# arguments of kernels


class Step(NamedTuple):
    """Joints and worlds in a control step: records, and constants of an episode.

    Attributes:
        last_joints, joints: Records of the last step and of the present one, (num_worlds, n). After
            the physics the kernels fill the present one.
        last_worlds, worlds: The same for the worlds, (num_worlds,).
        addresses: Records of `ADDRESS`: indices of the joints in the physics, (n,).
        columns: First column of each group of the observation, (1,).
        plans: Angle, rate and acceleration of the reference at every step, (plans, steps, 3, n).
        plan: Index of the plan of each world, (num_worlds,).
        rules: Records of `RULES`, (kinds,).
        kind: Index of the rules, and of all other constants, of each world, (num_worlds,).
        samples: Standard normal samples, (block, num_worlds).
        used: Number of used samples of each world, (num_worlds,).
    """

    last_joints: Any
    joints: Any
    last_worlds: Any
    worlds: Any
    addresses: Any
    columns: Any
    plans: Array
    plan: IntArray
    rules: Any
    kind: IntArray
    samples: Any
    used: IntArray


@compiled_part
def step_at(joints: Any, worlds: Any, row: int, *constants: Any) -> Step:
    """Return the step at a row of the blocks of joints, (steps, num_worlds, n), and of worlds."""
    return Step(joints[row - 1], joints[row], worlds[row - 1], worlds[row], *constants)


class Control(NamedTuple):
    """Commands of the last control period, and arrays that the kernels fill.

    Attributes:
        offset: Command offsets within their bounds, (num_worlds, n) [rad].
        is_clipped: Worlds whose action was beyond its bounds.
        diverged: Worlds that diverged; the kernels add worlds that are too fast. They keep angles,
            rates and measurements of the last step.
        periods: Elapsed control periods; more than 1 where hardware has missed some.
        observation: Observation, (num_worlds, columns).
        reward: Reward, (num_worlds,).
        ends: True where a world ends, (ways, num_worlds): a row for each reason of termination, the
            divergence first, then one for termination and one for truncation.
    """

    offset: Array
    is_clipped: BoolArray
    diverged: BoolArray
    periods: float
    observation: Array
    reward: Array
    ends: BoolArray


# joints of every robot


@compiled
def write_commands(
    step: Any,
    action: Array,
    bound: Array,
    is_clipped: BoolArray,
    inputs: Array,
    first: int,
    stride: int,
) -> bool:
    """Write the servo inputs of the coming control period: q_ref + offset − homing error.

    Args:
        step: The present `Step`.
        action: Offsets, (num_worlds, n) [rad]; they are clipped in place.
        bound: Largest offset of every joint [rad].
        is_clipped: Output: worlds with an action beyond its bounds.
        inputs: Output: servo inputs [rad].
        first: First world.
        stride: Distance to the next world, see `EVERY_WORLD`.

    Returns:
        True if all offsets are finite; otherwise no input is written.
    """
    step = step_at(*step)
    for world in range(first, len(action), stride):
        for i in range(len(bound)):
            if not np.isfinite(action[world, i]):
                return False
    for world in range(first, len(action), stride):
        is_clipped[world] = False
        coming = step.plans[coming_reference(step, world)]
        for i in range(len(bound)):
            value = action[world, i]
            offset = min(max(value, -bound[i]), bound[i])
            if offset != value:
                is_clipped[world] = True
            action[world, i] = offset
            homing = step.joints[world, i].truth.homing
            inputs[world, step.addresses[i].servo] = coming[0, i] + offset - homing
    return True


@compiled_part
def coming_reference(step: Step, world: int) -> tuple[int, int]:
    """Index of the reference at the end of the coming period: plan and row."""
    coming = step.worlds[world].truth.step + 1
    return step.plan[world], min(coming, step.plans.shape[1] - 1)


@compiled_part
def begin_joints(qpos: Array, qvel: Array, step: Step, world: int) -> None:
    """Fill truth and measurements of resting joints at the start of an episode."""
    world_truth = step.worlds[world].truth
    world_truth.step = 0
    world_truth.command_rate = 0.0
    world_truth.clipped = False
    world_truth.diverged = False
    count_rad = step.rules[step.kind[world]].count_rad
    plan = step.plans[step.plan[world]]
    for i in range(len(step.addresses)):
        joint = step.joints[world, i]
        joint.truth.q_ref = plan[0, 0, i]
        joint.truth.command = plan[0, 0, i]
        joint.truth.offset = 0.0
        joint.truth.command_rate = 0.0
        read_joint(qpos[world], qvel[world], step.addresses[i], joint, count_rad)
        joint.measured.last_encoder = joint.measured.encoder


@compiled_part
def sense_joints(
    qpos: Array, qvel: Array, step: Step, control: Control, first: int, stride: int
) -> None:
    """Process the joints after the physics: store the command, read, measure, observe."""
    offset = control.offset
    diverged = control.diverged
    n = len(step.addresses)
    for world in range(first, len(offset), stride):
        rules = step.rules[step.kind[world]]
        plan = step.plans[step.plan[world]]
        step.worlds[world] = step.last_worlds[world]
        world_truth = step.worlds[world].truth
        world_truth.step += 1
        world_truth.clipped = control.is_clipped[world]
        total = 0.0
        for i in range(n):
            step.joints[world, i] = step.last_joints[world, i]
            truth = step.joints[world, i].truth
            truth.q_ref = plan[min(world_truth.step, len(plan) - 1), 0, i]
            change = offset[world, i] - truth.offset
            truth.offset = offset[world, i]
            truth.command = truth.q_ref + truth.offset
            truth.command_rate = change / rules.control_period_s
            total += change * change
            motor = abs(qvel[world, step.addresses[i].theta_dot])
            fastest = max(motor, abs(qvel[world, step.addresses[i].q_dot]))
            diverged[world] = diverged[world] or fastest > rules.highest_rad_s
        world_truth.command_rate = math.sqrt(total / n) / rules.control_period_s
        world_truth.diverged = diverged[world]
        if not diverged[world]:
            for i in range(n):
                joint = step.joints[world, i]
                joint.measured.last_encoder = joint.measured.encoder
                address = step.addresses[i]
                read_joint(qpos[world], qvel[world], address, joint, rules.count_rad)
        observe_joints(step, world, control.periods, control.observation[world])


@compiled
def observe_all_joints(step: Any, observation: Array) -> None:
    """Fill the joints' columns of all observations from the present state."""
    step = step_at(*step)
    for world in range(len(observation)):
        observe_joints(step, world, 1.0, observation[world])


@compiled_part
def observe_joints(step: Step, world: int, periods: float, observation: Array) -> None:
    """Fill the joints' columns of an observation, including the coming reference."""
    rules = step.rules[step.kind[world]]
    visible = step.last_joints[world] if rules.is_delayed else step.joints[world]
    period_s = rules.control_period_s * periods
    coming = step.plans[coming_reference(step, world)]
    columns = step.columns[0]
    for i in range(len(step.addresses)):
        measured = visible[i].measured
        observation[columns.encoder_angle + i] = measured.encoder
        change = measured.encoder - measured.last_encoder
        observation[columns.encoder_rate + i] = change / period_s
        observation[columns.reference_angle + i] = coming[0, i]
        observation[columns.reference_rate + i] = coming[1, i]
        observation[columns.reference_acceleration + i] = coming[2, i]
        observation[columns.last_command + i] = step.joints[world, i].truth.command


@compiled_part
def read_joint(qpos: Array, qvel: Array, address: Any, joint: Any, count_rad: float) -> None:
    """Copy the state of a joint from the physics, and measure the motor's angle by its encoder."""
    truth = joint.truth
    truth.theta = qpos[address.theta]
    truth.theta_dot = qvel[address.theta_dot]
    truth.q = qpos[address.q]
    truth.q_dot = qvel[address.q_dot]
    angle = truth.theta + truth.homing
    joint.measured.encoder = angle
    if count_rad > 0.0:
        joint.measured.encoder = round_to_counts(angle, count_rad)


# links on a fixed base


class Links(NamedTuple):
    """Constants of links on a fixed base.

    Attributes:
        schedule: Records of `SCHEDULE`, (steps,).
        constants: Weights of the reward and quality of the IMU, (1,).
        imu_bias: Offset of the IMU on the only link, (num_worlds,) [rad].
        imu_column: Column of the IMU in the observation; −1 if it is not observed.
        imu_angle: Link angle by an inertial IMU, (num_worlds,) [rad]; None for an IMU that
            measures the true angle with errors.
    """

    schedule: Any
    constants: Any
    imu_bias: Array
    imu_column: int
    imu_angle: Any


@compiled
def begin_links(qpos: Array, qvel: Array, step: Any, links: Any, worlds: BoolArray) -> None:
    """Fill truth and measurements of resting links at the start of an episode in some worlds."""
    step = step_at(*step)
    links = Links(*links)
    for world in range(len(worlds)):
        if worlds[world]:
            begin_joints(qpos, qvel, step, world)
            truth = step.worlds[world].truth
            measured = step.worlds[world].measured
            truth.scored = links.schedule[0].scored
            truth.rest = links.schedule[0].rest
            sample_link_imu(links.imu_angle, links, step, world)
            measured.visible_imu = measured.imu


@compiled
def sense_links(
    qpos: Array, qvel: Array, step: Any, links: Any, control: Any, first: int, stride: int
) -> bool:
    """Process links on a fixed base after the physics: read, measure, observe, end, score.

    Args:
        qpos: Positions of all worlds.
        qvel: Speeds of all worlds.
        step: `Step`.
        links: `Links`.
        control: `Control`.
        first: First world.
        stride: Distance to the next world, see `EVERY_WORLD`.

    Returns:
        True if an episode ends.
    """
    step = step_at(*step)
    links = Links(*links)
    control = Control(*control)
    sense_joints(qpos, qvel, step, control, first, stride)
    diverged = control.diverged
    is_over = False
    for world in range(first, len(diverged), stride):
        truth = step.worlds[world].truth
        measured = step.worlds[world].measured
        scores = step.worlds[world].scores
        last = len(links.schedule) - 1
        planned = links.schedule[min(truth.step, last)]
        truth.scored = planned.scored
        truth.rest = planned.rest
        if planned.imu_is_due and not diverged[world]:
            sample_link_imu(links.imu_angle, links, step, world)
        is_delayed = step.rules[step.kind[world]].is_delayed
        measured.visible_imu = measured.imu
        if is_delayed:
            measured.visible_imu = step.last_worlds[world].measured.imu
        if links.imu_column >= 0:
            control.observation[world, links.imu_column] = measured.visible_imu
        ends = control.ends[:, world]
        ends[0] = ends[1] = diverged[world]
        ends[2] = truth.step >= last and not diverged[world]
        is_over = is_over or ends[0] or ends[2]
        total = 0.0
        for i in range(len(step.addresses)):
            error = step.joints[world, i].truth.q_ref - step.joints[world, i].truth.q
            total += error * error
        # penalties of error and rate grow without saturating
        weights = links.constants[0].weights
        scores.link_error = weights.link_error * -math.sqrt(total / len(step.addresses))
        scores.command_rate = weights.command_rate * -truth.command_rate
        scores.divergence = weights.divergence * (-1.0 if diverged[world] else -0.0)
        reward = scores.link_error + scores.command_rate + scores.divergence
        control.reward[world] = reward
    return is_over


@compiled_part
def sample_link_imu(imu_angle: Any, links: Links, step: Step, world: int) -> None:
    """Take the next sample of the IMU on the only link, see `Links`."""
    quality = links.constants[0]
    sample = next_noise(step, world)
    if imu_angle is None:
        angle = step.joints[world, 0].truth.q
        noise = quality.imu_noise_rad * sample.imu
    else:
        angle = imu_angle[world]
        noise = 0.0
    bias = links.imu_bias[world]
    step.worlds[world].measured.imu = measured_angle(
        angle, bias, noise, quality.imu_bias_rad, quality.imu_sine_error_rad
    )


# sensors


@compiled_part
def next_noise(step: Step, world: int) -> Any:
    """Return the next noise sample of a world, and count it as used."""
    used = step.used[world]
    step.used[world] += 1
    return step.samples[min(used, len(step.samples) - 1), world]


@within_compiled
def round_to_counts(angle: Any, count_rad: Any) -> Any:
    """Angle of the nearest whole count of an encoder [rad]."""
    return np.rint(angle / count_rad) * count_rad


@within_compiled
def measured_angle(
    angle: Any, drawn_bias: Any, noise: Any, bias_rad: float, sine_error_rad: float
) -> Any:
    """Angle that an IMU measures, see `elastic_env.world.sensors.attitude` [rad]."""
    return angle + drawn_bias + noise + (bias_rad + sine_error_rad * np.sin(angle))
