"""Servos on buses: states and goals in SI units, packets, serial ports, servo types as data."""
