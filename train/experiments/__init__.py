"""What the commands run: comparisons, the benchmark of CI, identification, videos, the demonstration."""
