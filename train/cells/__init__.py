"""Cells of a comparison: played wherever there are workers, and kept by their content."""
