"""Preview control on the cart-table: the optimum, the closed loop, the model."""

import numpy as np
import pytest
from scipy import linalg, optimize

from elastic_env.core.errors import ElasticError
from elastic_env.motion.preview_control import PreviewConfig, cart_table, follow_zmp, preview_gains

CONFIG = PreviewConfig(com_height_m=0.73)


def smooth_step(steps: int, begin: int, end: int, height: float) -> np.ndarray:
    """A quintic transfer between two levels."""
    s = np.clip((np.arange(steps) - begin) / (end - begin), 0.0, 1.0)
    return height * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def test_cart_table_is_the_exact_solution_under_constant_jerk() -> None:
    """Catches a wrong power or factorial of the period."""
    A, b, c = cart_table(CONFIG)
    continuous = np.zeros((4, 4))
    continuous[[0, 1, 2], [1, 2, 3]] = 1.0  # x' = v, v' = a, a' = u
    exact = linalg.expm(continuous * CONFIG.period_s)
    np.testing.assert_allclose(np.column_stack([A, b]), exact[:3], rtol=1e-14, atol=1e-18)
    assert c @ [0.3, 5.0, 2.0] == pytest.approx(0.3 - 0.73 / 9.81 * 2.0, rel=1e-15)


def test_closed_loop_follows_a_walking_reference_within_a_millimetre() -> None:
    """Catches a preview that is shifted by a sample or has the wrong sign (issue: below 1 mm
    rms)."""
    reference = np.stack(
        [smooth_step(2500, 500, 775, 0.105) - smooth_step(2500, 975, 1525, 0.21), np.zeros(2500)],
        axis=1,
    )
    motion = follow_zmp(CONFIG, reference, np.zeros(2))
    assert np.sqrt(np.mean((motion.zmp - reference) ** 2, axis=0)).max() < 1e-3
    np.testing.assert_array_equal(motion.com[:, 1], 0.0)
    np.testing.assert_allclose(motion.com[-1, 0], reference[-1, 0], atol=1e-5)


def test_motion_is_consistent_with_its_own_derivatives() -> None:
    """Catches columns of position, velocity and acceleration that are swapped."""
    motion = follow_zmp(CONFIG, smooth_step(1500, 500, 775, 0.1)[:, None], np.zeros(1))
    T = CONFIG.period_s
    np.testing.assert_allclose(
        np.gradient(motion.com[:, 0], T)[1:-1], motion.com_dot[1:-1, 0], atol=2e-5
    )
    np.testing.assert_allclose(
        np.gradient(motion.com_dot[:, 0], T)[1:-1], motion.com_ddot[1:-1, 0], atol=2e-4
    )
    np.testing.assert_allclose(
        motion.zmp, motion.com - 0.73 / 9.81 * motion.com_ddot, rtol=0.0, atol=1e-15
    )


def test_gains_are_the_optimum_of_the_cost() -> None:
    """Catches a Riccati equation of another system: no other jerk sequence has a lower cost over
    a long horizon."""
    config = PreviewConfig(com_height_m=0.73, period_s=0.04, preview_s=3.2)
    reference = smooth_step(160, 40, 60, 0.1)[:, None]
    A, b, c = cart_table(config)
    motion = follow_zmp(config, reference, np.zeros(1))
    jerk = np.diff(motion.com_ddot[:, 0]) / config.period_s

    def residuals(u: np.ndarray) -> np.ndarray:
        state = np.zeros(3)
        errors = np.empty(len(u))
        for k, value in enumerate(u):
            state = A @ state + b * value
            errors[k] = c @ state - reference[k + 1, 0]
        increments = np.diff(np.concatenate([[0.0], u]))
        return np.concatenate([errors, np.sqrt(config.jerk_weight) * increments])

    optimum = optimize.least_squares(
        residuals, np.zeros(len(jerk)), method="lm", xtol=1e-14, ftol=1e-14
    )
    # the servo sees 3.2 s ahead and plans for ever, the optimum knows all and ends: they may differ
    # a little
    assert np.sum(residuals(jerk) ** 2) <= 1.001 * 2.0 * optimum.cost


def test_preview_gains_decay_within_the_preview() -> None:
    """Catches a preview that is cut off where it still matters."""
    gains = preview_gains(CONFIG)
    assert len(gains.preview) == 400
    assert abs(gains.preview[-1]) < 1e-2 * np.abs(gains.preview).max()


def test_shapes_that_do_not_fit_are_an_error() -> None:
    """Catches a reference of one dimension taken for many."""
    with pytest.raises(ElasticError, match=r"\(T, d\)"):
        follow_zmp(CONFIG, np.zeros(100), np.zeros(1))
