"""Starts an emulator in a process of its own, for programs and tests."""

import json
import subprocess
import time
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from elastic_env.hardware.emulator.settings import EmulatorConfig
from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.safety.processes import child_command, child_environment

_LONGEST_SWING_S = 10.0
_REST_RAD_S = 0.02
_LOOK_S = 0.05
_STILL_LOOKS = 3  # where a swing turns back it stands still for one look


class RunningEmulator(AbstractContextManager["RunningEmulator"]):
    """Starts an emulator; a context manager that ends it.

    Args:
        config: What to emulate.

    Attributes:
        port: Of the servos.
        imu_port: Of the IMU.
    """

    def __init__(self, config: EmulatorConfig | None = None) -> None:
        text = (config or EmulatorConfig()).model_dump_json()
        self._process = subprocess.Popen(
            child_command("elastic_env.hardware.emulator.process", text),
            env=child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._take_ports(self._receive())

    def faults(self, **changes: Any) -> None:
        """Switch faults on and off, see `Faults`; a bus that is plugged in again has another port."""
        self._take_ports(self._request({"faults": changes}))

    def events(self) -> list[tuple[float, int, str, int]]:
        """Switches, goals and requests for states since the last call.

        Monotonic time, id, register, value [count]; `present_position` is what a state that was asked for is to tell.
        """
        return [(float(t), int(i), str(name), int(value)) for t, i, name, value in self._request({"events": True})]

    def state(self) -> dict[str, Any]:
        """Truth: time_s, theta and q [rad], torque_on, skipped_s."""
        return self._request({"state": True})

    def wait_until_rest(self) -> None:
        """Wait until joints that were let go have swung out: torque goes on at rest only.

        Raises:
            HardwareError: They still move after 10 s.
        """
        deadline = time.monotonic() + _LONGEST_SWING_S
        before = self.state()
        still_looks = 0
        while still_looks < _STILL_LOOKS:
            if time.monotonic() > deadline:
                raise HardwareError(f"the emulated joints still swing after {_LONGEST_SWING_S:g} s; is torque off?")
            time.sleep(_LOOK_S)
            now = self.state()
            moved = np.abs(np.subtract(now["theta"], before["theta"])).max()
            is_still = moved < _REST_RAD_S * (now["time_s"] - before["time_s"])
            still_looks = still_looks + 1 if is_still else 0
            before = now

    def wait(self) -> None:
        """Wait until it ends by itself, or an interrupt comes."""
        self._process.wait()

    def close(self) -> None:
        """End it."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait(timeout=10)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(self, request: dict[str, Any]) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._receive()

    def _receive(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise HardwareError(f"the emulator ended with exit code {self._process.wait()}")
        return json.loads(line)

    def _take_ports(self, ports: dict[str, str]) -> None:
        self.port = ports["port"]
        self.imu_port = ports["imu_port"]
