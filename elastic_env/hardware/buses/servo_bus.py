"""Servos at a port: registers, goals in one packet, states in another.

A state is read as one block per servo. A request asks for a block whose length no earlier request
still awaits (`ServoModel.blocks`). So a reply that comes late is recognised as old and dropped.
Temperatures may lie farther off and change slowly: only every 25th request asks for a block that
contains them.

Differences between makes are in `dynamixel_bus` and `feetech_bus`: packets, answers to a ping, and
the meaning of a status.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from elastic_env.core.signals import Array
from elastic_env.hardware.buses import packets, servo_models
from elastic_env.hardware.buses.bus import TEMPERATURE_CYCLES, Condition, States
from elastic_env.hardware.buses.packet_line import PacketLine, servo_name
from elastic_env.hardware.buses.servo_models import ServoModel
from elastic_env.hardware.errors import HardwareError, ReplyError

_WATCHDOG_COUNTS = 3  # of 20 ms


class ServoBus(PacketLine):
    """Servos of one protocol at a port.

    Args:
        port: Device, such as /dev/ttyUSB0.
        baudrate: Bits per second; None for `rates[0]`.

    Attributes:
        models: Types of the attached servos, by id.
    """

    position_mode: ClassVar[int]
    """Operating mode in which a servo follows goal positions."""
    full_replies: ClassVar[int]
    """Status return level of a servo that answers every instruction."""
    patience_s: ClassVar[float]
    """Time that replies in motion may take beyond the time on the wire [s]."""
    slowest_trip_s: ClassVar[float]
    """Round trip of a ping from which on nothing may move [s]."""

    def __init__(self, port: str, baudrate: int | None = None) -> None:
        super().__init__(port, baudrate)
        self.models: dict[int, ServoModel] = {}
        self._cycles_without_temperature = TEMPERATURE_CYCLES
        self._awaited: deque[range | None] = deque(maxlen=servo_models.NUM_BLOCKS - 1)
        """Blocks of the last requests; None where all servos answered."""
        self._torque_lines: Array = np.zeros((2, 0))
        """Torque per current [N·m/A] and lost torque [N·m], (2, n)."""
        self._full_efforts: dict[int, int] = {}
        """Largest value of the register that limits the torque, by id [count]."""

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the attached servos, in order."""
        return tuple(self.models)

    def attach(self, ids: Sequence[int]) -> None:
        """Attach servos; each is asked for its model, which determines its registers.

        Raises:
            ConfigurationError: An id is impossible, or given twice.
            ReplyError: A servo does not answer.
            HardwareError: Its model is not known.
        """
        packets.require_ids(ids)
        self.attach_known({i: self.ping(i).model_number for i in ids})

    def attach_known(self, numbers: Mapping[int, int]) -> None:
        """Attach servos without asking them for their models.

        Args:
            numbers: Model numbers by id.

        Raises:
            HardwareError: A model is not known, or the models differ in protocol or registers.
        """
        models = {i: servo_models.servo_model(number) for i, number in numbers.items()}
        for servo_id, model in models.items():
            if model.protocol != self.protocol:
                raise HardwareError(
                    f"servo {servo_id} at {self.name} is a {model.name}, which speaks the protocol"
                    f" {model.protocol!r}, and the bus {self.protocol!r}: set protocol"
                )
        self.models = models
        lines = [(model.torque_per_ampere, model.loss) for model in models.values()]
        self._torque_lines = np.array(lines).reshape(-1, 2).T
        if len({model.blocks for model in models.values()}) > 1:
            names = ", ".join(f"{i}: {model.name}" for i, model in models.items())
            raise HardwareError(
                f"the servos of one bus must have one control table, at {self.name} are {names}"
            )

    def read_register(self, servo_id: int, name: str) -> int:
        """Read a register [count].

        Raises:
            ReplyError: No answer after some tries, or a refusal.
        """
        register = self.models[servo_id].table[name]
        place = self._place(register.address, register.size)
        data = self._request(servo_id, packets.READ, place, register.size)
        return register.decode(data)

    def write_register(self, servo_id: int, name: str, value: int) -> None:
        """Write a register [count].

        Raises:
            ReplyError: No answer after some tries, or a refusal, with the servo's reason.
        """
        register = self.models[servo_id].table[name]
        data = self._place(register.address) + register.encode(value)
        self._request(servo_id, packets.WRITE, data, length=0)

    def write_all(self, name: str, values: Mapping[int, int]) -> None:
        """Write a register of several servos, by id [count], in one packet without confirmation.

        Raises:
            BusGoneError: The port is gone.
        """
        if not values:
            return
        register = self.models[next(iter(values))].table[name]
        data = self._place(register.address, register.size)
        for servo_id, value in values.items():
            data += bytes([servo_id]) + register.encode(value)
        self._transmit(packets.BROADCAST, packets.SYNC_WRITE, data)

    def read_position(self, servo_id: int) -> float:
        """Present position of one servo [rad]."""
        count = self.read_register(servo_id, "present_position")
        return self.models[servo_id].angle(count)

    def read_condition(self, servo_id: int) -> Condition:
        """Velocity, temperature and hardware error of one servo."""
        counts = self.read_register(servo_id, "present_velocity")
        temperature = float(self.read_register(servo_id, "present_temperature"))
        highest = float(self.read_register(servo_id, "temperature_limit"))
        status = self.read_register(servo_id, "hardware_error_status")
        model = self.models[servo_id]
        error = model.explain_errors(status)
        return Condition(counts * model.velocity_unit, temperature, highest, error)

    def write_goal(self, servo_id: int, angle: float) -> None:
        """Command one servo, with confirmation [rad].

        Raises:
            ReplyError: As in `write_register`.
        """
        count = self.models[servo_id].count(angle)
        self.write_register(servo_id, "goal_position", count)

    def write_goals(self, angles: Array) -> None:
        """Command all servos at once.

        Args:
            angles: Goal positions in the order of `ids`, (n,) [rad].
        """
        servos = zip(self.models.items(), angles.tolist(), strict=True)
        counts = {servo_id: model.count(angle) for (servo_id, model), angle in servos}
        self.write_all("goal_position", counts)

    def write_torque(self, servo_id: int, is_on: bool) -> None:
        """Switch the torque of one servo, with confirmation."""
        self.write_register(servo_id, "torque_enable", int(is_on))

    def write_watchdog(self, servo_id: int, is_on: bool) -> None:
        """Set the bus watchdog of a servo to 60 ms, or clear it.

        Models without a watchdog are left out.
        """
        if self.models[servo_id].has_watchdog:
            counts = _WATCHDOG_COUNTS if is_on else 0
            self.write_register(servo_id, "bus_watchdog", counts)

    def restore_effort(self) -> None:
        """Let the servos give all the torque that their settings allow, with confirmation.

        Models whose torque cannot be limited at once are left out.
        """
        for servo_id, model in self.models.items():
            if model.effort_register:
                full = self.read_register(servo_id, model.effort_maximum)
                self._full_efforts[servo_id] = full
                self.write_register(servo_id, model.effort_register, full)

    @property
    def can_limit_effort(self) -> bool:
        """True if the torque of its servos can be limited at once."""
        return bool(self._full_efforts)

    def limit_effort(self, share: float) -> None:
        """Limit the torque of all servos to a share of their settings, without confirmation.

        Models whose torque cannot be limited at once are left out.
        """
        efforts = {i: round(share * full) for i, full in self._full_efforts.items()}
        if efforts:
            self.write_all(self.models[next(iter(efforts))].effort_register, efforts)

    def torque_off(self) -> None:
        """Switch all torque off, without confirmation; also after an interrupted read.

        Raises:
            BusGoneError: The port is gone.
        """
        # servos do not confirm a packet to all; a second one costs nothing
        for _ in range(2):
            self.write_all("torque_enable", dict.fromkeys(self.ids, 0))
        # the next program must not find servos without strength
        self.limit_effort(1.0)

    def confirm_torque_off(self) -> list[str]:
        """Names of the servos that do not confirm that their torque is off, after some tries."""
        return [servo_name(self, i) for i in self.ids if not self._is_off(i)]

    def _is_off(self, servo_id: int) -> bool:
        """Return True if a servo confirms that its torque is off."""
        try:
            if self.read_register(servo_id, "torque_enable") != 0:
                self.write_torque(servo_id, False)
        except ReplyError:
            return False
        return True

    def read_states(self, timeout_s: float) -> States:
        """Position, velocity and torque of all servos, and now and then their temperature.

        Args:
            timeout_s: Time that all replies may take beyond that on the wire [s].

        Raises:
            BusGoneError: The port is gone.
        """
        block = self._next_block()
        self._awaited.append(block)
        request = self._place(block.start, len(block)) + bytes(self.ids)
        self._transmit(packets.BROADCAST, packets.SYNC_READ, request)
        length = len(self.ids) * (self.status_bytes + len(block))
        longest_ms = self.port.tx_time_per_byte * length + 1e3 * timeout_s
        self.port.setPacketTimeoutMillis(longest_ms)
        replies: dict[int, bytes] = {}
        alerts: set[int] = set()
        while len(replies) < len(self.ids):
            reply = self._receive()
            if reply is None:
                if self.port.getTimeSinceStart() >= longest_ms:
                    break
                continue
            if not reply.is_intact:
                continue
            if reply.has_alert:
                alerts.add(reply.servo_id)
            is_good = reply.error == 0 and len(reply.data) == len(block)
            if is_good and reply.servo_id in self.models:
                replies[reply.servo_id] = reply.data
        if len(replies) == len(self.ids):
            self._awaited[-1] = None
        states = self._decode(block, replies, alerts)
        self._cycles_without_temperature += 1
        if not np.isnan(states.temperature).any():
            self._cycles_without_temperature = 0
        return states

    def _next_block(self) -> range:
        """Shortest block that no request still awaits, with the temperature if that is due."""
        model = next(iter(self.models.values()))
        free = [block for block in model.blocks if block not in self._awaited]
        if self._cycles_without_temperature + 1 < TEMPERATURE_CYCLES:
            return free[0]
        return next(filter(model.has_temperature, free), free[0])

    def _decode(self, block: range, data: dict[int, bytes], alerts: set[int]) -> States:
        """States of all servos, from the data of a block by id."""
        values = np.full((len(self.ids), 4), np.nan)
        for row, (servo_id, model) in enumerate(self.models.items()):
            if servo_id in data:
                values[row] = model.decode_block(block, data[servo_id])
        angle, velocity, current, temperature = values.T.copy()
        torque = servo_models.torque_of_current(current, *self._torque_lines)
        now = self.port.clock.monotonic()
        is_fresh = np.array([servo_id in data for servo_id in self.ids])
        has_alert = np.array([servo_id in alerts for servo_id in self.ids])
        return States(angle, velocity, torque, is_fresh, has_alert, now, temperature)
