"""Analytic compensators as policies."""
