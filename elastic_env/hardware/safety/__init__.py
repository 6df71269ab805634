"""What keeps a moving joint safe: limits, a supervisor in a process of its own, checks before the motion."""
