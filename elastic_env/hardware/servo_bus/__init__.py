"""Dynamixel servos on a bus: protocol, port, control tables, what a servo is asked and told."""
