"""Sessions with servos, and trials of the safety path on emulated ones."""
