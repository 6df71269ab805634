"""Lock of a serial port for one program, taken before anything touches the line.

It is an advisory lock (flock): it does not keep out programs that take none. The stronger TIOCEXCL
would keep them out. But it outlives a killed program while another one has the port open, and then
keeps out the process that must switch torque off.
"""

import errno
import fcntl
import os
from pathlib import Path

from elastic_env.hardware.errors import PortError


def lock_port(name: str) -> int:
    """Lock a serial port for this program, without changing its settings or reading from it.

    Args:
        name: Device, such as /dev/ttyUSB0.

    Returns:
        A file descriptor; the lock ends when it is closed, or when the program ends.

    Raises:
        PortError: The port does not exist, cannot be opened, or another program uses it.
    """
    try:
        descriptor = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise cannot_open(name, error.errno, str(error.strerror)) from None
    try:
        if not os.isatty(descriptor):
            raise PortError(f"cannot open the port {name}: it is no serial port; {_found_ports()}")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise _port_in_use(name) from None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def cannot_open(name: str, number: object, reason: str) -> PortError:
    """Error, with its cure, for a port that the system does not open."""
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
    """Error for a port that another program uses."""
    return PortError(
        f"another program uses {name}; two on one bus would garble each other's packets. End that "
        f"program (fuser {name} says which it is), or name another port"
    )


def _found_ports() -> str:
    """Text with the USB serial adapters of this computer."""
    found = [*Path("/dev").glob("ttyUSB*"), *Path("/dev").glob("ttyACM*")]
    return f"found: {', '.join(sorted(map(str, found))) or 'no USB serial adapter'}"
