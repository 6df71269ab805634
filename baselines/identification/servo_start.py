"""First parameters of a servo by linear regression.

The equation of motion is linear in the parameters where the joint moves.
"""

import numpy as np
from scipy.optimize import lsq_linear

from baselines.identification.servo_log import ServoLog
from baselines.identification.servo_problem import INDEX, MOVING, ServoProblem
from baselines.identification.servo_replay import NAMES
from elastic_env.core.errors import ElasticError
from elastic_env.core.signals import Array

_LEAST_START = 0.05
"""Least start of an estimated parameter, in its scale."""
_NO_LIMIT = 1e6
"""Start of the torque limit, in its scale: beyond all torques."""


def regress(problem: ServoProblem) -> Array:
    """Parameters that solve the equation of motion where the joint moves, in their scales, (13,).

    k g e − k c g e s σ − b w − B a − F s − d w − m g l o cos q = I a − τ(q), linear in k, k c, b,
    B, F, d and o, for the error e, the side s of motion and the side σ of the motor's torque.

    Raises:
        ElasticError: The joint hardly moves.
    """
    equations = [_motion_equations(log, problem.limit_per_gain) for log in problem.logs]
    matrix = np.concatenate([rows for rows, _ in equations])
    target = np.concatenate([right for _, right in equations])
    if len(target) < 2 * matrix.shape[1]:
        raise ElasticError(
            f"the joint moves in {len(target)} rows only, {2 * matrix.shape[1]} are needed: it"
            " sticks or the goal hardly moves; command a motion of some tenths of a radian"
        )
    size = np.maximum(np.abs(matrix).max(axis=0), 1e-12)
    low = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -np.inf])
    k, kc, b, B, F, d, offset = (
        lsq_linear(matrix / size, target, (low, np.full(7, np.inf))).x / size
    )
    has_inertia = all(log.load.inertia is not None for log in problem.logs)
    values = {
        "position_gain": k,
        "motor_damping": b,
        "rotor_inertia": B if has_inertia else 0.0,
        "link_inertia": 0.0 if has_inertia else B,
        "coulomb_friction": F,
        "load_friction": np.clip(kc / k if k > 0.0 else 0.0, 0.0, 0.7),
        "viscous_friction": d,
        "stribeck_speed": 0.3,
        "zero_offset": np.clip(offset, -0.1, 0.1),
    }
    z = np.array([values.get(name, 0.0) for name in NAMES]) / problem.scale
    z[INDEX["torque_limit"]] = _NO_LIMIT
    least = np.zeros(len(NAMES))
    least[problem.basic_parameters] = _LEAST_START
    least[INDEX["zero_offset"]] = -np.inf
    return np.maximum(z, least)


def _motion_equations(log: ServoLog, limit: float | None) -> tuple[Array, Array]:
    """Columns of k, k c, b, B, F, d and o, (N, 7), and right-hand sides, (N,), of moving rows."""
    w, a = log.derivatives()
    error = log.torque_per_gain(limit)
    moving = np.abs(w) > MOVING
    side = np.sign(w)
    columns = [
        error,
        -error * side * np.sign(error),
        -w * log.enabled,
        -a,
        -side,
        -w * ~log.enabled,
        log.load.torque * np.cos(log.position - log.load.rest),
    ]
    right = (log.load.inertia or 0.0) * a - log.external_torque(log.position)
    return np.stack(columns, axis=-1)[moving], right[moving]
