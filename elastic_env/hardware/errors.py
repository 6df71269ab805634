"""Errors of hardware. Every message names the port and a cure."""

from elastic_env.core.errors import SystemFailedError


class HardwareError(SystemFailedError):
    """Base of the errors of hardware: wrong servo, wrong setting, no reply, no permission."""


class PortError(HardwareError):
    """A port cannot be opened, or another program uses it."""


class ReplyError(HardwareError):
    """A servo did not reply, or sent a wrong reply."""


class BusGoneError(HardwareError):
    """The port is gone: unplugged, or its driver failed.

    No command reaches the servos any more, not even torque off.
    """


class FaultError(HardwareError):
    """The motion was stopped: torque is off, or the message says why that is uncertain."""
