"""Walking patterns: timing, preview control of the center of mass, leg kinematics."""
