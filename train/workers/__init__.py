"""Calls in workers: processes of this machine, a dask cluster, or jobs of Slurm."""
