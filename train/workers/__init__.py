"""Calls beside this program: in processes of this machine, on a dask cluster, as jobs of Slurm."""
