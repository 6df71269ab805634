"""The testbed on hardware, as an environment."""
