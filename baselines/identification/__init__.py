"""Stiffness, friction and offset of a joint from static positions."""
