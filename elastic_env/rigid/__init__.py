"""Rigid bodies and feet on the ground: torques, Jacobians, contact, for many worlds at once."""
