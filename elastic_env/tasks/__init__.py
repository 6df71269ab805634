"""Tasks: what is observed, rewarded and scored."""
