"""Evaluation, comparison and training. The wrappers for agents are here by name too; they load no torch."""

from baselines import ResidualVectorWrapper, ResidualWrapper

__all__ = ["ResidualVectorWrapper", "ResidualWrapper"]
