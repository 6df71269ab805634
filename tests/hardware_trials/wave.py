"""A program that moves servos up and down, to be killed: started by `tests.hardware_trials.trials`.

python -m tests.hardware_trials.wave PORT ID ...
"""

import math
import signal
import sys
import time

import numpy as np

from elastic_env.hardware.errors import HardwareError
from elastic_env.hardware.safety.supervised_bus import SupervisedBus

PERIOD_S = 0.004
AMPLITUDE_RAD = 0.3
FREQUENCY_HZ = 0.5


def goal(elapsed_s: float) -> float:
    """The motion [rad]."""
    return AMPLITUDE_RAD * math.sin(2.0 * math.pi * FREQUENCY_HZ * elapsed_s)


def main(port: str, ids: list[int]) -> None:
    """Move until ended; says the supervisor's process id when the motion has begun."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored
    with SupervisedBus({port: ids}) as bus:
        bus.enable()
        begin = due = time.monotonic()
        is_said = False
        while True:
            due = max(due, time.monotonic()) + PERIOD_S
            bus.exchange(np.full(len(ids), goal(due - begin)), due)
            if not is_said and due - begin > 0.05:
                print(bus.process_id, flush=True)
                is_said = True


if __name__ == "__main__":
    try:
        main(sys.argv[1], [int(text) for text in sys.argv[2:]])
    except KeyboardInterrupt:
        print("interrupted")
        sys.exit(130)
    except HardwareError as error:
        print(error)
        sys.exit(2)
