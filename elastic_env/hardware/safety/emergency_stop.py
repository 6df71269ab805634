"""Torque off without a supervisor, after it has died or been silent."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence

from elastic_env.hardware.buses.bus_group import BusGroup
from elastic_env.hardware.buses.protocols import BUSES
from elastic_env.hardware.buses.servo_models import Protocol
from elastic_env.hardware.errors import HardwareError, ReplyError


def switch_torque_off(
    ports: Mapping[str, Sequence[int]],
    baudrate: int | None = None,
    models: Sequence[Sequence[int]] = (),
    protocol: Protocol = "dynamixel",
) -> str:
    """Switch torque off without a supervisor.

    Args:
        ports: Ids of the servos by port.
        baudrate: Bits per second; None for the usual rate of the protocol.
        models: Their model numbers, in that order; without them each servo is asked first.
        protocol: Protocol of all servos.

    Returns:
        Text about the outcome: torque is off, or what could not be confirmed.
    """
    problems: list[str] = []

    @contextlib.contextmanager
    def noting(kind: type[HardwareError]) -> Iterator[None]:
        """Note an error of a kind, and go on."""
        try:
            yield
        except kind as error:
            problems.append(f"torque could not be switched off: {error}")

    buses = [BUSES[protocol](port, baudrate) for port in ports]
    try:
        for index, (bus, ids) in enumerate(zip(buses, ports.values(), strict=True)):
            with noting(HardwareError):
                bus.open()
                numbers = dict(zip(ids, models[index], strict=True)) if models else {}
                for servo_id in ids if not models else ():
                    # a servo that does not answer must not keep others on
                    with noting(ReplyError):
                        numbers[servo_id] = bus.ping(servo_id).model_number
                # a model number of zero is none, and must not keep others on
                bus.attach_known({i: model for i, model in numbers.items() if model})
        reached = [bus for bus in buses if bus.models]
        problem = BusGroup(reached).torque_off() if reached else None
    finally:
        for bus in buses:
            # a port that is gone cannot be closed
            with contextlib.suppress(HardwareError):
                bus.close()
    if problem is not None:
        problems.append(str(problem))
    elif reached:
        problems.append("torque of the others is off" if problems else "torque is off")
    return "; ".join(dict.fromkeys(problems))
