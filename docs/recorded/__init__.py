"""Recordings of real robots by others: where they come from, and every figure of their page."""
