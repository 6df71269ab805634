"""Trees of hinges on a fixed base: links, torque and end effector, row by row for a whole batch."""
