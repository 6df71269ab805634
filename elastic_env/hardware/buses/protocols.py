"""Classes of buses by protocol."""

from elastic_env.hardware.buses.dynamixel_bus import DynamixelBus
from elastic_env.hardware.buses.feetech_bus import FeetechBus
from elastic_env.hardware.buses.servo_bus import ServoBus
from elastic_env.hardware.buses.servo_models import Protocol

BUSES: dict[Protocol, type[ServoBus]] = {"dynamixel": DynamixelBus, "feetech": FeetechBus}
"""Class of bus for each protocol."""
