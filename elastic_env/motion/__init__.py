"""Motions as trajectories: references of joints, gaits, preview control of the ZMP, walk plans."""
