"""Learning of residuals."""
