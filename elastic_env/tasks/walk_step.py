"""What follows the physics in a control step of the walker: one compiled pass from MuJoCo's state to the observation.

Arrays have one row per world, and a world's numbers depend on its own row alone. What is true of a step, measured and
scored stands in one record, whose columns `elastic_env.tasks.walk_state` names.
"""

import math
from typing import Any

import numpy as np

from elastic_env.compiled import compiled
from elastic_env.sensors import in_whole_counts, shown_angle
from elastic_env.signals import Array, BoolArray, IntArray, Parameter
from elastic_env.tasks.task import DIVERGED_ROW, TERMINATED_ROW, TRUNCATED_ROW
from elastic_env.tasks.walk_state import (
    ANKLES,
    ATTITUDE,
    COMMAND,
    COMMAND_RATE,
    CONTACT_SINCE,
    ENCODER,
    ENCODER_BEFORE,
    FORCE,
    GYRO,
    IMU_ATTITUDE,
    JOINTS,
    OFFSET,
    PELVIS,
    PELVIS_RATE,
    POSITION_END,
    QUATERNION,
    SCORES,
    SENSORS,
    SERVO_TORQUE,
    STATE_END,
    STEP,
    STIFFNESS,
    THETA,
    VELOCITY_END,
    WRENCH,
    ZMP,
    attitude_of,
    rms,
)
from elastic_env.walking.ground_contact import ground_wrench, moment_point

REFERENCE_END, ZMP_REFERENCE = 3 * JOINTS + 6, 3 * JOINTS + 4
HALF, SWING_FOOT, IMU_IS_DUE, WEIGHT, PLAN_END = range(REFERENCE_END, REFERENCE_END + 5)
"""Columns of the plan: what is observed; half and foot of a swing, whether the IMU is due, weight in the reward."""
FIRST_HALF, SECOND_HALF = 1, 2
"""Of a swing; 0 is none."""
FELL_ROW, NUM_ENDS = 1, 4
"""Of what ends an episode, beside `elastic_env.tasks.task.DIVERGED_ROW` and those after it."""
_TILT = ATTITUDE + 2
_NUM_BODY = SCORES - IMU_ATTITUDE
_REFERENCE = 2 * JOINTS + _NUM_BODY

_in_whole_counts, _shown_angle = compiled(in_whole_counts), compiled(shown_angle)


def tilt_penalty(pelvis_error: Parameter) -> Any:
    """−|tilt| [rad]: linear, so that a large error never stops to matter."""
    return -np.abs(pelvis_error)


def zmp_penalty(zmp_deviation: Parameter) -> Any:
    """−ZMP deviation [m], a distance; none where the feet are not loaded and it is nan."""
    return -np.fmax(zmp_deviation, 0.0)


_tilt_penalty, _zmp_penalty = compiled(tilt_penalty), compiled(zmp_penalty)


@compiled
def command(record: Array, offset: Array, plan: Array, bias: Array, inputs: Array) -> None:
    """Servo inputs of the coming control period, q_ref + offset, by encoders that are off by a bias, (n, 12) [rad]."""
    for world in range(len(offset)):
        coming = plan[min(int(record[world, STEP]) + 1, len(plan) - 1)]
        for i in range(JOINTS):
            inputs[world, i] = coming[i] + offset[world, i] - bias[world, i]


@compiled
def read(
    physics: Any, addresses: IntArray, feet: Array, least_n: float, worlds: BoolArray, last: Array, record: Array
) -> None:
    """The true state of some worlds into a record; the others keep that of the last one."""
    qpos, qvel, sensordata, actuator_force, site_xmat, site_xpos = physics
    sites, com, weight = addresses[VELOCITY_END:], feet[0], feet[1]
    foot_R, force, moment, ankles = np.empty((2, 3, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    for world in range(len(record)):
        row = record[world]
        if not worlds[world]:
            row[:STATE_END] = last[world, :STATE_END]
            continue
        for i in range(POSITION_END):
            row[i] = qpos[world, addresses[i]]
        for i in range(POSITION_END, VELOCITY_END):
            row[i] = qvel[world, addresses[i]]
        for i in range(12):
            row[WRENCH + i] = -sensordata[world, i]  # MuJoCo's act on the foot, ours on the leg
        for foot in range(2):
            for i in range(3):
                ankles[foot, i] = row[ANKLES + 3 * foot + i] = site_xpos[world, sites[foot], i]
                for j in range(3):
                    foot_R[foot, i, j] = site_xmat[world, sites[foot], 3 * i + j]
        ground_wrench(row[WRENCH:FORCE].reshape(2, 2, 3), foot_R, com, weight, force, moment)
        moment_point(force, moment, ankles, least_n, row[ZMP:SERVO_TORQUE])
        row[FORCE], row[FORCE + 1] = force[0, 2], force[1, 2]
        for i in range(JOINTS):
            row[SERVO_TORQUE + i] = actuator_force[world, i]
    record[:, ATTITUDE:ANKLES] = attitude_of(record[:, QUATERNION:POSITION_END])


@compiled
def measure(
    samples: Array, used: Any, spread: Array, bias: Array, sensors: Any, worlds: BoolArray, due: BoolArray, last: Array,
    record: Array,
) -> None:  # fmt: skip
    """What the sensors of some worlds show; the others keep their last values, as an IMU does that is not due."""
    count_rad, noise_rad, bias_rad, sine_error_rad = sensors
    for world in range(len(record)):
        row, before = record[world], last[world]
        if not worlds[world]:
            row[ENCODER:SCORES] = before[ENCODER:SCORES]
            continue
        noise = samples[min(used[world], len(samples) - 1), world]
        used[world] += 1
        for i in range(JOINTS):
            row[ENCODER + i] = _in_whole_counts(row[THETA + i] + bias[world, i], count_rad)
            row[ENCODER_BEFORE + i] = before[ENCODER + i]
        row[IMU_ATTITUDE:SENSORS] = before[IMU_ATTITUDE:SENSORS]
        if due[world]:
            for i in range(2):
                row[IMU_ATTITUDE + i] = _shown_angle(
                    row[ATTITUDE + i], bias[world, JOINTS + i], noise[i], noise_rad, bias_rad, sine_error_rad
                )
            for i in range(3):
                row[GYRO + i] = noise[2 + i] * spread[2 + i] + row[PELVIS_RATE + i]
        for i in range(12):
            row[SENSORS + i] = noise[5 + i] * spread[5 + i] + row[WRENCH + i]


@compiled
def observe(record: Array, shown: Array, plan: Array, period_s: float, observation: Array) -> None:
    """Observations, see the table of `elastic_env.tasks.walk_in_place`; `shown` is the record that is measured."""
    for world in range(len(record)):
        row, measured = observation[world], shown[world]
        coming = plan[min(int(record[world, STEP]) + 1, len(plan) - 1)]
        for i in range(JOINTS):
            row[i] = measured[ENCODER + i]
            row[JOINTS + i] = (measured[ENCODER + i] - measured[ENCODER_BEFORE + i]) / period_s
        for i in range(_NUM_BODY):
            row[2 * JOINTS + i] = measured[IMU_ATTITUDE + i]
        for i in range(REFERENCE_END):
            row[_REFERENCE + i] = coming[i]
        for i in range(JOINTS):
            row[_REFERENCE + REFERENCE_END + i] = record[world, COMMAND + i]


@compiled
def _watch_swing_foot(row: Array, half: float, foot: int, loaded_n: float) -> None:
    """Since when the swing foot has been on the ground in the second half of its swing."""
    if half == FIRST_HALF:
        row[CONTACT_SINCE] = -1.0
    if half == SECOND_HALF and row[CONTACT_SINCE] < 0.0 and row[FORCE + foot] > loaded_n:
        row[CONTACT_SINCE] = row[STEP]


@compiled
def control_step(
    physics: Any, addresses: IntArray, feet: Array, plan: Array, samples: Array, used: Any, spread: Array, bias: Array,
    sensors: Any, limits: Any, weights: Any, offset: Array, diverged: BoolArray, last: Array, is_delayed: bool,
    record: Array, observation: Array, reward: Array, ends: BoolArray,
) -> bool:  # fmt: skip
    """Read the new state, measure it, score it, say what ends, and observe.

    Args:
        physics: qpos, qvel, sensordata, actuator_force, site_xmat and site_xpos of all worlds.
        addresses: Where positions and velocities of the record stand in qpos and qvel, then the sites of the ankles.
        feet: Center of mass from the ankle in the frame of the foot, and weight in the world, (2, 2, 3) [m], [N].
        plan: One row per control step, up to `PLAN_END`.
        samples: Noise ahead, of `elastic_env.sensors.NoiseStream.ready`.
        used: How many samples are used, which is counted here.
        spread: Standard deviation of gyroscope and foot sensors, in the columns of the noise.
        bias: Homing errors of the encoders, then errors of the IMU's roll and pitch, (n, 14) [rad].
        sensors: Count of the encoders or 0 for none, noise, bias and sine error of the IMU [rad].
        limits: Control period [s], lowest pelvis [m], largest tilt [rad], and least forces of a loaded foot and for a
            ZMP [N].
        weights: Of the reward, by `REWARD_TERMS`.
        offset: Command offsets of this control period, (n, 12) [rad].
        diverged: Worlds without a new state, (n,).
        last: Record of the step before.
        is_delayed: Whether its measurements are shown now.
        record: To be filled.
        observation: To be filled.
        reward: To be filled, (n,).
        ends: To be filled: what ends, `elastic_env.tasks.task.Outcome.ends`, (4, n).

    Returns:
        Whether anything ends.
    """
    period_s, lowest_m, highest_rad, loaded_n, least_n = limits
    n, num_steps = len(last), len(plan) - 1
    healthy, due = ~diverged, np.empty(n, dtype=np.bool_)
    read(physics, addresses, feet, least_n, healthy, last, record)
    effort, change = rms(record[:, SERVO_TORQUE:STATE_END]), rms(offset - last[:, OFFSET:COMMAND])
    is_over = False
    for world in range(n):
        row, before = record[world], last[world]
        row[STIFFNESS:OFFSET] = before[STIFFNESS:OFFSET]
        row[STEP], row[CONTACT_SINCE] = before[STEP] + 1.0, before[CONTACT_SINCE]
        now = plan[min(int(row[STEP]), num_steps)]
        for i in range(JOINTS):
            row[OFFSET + i] = offset[world, i]
            row[COMMAND + i] = now[i] + offset[world, i]
        row[COMMAND_RATE] = change[world] / period_s
        _watch_swing_foot(row, now[HALF], int(now[SWING_FOOT]), loaded_n)
        due[world] = now[IMU_IS_DUE] > 0.0
        fell = row[PELVIS + 2] < lowest_m or row[_TILT] > highest_rad
        is_terminated = diverged[world] or fell
        is_truncated = not is_terminated and row[STEP] >= num_steps
        ends[DIVERGED_ROW, world], ends[FELL_ROW, world] = diverged[world], fell
        ends[TERMINATED_ROW, world], ends[TRUNCATED_ROW, world] = is_terminated, is_truncated
        is_over = is_over or is_terminated or is_truncated
        deviation = math.hypot(row[ZMP] - now[ZMP_REFERENCE], row[ZMP + 1] - now[ZMP_REFERENCE + 1])
        row[SCORES] = weights[0] * now[WEIGHT] * _tilt_penalty(row[_TILT])
        row[SCORES + 1] = weights[1] * now[WEIGHT] * _zmp_penalty(deviation)
        row[SCORES + 2] = -weights[2] * effort[world]
        row[SCORES + 3] = -weights[3] * row[COMMAND_RATE]
        row[SCORES + 4] = -weights[4] if is_terminated else 0.0
        reward[world] = row[SCORES] + row[SCORES + 1] + row[SCORES + 2] + row[SCORES + 3] + row[SCORES + 4]
    measure(samples, used, spread, bias, sensors, healthy, due, last, record)
    observe(record, last if is_delayed else record, plan, period_s, observation)
    return is_over
