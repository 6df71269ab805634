"""Episodes of policies under conditions, their scores, and what changes between two of them."""
