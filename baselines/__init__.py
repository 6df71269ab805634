"""Analytic compensators of joint elasticity, as policies.

import baselines
policy = baselines.make("input", env)
action, state = policy.predict(observation)
"""

import elastic_env  # noqa: F401  first: it chooses MuJoCo's OpenGL before anything imports MuJoCo
from baselines.compensated import Compensated
from baselines.compensators import DynamicCompensator, GravityCompensator
from baselines.correction import Corrected, ResidualSettings
from baselines.policies import RESIDUAL, make, policy_names
from baselines.policy import Policy
from baselines.residual_env import ResidualVectorWrapper, ResidualWrapper

__all__ = [
    "RESIDUAL",
    "Compensated",
    "Corrected",
    "DynamicCompensator",
    "GravityCompensator",
    "Policy",
    "ResidualSettings",
    "ResidualVectorWrapper",
    "ResidualWrapper",
    "make",
    "policy_names",
]
