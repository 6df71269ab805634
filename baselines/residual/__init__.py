"""Residuals: what they correct, what they see, their networks and their folders."""
