"""Analytic compensators of joint elasticity, as policies.

import baselines
policy = baselines.make("input", env)
action, state = policy.predict(observation)
"""

import elastic_env  # noqa: F401  first: it chooses MuJoCo's OpenGL before anything imports MuJoCo
from baselines.compensation.compensators import Compensated, GravityCompensator
from baselines.compensation.dynamic_compensator import DynamicCompensator
from baselines.compensation.policy import Policy
from baselines.compensation.position_compensator import PositionCompensator
from baselines.policies import RESIDUAL, make, policy_names
from baselines.residual.correction import Corrected
from baselines.residual.settings import ResidualSettings
from baselines.residual_env import ResidualVectorWrapper, ResidualWrapper

__all__ = [
    "RESIDUAL",
    "Compensated",
    "Corrected",
    "DynamicCompensator",
    "GravityCompensator",
    "Policy",
    "PositionCompensator",
    "ResidualSettings",
    "ResidualVectorWrapper",
    "ResidualWrapper",
    "make",
    "policy_names",
]
