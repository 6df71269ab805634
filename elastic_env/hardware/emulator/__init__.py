"""Servos and IMU without hardware: real protocols on pseudo-terminals, simulated elastic joints."""
