"""Worlds in time: physics, sensors, scenarios, episodes with their metrics, and the faces that
Gymnasium sees.
"""
