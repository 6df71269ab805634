"""Servos on buses: states and goals in SI units, packets, serial ports, servo types as data.

A Dynamixel servo of Protocol 2.0 needs a row in models.csv and, if its registers are others, a
control table. Another make needs a class with the methods of `dynamixel_bus.DynamixelBus`.
"""
