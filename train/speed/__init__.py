"""Throughput compared with raw physics, and latency of policies."""
