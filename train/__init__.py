"""Evaluation, comparison and training."""
