"""Worlds in time: physics, sensors, scenarios, episodes, metrics, and their Gymnasium faces."""
