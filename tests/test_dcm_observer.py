"""The disturbance observer of the walker: against a pendulum, at rest, and on a slope."""

import numpy as np
import pytest

import baselines
from baselines.compensation.compiled_rows import record_row
from baselines.compensation.policy import PolicyInputs
from baselines.walking.dcm_observer import (
    OBSERVED,
    DcmObserver,
    DcmObserverGains,
    observe,
)
from elastic_env.motion.trajectory import STAND_S
from tests.test_zmp_offset import OFFSET_M, Recorder, standing, vector

OMEGA = 4.0
PERIOD_S = 0.004
SWAY_M = 0.01
SWAY_RAD_S = 3.0
AHEAD_M = np.array([0.012, -0.005])
HOMING_M = 0.02
FILTER_S = 0.3
FOLLOW_S = 2.0


def test_the_place_of_a_pendulum_is_found_though_its_sensors_are_off() -> None:
    """Catches a wrong sign, a mean of sensors that lie, and a rate that is not that of the DCM."""
    constants = record_row(
        period_s=PERIOD_S,
        omega=OMEGA,
        smooth_share=1.0 - np.exp(-PERIOD_S / FILTER_S),
        follow_share=1.0 - np.exp(-PERIOD_S / FOLLOW_S),
        limit_m=0.0,
    )
    observed = np.zeros(1, [("clock", float, 3), ("load_share", float)]).view(np.recarray)
    observed["load_share"] = 0.3
    soles = np.array([[[0.0, 0.1, -0.7], [0.0, -0.1, -0.7]]])
    memory = np.zeros(1, OBSERVED)
    planned = record_row(com=[0.0, 0.0], soles=[[0.0, 0.1], [0.0, -0.1]])
    found = []
    times = np.arange(0.0, 24.0, PERIOD_S)
    for time in times:
        sway = SWAY_M * np.sin(SWAY_RAD_S * time)
        com = np.zeros((1, 3))
        com[0, :2] = AHEAD_M + sway + HOMING_M
        zmp = AHEAD_M + sway * (1.0 + (SWAY_RAD_S / OMEGA) ** 2)
        observe(constants, observed, planned, com, soles, zmp[None], memory)
        found.append(memory["disturbance"][0].copy())
    late = times > times[-1] - 4.0 * np.pi / SWAY_RAD_S
    np.testing.assert_allclose(np.mean(found, axis=0, where=late[:, None]), AHEAD_M, rtol=0.01)
    s = 1j * SWAY_RAD_S
    dcm = SWAY_M * abs((1.0 + s / OMEGA) / ((1.0 + s * FILTER_S) * (1.0 + s * FOLLOW_S)))
    np.testing.assert_allclose(np.ptp(np.array(found)[late], axis=0), 2.0 * dcm, rtol=0.02)


@pytest.mark.slow
def test_the_planned_zmp_is_shifted_against_it_up_to_the_limit() -> None:
    """Catches a wrong sign or axis, a shift that jumps, and one that replaces an input."""
    env = vector()
    model = env.unwrapped.task.assumed_model
    recorder = Recorder(model)
    gains = DcmObserverGains(time_constant_s=1.0, limit_m=0.008)
    policy = DcmObserver(recorder, model, gains)
    rows = standing(env)
    state = None
    steps = round(STAND_S / model.control_period_s)
    for step in range(2 * steps):
        _, state = policy.predict(rows, state, np.full(2, step == 0))
    shifts = np.array(recorder.shifts)
    # a robot that does not answer: d̂ grows by the error over T, as u is expected and does not come
    assert shifts[-1, 0, 0] == -0.008
    assert 0.001 < shifts[-1, 0, 1] < 0.008
    assert np.sign(OFFSET_M).tolist() == [1.0, -1.0]
    np.testing.assert_allclose(shifts[:, 1], 0.0, atol=1e-12)
    np.testing.assert_array_equal(shifts[0], 0.0)
    assert np.abs(np.diff(shifts, axis=0)).max() < 1e-4
    inputs = PolicyInputs(zmp=np.full((2, 2), 0.01))
    policy.predict(rows, state, np.zeros(2, dtype=np.bool_), inputs=inputs)
    np.testing.assert_allclose(recorder.shifts[-1][1], 0.01, atol=1e-12)
    np.testing.assert_allclose(recorder.shifts[-1][0, 0], 0.01 - 0.008, atol=1e-12)


@pytest.mark.slow
def test_on_a_slope_the_mean_error_of_the_zmp_goes() -> None:
    """Catches an observer that the body does not follow, and one that sees its own shift."""
    left = {}
    quick = {"disturbance_observer": {"dcm_observer": {"time_constant_s": 2.0}}}
    for name in ("adaptive_posture", "disturbance_observer"):
        env = vector("slope")
        policy = baselines.make(name, env, **quick.get(name, {}))
        observation, _ = env.reset(seed=3)
        state = None
        start = np.ones(2, dtype=np.bool_)
        deviations = []
        for _ in range(2500):
            action, state = policy.predict(observation, state, start)
            observation, *_, info = env.step(action)
            start = np.zeros(2, dtype=np.bool_)
            deviations.append([info["zmp_deviation_x"], info["zmp_deviation_y"]])
        left[name] = np.linalg.norm(np.nanmean(deviations[1000:], axis=0), axis=0)
    assert (left["adaptive_posture"] > 5e-3).all()
    assert (left["disturbance_observer"] < 0.5 * left["adaptive_posture"]).all()
