"""Cells of a comparison: played by workers, and stored under digests of their conditions."""
