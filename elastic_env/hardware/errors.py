"""Errors of hardware. Every message names the port and says what to do."""

from elastic_env.core.errors import SystemFailedError


class HardwareError(SystemFailedError):
    """Base of the errors of hardware: wrong servo, wrong setting, no reply, no permission."""


class PortError(HardwareError):
    """A port cannot be opened, or another program has it."""


class ReplyError(HardwareError):
    """A servo did not reply, or not with what was asked for."""


class BusGoneError(HardwareError):
    """The port is gone: unplugged, or its driver failed.

    Nothing can be commanded any more, torque off neither.
    """


class FaultError(HardwareError):
    """Motion was stopped: torque is off, or the message says why that is not known."""
