"""Learning on the robot itself, while it moves or from one motion to the next."""
