"""Simulated worlds: physics, sensors, scenarios, episodes, metrics, Gymnasium environments."""
