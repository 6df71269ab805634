"""Layers of a walker's policy that can be exported to C."""

from typing import Any, NamedTuple

import numpy as np

from baselines.adaptation.estimators import LegEstimator
from baselines.adaptation.online_stiffness import OnlineStiffness
from baselines.compensation.compensators import Compensated, GravityCompensator
from baselines.walking.controller import WalkingController
from baselines.walking.posture import PostureFeedback
from elastic_env.core.errors import ConfigurationError
from elastic_env.world.robot_model import WalkerModel


class WalkerLayers(NamedTuple):
    """Layers of a policy; `input_output` has neither posture feedback nor adaptation."""

    compensated: Compensated
    model: WalkerModel
    posture: PostureFeedback | None = None
    adaptive: OnlineStiffness | None = None


def find_layers(policy: Any) -> WalkerLayers:
    """Find the layers of a policy around the paper's compensator around its controller.

    Raises:
        ConfigurationError: The policy cannot be exported to C.
    """
    posture = policy if isinstance(policy, PostureFeedback) else None
    adaptive: Any = None if posture is None else posture.policy
    inner: Any = policy
    estimator = adaptive.estimator if isinstance(adaptive, OnlineStiffness) else None
    if isinstance(estimator, LegEstimator) and estimator.sensors is None:
        inner = adaptive.policy
        if not np.array_equal(policy.ramp, getattr(inner, "ramp", ())):
            raise ConfigurationError("in C, posture feedback and compensation have the same ramp")
    taylor = inner.compensator if isinstance(inner, Compensated) else None
    if isinstance(taylor, GravityCompensator) and isinstance(inner.policy, WalkingController):
        model = taylor.model
        assert isinstance(model, WalkerModel)  # its controller needs one
        if taylor.output == "taylor" and taylor.gravity.chains is model.biped.chains:
            return WalkerLayers(inner, model, posture, adaptive)
    raise ConfigurationError(
        "only input_output and adaptive_posture of a walker can be exported to C, with"
        " output: taylor and gravity: com or ankle"
    )
