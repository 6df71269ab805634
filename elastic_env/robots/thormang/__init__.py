"""The humanoid of the paper, which walks in place on twelve elastic joints."""
