"""Benchmarks of the vector environments; not part of `make test`, see `make bench`."""
