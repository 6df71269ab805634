"""Parameters of elastic joints, arms, their geometry and servos from measurements."""
