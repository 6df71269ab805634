"""Servos on buses: states and goals in SI units, packets, serial ports, servo types as data.

A new servo of a known protocol needs a row in models.csv and, if its registers differ, a control
table. A new protocol needs a subclass of `servo_bus.ServoBus`, and a name in `protocols`.
"""
