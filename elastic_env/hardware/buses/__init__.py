"""Servos on buses: states and goals in SI units, packets, serial ports, servo types as data.

A servo of a known protocol needs a row in models.csv and, if its registers are others, a control
table. Another protocol needs a class that fills in `servo_bus.ServoBus`, and a name in `protocols`.
"""
