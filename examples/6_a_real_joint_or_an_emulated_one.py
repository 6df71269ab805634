"""
6. A real joint, or an emulated one
===================================

The emulator speaks the protocols of servo and IMU on pseudo-terminals. Everything but the port is
as on a real joint.
"""

import re
import subprocess
import sys

from train.commands.cli import main

# %%
# Start the emulator. In a terminal it is ``elastic hardware emulate``, and it prints its ports.

emulator = subprocess.Popen(
    [sys.executable, "-m", "train.commands.entry", "hardware", "emulate"],
    stdout=subprocess.PIPE,
    text=True,
)
ports: dict[str, None] = {}
while len(ports) < 2:
    ports |= dict.fromkeys(re.findall(r"/dev/pts/\d+", emulator.stdout.readline()))
servo_port, imu_port = ports

# %%
# Which servos are at the port? Nothing moves.

try:
    main(["hardware", "scan", servo_port])
finally:
    emulator.terminate()
    emulator.wait()

# %%
# Then let it move. These commands need a computer with little else to do, as the bus answers 250
# times a second:
#
# .. code-block:: text
#
#    elastic hardware check /dev/pts/3 --imu-port /dev/pts/4
#    elastic identify --port /dev/pts/3 --imu-port /dev/pts/4 --yes --patient
#    elastic evaluate --port /dev/pts/3 --imu-port /dev/pts/4 --policy input --reference sine \
#        --yes --patient
#
# On a real joint the port is ``/dev/ttyUSB0``, and there is no ``--patient``. Somebody stands by
# the power switch.
# Read the page on hardware first. Nobody has tried it on a real servo so far.
