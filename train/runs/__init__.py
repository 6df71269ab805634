"""Runs: result folders, progress, the console, code of the user, and messages of failures."""
