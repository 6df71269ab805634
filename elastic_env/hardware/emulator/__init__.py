"""Servos and IMU without hardware: real protocols on pseudo-terminals, our own elastic joint."""
