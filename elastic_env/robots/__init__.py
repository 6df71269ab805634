"""Robots as MuJoCo specifications, and the transform that makes their hinges elastic."""
