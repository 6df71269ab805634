"""What driver, limits and supervisor do when things go wrong, measured against an emulated bus."""
