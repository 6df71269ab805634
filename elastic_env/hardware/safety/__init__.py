"""Safety of a moving joint: limits, a supervisor in a process of its own, checks before the motion."""
