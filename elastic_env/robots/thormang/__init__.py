"""The humanoid of the paper, which walks in place on twelve elastic joints."""

NAME, ID = "walker", "elastic_env/WalkInPlace-v0"
