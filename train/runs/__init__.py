"""Runs: their folders, processes beside each other, code of the user, and what is said of
failures.
"""
