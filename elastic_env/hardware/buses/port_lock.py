"""One program per serial port: the lock that is taken before anything touches the line.

It is an advisory lock (flock): programs that take none are not refused. The stronger mark TIOCEXCL
would refuse them, but it outlives a program that is killed while any other has the port open, and
then keeps out the one that is to switch torque off.
"""

import errno
import fcntl
import os
from pathlib import Path

from elastic_env.hardware.errors import PortError


def lock_port(name: str) -> int:
    """Take a serial port for this program alone, without changing its settings or reading from it.

    Args:
        name: Device, such as /dev/ttyUSB0.

    Returns:
        A descriptor; the port is given back when it is closed, and by the system when the program
        ends.

    Raises:
        PortError: There is no such port, it may not be opened, or another program has it.
    """
    try:
        descriptor = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise cannot_open(name, error.errno, str(error.strerror)) from None
    try:
        if not os.isatty(descriptor):
            problem = f"it is no serial port; {_found_ports()}"
            raise PortError(f"cannot open the port {name}: {problem}")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise _port_in_use(name) from None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def cannot_open(name: str, number: object, reason: str) -> PortError:
    """The error, with its cure, of a port that the system does not open for a reason."""
    if number == errno.EBUSY:
        return _port_in_use(name)
    if number == errno.EACCES:
        cure = "you may not open it: sudo usermod -aG dialout $USER, then log in again"
    elif number in (errno.ENOENT, errno.ENXIO) or not Path(name).exists():
        cure = f"there is no such device; {_found_ports()}"
    elif Path(name).is_dir():
        cure = f"it is a folder; {_found_ports()}"
    else:
        cure = reason
    return PortError(f"cannot open the port {name}: {cure}")


def _port_in_use(name: str) -> PortError:
    return PortError(
        f"another program uses {name}; two on one bus would garble each other's packets. End that "
        f"program (fuser {name} says which it is), or name another port"
    )


def _found_ports() -> str:
    found = [*Path("/dev").glob("ttyUSB*"), *Path("/dev").glob("ttyACM*")]
    return f"found: {', '.join(sorted(map(str, found))) or 'no USB serial adapter'}"
