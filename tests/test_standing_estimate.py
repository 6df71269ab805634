"""The mean ZMP error of a walk by what the robot shows at rest."""

import numpy as np

from baselines.walking.standing_estimate import StandingEstimate, StandingGains
from elastic_env.motion.trajectory import STAND_S
from tests.test_zmp_offset import OFFSET_M, Recorder, standing, vector

GAINS = StandingGains()


def test_the_plan_is_shifted_before_the_walk_by_what_standing_shows() -> None:
    """Catches a wrong sign or axis, a jump of the command, and a mean over the wrong time."""
    env = vector()
    model = env.unwrapped.task.assumed_model
    rows = standing(env)
    roll = model.observation_table.group("imu_attitude").start
    pitch = roll + 1
    rows[0, pitch] = 0.02
    rows[0, roll] = -0.03
    rows[1, [roll, pitch]] = [0.0, -0.1]
    recorder = Recorder(model)
    policy = StandingEstimate(recorder, model, GAINS)
    state = None
    rest = round(GAINS.duration_s / model.control_period_s)
    steps = round(STAND_S / model.control_period_s)
    for step in range(steps + 20):
        _, state = policy.predict(rows, state, np.full(2, step == 0))
        if step == rest:
            rows[:, [roll, pitch]] = 0.05  # what comes later does not count
    shifts = np.array(recorder.shifts)
    forward = GAINS.zmp_x * OFFSET_M[0] + GAINS.pitch_m_rad * 0.02 + GAINS.constant_m
    to_the_left = GAINS.zmp_y * OFFSET_M[1] - GAINS.roll_m_rad * 0.03
    np.testing.assert_array_equal(shifts[: rest - 1], 0.0)
    np.testing.assert_allclose(shifts[steps - 1 :, 0, 0], -forward, atol=1e-12)
    np.testing.assert_allclose(shifts[steps - 1 :, 0, 1], -to_the_left, atol=1e-12)
    np.testing.assert_allclose(shifts[-1, 1], [-GAINS.limit_m, 0.0], atol=1e-12)
    fastest = 1.9 * GAINS.limit_m / (steps - rest)  # 15/8 at the middle
    assert np.abs(np.diff(shifts, axis=0)).max() < fastest
