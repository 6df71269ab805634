"""Measurements and pictures of the documentation that no command makes."""
