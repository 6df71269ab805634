"""Sessions with servos, real or emulated."""
