"""Residuals: corrections of a base policy, their features, networks and folders."""
