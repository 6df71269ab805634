"""Throughput against raw physics."""
