"""Analytic compensators of joint elasticity, as policies.

import baselines
policy = baselines.make("input", env)
action, state = policy.predict(observation)
"""

from baselines.compensators import DynamicCompensator, GravityCompensator
from baselines.policies import Compensated, Policy, make, policy_names

__all__ = ["Compensated", "DynamicCompensator", "GravityCompensator", "Policy", "make", "policy_names"]
