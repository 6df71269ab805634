"""The commands of `elastic`: a module for each, with its options, help and work."""
