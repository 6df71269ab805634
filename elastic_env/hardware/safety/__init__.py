"""Safety of a moving joint: limits, a supervisor process, checks before the motion."""
