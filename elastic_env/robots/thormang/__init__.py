"""The humanoid of the paper, which walks in place on twelve elastic joints."""

NAME = "walker"
ID = "elastic_env/WalkInPlace-v0"
