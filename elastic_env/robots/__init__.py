"""Robots as MuJoCo specifications, with their tasks, environments and pictures."""
