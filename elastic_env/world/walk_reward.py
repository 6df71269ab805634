"""Reward of a walker in a control step: compiled terms."""

import math
from typing import Any

import numpy as np

from elastic_env.core.compiled import compiled_part
from elastic_env.core.signals import Parameter


@compiled_part
def score_walk(row: Any, planned: Any, weights: Any, is_failed: bool, terms: Any) -> float:
    """Fill the weighted terms of the reward, and return their sum."""
    x = row.zmp[0] - planned.zmp[0]
    y = row.zmp[1] - planned.zmp[1]
    drift_x = row.drift[0]
    drift_y = row.drift[1]
    in_feet = math.hypot(x - drift_x, y - drift_y)
    terms.tilt = weights.tilt * planned.weight * tilt_penalty(row.tilt)
    terms.zmp = weights.zmp * planned.weight * distance_penalty(math.hypot(x, y))
    terms.effort = weights.effort * -row.servo_torque
    terms.smoothness = weights.smoothness * -row.command_rate
    terms.fall = weights.fall * (-1.0 if is_failed else 0.0)
    terms.zmp_in_feet = weights.zmp_in_feet * planned.weight * distance_penalty(in_feet)
    drift = math.hypot(drift_x, drift_y)
    terms.foot_drift = weights.foot_drift * planned.weight * distance_penalty(drift)
    total = terms.tilt + terms.zmp + terms.effort + terms.smoothness + terms.fall
    return total + (terms.zmp_in_feet + terms.foot_drift)


@compiled_part
def tilt_penalty(tilt: Parameter) -> Any:
    """−|tilt| [rad]: linear, so that the penalty never saturates."""
    return -np.abs(tilt)


@compiled_part
def distance_penalty(distance: Parameter) -> Any:
    """−distance [m]; −0 where it is nan because the feet are not loaded."""
    return -np.fmax(distance, 0.0)
