"""Hold an emulated arm until somebody ends this: `python -m tests.hardware_trials.held PORT ID...`."""

import sys
import time

import numpy as np

from elastic_env.hardware.arm_settings import ARM_LIMITS
from elastic_env.hardware.safety.supervised_bus import SupervisedBus


def main(port: str, ids: list[int]) -> None:
    """Hold until the end of the program."""
    with SupervisedBus({port: ids}, protocol="feetech") as bus:
        ranges = np.tile([-3.0, 3.0], (len(ids), 1))
        stands = bus.enable(ARM_LIMITS.replace(patience_cycles=10), ranges)
        print(bus.process_id, flush=True)
        while True:
            bus.exchange(stands, time.monotonic() + 0.01)


if __name__ == "__main__":
    main(sys.argv[1], [int(text) for text in sys.argv[2:]])
