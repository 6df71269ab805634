"""Estimates of the joints and of the ground from measurements."""
