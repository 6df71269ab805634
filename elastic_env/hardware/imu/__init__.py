"""The IMU on the link, read in a process of its own."""
