"""Rigid bodies, legs and what the ground does to feet: torques, Jacobians, contact, for many
worlds in one pass.
"""
