"""Servos and IMU without hardware: real protocols on pseudo-terminals, moved by the project's own elastic joint."""
