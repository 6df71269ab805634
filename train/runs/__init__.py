"""Runs: their folders, their progress, code of the user, and how failures are explained."""
