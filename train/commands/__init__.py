"""The commands of `elastic`: a module each, with its options, its help and its work."""
