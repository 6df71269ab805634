"""An emulator in a process of its own, as programs and tests use it."""

import json
import subprocess
import time
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from elastic_env.hardware.emulator.config import EmulatorConfig
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.safety.child_process import child_command, child_environment

_LONGEST_SWING_S, _REST_RAD_S = 10.0, 0.02
_LOOK_S, _STILL_LOOKS = 0.05, 3  # where a swing turns back it stands still for one look


class RunningEmulator(AbstractContextManager["RunningEmulator"]):
    """Starts an emulator; a context manager that ends it.

    Args:
        config: What to emulate.

    Attributes:
        port: Of the servos.
        imu_port: Of the IMU.
    """

    def __init__(self, config: EmulatorConfig | None = None) -> None:
        given = (config or EmulatorConfig()).model_dump_json()
        self._process = subprocess.Popen(
            child_command("elastic_env.hardware.emulator.process", given), env=child_environment(),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        self._take_ports(self._hear())

    def faults(self, **changes: Any) -> None:
        """Switch faults on and off, see `Faults`; a bus that is plugged in again has another port."""
        self._take_ports(self._ask({"faults": changes}))

    def events(self) -> list[tuple[float, int, str, int]]:
        """What has been switched, commanded and asked for since the last call.

        Monotonic time, id, register, value [count]; `present_position` is what a state that was asked for is to tell.
        """
        return [(float(t), int(i), str(name), int(value)) for t, i, name, value in self._ask({"events": True})]

    def state(self) -> dict[str, Any]:
        """Truth: time_s, theta and q [rad], torque_on, skipped_s."""
        return self._ask({"state": True})

    def wait_until_rest(self) -> None:
        """Wait until joints that were let go have swung out: torque goes on at rest only.

        Raises:
            HardwareError: They still move after 10 s.
        """
        deadline, before, still = time.monotonic() + _LONGEST_SWING_S, self.state(), 0
        while still < _STILL_LOOKS:
            if time.monotonic() > deadline:
                raise HardwareError(f"the emulated joints still swing after {_LONGEST_SWING_S:g} s; is torque off?")
            time.sleep(_LOOK_S)
            now = self.state()
            moved = np.abs(np.subtract(now["theta"], before["theta"])).max()
            still = still + 1 if moved < _REST_RAD_S * (now["time_s"] - before["time_s"]) else 0
            before = now

    def wait(self) -> None:
        """Wait until it ends by itself, or an interrupt comes."""
        self._process.wait()

    def close(self) -> None:
        """End it."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.wait(timeout=10)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, request: dict[str, Any]) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._hear()

    def _hear(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise HardwareError(f"the emulator ended with exit code {self._process.wait()}")
        return json.loads(line)

    def _take_ports(self, ports: dict[str, str]) -> None:
        self.port, self.imu_port = ports["port"], ports["imu_port"]
